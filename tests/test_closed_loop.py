"""Car, localisation and a short closed loop."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from evidence.closed_loop import Car, ReportedPoses, on_street

from maplines_can import Gaussian, MapLine, Motion, Polyline, Scene, Slot
from maplines_can.consumers import scene_view
from maplines_can.consumers.speed_limit import SteeringReason
from maplines_can.consumers.steering import LaneSteering, SteeringState
from maplines_can.simulation import STREETS
from maplines_can.values.scene import PoseError


def test_the_car_stays_in_a_roundabout_and_hands_over_without_lines() -> None:
    loop = on_street(STREETS["roundabout-12m"].lines, ReportedPoses((0.05, 0.02, 0.001)).pose)
    loop.line_outages = ((2.5, 99.0),)
    moments = loop.run()
    assert max(abs(m.error) for m in moments) < 0.3
    driving = next(m for m in moments if m.state is not SteeringState.HANDOVER)
    assert driving.t < 0.5
    handover = next(m for m in moments if m.t > driving.t and m.state is SteeringState.HANDOVER)
    assert 2.9 < handover.t < 3.1
    assert handover.reason is SteeringReason.NO_LINES
    assert moments[-1].speed < 0.05


def test_the_car_stops_before_a_corner_that_it_cannot_steer() -> None:
    """A corner of 4 m after 30 m; at full lock, the car turns on 5 m.

    The road before it has no points: the lines end where the corner begins.
    """
    turn = np.linspace(0.0, math.pi / 2, 60)

    def beside(distance: float) -> Polyline:
        r = 4.0 - distance
        bend = np.column_stack([30 + r * np.sin(turn), 4.0 - r * np.cos(turn)])
        return Polyline(np.concatenate([[[0.0, distance]], bend, [[30 + r, 60.0]]]))

    lines = {Slot.EGO_LEFT: beside(1.75), Slot.EGO_RIGHT: beside(-1.75), Slot.CENTRE: beside(0.0)}
    loop = on_street(lines, ReportedPoses((0.05, 0.02, 0.001)).pose)
    loop.way = (22.0, 60.0)
    moments = loop.run()
    last = moments[-1]
    assert (last.state, last.reason) == (SteeringState.HANDOVER, SteeringReason.RANGE)
    assert last.speed < 0.05
    assert last.along < 31.5
    assert max(abs(m.error) for m in moments) < 0.1


def lane_around(car: Car, middle: float = 0.0) -> Scene:
    """Scene of a straight lane along x as a car sees it, whose middle is at this y [m]."""
    _, y, psi = car.pose
    lines = tuple(
        MapLine(slot, Gaussian([(middle + d - y) / math.cos(psi), -psi, 0, 0],
                               np.diag([1e-4, 0, 0, 0])), x_min=-4.0, x_max=200.0)
        for slot, d in ((Slot.EGO_LEFT, 1.75), (Slot.EGO_RIGHT, -1.75))
    )  # fmt: skip
    cov: Any = np.kron(np.eye(2), lines[0].gaussian.cov)
    return Scene(lines, cov, PoseError(np.zeros((3, 3))), np.array([[-4.0, 200.0]] * 2))


def drive(
    steering: LaneSteering, car: Car, middles: Sequence[float], set_speed: float
) -> tuple[list[Any], Any]:
    """Return the commands, and the lateral positions after them, of a car in a lane that jumps."""
    commands, offsets, steering.set_speed = [], [], set_speed
    for k, middle in enumerate(middles):
        motion = Motion(car.speed, car.speed * car.curvature)
        scene = lane_around(car, middle)
        commands.append(steering.step(50_000_000 * k, scene_view(scene), motion))
        car.drive(commands[-1].curvature, commands[-1].speed, 0.05)
        offsets.append(car.pose[1])
    return commands, np.array(offsets)


@pytest.mark.parametrize(
    ("speed", "heading"),
    [(0.0, 0.2), (1.0, 0.0), (3.0, 0.2), (10.0, 0.05), (20.0, 0.0), (35.0, 0.02)],
)
def test_a_car_that_is_far_off_the_path_does_not_swing(speed: float, heading: float) -> None:
    """The limits of the curvature and of its rate hold the car back, most of all when it starts."""
    car = Car(np.array([0.0, 0.5, heading]), speed)
    _, offsets = drive(LaneSteering(), car, [0.0] * 200, max(speed, 12.0))
    assert offsets.min() > -0.15
    assert np.abs(offsets[-40:]).max() < 0.02


@pytest.mark.parametrize("speed", [10.0, 25.0])
def test_a_car_stays_in_its_lane_if_the_lines_jump_to_the_next_one(speed: float) -> None:
    """It hands over, and stops where it was: lines that jump are no reason to leave the lane."""
    car = Car(np.zeros(3), speed)
    commands, offsets = drive(LaneSteering(), car, [0.0] * 20 + [3.5] * 160, speed)
    assert (commands[20].state, commands[20].reason) == (
        SteeringState.HANDOVER,
        SteeringReason.OFF_LANE,
    )
    assert np.abs(offsets).max() < 0.05
    assert car.speed < 0.05
