"""The command ``maplines diff``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from ..wire import LineCodec, SlotStats
from .command_line import add_command, add_json, note, number, option_group
from .decode import distances, slots
from .file_arguments import add_force
from .frame_source import add_part, add_times, choose_dbc, note_log
from .options import add_codec, add_cycle, add_transfer_timeout, keyed_codec
from .output import check_text, counts_text, owner_text, slot_text
from .plot import PICTURES, picture_path

if TYPE_CHECKING:
    from ..recordings.difference import Difference, LoggedLines, Part

#: Lines and parts that the text names.
MAX_ROWS = 10

DESCRIPTION = """\
Compare the lines of two logs: which differ, in what and by how many sigmas; which only one log has;
the E2E states, what was dropped, and the lateral positions at each x of --at.

Lines are the same record if slot and counter are: counters wrap, so the offset of the clocks that
most lines with a like mean vote for is found first, and of lines with one counter the nearest in
time match. Offset, drift and what is left are printed. Names of channels do not matter. Logs with
counters that have nothing in common, as of different DBCs, are matched by their times.

The distance of two means is in sigmas of their difference: by the sum of both covariances, as if
their errors were independent. With --sigma S, means within S sigmas are equal, standard deviations
whose ratio is at most 1 + S, and ranges and ages within a step of the DBC. Frames of other messages
are not compared; scenes are with S = 0: their joint covariances.

With --time, which is that of A, or --slots, only lines and scenes are compared.

