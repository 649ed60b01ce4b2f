"""The command ``maplines info``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..logs.log_part import ALL
from ..logs.log_summary import skipped_text
from ..wire import SHIPPED, Layout, default_dbc_path
from .command_line import add_command, add_json, note, option_group
from .frame_source import add_times, choose_dbc, time_range
from .options import add_codec, keyed_codec, line_codec_from
from .output import check_text, counts_text, owner_text, pose_errors_text, slot_text

if TYPE_CHECKING:
    from ..logs.spacings import Spacing
    from ..recordings.log_contents import LogContents, LogMessage, Reception

#: Rows of CAN IDs of no DBC in the text.
MAX_FOREIGN = 12
#: Times before this are from the start of the log [ns]: 1973.
MIN_DATE_NS = 10**17

DESCRIPTION = """\
Print what is in log files: span, channels, CAN IDs with their messages, frames, mean period and
largest gap; and by each DBC that fits, the lines of each slot with their E2E states, what was lost,
left out or dropped, and whether two senders sent a slot.

All DBCs of this package name the CAN IDs and receive the lines, or the one of --dbc; authenticated
lines need their key. A gap is the longest time between two frames, or lines; it is at the time from
the first frame on. The period of a message of several frames a line is that of its frames.

The exit status is 1 if a log is damaged; what is intact is printed."""


def add_info(commands: Any) -> None:
    """Add the command ``info``."""
    example = "maplines info drive.blf\n         maplines info --json drives/*.log"
    parser = add_command(commands, "info", _info, DESCRIPTION, example)
    add_codec(parser)
    add_times(parser)
    add = option_group(parser, "message").add_argument
    add(
        "--time",
        type=time_range,
        default=ALL,
        metavar="FROM..TO",
        help="frames of this time only [s], from the first one on, such as 10..20 or 30..",
    )
    add("--channel", metavar="NAME", help="frames of this channel of the log only")
    parser.add_argument(
        "logs", metavar="LOG", nargs="+", help="log file, or - for standard input; as for 'decode'"
    )
    add_json(parser, "a row for each log")


def _info(arguments: argparse.Namespace) -> int:
    from ..recordings.log_contents import contents_of

    choose_dbc(arguments)
    status = 0
    for number, log in enumerate(arguments.logs):
        if arguments.dbc is None and not arguments.keys:
            codecs = [line_codec_from(name) for name in SHIPPED if "secoc" not in name]
            naming = [Layout.from_dbc(default_dbc_path(name)) for name in SHIPPED]
        else:
            codecs, naming = [keyed_codec(arguments, clock=None)], []
        source: Any = sys.stdin.buffer if log == "-" else log
        found = contents_of(
            source,
            codecs,
            naming=naming,
            times=arguments.times,
            time=arguments.time,
            channel=arguments.channel,
        )
        if arguments.json:
            print(json.dumps({"bytes": _size(log)} | found.as_dict()), flush=True)
        else:
            print("\n" * (number > 0) + "\n".join(_rows(found, _size(log))), flush=True)
        if found.damage:
            note(f"error: {found.damage}")
            status = 1
    return status


def _size(log: str) -> int | None:
    return None if log == "-" else Path(log).stat().st_size


def _rows(found: LogContents, size: int | None) -> Iterator[str]:
    """Yield the rows of the text."""
    summary = found.summary
    about = [summary.format, "" if size is None else f"{size / 1e6:.2f} MB"]
    about += [f"{summary.times} times" if summary.times else "no time stamps"]
    yield f"{found.log}: {', '.join(one for one in about if one)}"
    if found.has_time:
        yield f"time      {_span_text(found)}"
    for name, spacing in found.channels.items():
        gap = _gap_text(spacing, found.begin_ns) if found.has_time else ""
        yield f"frames    {spacing.n} on channel {printable(name) or 'without a name'}{gap}"
    if skipped := skipped_text(summary.skipped):
        yield f"skipped   {skipped}"
    for notice in summary.notices:
        yield f"note      {notice}"
    yield from _id_rows(found)
    for one in found.receptions:
        yield from _reception_rows(found, one)
    if found.misfit:
        yield f"lines     {found.misfit}"


def _span_text(found: LogContents) -> str:
    span = (found.end_ns - found.begin_ns) / 1e9
    if abs(found.begin_ns) < MIN_DATE_NS:
        return f"{found.begin_ns / 1e9:.3f} to {found.end_ns / 1e9:.3f} s, {span:.3f} s"
    begin, end = (
        datetime.fromtimestamp(t / 1e9, UTC).isoformat(" ", "milliseconds")[:-6]
        for t in (found.begin_ns, found.end_ns)
    )
    return f"{begin} to {end} UTC, {span:.3f} s"


def _gap_text(spacing: Spacing, begin_ns: int) -> str:
    if spacing.n < 2:
        return ""
    at = (spacing.gap_ns - begin_ns) / 1e9
    return f"; one in {_ms(spacing.period)}, largest gap {_ms(spacing.gap)} at {at:.3f} s"


def printable(text: str) -> str:
    r"""Return a name in a log without what a terminal would obey.

    >>> printable("can\x1b0")
    'can?0'
    """
    return "".join(one if one.isprintable() else "?" for one in text)


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms" if seconds < 10 else f"{seconds:.4g} s"


def _id_rows(found: LogContents) -> Iterator[str]:
    """Yield a row for each CAN ID of a DBC, and for those of no DBC that have most frames."""
    known = [one for one in found.messages if one.name is not None]
    foreign = [one for one in found.messages if one.name is None]
    shown = sorted(foreign, key=lambda one: -one.spacing.n)[:MAX_FOREIGN]
    if known or shown:
        yield f"{'CAN ID':<12}{'frames':>9}{'period':>11}{'gap':>11}{'at':>10}{'bytes':>7}  message"
    many = len(found.channels) > 1
    for one in (*known, *shown):
        yield _id_row(one, found.begin_ns, has_time=found.has_time, has_channel=many)
    if rest := foreign[len(shown) :]:
        frames = sum(one.spacing.n for one in foreign) - sum(one.spacing.n for one in shown)
        yield f"{len(rest)} more CAN IDs of no DBC{frames:>9} frames; --json has them"
    if found.beyond:
        yield f"{found.beyond} frames of yet more CAN IDs"


def _id_row(one: LogMessage, begin_ns: int, *, has_time: bool, has_channel: bool) -> str:
    spacing, name = one.spacing, one.name
    times = [""] * 3
    if has_time and spacing.n > 1:
        at = f"{(spacing.gap_ns - begin_ns) / 1e9:.3f} s"
        times = [_ms(spacing.period), _ms(spacing.gap), at]
    low, high = one.lengths
    length = f"{low}" if low == high else f"{low}-{high}"
    can_id = f"{one.can_id.number:#x}{'x' * one.can_id.is_extended}"
    text = "-"
    if name is not None:
        frame = f", {name.frame}" * (name.frame != "classic")
        text = f"{name.name} ({owner_text(name.owner)}{frame}) of {name.dbc}"
    text += f" on {printable(one.channel)}" * has_channel
    columns = f"{times[0]:>11}{times[1]:>11}{times[2]:>10}{length:>7}"
    return f"{can_id:<12}{spacing.n:>9}{columns}  {text}"


def _reception_rows(found: LogContents, one: Reception) -> Iterator[str]:
    """Yield the rows of what is received by a DBC."""
    yield f"{one.fit}"
    if not one.fit.records:
        return
    result = one.as_dict([*found.channels], found.begin_ns)
    many = len(found.channels) > 1
    for row in result["lines"]:
        yield _line_row(row, has_time=found.has_time, has_channel=many)
    decoders = one.receiver.decoders
    for channel, decoder in decoders.items():
        for owner, stats in decoder.messages(one.receiver.last_ns).items():
            where = f" on {printable(channel)}" * many
            yield f"  {owner_text(owner)}{where} at the end: {check_text(stats)}"
    total = sum(row["count"] for row in result["lines"])
    left_out = f", {result['left_out']} left out by the sender" * bool(result["left_out"])
    yield (
        f"  {total} lines{pose_errors_text(result['pose_errors'])}; {result['lost']} records lost "
        f"by their counters{left_out}; dropped frames: {counts_text(result['rejects'])}"
    )


def _line_row(row: dict[str, Any], *, has_time: bool, has_channel: bool) -> str:
    where = f" on {printable(row['channel'])}" * has_channel
    text = f"  {slot_text(row['slot'])}{where}: {row['count']} lines"
    if has_time and row["period"] is not None:
        text += f", one in {_ms(row['period'])}, largest gap {_ms(row['gap'])}"
        text += f" at {row['gap_at']:.3f} s"
    states: Sequence[str] = [f"{n} {state}" for state, n in row["states"].items()]
    text += f"; {', '.join(states)}"
    return text + f"; TWO SENDERS at {row['two_senders']} lines" * bool(row["two_senders"])
