"""The command ``maplines consume fusion``."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from ..consumers import FusedLane, LaneFusion
from ..consumers.integrity import RISKS, multiplier
from ..propagation import Motion
from ..values.line import MapLine
from ..wire import LineCodec, SceneView
from .consume_camera import COLUMNS, NewLines, add_camera, camera_of, check_camera
from .consume_input import PERIOD, ConsumerCycle, Input, add_input, scene_codec
from .consume_motion import MotionAt, add_motion, motion_of
from .output import LANE, LANE_X
from .parsing import add_command, number, option_group

#: Motion of a car of which none is known: means and standard deviations [m/s, rad/s].
UNKNOWN_MOTION = Motion.with_sigma(15.0, 0.0, (10.0, 0.3))
#: Correlation time and start of the simulated drive [s].
SIMULATED_TIME, SIMULATED_START = 5.0, 20.0

DESCRIPTION = f"""\
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
    true_centre: Any = None  #: (3,) at ``LANE_X`` [m], if it is known


def add_fusion(consumers: Any) -> None:
    """Add the consumer ``fusion``."""
    example = "maplines consume fusion --simulate --seconds 30"
    parser = add_command(consumers, "fusion", _fusion, DESCRIPTION, example)
    add_input(parser, "the lane")
    scenario = option_group(parser, "scenario")
    scenario.add_argument("--simulate", action="store_true", help="simulate a car with a camera")
    add_camera(parser, scenario.add_mutually_exclusive_group())
    add_motion(parser)
    scenario.add_argument("--seed", type=number(int, 0, 2**32), default=0, help="of --simulate")


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
    if arguments.simulate:
        _print_rows(_simulated(arguments, scene_codec(arguments)), arguments)
        return 0
    source = Input(arguments)
    with (
        motion_of(arguments, UNKNOWN_MOTION) as motion,
        camera_of(arguments) as camera,
        source as cycles,
    ):
        rows = _print_rows(_epochs(cycles, motion, camera), arguments, source)
    if not rows:
        return source.report_nothing("no scene with a line of the ego lane was received")
    return 0


def _print_rows(
    epochs: Iterator[tuple[LaneFusion, FusionInputs]],
    arguments: argparse.Namespace,
    source: Input | None = None,
) -> int:
    """Fuse until the end or Ctrl-C, and print rows; return the number of those with a lane."""
    last = None
    rows = 0
    try:
        for fusion, epoch in epochs:
            lane = fusion.step(epoch.t_ns, epoch.view, epoch.motion, epoch.camera)
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
    cycles: Iterable[ConsumerCycle], motion: MotionAt, camera: NewLines
) -> Iterator[tuple[LaneFusion, FusionInputs]]:
    """Yield the epochs of a bus or of a log."""
    fusion, last = None, 0
    for cycle in cycles:
        if fusion is None or cycle.now_ns < last:  # the clock of the stamps was set back
            fusion = LaneFusion()
        last = cycle.now_ns
        lines = [line for line in camera(last) if line.slot in LANE]
        yield fusion, FusionInputs(last, cycle.view, motion(last) or UNKNOWN_MOTION, lines)


def _simulated(
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
        yield fusion, FusionInputs(moment.t_ns, view, moment.motion, moment.camera, true)


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
