"""The command ``maplines consume``: one subcommand for each consumer."""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..consumers import FusedLane, LaneFusion
from ..consumers.integrity import RISKS, multiplier
from ..consumers.plausibility import Check, Outcome, PlausibilityCheck
from ..consumers.residual_filter import SLOW, CameraNoise
from ..consumers.steering import Command, LaneSteering, SteeringState
from ..desk.facts import Facts, facts_of
from ..propagation import Motion
from ..simulation.camera import CameraAtReportedPose
from ..values.arrays import count_text
from ..values.line import MapLine, Slot
from ..wire import LineCodec, SceneView
from .command_line import add_command, add_group, note, number, option_group
from .consume_camera import COLUMNS, NewLines, add_camera, camera_of, check_camera
from .consume_input import (
    PERIOD,
    ConsumerCycle,
    Input,
    MotionAt,
    add_input,
    add_motion,
    motion_of,
    scene_codec,
)
from .consume_view import Show, add_page, page_of
from .output import LANE, LANE_X

#: Motion of a car of which none is known: means and standard deviations [m/s, rad/s].
UNKNOWN_MOTION = Motion.with_sigma(15.0, 0.0, (10.0, 0.3))
#: Correlation time and start of the simulated drive [s].
SIMULATED_TIME, SIMULATED_START = 5.0, 20.0

FUSION = f"""\
Fuse the scenes of a bus or of a log into the ego lane, and print its centre and its width every
second (--every), with standard deviations and protection levels: bounds that the error of the
centre exceeds with a risk of 1e-5 and 1e-7 in an hour, whatever its correlation time, if the stated
standard deviation is right.

The fusion needs the motion of the car between scenes: --motion, --signals or --speed. Without it,
the lane is about that of the newest scene. It takes the lines of a camera, if there is one.

{COLUMNS}

--simulate drives through the town of this package instead, with a
simulated camera that fails after a third of the drive, and prints the true errors as well."""


class FusionInputs(NamedTuple):
    """Inputs of one step."""

    t_ns: int
    view: SceneView
    motion: Motion
    camera: list[MapLine]
    facts: Callable[[], Facts]  #: facts of the lines, for the page
    true_centre: Any = None  #: (3,) at ``LANE_X`` [m], if it is known


def add_fusion(consumers: Any) -> None:
    """Add the consumer ``fusion``."""
    example = "maplines consume fusion --simulate --seconds 30"
    parser = add_command(consumers, "fusion", _fusion, FUSION, example)
    add_input(parser, "the lane")
    scenario = option_group(parser, "scenario")
    scenario.add_argument("--simulate", action="store_true", help="simulate a car with a camera")
    add_camera(parser, scenario.add_mutually_exclusive_group())
    add_motion(parser)
    scenario.add_argument("--seed", type=number(int, 0, 2**32), default=0, help="of --simulate")
    add_page(parser)


def _fusion(arguments: argparse.Namespace) -> int:
    own = ["log", "motion", "signals", "signals_channel", "speed", "camera", "camera_channel"]
    if arguments.simulate and any(getattr(arguments, name) is not None for name in own):
        raise ValueError(
            "--simulate has a car of its own; leave out LOG, --speed, and the options of the "
            "camera, of the motion and of the signals"
        )
    check_camera(arguments)
    if arguments.dbc is None and not arguments.keys:
        arguments.dbc = "maplines-pose.dbc" if arguments.simulate else None
    codec = scene_codec(arguments)
    if arguments.simulate:
        with page_of(arguments, codec, "simulated car") as show:
            _print_rows(_simulated_inputs(arguments, codec), arguments, show)
        return 0
    source = Input(arguments)
    rows = 0
    with (
        motion_of(arguments, UNKNOWN_MOTION) as motion,
        camera_of(arguments) as camera,
        page_of(arguments, codec, source.name) as show,
        source as cycles,
    ):
        epochs = _epochs(cycles, motion, camera, source)
        rows = _print_rows(epochs, arguments, show, source)
    if not rows:
        return source.report_nothing("no scene with a line of the ego lane was received")
    return 0


def _print_rows(
    epochs: Iterator[tuple[LaneFusion, FusionInputs]],
    arguments: argparse.Namespace,
    show: Show,
    source: Input | None = None,
) -> int:
    """Fuse until the end or Ctrl-C, and print rows; return the number of those with a lane."""
    last = None
    rows = 0
    try:
        for fusion, epoch in epochs:
            lane = fusion.step(epoch.t_ns, epoch.view, epoch.motion, epoch.camera)
            show(epoch.facts, lane, epoch.camera)
            if last is None or abs(epoch.t_ns - last) >= round(1e9 * arguments.every) - 1:
                last = epoch.t_ns
                row = lane_dict(lane, epoch)
                row["skipped"] = {} if source is None else source.skipped
                print(json.dumps(row) if arguments.json else lane_text(row), flush=True)
                rows += lane.scene is not None
    except KeyboardInterrupt:
        pass
    return rows


