"""Options that several commands share, each group with the function that uses its values."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..bus import key_from_env, key_from_file
from ..values.errors import LayoutError
from ..wire import (
    CODES,
    SHIPPED,
    Authenticator,
    Codec,
    Decoder,
    Frame,
    Key,
    Layout,
    LineCodec,
    default_dbc_path,
)
from ..wire.protection.secoc import WHOLE_FRESHNESS
from .command_line import natural, number, option_group

if TYPE_CHECKING:
    from ..testing import FaultInjector, Faults, FaultyOpener

#: Port of the page of ``view`` and ``consume``.
PORT = 8340


def add_port(parser: argparse.ArgumentParser) -> None:
    """Add ``--port``."""
    option_group(parser, "output").add_argument(
        "--port",
        type=number(int, 0, 65535),
        default=PORT,
        metavar="N",
        help=f"port of the page; 0 for any that is free (default: {PORT})",
    )


def add_bus(parser: argparse.ArgumentParser, *, private: bool = False) -> None:
    """Add the options of the CAN interface, by default a bus within the process if ``private``."""
    add = option_group(parser, "bus").add_argument
    configured = "the configuration of python-can"
    add(
        "--interface",
        metavar="NAME",
        default="virtual" if private else None,
        help="python-can interface, such as socketcan, virtual or udp_multicast "
        f"(default: {'virtual, within this process' if private else configured})",
    )
    add(
        "--channel",
        metavar="NAME",
        help="channel of the interface, such as vcan0 "
        f"(default: {'one of its own' if private else configured})",
    )
    add(
        "--bitrate",
        type=natural,
        metavar="BITRATE",
        help="nominal bit rate [bit/s], for interfaces that set it, and for the bus load; the data "
        "phase of CAN FD is taken to be 4 times as fast (default for the bus load: 500000)",
    )
    add(
        "--fd",
        action="store_true",
        help="CAN FD: one frame for each line and each pose error, or for a whole scene, instead "
        "of 2 to 5 frames of 8 bytes of classic CAN (implied by a DBC without messages for that, "
        "such as maplines-scene.dbc)",
    )


def bus_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the settings for ``Link``; python-can's configuration supplies those not given."""
    names = ("interface", "channel", "bitrate")
    settings = {name: getattr(arguments, name) for name in names}
    settings = {name: value for name, value in settings.items() if value is not None}
    return settings | ({"fd": True} if arguments.fd else {})


def add_faults(parser: argparse.ArgumentParser) -> None:
    """Add ``--faults``."""
    option_group(parser, "bus").add_argument(
        "--faults",
        type=_faults,
        metavar="SPEC",
        help="inject faults into the frames, for tests; KEY=VALUE joined by commas. Shares of the "
        "frames: loss=0.1 dup=0.05 reorder=0.05 corrupt=0.02 garbage=0.01 late=0.1 (by "
        "delay=0.02 plus up to jitter=0.01 s). Foreign frames per second: flood=1000 with "
        "flood_ids=0x340-0x347. Each of them may have a time in which it is active [s]: "
        "loss=1@2.0-2.6, to the end loss=1@2-, several loss=1@2-3+5-6. Seed: seed=7. Faults of "
        "single frames: script=FILE, with rows such as 'loss 3' or 'flip 20-29 3'",
    )


def fault_opener(arguments: argparse.Namespace) -> FaultyOpener | None:
    """Return the bus factory for ``Link`` that injects ``--faults``; None without faults."""
    if arguments.faults is None:
        return None
    from ..testing import FaultyOpener

    return FaultyOpener(arguments.faults)


def fault_injector(
    arguments: argparse.Namespace, make_frame: Callable[[int, bytes, bool, bool], Any] = Frame
) -> FaultInjector[Any] | None:
    """Return the injector of ``--faults`` into frames that no bus carries; None without faults.

    It gives the same faults as a bus into which the frames are sent. ``make_frame`` makes the
    frames of a flood.
    """
    if arguments.faults is None or arguments.faults.direction == "receive":
        return None
    from ..testing import FaultInjector

    return FaultInjector(arguments.faults, stream="send", make_frame=make_frame)


