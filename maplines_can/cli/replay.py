"""The command ``maplines replay``."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..bus import Link
from ..logs.first_frames import CanId, ids_text
from ..logs.frame_block import FrameBlock
from ..logs.log_part import ALL
from ..logs.log_summary import skipped_text
from ..values.errors import BusError, LogError
from ..values.line import Slot
from ..wire import SHIPPED, Layout
from .command_line import add_command, add_json, natural, note, number, option_group
from .frame_source import add_times, time_range
from .options import (
    add_bus,
    add_dbc,
    add_faults,
    bus_settings,
    fault_counts,
    fault_opener,
    layout_from,
)
from .output import faults_text

if TYPE_CHECKING:
    from ..bus.replay import Plan, ReplayStats

#: Frames that are read at a time: reading more would hold up the sending.
BLOCK_FRAMES = 4096
#: Words of --only for all CAN IDs of the DBCs, and for all others.
LINES, OTHERS = "lines", "others"

DESCRIPTION = f"""\
Send the frames of a log on a bus at the times at which they were recorded. Then print how late they
were, and how many frames the bus did not take.

Nothing is sent twice by two senders: --only chooses the messages that this command sends, so that
those which a device on the bus sends itself are left out. It takes CAN IDs and ranges (0x340-0x347,
with an x behind those of 29 bits), names of slots and messages (ego-left, pose, EgoLeft), '{LINES}'
for all messages of the DBCs, and '{OTHERS}' for all but these. Before it begins, the command
listens for twice the longest period of its messages, at most 1 s, and ends with an error if one of
their CAN IDs is alive, unless --force is given.

