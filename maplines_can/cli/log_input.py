"""Logs and buses as input of a command: ``--times``, their DBC, and why nothing is received."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import get_args

from ..bus import LogSummary
from ..logs.first_frames import FirstFrames
from ..logs.log_summary import Times, skipped_text
from ..values.errors import LogError
from ..wire import SHIPPED, LineCodec
from .parsing import option_group
from .stderr import note


def add_times(parser: argparse.ArgumentParser) -> None:
    """Add ``--times``."""
    option_group(parser, "message").add_argument(
        "--times",
        choices=get_args(Times),
        default="auto",
        help="kind of the time stamps of a text log: absolute, zero (from the start of the log) or "
        "delta (from the frame before); by default auto, by the header or the first rows",
    )


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
    also = f"; {', '.join(fit.name for fit in others)}: {others[0].intact} frames" if others else ""
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