def fault_counts(opener: FaultyOpener | None) -> dict[str, int]:
    """Return the counters of the injected faults; empty without faults."""
    return {} if opener is None else opener.as_dict()


def _faults(text: str) -> Faults:
    """Argparse type of ``--faults``."""
    from ..testing import Faults

    try:
        return Faults.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def add_dbc(parser: argparse.ArgumentParser, others: str = "") -> None:
    """Add ``--dbc``; ``others`` are DBCs that are not of the package's wire."""
    option_group(parser, "message").add_argument(
        "--dbc",
        metavar="FILE",
        help=f"DBC of the messages; of this package there are {', '.join(SHIPPED)}{others} "
        "(default: maplines.dbc, or with a key maplines-secoc.dbc)",
    )
    add_encoding(parser)


def add_encoding(parser: argparse.ArgumentParser) -> None:
    """Add ``--encoding``."""
    option_group(parser, "message").add_argument(
        "--encoding",
        metavar="NAME",
        help="encoding of the DBCs of this call, such as utf-8, cp1252 or cp936 (default: found, "
        "by a byte order mark, as UTF-8, or as the code page in which all units exist)",
    )


def add_codec(parser: argparse.ArgumentParser) -> None:
    """Add the options for ``keyed_codec``: keys and DBC."""
    add = option_group(parser, "message").add_argument
    add(
        "--key-file",
        action="append",
        dest="keys",
        type=_key_from(key_from_file),
        metavar="[ID:]FILE",
        help="authenticate the lines (AUTOSAR SecOC; implies --fd) with the key in this file, "
        "32 or 64 hex digits. ID is the number of the key, 1 to 255 (default: 1). If repeated, "
        "the first key is used to send and all of them to receive",
    )
    add(
        "--key-env",
        action="append",
        dest="keys",
        type=_key_from(key_from_env),
        metavar="[ID:]NAME",
        help="like --key-file, with the key in an environment variable",
    )
    add_dbc(parser, ", and those of the study, such as maplines-float16.dbc")


def keyed_codec(
    arguments: argparse.Namespace,
    *,
    clock: Callable[[], int] | None = time.time_ns,
    window: float = 1.0,
) -> LineCodec:
    """Return the codec of the DBC, with the keys if there are any.

    A DBC without messages for classic CAN implies ``--fd``. The freshness of a frame is checked
    against the clock [ns], within the window [s]; that of a log is not, so its clock is None. If
    its frames have not all of it, the time stamps of the log complete it.
    """
    keys = [read(name, key_id) for read, name, key_id in arguments.keys or ()]
    authenticator = None
    if keys:
        settings: dict[str, Any] = {"clock": clock, "window_ns": round(1e9 * window)}
        settings |= {} if clock is not None else _clock_of_log(arguments)
        authenticator = Authenticator(*keys, **settings)
    codec = line_codec_from(arguments.dbc, authenticator, arguments.encoding)
    if not codec.layout.has_classic:
        arguments.fd = True
    return codec