A frame is of CAN FD if one of its CAN ID in the log has more than 8 bytes, or if its message is in
the DBC (--dbc, or those of this package); that needs --fd. Error and remote frames are not sent.
The freshness of an authenticated frame is that of its recording: receivers drop it as too old."""


def add_replay(commands: Any) -> None:
    """Add the command ``replay``."""
    example = (
        "maplines replay drive.blf --interface socketcan --channel vcan0 --only ego-left,pose\n"
        "         maplines replay drive.blf --interface socketcan --channel vcan0 --loop --speed 2"
    )
    parser = add_command(commands, "replay", _replay, DESCRIPTION, example)
    parser.add_argument("log", metavar="LOG", help="log file, as for 'decode'")
    add_bus(parser)
    add_dbc(parser)
    add_times(parser)
    add = option_group(parser, "bus").add_argument
    pace = option_group(parser, "bus").add_mutually_exclusive_group()
    pace.add_argument(
        "--speed",
        type=number(float, 0.01, 1000),
        default=1.0,
        metavar="FACTOR",
        help="how much faster than recorded, such as 0.1 or 10 (default: 1)",
    )
    pace.add_argument(
        "--as-fast-as-possible",
        action="store_true",
        help="do not wait for the recorded times: the bus sets the pace",
    )
    add(
        "--loop",
        type=natural,
        nargs="?",
        default=1,
        const=None,
        metavar="N",
        help="send the log N times, or without N until Ctrl-C; counters of lines jump where it "
        "begins again (default: once)",
    )
    add("--force", action="store_true", help="send CAN IDs that are alive on the bus, too")
    _add_choice(parser)
    add_faults(parser)
    add_json(parser, "the counters")


def _add_choice(parser: argparse.ArgumentParser) -> None:
    """Add what is sent of the log."""
    chosen = option_group(parser, "message").add_argument
    chosen(
        "--only",
        type=_only,
        metavar="WHAT,...",
        help=f"these frames only: CAN IDs, ranges, slots, names of messages, {LINES}, {OTHERS}",
    )
    chosen(
        "--time",
        type=time_range,
        default=ALL,
        metavar="FROM..TO",
        help="this part only [s], from the first frame on, such as 10..20 or 30..",
    )
    chosen("--log-channel", metavar="NAME", help="the frames of this channel of the log")


def _replay(arguments: argparse.Namespace) -> int:
    from ..bus.replay import Choice, Replay, planned
    from ..recordings.log_contents import names_of

    if arguments.log == "-":
        raise ValueError("a replay reads the log twice, first what it has; give a file")
    names = SHIPPED if arguments.dbc is None else [arguments.dbc]
    layouts = [layout_from(name, arguments.encoding) for name in names]
    has_key = None if arguments.only is None else partial(_has_key, _spans(arguments.only, layouts))
    reading = _Reading(arguments)
    choice = Choice(arguments.log_channel, arguments.time, has_key)

    def blocks() -> Iterator[FrameBlock]:
        return choice.of(reading.blocks())

    fd_keys = {one.key for one, own in names_of(layouts).items() if own.frame != "classic"}
    try:
        plan = planned(blocks(), frozenset(fd_keys))
    except LogError as error:
        raise LogError(f"{arguments.log}: {error}{reading.hint(arguments)}") from None
    _check(plan, arguments)
    opener = fault_opener(arguments)
    with Link(opener, **bus_settings(arguments)) as link:
        speed = math.inf if arguments.as_fast_as_possible else arguments.speed
        replay = Replay(link, plan, speed=speed)
        if not arguments.force and (alive := replay.alive()):
            raise BusError(_alive_text(link.name, alive, layouts))
        if not arguments.json:
            note(_start_text(plan, link.name, arguments))
        with suppress(KeyboardInterrupt):
            replay.run(blocks, arguments.loop)
        stats, faults = replay.stats(), fault_counts(opener)
    skipped = {str(kind): n for kind, n in reading.skipped.items()}
    if arguments.json:
        rest = {"skipped": skipped, "outages": link.outages}
        print(json.dumps(stats.as_dict() | rest | ({"faults": faults} if faults else {})))
    else:
        print("\n".join(_rows(stats, skipped_text(reading.skipped), faults)))
    return int(reading.is_damaged)


class _Reading:
    """Readings of a log, of which each damage is told once."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._log, self._times = arguments.log, arguments.times
        self.is_damaged = False
        self.skipped: Mapping[Any, int] = {}
        self.channels: tuple[str, ...] = ()

    def blocks(self) -> Iterator[FrameBlock]:
        """Yield the frames that are intact."""
        from ..recordings.blocks import read_blocks

        blocks = read_blocks(self._log, block_frames=BLOCK_FRAMES, times=self._times)
        self.skipped, has_frames = blocks.summary.skipped, False
        try:
            for block in blocks:
                has_frames, self.channels = True, block.channels
                yield block
        except LogError as error:
            if not has_frames:
                raise
            if not self.is_damaged:
                note(f"error: {error}")
            self.is_damaged = True

    def hint(self, arguments: argparse.Namespace) -> str:
        """Return which options may leave out all frames, as the end of a sentence."""
        if arguments.log_channel is not None and arguments.log_channel not in self.channels:
            return f"; its channels are {', '.join(self.channels)}, not {arguments.log_channel}"
        return ""


def _check(plan: Plan, arguments: argparse.Namespace) -> None:
    """Raise an error if a plan needs an option."""
    if len(plan.channels) > 1:
        raise LogError(
            f"{arguments.log}: has frames of the channels {', '.join(plan.channels)}; choose one "
            "by --log-channel"
        )
    if not plan.has_time and not arguments.as_fast_as_possible:
        raise LogError(
            f"{arguments.log}: has no time stamps; give --as-fast-as-possible, or take it again "
            "with candump -L"
        )


#: A range of keys of CAN IDs.
_Span = tuple[int, int]


def _only(text: str) -> tuple[str | _Span, ...]:
    """Return the ranges and names of ``--only``.

    >>> _only("0x340-0x347,0x18ff00,ego-left")
    ((832, 839), (538509056, 538509056), 'ego-left')
    """
    return tuple(_span(part.strip()) or part.strip() for part in text.split(","))


def _span(text: str) -> _Span | None:
    """Return the range of keys that a text names; None if it is a name."""
    low, _, high = text.partition("-")
    try:
        ends = [_number(one) for one in (low, high or low)]
    except ValueError:
        return None
    if ends[0] > ends[1] or ends[0] >> 29 != ends[1] >> 29:
        raise argparse.ArgumentTypeError(f"{text}: must be from a CAN ID to a greater one")
    return ends[0], ends[1]