The exit status is 0 if the logs are equal, and 1 if they differ or cannot be read."""


def add_diff(commands: Any) -> None:
    """Add the command ``diff``."""
    example = (
        "maplines diff monday.blf tuesday.blf --at 20,40\n"
        "         maplines diff classic.log scenes.log --dbc-b maplines-scene.dbc --sigma 0.5"
    )
    parser = add_command(commands, "diff", _diff, DESCRIPTION, example)
    add_codec(parser)
    option_group(parser, "message").add_argument(
        "--dbc-b", metavar="FILE", help="DBC of the log B, as --dbc (default: that of --dbc)"
    )
    add_cycle(parser)
    add_transfer_timeout(parser)
    add_times(parser)
    add_part(parser)
    option_group(parser, "message").add_argument(
        "--channel-b", metavar="NAME", help="channel of the log B (default: that of --channel)"
    )
    parser.add_argument("a", metavar="A", help="log file, as for 'decode'")
    parser.add_argument("b", metavar="B", help="the other one")
    add = option_group(parser, "output").add_argument
    add(
        "--at",
        type=distances,
        default=(20.0,),
        metavar="X,...",
        help="compare positions at these distances ahead of the car [m] (default: 20)",
    )
    add("--slots", type=slots, metavar="NAME,...", help="these lines only, such as ego-left")
    add(
        "--sigma",
        type=number(float, 0, 1e6),
        default=0.0,
        metavar="S",
        help="lines within S sigmas are equal (default: 0, those with the same values only)",
    )
    add(
        "-o",
        "--out",
        metavar="FILE",
        help=f"draw the differences over time, too: {' '.join(PICTURES)} or .html",
    )
    add_force(parser)
    add_json(parser)


def _diff(arguments: argparse.Namespace) -> int:
    from ..recordings.difference import difference

    out = None if arguments.out is None else picture_path(arguments)
    if arguments.a == arguments.b == "-":
        raise ValueError("standard input is one log: A and B cannot both be -")
    logs = [
        _lines(log, dbc, channel, arguments)
        for log, dbc, channel in (
            (arguments.a, arguments.dbc, arguments.channel),
            (
                arguments.b,
                arguments.dbc_b or arguments.dbc,
                arguments.channel_b or arguments.channel,
            ),
        )
    ]
    found = difference(
        *logs,
        sigma=arguments.sigma,
        at=arguments.at,
        time=arguments.time,
        slots=arguments.slots,
    )
    if arguments.json:
        print(json.dumps(found.as_dict(), indent=2))
    else:
        print("\n".join(_rows(found)))
    if out is not None:
        from ..recordings.plots import write_page, write_picture
        from ..recordings.plots.difference_panels import difference_panels

        write = write_page if out.suffix == ".html" else write_picture
        write(difference_panels(found), f"{logs[0].name}, {logs[1].name}", out)
        note(f"written: {out}")
    damaged = [log.damage for log in logs if log.damage]
    for damage in damaged:
        note(f"error: {damage}")
    return int(bool(damaged) or not found.is_equal)


def _lines(
    log: str, dbc: str | None, channel: str | None, arguments: argparse.Namespace
) -> LoggedLines:
    from ..recordings.difference import LoggedLines

    own = argparse.Namespace(**vars(arguments) | {"dbc": dbc, "logs": [log]})
    choose_dbc(own)
    codec: LineCodec = keyed_codec(own, clock=None)
    found = LoggedLines.of(
        sys.stdin.buffer if log == "-" else log,
        codec,
        cycle_ms=arguments.cycle_ms,
        timeout_ms=arguments.transfer_timeout,
        times=arguments.times,
        channel=channel,
    )
    note_log(log, found.summary)
    return found


def _rows(found: Difference) -> Iterator[str]:
    """Yield the rows of the text."""
    for name, log in (("A", found.a), ("B", found.b)):
        yield f"{name}         {log.name}: {len(log.rows)} lines of {log.layout.source}"
    yield f"aligned   {_alignment_text(found)}"
    yield f"equal     {len(found.alignment.a) - len(found.differing)} lines"
    yield f"differ    {_differs_text(found)}"
    for k in found.differing[:MAX_ROWS].tolist():
        yield f"  {_line_text(found.line_dict(k))}"
    if (more := len(found.differing) - MAX_ROWS) > 0:
        yield f"  {more} more, which differ less; --json has them"
    for of, name in enumerate("AB"):
        parts = found.parts(of)
        total = sum(sum(part.lines.values()) for part in parts)
        yield f"only in {name} {total} lines" + f" in {len(parts)} parts" * (len(parts) > 1)
        yield from (f"  {_part_text(part)}" for part in parts[:MAX_ROWS])
        if (more := len(parts) - MAX_ROWS) > 0:
            yield f"  {more} more parts; --json has them"
    yield from _scene_rows(found)
    yield from _position_rows(found)
    if found.part.is_all:
        yield from _state_rows(found)
    within = f" within {found.sigma:g} sigma" * (found.sigma > 0)
    yield f"the logs {'are equal' if found.is_equal else 'differ'}{within}"


def _alignment_text(found: Difference) -> str:
    result = found.alignment
    if result.method == "nothing":
        return "not at all: no line of one log has a counter and a time as one of the other"
    text = f"{len(result.a)} lines by slot and {result.method}"
    if not result.has_time:
        return f"{text}, in their order, since a log has no time stamps"
    drift = f", drift {1e6 * result.drift:+.2f} ppm" if result.drift else ", no drift"
    median, most = (f"{1e3 * one:.3g}" for one in result.rest)
    return (
        f"{text}; the clock of B is {result.offset:+.6f} s from that of A{drift}; "
        f"the rest is {median} ms (median), {most} ms (99 %)"
    )


def _differs_text(found: Difference) -> str:
    """Return how many matched lines differ in what."""
    n = len(found.differing)
    if not n:
        return "0 lines"
    differs = dict(found.differs)
    mean, covariance = differs.pop("mean"), differs.pop("covariance")
    counts = {"mean": int(mean.sum()), "covariance only": int((covariance & ~mean).sum())}
    counts |= {name: int(one.sum()) for name, one in differs.items()}
    counts = {name.replace("_", " "): count for name, count in counts.items() if count}
    text = f"{n} lines: {', '.join(f'{count} in {name}' for name, count in counts.items())}"
    if mean.any():
        text += f"; the means by up to {found.distance.max():.3g} sigma"
    if covariance.any():
        low, high = found.ratio[:, 0].min(), found.ratio[:, 1].max()
        text += f"; the sigmas of B are {low:.3g} to {high:.3g} times those of A"
    return text


def _line_text(row: Mapping[str, Any]) -> str:
    texts = []
    for name in row["differs"]:
        if name == "mean":
            texts.append(f"mean by {row['distance']:.3g} sigma")
        elif name == "covariance":
            low, high = row["sigma_ratio"]
            texts.append(f"covariance, sigmas {low:.3g} to {high:.3g} times")
        else:
            one, two = (_value_text(value) for value in row[name])
            texts.append(f"{name.replace('_', ' ')} {one}, {two}")
    return (
        f"{row['t']:.3f} s {slot_text(row['slot'])}, counter {row['counter']}: {'; '.join(texts)}"
    )


def _value_text(value: float | str | None) -> str:
    if isinstance(value, str):
        return value
    return "none" if value is None else f"{value:g}"


def _part_text(part: Part) -> str:
    lines = ", ".join(f"{n} {slot_text(slot.name)}" for slot, n in part.lines.items())
    return f"{part.begin:.3f} to {part.end:.3f} s: {lines}"


def _scene_rows(found: Difference) -> Iterator[str]:
    """Yield how scenes differ, if they are compared."""
    scenes = found.scenes
    if scenes is not None:
        times = ", ".join(f"{t:.3f}" for t in scenes.differing[:MAX_ROWS])
        more = ", ..." * (len(scenes.differing) > MAX_ROWS)
        yield (
            f"scenes    {scenes.matched - len(scenes.differing)} equal, {len(scenes.differing)} "
            f"differ{f' (at {times}{more} s)' if times else ''}; {scenes.only_a} only in A, "
            f"{scenes.only_b} only in B"
        )


def _position_rows(found: Difference) -> Iterator[str]:
    for slot, rows in found.positions().items():
        for row in rows:
            yield (
                f"position  {slot_text(slot)} at {row.x:g} m, B - A in {row.lines} lines: mean "
                f"{row.mean:+.4f} m ({row.mean_sigma:+.3f} sigma), largest {row.largest:+.4f} m "
                f"({row.largest_sigma:+.3f} sigma)"
            )


def _state_rows(found: Difference) -> Iterator[str]:
    """Yield states and counters side by side; one row where both are the same."""
    for _, owner, one, two in found.owners:
        name = owner_text(owner)
        if _owner_text(one) == _owner_text(two):
            yield f"state     {name}: {_owner_text(one)}"
        else:
            yield f"state     {name} in A: {_owner_text(one)}"
            yield f"state     {name} in B: {_owner_text(two)}"
    first, second = (counts_text(log.rejects) for log in (found.a, found.b))
    same = f"dropped   {first}, in both"
    yield same if first == second else f"dropped   in A {first}; in B {second}"
    errors = found.a.pose_errors, found.b.pose_errors
    if any(errors):
        yield f"pose      {errors[0]} pose errors in A, {errors[1]} in B"


def _owner_text(stats: SlotStats | None) -> str:
    return "nothing" if stats is None else check_text(stats)
