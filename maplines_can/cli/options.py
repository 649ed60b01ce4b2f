"""Options that several jobs have, each group beside what is made of it."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from ..bus import key_from_env, key_from_file
from ..bus.keys import without_keys
from ..propagation import MapError
from ..scenarios import SCENARIOS
from ..wire import CODES, Authenticator, Codec, Decoder, Key, Layout
from .arguments import number
from .sending import MAX_LOAD

if TYPE_CHECKING:
    from ..testing import Faults, FaultyOpener

__all__ = [
    "Parser",
    "add_bus",
    "add_codec",
    "add_cycle",
    "add_dbc",
    "add_draws",
    "add_job",
    "add_json",
    "add_sending",
    "bus_settings",
    "codec_from",
    "decoder_of",
    "fault_counts",
    "fault_opener",
    "keyed_codec",
    "map_error",
    "natural",
    "seconds",
    "sending",
]

natural = number(int, 1, 10**9)
seconds = number(float, 1e-3, 1e6)


class Parser(argparse.ArgumentParser):
    """A parser, with subparsers of its kind, that does not repeat a key that was typed.

    No option is taken by its beginning: ``--key`` is none.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)

    def error(self, message: str) -> NoReturn:
        """End with usage and message, but for what may be a key in it."""
        super().error(without_keys(message))


