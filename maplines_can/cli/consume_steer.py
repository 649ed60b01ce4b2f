"""The command ``maplines consume steer``."""

from __future__ import annotations

import argparse
import json
import math
from typing import Any

from ..consumers.steering import Command, LaneSteering, SteeringState
from ..propagation import Motion
from .consume_input import PERIOD, Input, add_input
from .parsing import add_command, number, option_group

DESCRIPTION = """\
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
    parser = add_command(commands, "steer", _steer, DESCRIPTION, example)
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
                _print(t, command, source.skipped if arguments.json else None)
                state, due = command.state, t + arguments.every
    if not engaged:
        return source.report_nothing("there was no usable scene with a boundary of the ego lane")
    return 0


def _print(t: float, command: Command, skipped: dict[str, int] | None) -> None:
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
    radius = math.inf if abs(command.curvature) < 1e-4 else 1 / command.curvature
    where = ""
    if path is not None:
        where = f"  offset {path.offset:+.2f} m, sigma {path.sigma[0]:.2f} m"
        where += f", lines for {path.reach:.0f} m"
    why = "" if command.reason.name == "NONE" else f"  {command.reason}"
    print(
        f"{t:8.2f} s  {command.state.name:<9}{command.speed:5.1f} m/s  "
        f"curvature {command.curvature:+.4f}/m (radius {radius:.0f} m){where}{why}",
        flush=True,
    )
