"""Logs and buses as input of a command: their times, DBC and parts, and why nothing is received."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from ..bus import Link, LogFrame, LogSummary
from ..logs.first_frames import FirstFrames
from ..logs.log_part import ALL, Time, time_of
from ..logs.log_summary import Times, skipped_text
from ..values.arrays import count_text
from ..values.errors import LogError
from ..wire import SHIPPED, Decoder, LineCodec, Reason
from .command_line import note, option_group
from .output import counts_text


def add_times(parser: argparse.ArgumentParser) -> None:
    """Add ``--times``."""
    option_group(parser, "message").add_argument(
        "--times",
        choices=get_args(Times),
        default="auto",
        help="kind of the time stamps of a text log: absolute, zero (from the start of the log) or "
        "delta (from the frame before); by default auto, by the header or the first rows",
    )


def add_part(parser: argparse.ArgumentParser, *, channel: bool = True) -> None:
    """Add ``--time``, and ``--channel`` where no bus has that."""
    add = option_group(parser, "message").add_argument
    add(
        "--time",
        type=time_range,
        default=ALL,
        metavar="FROM..TO",
        help="lines of this time only [s], from the first line on, such as 10..20 or 30.., or of "
        "the clock of the log (more than 1e8); what is before is decoded, too",
    )
    if channel:
        add("--channel", metavar="NAME", help="frames of this channel of the log only")


def time_range(text: str) -> Time:
    """Return the time of ``--time``."""
    try:
        return time_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def choose_dbc(arguments: argparse.Namespace) -> None:
    """Replace ``--dbc auto``, or a folder of DBCs, by the DBC that fits a log best.

    Raises:
        LogError: no DBC fits, or the log is a stream.
    """
    wanted = arguments.dbc
    if wanted is None or (wanted != "auto" and not Path(wanted).is_dir()):
        return
    from ..recordings.data_set import logs_of
    from ..recordings.fitting import best_fit, fits

    if "-" in arguments.logs:
        raise LogError(f"--dbc {wanted} reads the begin of a log twice; give a file, or the DBC")
    log = logs_of(arguments.logs)[0]
    dbcs = SHIPPED if wanted == "auto" else [*map(str, sorted(Path(wanted).glob("*.dbc")))]
    found = fits(log, dbcs, arguments.encoding, times=arguments.times)
    best = best_fit(found, log, times=arguments.times)
    others = [fit for fit in found if fit is not best and fit.records]
    also = (
        f"; {', '.join(fit.name for fit in others)}: {count_text(others[0].intact, 'frame')}"
        if others
        else ""
    )
    note(f"--dbc {wanted}: {best}{also}")
    arguments.dbc = best.codec.layout.source


def note_log(log: str, summary: LogSummary) -> None:
    """Print what was assumed about a log, and how many of its records are no data frames."""
    for notice in summary.notices:
        note(f"{log}: {notice}")
    if skipped := skipped_text(summary.skipped):
        note(f"{log}: skipped: {skipped}")


def check_received(
    log: str,
    first: FirstFrames,
    codec: LineCodec,
    summary: LogSummary,
    *,
    has_failed: bool = False,
) -> None:
    """Say why neither a line nor a pose error was received of a log.

    Args:
        log: its name.
        first: frames of it.
        codec: of the lines.
        summary: of the log.
        has_failed: whether an error of the log has been printed, which the reason follows.

    Raises:
        LogError: with the reason, unless there was an error, or options of the command leave out
            what there is.
    """
    from ..recordings.fitting import misfit

    why = misfit(first, [codec], summary)
    if not (why.is_left_out or has_failed):
        raise LogError(f"{log}: {why.text}")
    note(f"{log}: {why.text}")


class ObservedLink(Link):
    """Link that receives frames of all CAN IDs until the first line; they tell which DBC fits.

    Args:
        decoder: of the lines.
        opener: of the interface, as for ``Link``.
        settings: as for ``Link``.
    """

    def __init__(self, decoder: Decoder, opener: Any = None, **settings: Any) -> None:
        super().__init__(opener, **settings)
        self.first = FirstFrames()
        self._decoder: Decoder | None = decoder

    def recv(self, timeout: float) -> Any:
        """Return the next frame, as ``Link.recv``."""
        message = super().recv(timeout)
        if self._decoder is None or message is None:
            return message
        if self._decoder.lines:
            self.accept_only(self._decoder.can_ids)
            self._decoder = None
        elif not (message.is_error_frame or message.is_remote_frame):
            self.first.add(
                LogFrame(
                    message.arbitration_id,
                    bytes(message.data),
                    round(message.timestamp * 1e9),
                    message.is_extended_id,
                    "",
                    has_time=True,
                )
            )
        return message


def why_silent(
    link: ObservedLink, codec: LineCodec, counts: Mapping[Reason, int], *, fd: bool
) -> str:
    """Return what to check if no line has arrived.

    Args:
        link: on which it was to come.
        codec: of the lines.
        counts: dropped frames by reason.
        fd: whether the interface is for CAN FD.
    """
    from ..recordings.fitting import misfit

    if not link.first.frames:
        return (
            "no frame has arrived; check that the sender runs, on the same --interface and "
            "--channel" + ("" if fd else ", and whether it sends CAN FD (--fd)")
        )
    dropped = counts_text({reason.name: n for reason, n in counts.items()})
    return (
        f"frames have arrived, but none completed a line (dropped: {dropped}); "
        f"{misfit(link.first, [codec]).text}"
    )
