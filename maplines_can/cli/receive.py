"""The command ``maplines receive``."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import Any

from ..bus import Receiver, ReceiverStats
from ..values.arrays import count_text
from ..values.line import MapLine
from ..wire import E2EState, LineCodec, Owner, SceneView, SlotStats
from .command_line import add_command, add_json, natural, note, option_group, seconds
from .frame_source import ObservedLink, why_silent
from .options import (
    add_bus,
    add_codec,
    add_cycle,
    add_faults,
    add_scenes,
    add_transfer_timeout,
    bus_settings,
    check_scenes,
    decoder_of,
    fault_counts,
    fault_opener,
    keyed_codec,
)
from .output import (
    check_dict,
    check_text,
    counts_text,
    faults_text,
    is_another_scene,
    left_out_text,
    line_dict,
    line_text,
    lost_text,
    owner_text,
    pose_errors_text,
    scene_dict,
    scene_text,
)

#: Time without a line after which the reason is printed, once [s].
SILENCE = 2.0
#: How often slots are checked for a change of state while nothing arrives [s].
CHECK_PERIOD = 0.05

DESCRIPTION = """\
Print the lines that arrive on a bus until Ctrl-C. Standard error shows when the end-to-end (E2E)
state of a slot changes and, at the end, how many frames were dropped and why; and after two seconds
without a line, what to check.

A slot is in the state INIT until enough lines have come in sequence, and then in VALID. It becomes
INVALID after too many errors, or if its lines stop: "no data any more".