def _number(text: str) -> int:
    """Return the key of a CAN ID as text; one of more than 11 bits is of 29 bits.

    >>> _number("0x340"), _number("832"), CanId.of_key(_number("0x340x"))
    (832, 832, CanId(number=832, is_extended=True))
    """
    bare = text.removesuffix("x")
    value = int(bare, 0)
    if not 0 <= value < 1 << 29:
        raise argparse.ArgumentTypeError(f"{text}: a CAN ID has 29 bits at most")
    return CanId(value, value > 0x7FF or bare != text).key


def _spans(only: Sequence[str | _Span], layouts: Sequence[Layout]) -> list[_Span]:
    """Return the ranges of keys of ``--only``, with those of names.

    Raises:
        ValueError: no DBC has a name.
    """
    named: dict[str, set[int]] = {}
    for layout in layouts:
        for owner, own in layout.messages_of.items():
            slot = owner.name.lower().replace("_", "-") if isinstance(owner, Slot) else owner
            keys = {CanId(*key).key for key in own.ids}
            for name in (slot, own.name.lower(), LINES):
                named.setdefault(name, set()).update(keys)
    spans: list[_Span] = []
    for one in only:
        if not isinstance(one, str):
            spans.append(one)
        elif one.lower() == OTHERS:
            bounds = [-1, *sorted(named[LINES]), 1 << 30]
            spans += [(low + 1, high - 1) for low, high in pairwise(bounds)]
        elif one.lower() in named:
            spans += [(key, key) for key in named[one.lower()]]
        else:
            known = ", ".join([*sorted(named), OTHERS])
            raise ValueError(f"--only {one}: is no CAN ID, such as 0x340, and no name; {known}")
    return spans


def _has_key(spans: Sequence[_Span], keys: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """Return which keys are in one of the ranges."""
    found = np.zeros(len(keys), bool)
    for low, high in spans:
        found |= (keys >= low) & (keys <= high)
    return found


def _alive_text(name: str, alive: Sequence[CanId], layouts: Sequence[Layout]) -> str:
    from ..recordings.log_contents import names_of
    from .output import owner_text

    names = names_of(layouts)
    owners = dict.fromkeys(owner_text(names[one].owner) for one in alive if one in names)
    whose = f" ({', '.join(owners)})" if owners else ""
    return (
        f"{ids_text(alive)}{whose}: another sender on {name} sends this; leave it out by --only, "
        "or stop it; --force sends all the same"
    )


def _start_text(plan: Plan, name: str, arguments: argparse.Namespace) -> str:
    pace = f"{arguments.speed:g} times as fast as recorded"
    if arguments.as_fast_as_possible:
        pace = "as fast as possible"
    elif arguments.speed == 1:
        pace = "as recorded"
    loops = "until Ctrl-C" if arguments.loop is None else f"{arguments.loop} times"
    return (
        f"{plan.frames} frames of {len(plan.can_ids)} CAN IDs, {plan.span:.3f} s, on {name}, {pace}"
        + f", {loops}" * (arguments.loop != 1)
    )


def _rows(stats: ReplayStats, skipped: str, faults: dict[str, int]) -> Iterator[str]:
    """Yield the counters as text."""
    passes = f" in {stats.passes} passes" * (stats.passes > 1)
    yield f"sent {stats.frames} frames in {stats.seconds:.3f} s{passes}"
    if stats.full or stats.down:
        yield (
            f"not taken by the bus: {stats.full} frames with a full queue, {stats.down} while it "
            "was down"
        )
    left_out = [skipped] * bool(skipped)
    left_out += [f"{stats.unfit} frames whose length CAN FD has not"] * bool(stats.unfit)
    if left_out:
        yield f"not sent: {', '.join(left_out)}"
    if faults:
        yield f"faults: {faults_text(faults)}"
    if stats.late_mean == stats.late_mean:
        late = (1e3 * one for one in (stats.late_mean, stats.late_p99, stats.late_max))
        yield "late by {:.3f}, {:.3f}, {:.3f} ms (mean, 99 %, maximum)".format(*late)
    elif stats.seconds:
        yield f"{stats.frames / stats.seconds:.0f} frames a second"