def add_job(
    jobs: Any, name: str, run: Callable[[argparse.Namespace], int], about: str, example: str
) -> argparse.ArgumentParser:
    """Add a job to the subparsers of ``maplines``; returns its parser.

    Args:
        jobs: what ``ArgumentParser.add_subparsers`` returned.
        name: of the job.
        run: takes the parsed arguments and returns the exit status.
        about: what the job does, in a sentence.
        example: a command.
    """
    parser: argparse.ArgumentParser = jobs.add_parser(
        name,
        help=about,
        description=about,
        epilog=f"example: {example}",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def add_json(parser: argparse.ArgumentParser) -> None:
    """``--json``."""
    parser.add_argument("--json", action="store_true", help="for machines")


# ---- what is sent -----------------------------------------------------------------------


def add_sending(parser: argparse.ArgumentParser) -> None:
    """Which lines are sent, how often and as what."""
    add = parser.add_argument
    add("--scenario", default="highway", choices=list(SCENARIOS), help="the scene")
    add("--lines", type=number(int, 1, 8), default=4, metavar="N", help="1 to 8 lines")
    add("--rate", type=number(float, 1e-3, 1000), default=20.0, help="lines of each slot a second")
    add(
        "--components",
        type=number(int, 1, 8, "auto"),
        default=1,
        metavar="K",
        help="send each line as a Gaussian mixture of so many parts; auto: of as many as its "
        "bend asks for and the bus allows",
    )
    add(
        "--max-load",
        type=number(float, 1e-3, 1),
        metavar="SHARE",
        help=f"most of the bus's time that the lines may take; for auto {MAX_LOAD:g}",
    )
    add(
        "--map-error",
        type=number(float, 1e-6, 100),
        metavar="SIGMA",
        help="error of the map's points and of their common offset [m], beside the pose's",
    )


def sending(arguments: argparse.Namespace) -> dict[str, Any]:
    """How the lines are sent, for ``choose_components`` and ``round_trip``."""
    names = ("lines", "components", "max_load", "rate", "fd")
    settings = {name: getattr(arguments, name) for name in names}
    return settings | {"bitrate": arguments.bitrate or 500_000}


def map_error(arguments: argparse.Namespace) -> MapError | None:
    """The error of the map, if there is one."""
    if not arguments.map_error:
        return None
    return MapError(arguments.map_error, arguments.map_error, np.radians(0.05))


# ---- the bus ----------------------------------------------------------------------------


def add_bus(parser: argparse.ArgumentParser, interface: str | None = None) -> None:
    """Which bus, and how it is spoiled; ``interface`` is the one that is not asked for."""
    add = parser.add_argument
    add(
        "--interface",
        default=interface,
        help="python-can interface, such as virtual, socketcan, udp_multicast; "
        "without it, python-can's own configuration",
    )
    add("--channel", help="channel of the interface, such as vcan0")
    add("--bitrate", type=natural, help="[bit/s]")
    add("--fd", action="store_true", help="CAN FD: one frame of 32 bytes a line")
    add(
        "--faults",
        type=_faults,
        metavar="SPEC",
        help="spoil the bus by rates: loss=0.1,dup=0.05,reorder=0.05,corrupt=0.02,seed=7; also "
        "late=0.1,delay=0.02,jitter=0.01 [s]; garbage=0.01; flood=1000,flood_ids=0x340+0 "
        "[1/s]; or by a script, script=FILE, with lines such as 'loss 3' and 'flip 20-29 3'; a "
        "wrong key is answered with the right ones",
    )


def bus_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Settings of ``Link``; what is not given is left to python-can's own configuration."""
    names = ("interface", "channel", "bitrate")
    settings = {name: getattr(arguments, name) for name in names}
    settings = {name: value for name, value in settings.items() if value is not None}
    return settings | ({"fd": True} if arguments.fd else {})


def fault_opener(arguments: argparse.Namespace) -> FaultyOpener | None:
    """Return the opener of ``--faults`` for ``Link``; None without faults."""
    if arguments.faults is None:
        return None
    from ..testing import FaultyOpener

    return FaultyOpener(arguments.faults)


def fault_counts(opener: FaultyOpener | None) -> dict[str, int]:
    """Return what the faults did so far; empty without faults."""
    return {} if opener is None else opener.as_dict()


def _faults(text: str) -> Faults:
    from ..testing import Faults

    try:
        return Faults.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


# ---- the codec --------------------------------------------------------------------------


def add_dbc(parser: argparse.ArgumentParser) -> None:
    """``--dbc``."""
    parser.add_argument("--dbc", help="another DBC than the project's own")


def add_codec(parser: argparse.ArgumentParser) -> None:
    """Keys and DBC, for ``keyed_codec``."""
    parser.add_argument(
        "--key-file",
        action="append",
        dest="keys",
        type=_key_from(key_from_file),
        metavar="[ID:]FILE",
        help="authenticate (AUTOSAR SecOC, CAN FD only) with the key whose 32 or 64 hex digits "
        "are in this file, number 1 if no other is given; the first key is sent with, all are "
        "accepted",
    )
    parser.add_argument(
        "--key-env",
        action="append",
        dest="keys",
        type=_key_from(key_from_env),
        metavar="[ID:]NAME",
        help="the same, from an environment variable",
    )
    add_dbc(parser)


def keyed_codec(
    arguments: argparse.Namespace,
    *,
    clock: Callable[[], int] | None = time.time_ns,
    window: float = 1.0,
) -> Codec:
    """The codec of the DBC, with the keys if there are any.

    Args:
        arguments: of a job with ``add_codec``.
        clock: for the freshness of authenticated frames [ns]; None for a log, which is as old
            as it is.
        window: how far a frame's time may be from the clock [s].
    """
    keys = [read(name, key_id) for read, name, key_id in arguments.keys or ()]
    if not keys:
        return codec_from(arguments.dbc)
    authenticator = Authenticator(*keys, clock=clock, window_ns=round(1e9 * window))
    return codec_from(arguments.dbc, authenticator)


def codec_from(path: str | None, authenticator: Authenticator | None = None) -> Codec:
    """Return the codec of a DBC; the study's codes are imported only if the DBC names one.

    Raises:
        LayoutError: see ``Codec.from_dbc``.
    """
    if path is None:
        return Codec.from_dbc(None, authenticator)
    layout = Layout.from_dbc(path)
    if layout.covariance_code in CODES:
        return Codec(layout, authenticator)
    from ..study.codes import CODES as STUDY_CODES

    return Codec(layout, authenticator, STUDY_CODES)


def _key_from(read: Callable[[str, int], Key]) -> Callable[[str], tuple[Any, str, int]]:
    """A type for argparse: where a key is, after its number if that is not 1."""

    def parse(text: str) -> tuple[Any, str, int]:
        key_id, colon, name = text.partition(":")
        numbered = colon and key_id.isdecimal() and len(key_id) <= 3  # longer ones may be a key
        return (read, name, int(key_id)) if numbered else (read, text, 1)

    return parse


def add_cycle(parser: argparse.ArgumentParser) -> None:
    """How often lines come, for ``decoder_of``."""
    parser.add_argument(
        "--cycle-ms",
        type=number(float, 1, 60_000),
        metavar="MS",
        help="how often the sender sends each line [ms], such as 500 for --rate 2: by this cycles "
        "without data are progress_bar and slots judged; by default what the DBC states, 50 in the "
        "project's own",
    )


def decoder_of(codec: Codec, arguments: argparse.Namespace) -> Decoder:
    """A receiver's state, for lines that come as often as is said."""
    return codec.decoder(cycle_ms=arguments.cycle_ms)


# ---- random draws -----------------------------------------------------------------------


def add_draws(parser: argparse.ArgumentParser, samples: int) -> None:
    """``--seed`` and ``--samples``; so many samples unless others are asked for."""
    parser.add_argument("--seed", type=number(int, 0, 2**32), default=0, help="of the draws")
    parser.add_argument(
        "--samples", type=number(int, 1000, 10**7), default=samples, help="Monte Carlo draws"
    )