If the sender states the error of the pose from which the lines of a cycle are seen, the pose error
has such a state, too, and a row in each cycle gives the width and the centre of the ego lane, with
their standard deviations from the joint covariance of the lines."""

#: Lines that may wait to be printed: what comes is to be printed late rather than not at all.
WAITING = 4096


def add_receive(commands: Any) -> None:
    """Add the command ``receive``."""
    example = "maplines receive --interface socketcan --channel vcan0 --json"
    parser = add_command(commands, "receive", _receive, DESCRIPTION, example)
    add_bus(parser)
    add_codec(parser)
    add_cycle(parser)
    add_transfer_timeout(parser)
    option_group(parser, "message").add_argument(
        "--freshness-window",
        type=seconds,
        default=1.0,
        metavar="S",
        help="with a key, largest difference of the time in a frame and the clock of this "
        "machine [s] (default: 1)",
    )
    output = option_group(parser, "output")
    output.add_argument(
        "--count", type=natural, metavar="N", help="stop after N lines (default: no limit)"
    )
    output.add_argument(
        "--timeout",
        type=seconds,
        metavar="S",
        help="stop when no line arrives for this time [s]; the exit status is 1 if none arrived "
        "at all (default: never)",
    )
    add_faults(parser)
    add_json(parser, "each line")
    add_scenes(output)


def _receive(arguments: argparse.Namespace) -> int:
    codec = keyed_codec(arguments, window=arguments.freshness_window)
    check_scenes(codec, arguments)
    if arguments.scenes and not arguments.json:
        raise ValueError("--scenes needs --json; as text, the ego lane of scenes is printed anyway")
    opener = fault_opener(arguments)
    decoder = decoder_of(codec, arguments)
    with (
        ObservedLink(decoder, opener, **bus_settings(arguments)) as link,
        Receiver(link, decoder, can_ids=None, queue_size=WAITING) as receiver,
    ):
        if not arguments.json:
            note(f"listening on {link.name}; stop with Ctrl-C")
        has_scenes = codec.layout.pose is not None and (arguments.scenes or not arguments.json)
        why = partial(_why_nothing, link, codec, fd=arguments.fd)
        left = _print_lines(receiver, has_scenes, why, arguments)
        stats, faults, owners = receiver.stats(), fault_counts(opener), receiver.messages()
    _note_stats(stats, codec)
    for owner, check in owners.items():
        note(f"{owner_text(owner)}: {check_text(check)}")
    if faults:
        note(f"faults: {faults_text(faults)}")
    if not stats.lines:
        note(f"error: nothing received: {why(stats)}")
        return 1
    return 0 if left in (None, 0) else 1


def _print_lines(
    receiver: Receiver,
    has_scenes: bool,
    why: Callable[[ReceiverStats], str],
    arguments: argparse.Namespace,
) -> int | None:
    """Print lines and scenes as they arrive; return how many of ``--count`` are left."""
    left = arguments.count
    scene: SceneView | None = None  # the newest, to which late lines may come
    with suppress(KeyboardInterrupt):
        for line, check in _arriving(receiver, why, arguments):
            if has_scenes:
                now = receiver.latest_scene()
                if scene is not None and is_another_scene(now, scene):
                    _print_scene(scene, receiver, arguments)
                if not arguments.json:
                    _note_left_out(now, scene)
                scene = now
            if arguments.json:
                row = line_dict(line, receiver.latest(line.slot)) | {"e2e": check_dict(check)}
                print(json.dumps(row), flush=True)
            else:
                print(line_text(line), flush=True)
            left = None if left is None else left - 1
            if left == 0:
                break
    if scene is not None:
        _print_scene(scene, receiver, arguments)
    return left


def _note_stats(stats: ReceiverStats, codec: LineCodec) -> None:
    dropped = {reason.name: n for reason, n in stats.counts.items()}
    note(
        f"{count_text(stats.lines, 'line')}{pose_errors_text(stats.pose_errors)} from "
        f"{count_text(stats.frames, 'frame')}; "
        f"{lost_text(stats.lost, scenes=codec.layout.scene is not None)}; "
        f"dropped frames: {counts_text(dropped)}; "
        f"{stats.pending} still waiting for other frames of their line"
        + "".join(
            f"; {count_text(n, noun)}{why}"
            for n, noun, why in (
                (stats.error_frames, "error frame", ""),
                (stats.remote_frames, "remote frame", ""),
                (stats.overflowed, "line", " dropped before being fetched"),
            )
            if n
        )
    )


def _print_scene(scene: SceneView, receiver: Receiver, arguments: argparse.Namespace) -> None:
    """Print a scene as a row of JSON; or its ego lane as a row of text, if it has one."""
    if scene.received is None:
        return
    if arguments.json:
        check = receiver.pose_error()
        row = scene_dict(scene) | ({} if check is None else {"e2e": check_dict(check)})
        print(json.dumps(row), flush=True)
    elif text := scene_text(scene):
        print(text, flush=True)


def _note_left_out(scene: SceneView, before: SceneView | None) -> None:
    """Print which lines a scene leaves out, if it is not as in the scene before."""
    now, then = (
        {} if one is None or one.scene is None else one.scene.left_out for one in (scene, before)
    )
    if now != then:
        note(left_out_text(now) if now else "no line is left out any more")


def _why_nothing(link: ObservedLink, codec: LineCodec, stats: ReceiverStats, *, fd: bool) -> str:
    """Return what to check if no line has arrived."""
    if stats.pose_errors:
        return f"{count_text(stats.pose_errors, 'pose error')} arrived, but no line"
    return why_silent(link, codec, stats.counts, fd=fd)


def _arriving(
    receiver: Receiver, why: Callable[[ReceiverStats], str], arguments: argparse.Namespace
) -> Iterator[tuple[MapLine, SlotStats]]:
    """Yield lines with the checks of their slots; print each change of a state.

    Print why there is nothing if no line arrives within ``SILENCE`` from the start.
    """
    states: dict[Owner, tuple[E2EState, bool]] = {}
    timeout: float | None = arguments.timeout
    last = start = time.monotonic()
    is_silent = True  # and that has not been said
    while True:
        line = receiver.get(CHECK_PERIOD if timeout is None else min(CHECK_PERIOD, timeout))
        for owner, check in receiver.messages().items():
            state = check.state, check.two_senders
            if states.get(owner) != state:
                states[owner] = state
                note(f"{owner_text(owner)}: {check_text(check)}")
        if line is not None:
            last, is_silent = time.monotonic(), False
            yield line, receiver.slots()[line.slot]
            continue
        if is_silent and time.monotonic() - start >= SILENCE:
            is_silent = False
            note(f"no line for {SILENCE:g} s: {why(receiver.stats())}")
        if timeout is not None and time.monotonic() - last >= timeout:
            note(f"no line for {timeout:g} s")
            return