def _epochs(
    cycles: Iterable[ConsumerCycle], motion: MotionAt, camera: NewLines, source: Input
) -> Iterator[tuple[LaneFusion, FusionInputs]]:
    """Yield the epochs of a bus or of a log."""
    fusion, last = None, 0
    for cycle in cycles:
        if fusion is None or cycle.now_ns < last:  # the clock of the stamps was set back
            fusion = LaneFusion()
        last = cycle.now_ns
        lines = [line for line in camera(last) if line.slot in LANE]
        facts = partial(source.facts, last)
        yield fusion, FusionInputs(last, cycle.view, motion(last) or UNKNOWN_MOTION, lines, facts)


def _simulated_inputs(
    arguments: argparse.Namespace, codec: LineCodec
) -> Iterator[tuple[LaneFusion, FusionInputs]]:
    """Yield the epochs of a simulated car in the town."""
    from ..maps import load, town_path, town_tour
    from ..simulation.car_stream import CarStream
    from ..simulation.trajectory import drive_along

    road_map = load(town_path())
    route = town_tour(road_map)
    drive = drive_along(road_map, route)
    stream = CarStream(road_map, route, drive, codec, SIMULATED_TIME, arguments.seed)
    length = 60.0 if arguments.seconds is None else arguments.seconds
    end = min(SIMULATED_START + length, drive.duration - 1.0)
    fusion = LaneFusion()
    for moment in stream(SIMULATED_START, end, 1 / PERIOD):
        view = moment.decoder.latest_scene(moment.t_ns)
        true = moment.true.mean(axis=0)
        facts = partial(facts_of, moment.decoder, codec.layout, moment.t_ns)
        yield fusion, FusionInputs(moment.t_ns, view, moment.motion, moment.camera, facts, true)


def lane_dict(lane: FusedLane, epoch: FusionInputs) -> dict[str, Any]:
    """Return a fused lane, for JSON."""
    row: dict[str, Any] = {
        "t": lane.t_ns / 1e9,
        "map_age": lane.map_age if math.isfinite(lane.map_age) else None,
        "camera": [slot.name for slot in lane.used],
        "rejected": [slot.name for slot in lane.rejected],
        "centre": [],
    }
    if lane.scene is None:
        return row
    low, high = lane.scene.x_range(LANE)
    for i, x in enumerate(LANE_X):
        if not low <= x <= high:
            continue
        centre, width = lane.scene.centre(x), lane.scene.width(x)
        sigma = float(centre.sigma)
        at = {
            "x": x,
            "value": float(centre.value),
            "sigma": sigma,
            # The error is a sum of errors with several correlation times: any of them is covered.
            "protection_level": {f"{risk:g}": sigma * multiplier(risk) for risk in RISKS},
            "width": float(width.value),
            "width_sigma": float(width.sigma),
        }
        if epoch.true_centre is not None and np.isfinite(epoch.true_centre[i]):
            at["error"] = float(centre.value - epoch.true_centre[i])
        row["centre"].append(at)
    return row


def lane_text(row: dict[str, Any]) -> str:
    """Return a fused lane as one row of text."""
    head = f"{row['t']:.1f}  "
    if not row["centre"]:
        return f"{head}no lane"
    places = [
        f"at {at['x']:g} m {at['value']:+.2f} ± {at['sigma']:.2f} m"
        + (f" (error {at['error']:+.2f})" if "error" in at else "")
        + f", level {at['protection_level']['1e-05']:.2f}/{at['protection_level']['1e-07']:.2f} m"
        for at in row["centre"]
    ]
    first = row["centre"][0]
    width = f"width {first['width']:.2f} ± {first['width_sigma']:.2f} m"
    camera = {0: "no camera", 1: "one camera line", 2: "camera"}[len(row["camera"])]
    return f"{head}{'; '.join(places)}; {width}; {camera}"


STEERING = """\
Follow the ego lane by received lines, and print the demanded curvature and speed, the state, and
the reason for which the car is slower than --set-speed. Nothing is sent: the car is taken to drive
as demanded.

The car slows down in curves, where the valid range of the lines is shorter than its stopping
distance, and where the lateral position ahead is too uncertain. It hands over to the driver if that
does not suffice, or if there is no usable line; then it brakes to a stop. A change of the state has
a row of its own."""