def _clock_of_log(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return clock and window for the DBC of a log: its time stamps if they are needed."""
    secured = layout_from(arguments.dbc or "maplines-secoc.dbc", arguments.encoding).secured
    if secured is None or secured.freshness_bytes >= WHOLE_FRESHNESS:
        return {}
    span_us = 1 << 8 * secured.freshness_bytes
    return {"clock": "frames", "window_ns": 1000 * (span_us // 2 - 1)}


def codec_from(
    path: str | None, authenticator: Authenticator | None = None, encoding: str | None = None
) -> Codec:
    """Return the codec of a DBC with a covariance code of the core.

    Raises:
        LayoutError: see ``Codec.from_dbc``.
    """
    if path is None:
        return Codec.from_dbc(None, authenticator)
    return Codec(layout_from(path, encoding), authenticator)


def line_codec_from(
    path: str | None, authenticator: Authenticator | None = None, encoding: str | None = None
) -> LineCodec:
    """Return the codec of any DBC of lines; one with a code of the study imports the study.

    Raises:
        LayoutError: see ``Codec.from_dbc``; or lines with a code of the study have a key.
    """
    if path is None:
        return Codec.from_dbc(None, authenticator)
    layout = layout_from(path, encoding)
    if layout.covariance_code in CODES:
        return Codec(layout, authenticator)
    if authenticator is not None:
        raise LayoutError(
            f"{layout.source}: lines with the covariance code {layout.covariance_code!r} are not "
            "authenticated; take maplines-secoc.dbc, or no key"
        )
    from ..study.comparison import ComparisonCodec

    return ComparisonCodec(layout)


def layout_from(path: str, encoding: str | None = None) -> Layout:
    """Return the layout of a file, or of a DBC of the package or of its study by its name.

    Raises:
        LayoutError: see ``Layout.from_dbc``.
    """
    if Path(path).exists():
        return Layout.from_dbc(path, encoding=encoding)
    if path in SHIPPED:
        return Layout.from_dbc(default_dbc_path(path))
    if path.startswith("maplines-"):
        from ..study.code_dbcs import dbc_named

        if text := dbc_named(path):
            return Layout.from_text(text, path)
    return Layout.from_dbc(path, encoding=encoding)


def _key_from(read: Callable[[str, int], Key]) -> Callable[[str], tuple[Any, str, int]]:
    """Return an argparse type that returns (read, name, key_id)."""

    def parse(text: str) -> tuple[Any, str, int]:
        key_id, colon, name = text.partition(":")
        numbered = colon and key_id.isdecimal() and len(key_id) <= 3  # a longer number may be a key
        return (read, name, int(key_id)) if numbered else (read, text, 1)

    return parse


def add_cycle(parser: argparse.ArgumentParser) -> None:
    """Add ``--cycle-ms``, for ``decoder_of``."""
    option_group(parser, "message").add_argument(
        "--cycle-ms",
        type=number(float, 1, 60_000),
        metavar="MS",
        help="period at which each line is sent [ms], such as 500 for 'send --rate 2'; "
        "used to count cycles without data (default: the cycle time in the DBC, 50 in the one of "
        "this package)",
    )


def add_transfer_timeout(parser: argparse.ArgumentParser) -> None:
    """Add ``--transfer-timeout``, for ``decoder_of``."""
    option_group(parser, "message").add_argument(
        "--transfer-timeout",
        type=number(float, 0.001, 3_600_000),
        metavar="MS",
        help="longest time between the frames of one transfer [ms]. A longer one receives more "
        "lines if the sender or receiver is held up; but if it exceeds the time after which "
        "transfer IDs repeat, only the counter and the checksum distinguish frames of two lines "
        "(default: 1.5 cycles with the DBC of this package, 75 at 20 Hz; less if transfer IDs "
        "repeat sooner)",
    )


def decoder_of(codec: LineCodec, arguments: argparse.Namespace) -> Decoder:
    """Return a new decoder for ``--cycle-ms`` and ``--transfer-timeout``."""
    return codec.decoder(cycle_ms=arguments.cycle_ms, timeout_ms=arguments.transfer_timeout)


def add_scenes(options: Any) -> None:
    """Add ``--scenes`` to a group of options."""
    options.add_argument(
        "--scenes",
        action="store_true",
        help="JSON: print a row for each scene, too, that is for the lines of one pose error, with "
        "their joint covariance, and with the width and the centre of the ego lane. It has the key "
        '"scene" where the row of a line has "slot"',
    )


def check_scenes(codec: LineCodec, arguments: argparse.Namespace) -> None:
    """Raise ValueError if ``--scenes`` is given and the DBC has none."""
    if arguments.scenes and codec.layout.pose is None:
        raise ValueError(
            f"--scenes: {codec.layout.source} has no message of the pose error (MapLinePose), so "
            "there are no scenes; leave it out, or take the --dbc of the sender"
        )


def add_draws(parser: argparse.ArgumentParser, samples: int) -> None:
    """Add ``--seed`` and ``--samples``, with this number of samples by default."""
    add = option_group(parser, "scenario").add_argument
    add(
        "--seed",
        type=number(int, 0, 2**32),
        default=0,
        help="seed of the random samples (default: 0)",
    )
    add(
        "--samples",
        type=number(int, 1000, 10**7),
        default=samples,
        metavar="N",
        help="number of Monte Carlo samples, 1000 to 1e7 (default: %(default)s)",
    )
