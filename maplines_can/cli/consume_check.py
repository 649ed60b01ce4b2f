"""The command ``maplines consume check``."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from ..consumers.plausibility import Check, Outcome, PlausibilityCheck
from ..consumers.residual_filter import SLOW, CameraNoise
from ..propagation import Motion
from ..simulation.camera import CameraAtReportedPose
from ..values.line import MapLine, Slot
from .consume_camera import COLUMNS, NewLines, add_camera, camera_of, check_camera
from .consume_input import PERIOD, ConsumerCycle, Input, add_input
from .consume_motion import add_motion, motion_of
from .parsing import add_command, number, option_group
from .stderr import note

#: Oldest camera line that is compared [s].
OLDEST = 0.15


#: Lines of the newest image in a cycle, with their ages; None if it is that of the cycle before.
Camera = Callable[[ConsumerCycle], list[MapLine] | None]

DESCRIPTION = f"""\
Compare received map lines with the lines of a camera, and print whether they contradict each other.
There are at most as many false alarms per hour as designed, if the errors are as stated. The exit
status is 3 if there was an alarm. A change of the outcome has a row of its own.

The noise of the camera may last for up to --noise-time, and have outliers unless --gaussian-noise
is given; the pose error may last for up to --pose-time. Whoever knows that errors are smaller finds
faults sooner: with --noise-time 0 --gaussian-noise --pose-time 0, noise is white and Gaussian, and
the pose error lasts as its sender says.

The motion of the car moves map lines to the time of the image; without --motion, --signals or
--speed, the car stands. While signals on a bus are too old, nothing is compared.

{COLUMNS}

--simulate simulates a camera at the pose that the lines state, with the stated pose error;
--shift moves its lines to the side from a time on, as if the map were shifted the other way."""


def add_check(commands: Any) -> None:
    """Add the sub-command ``check``."""
    example = "maplines consume check drive.log --dbc maplines-pose.dbc --simulate --shift 0.5"
    parser = add_command(commands, "check", _check, DESCRIPTION, example)
    add_input(parser, "results")
    scenario = option_group(parser, "scenario")
    add = scenario.add_argument
    camera = scenario.add_mutually_exclusive_group(required=True)
    camera.add_argument("--simulate", action="store_true", help="simulate a camera")
    add_camera(parser, camera)
    add(
        "--shift",
        type=number(float, -10, 10),
        default=0.0,
        metavar="Y",
        help="shift of the lines of the simulated camera, to the left [m] (default: 0)",
    )
    add(
        "--shift-at",
        type=number(float, 0, 1e6),
        default=5.0,
        metavar="S",
        help="time from which --shift applies [s] (default: 5)",
    )
    add("--seed", type=number(int, 0, 2**32), default=0, help="of the simulation (default: 0)")
    add(
        "--false-alarms",
        type=number(float, 1e-9, 10),
        default=0.01,
        metavar="N",
        help="expected number of false alarms per hour, 1e-9 to 10 (default: 0.01)",
    )
    add(
        "--noise-time",
        type=number(float, 0, SLOW),
        default=CameraNoise().correlation_time,
        metavar="S",
        help="longest correlation time of the camera's noise [s], 0 for white noise (default: "
        "%(default)g)",
    )
    add(
        "--gaussian-noise",
        action="store_true",
        help="the camera's noise has no heavy tails (default: up to those of Student's t with 4 "
        "degrees of freedom)",
    )
    add(
        "--pose-time",
        type=number(float, 0, 1e4),
        default=SLOW,
        metavar="S",
        help="longest time for which the pose error may last [s], 0 for the time that the sender "
        "states (default: %(default)g)",
    )
    add_motion(parser)


def _check(arguments: argparse.Namespace) -> int:
    check_camera(arguments)
    counts: Counter[Outcome] = Counter()
    alarms, due, last = 0, 0.0, None
    source = Input(arguments)
    check = PlausibilityCheck(
        arguments.false_alarms,
        camera_noise=CameraNoise(
            arguments.noise_time, heavy_tails=not arguments.gaussian_noise, period=PERIOD
        ),
        longest_pose_time=arguments.pose_time,
    )
    with (
        motion_of(arguments, Motion(0.0, 0.0)) as motion,
        camera_of(arguments) as new_lines,
        source as cycles,
    ):
        camera = _simulated(arguments) if arguments.simulate else _seen(new_lines)
        for cycle in cycles:
            lines, now = camera(cycle), motion(cycle.now_ns)
            view = cycle.view if cycle.view.usable and now is not None else None
            if lines is None and view is not None and view.scene is not None:
                continue  # this image was compared before
            t, moving = cycle.t, now or Motion(0.0, 0.0)
            result = check.step(cycle.since_ns, view, moving, lines or ())
            counts[result.outcome] += 1
            alarms += result.raised
            if result.outcome is not last or t >= due - 1e-9:
                _print(t, result, source.skipped if arguments.json else None)
                last, due = result.outcome, t + arguments.every
    note(
        f"{alarms} alarms; "
        + ", ".join(f"{counts[outcome]} cycles {outcome.name}" for outcome in Outcome)
    )
    if counts[Outcome.UNCHECKED] == counts.total():
        return source.report_nothing(
            "nothing was compared: there was no usable scene with a line that the camera sees, too"
        )
    return 3 if alarms else 0


def _simulated(arguments: argparse.Namespace) -> Camera:
    """Return a simulated camera, whose lines ``--shift`` moves to the side from a time on."""
    camera = CameraAtReportedPose(PERIOD, arguments.seed)

    def lines(cycle: ConsumerCycle) -> list[MapLine]:
        shift = arguments.shift * (cycle.t >= arguments.shift_at)
        scene, age = cycle.view.scene, cycle.view.age
        return [] if scene is None else camera.lines(scene, age, shift)

    return lines


def _seen(new_lines: NewLines) -> Camera:
    """Return a camera whose lines arrive one by one."""
    known: dict[Slot, tuple[int, MapLine]] = {}  # with the time of each [ns]

    def lines(cycle: ConsumerCycle) -> list[MapLine] | None:
        arrived, now_ns = new_lines(cycle.now_ns), cycle.now_ns
        for line in arrived:
            known[line.slot] = now_ns - round(1e9 * line.age), line
        newest = max((t_ns for t_ns, _ in known.values()), default=0)
        if not known or (now_ns - newest) / 1e9 > OLDEST:
            return []
        fresh = [
            replace(line, age=(now_ns - t_ns) / 1e9)
            for t_ns, line in known.values()
            if newest - t_ns < 1e9 * PERIOD
        ]
        return fresh if arrived else None

    return lines


def _print(t: float, result: Check, skipped: dict[str, int] | None) -> None:
    """Print a row; as JSON with the counters of skipped records, otherwise as text."""
    suspect = None if result.suspect is None else result.suspect.name
    if skipped is not None:
        row = {
            "t": round(t, 3),
            "outcome": result.outcome.name,
            "raised": result.raised,
            "statistic": result.statistic,
            "lines": [slot.name for slot in result.slots],
            "suspect": suspect,
            "skipped": skipped,
        }
        print(json.dumps(row), flush=True)
        return
    lines = ", ".join(slot.name.lower().replace("_", " ") for slot in result.slots)
    print(
        f"{t:8.2f} s  {result.outcome.name:<13}statistic {result.statistic:5.2f} of its threshold"
        + f"  {lines}" * bool(lines)
        + (f"; suspect: {suspect}" if suspect else ""),
        flush=True,
    )