def add_steer(commands: Any) -> None:
    """Add the sub-command ``steer``."""
    example = "maplines consume steer drive.log --dbc maplines-pose.dbc --set-speed 13.9"
    parser = add_command(commands, "steer", _steer, STEERING, example)
    add_input(parser, "demands")
    option_group(parser, "scenario").add_argument(
        "--set-speed",
        type=number(float, 1, 70),
        default=50 / 3.6,
        metavar="V",
        help="speed of the car if nothing limits it [m/s], 1 to 70 (default: 13.9)",
    )


def _steer(arguments: argparse.Namespace) -> int:
    steering = LaneSteering(period=PERIOD, set_speed=arguments.set_speed)
    motion = Motion(arguments.set_speed, 0.0)
    state: SteeringState | None = None
    due, engaged = 0.0, False
    source = Input(arguments)
    with source as cycles:
        for cycle in cycles:
            t, command = cycle.t, steering.step(cycle.since_ns, cycle.view, motion)
            motion = Motion(command.speed, command.speed * command.curvature)
            engaged |= command.state is not SteeringState.HANDOVER
            if command.state is not state or t >= due - 1e-9:
                _print_command(t, command, source.skipped if arguments.json else None)
                state, due = command.state, t + arguments.every
    if not engaged:
        return source.report_nothing("there was no usable scene with a boundary of the ego lane")
    return 0


def _print_command(t: float, command: Command, skipped: dict[str, int] | None) -> None:
    """Print a row; as JSON with the counters of skipped records, otherwise as text."""
    path = command.path
    row = {
        "t": round(t, 3),
        "state": command.state.name,
        "reason": command.reason.name,
        "curvature": command.curvature,
        "speed": command.speed,
        "offset": None if path is None else path.offset,
        "sigma": None if path is None else float(path.sigma[0]),
        "reach": None if path is None else path.reach,
    }
    if skipped is not None:
        print(json.dumps(row | {"skipped": skipped}), flush=True)
        return
    is_straight = abs(command.curvature) < 1e-4
    bend = "straight on" if is_straight else f"radius {1 / command.curvature:.0f} m"
    where = ""
    if path is not None:
        where = f"  offset {path.offset:+.2f} m, sigma {path.sigma[0]:.2f} m"
        where += f", lines for {path.reach:.0f} m"
    why = "" if command.reason.name == "NONE" else f"  {command.reason}"
    print(
        f"{t:8.2f} s  {command.state.name:<9}{command.speed:5.1f} m/s  "
        f"curvature {command.curvature:+.4f}/m ({bend}){where}{why}",
        flush=True,
    )


#: Oldest camera line that is compared [s].
OLDEST = 0.15


#: Lines of the newest image in a cycle, with their ages; None if it is that of the cycle before.
Camera = Callable[[ConsumerCycle], list[MapLine] | None]

CHECKING = f"""\
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
    parser = add_command(commands, "check", _check, CHECKING, example)
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
        camera = _simulated_camera(arguments) if arguments.simulate else _seen(new_lines)
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
                _print_check(t, result, source.skipped if arguments.json else None)
                last, due = result.outcome, t + arguments.every
    note(
        f"{count_text(alarms, 'alarm')}; "
        + ", ".join(f"{count_text(counts[outcome], 'cycle')} {outcome.name}" for outcome in Outcome)
    )
    if counts[Outcome.UNCHECKED] == counts.total():
        return source.report_nothing(
            "nothing was compared: there was no usable scene with a line that the camera sees, too"
        )
    return 3 if alarms else 0


def _simulated_camera(arguments: argparse.Namespace) -> Camera:
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


def _print_check(t: float, result: Check, skipped: dict[str, int] | None) -> None:
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


#: Subcommands, with one line of help.
CONSUMERS = {
    "fusion": (add_fusion, "fuse received scenes and camera lines into the ego lane"),
    "steer": (add_steer, "follow the ego lane: demanded curvature and speed"),
    "check": (add_check, "compare the lines with those of a camera"),
}
DESCRIPTION = "Use the received lines as a car does: one subcommand for each consumer."


def add_consume(commands: Any) -> None:
    """Add the command ``consume`` with its subcommands."""
    example = "maplines consume fusion --simulate --seconds 10"
    add_group(commands, "consume", DESCRIPTION, "consumers", CONSUMERS, example)
