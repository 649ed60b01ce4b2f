"""Preview control against a brute-force optimum, and speeds and states of the lane keeping."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from maplines_can import Gaussian, MapLine, Motion, Polyline, Scene, Slot, map_scene
from maplines_can.consumers import scene_view
from maplines_can.consumers.path import Path
from maplines_can.consumers.preview_control import COST, SLOW, model, preview_gains, riccati
from maplines_can.consumers.speed_limit import CUT, SteeringLimits, SteeringReason, fastest
from maplines_can.consumers.steering import LaneSteering, SteeringState
from maplines_can.maps.line_source import WINDOW
from maplines_can.simulation import STREETS
from maplines_can.values.scene import PoseError

LEFT, RIGHT = Slot.EGO_LEFT, Slot.EGO_RIGHT
POSE = PoseError(np.diag([0.1, 0.1, 0.003]) ** 2)


def straight(sigma: float = 0.05, reach: float = 80.0, offset: float = 0.0) -> Scene:
    """Scene of a straight lane."""
    cov = np.diag([sigma, 1e-4, 1e-7, 1e-9]) ** 2
    lines = tuple(
        MapLine(slot, Gaussian([y + offset, 0, 0, 0], cov), x_min=-4.0, x_max=reach)
        for slot, y in ((LEFT, 1.75), (RIGHT, -1.75))
    )
    return Scene(lines, np.kron(np.eye(2), cov), POSE, np.array([[-4.0, reach]] * 2))


def ns(t: float) -> int:
    """Nanoseconds of a time [s]."""
    return round(1e9 * t)


def driven(
    steering: LaneSteering, scenes: Sequence[Scene | None], speed: float = 10.0, first: float = 0.0
) -> list[Any]:
    """Commands in successive periods, of a car that drives straight ahead."""
    steering.set_speed = 13.9
    motion = Motion(speed, 0.0)
    return [
        steering.step(ns(first + 0.05 * k), scene_view(scene, 0.05), motion)
        for k, scene in enumerate(scenes)
    ]


@pytest.mark.parametrize("speed", [0.5, 4.0, 14.0, 30.0])
@pytest.mark.parametrize("lag", [0.0, 0.1])
def test_gains_are_those_of_the_optimum_over_a_long_horizon(speed: float, lag: float) -> None:
    """Least squares over all inputs of 600 steps, for an offset and a curvature ahead."""
    period, steps = 0.05, 600
    A, B, D = model(speed, period, lag)
    bends = np.zeros(steps)
    bends[10:30] = 0.01
    x0 = np.array([0.3, -0.02, 0.001, 0.002])
    jerk = COST[2] * period / max(speed, SLOW) ** 2
    # x_k = free_k + sum of responses to the inputs
    free, responses = [], []
    x, impulse = x0.copy(), B[:, 0].copy()
    for k in range(steps):
        x = A @ x + D[:, 0] * bends[k]
        free.append(x[:2])
        responses.append(impulse[:2])
        impulse = A @ impulse
    scale = np.array([1 / COST[0], 1 / COST[1]])
    rows = np.zeros((steps, 2, steps))
    for k in range(steps):
        rows[k, :, : k + 1] = np.array(responses[: k + 1])[::-1].T
    lhs = np.vstack([(rows * scale[None, :, None]).reshape(-1, steps), np.eye(steps) / jerk])
    rhs = np.concatenate([-(np.array(free) * scale).ravel(), np.zeros(steps)])
    u = np.linalg.lstsq(lhs, rhs, rcond=None)[0]
    K, F = preview_gains(speed, period, lag)
    ours = -K @ x0 + F @ bends[: len(F)]
    tolerance = 2e-3 if speed > 1 else 0.2  # at a crawl, 30 s are not enough
    assert ours == pytest.approx(u[0], rel=tolerance, abs=1e-6)


@pytest.mark.parametrize("lag", [0.0, 0.01, 0.1, 1.0])
@pytest.mark.parametrize("period", [0.01, 0.05, 0.1])
def test_the_riccati_equation_is_solved_at_each_speed(period: float, lag: float) -> None:
    """To rounding, with a stable closed loop, also where the pencil of scipy is ill-conditioned."""
    for speed in np.arange(0.5, 70.5, 0.5):
        A, B, _ = model(speed, period, lag)
        jerk = COST[2] * period / max(speed, SLOW) ** 2
        Q, G = np.diag([COST[0] ** -2, COST[1] ** -2, 0, 0]), jerk**2 * B @ B.T
        P = riccati(A, G, Q)
        M = np.linalg.solve(np.eye(4) + G @ P, A)  # the closed loop
        assert np.abs(A.T @ P @ M + Q - P).max() <= 1e-13 * np.abs(P).max()
        assert np.abs(np.linalg.eigvals(M)).max() < 1


def test_the_set_speed_is_reached_by_the_acceleration() -> None:
    commands = driven(LaneSteering(), [straight()] * 60)
    speeds = [command.speed for command in commands]
    assert speeds[0] == pytest.approx(10.0 + 1.5 * 0.05)
    assert speeds[-1] == 13.9
    assert {command.state for command in commands} == {SteeringState.DRIVING}


def test_it_can_stop_where_the_lines_end() -> None:
    """The speed and deceleration lead to a stop within the reach, with the reaction time."""
    command = driven(LaneSteering(), [straight(reach=20.0)], speed=10.0)[-1]
    assert (command.state, command.reason) == (SteeringState.SLOWING, SteeringReason.RANGE)
    limits = SteeringLimits()
    reach = command.path.reach
    v = fastest(command.path, 10.0, 13.9, SteeringLimits())[1]
    stopping = v * limits.reaction + v**2 / (2 * limits.deceleration)
    assert stopping == pytest.approx(reach)


def test_it_slows_down_where_the_band_is_too_wide() -> None:
    wide = straight(sigma=0.05)
    cov = np.diag([0.05, 0.02, 1e-7, 1e-9]) ** 2  # 0.28 m at 13.8 m
    lines = tuple(replace(line, gaussian=Gaussian(line.gaussian.mean, cov)) for line in wide.lines)
    wide = replace(wide, lines=lines, cov=np.kron(np.eye(2), cov))
    command = driven(LaneSteering(), [wide] * 40, speed=12.0)[-1]
    assert (command.state, command.reason) == (SteeringState.SLOWING, SteeringReason.BAND)
    stopping = command.speed * 0.3 + command.speed**2 / (2 * 2.5)
    assert stopping == pytest.approx(13.7 - 12 * 0.15, abs=0.5)


@pytest.mark.parametrize(
    ("scene", "reason"),
    [
        pytest.param(straight(sigma=0.3), SteeringReason.BAND, id="band-at-the-car"),
        pytest.param(straight(reach=2.3), SteeringReason.RANGE, id="lines-too-short"),
        pytest.param(straight(offset=1.3), SteeringReason.OFF_LANE, id="off-the-lane"),
    ],
)
def test_it_hands_over_for_good(scene: Scene, reason: SteeringReason) -> None:
    """The driver has to take over; good lines do not change that, a reset does."""
    steering = LaneSteering()
    driven(steering, [straight()] * 3)
    (command,) = driven(steering, [scene], first=0.15)
    assert (command.state, command.reason) == (SteeringState.HANDOVER, reason)
    later = driven(steering, [straight()] * 200, first=0.2)
    assert {c.state for c in later} == {SteeringState.HANDOVER}
    assert later[-1].speed == 0.0
    steering.reset()
    assert driven(steering, [straight()], first=20.0)[0].state is SteeringState.DRIVING


def test_it_hands_over_after_half_a_second_without_lines() -> None:
    steering = LaneSteering()
    driven(steering, [straight()] * 5)
    commands = driven(steering, [None] * 20, first=0.25)
    states = [command.state for command in commands]
    first = states.index(SteeringState.HANDOVER)
    assert first == 9  # the last pose was 0.05 s before the last of the five cycles
    assert commands[first].reason is SteeringReason.NO_LINES
    # Until then, it follows the last lines, which come nearer.
    reaches = [command.path.reach for command in commands[:first]]
    assert np.diff(reaches) == pytest.approx([-0.5] * (first - 1))
    # It brakes along them by odometry.
    assert commands[-1].path.reach == pytest.approx(reaches[0] - 19 * 0.5)


def test_a_scene_without_the_line_of_the_route_is_not_used() -> None:
    """As while the lines of a cycle are arriving: only after half a second is there no line."""
    lane = straight()
    line = replace(
        lane.lines[0], slot=Slot.ROUTE, gaussian=Gaussian([0, 0, 0, 0], np.eye(4) * 1e-9)
    )
    with_route = Scene((line,), line.gaussian.cov, POSE, lane.fit_ranges[:1])
    steering, states = LaneSteering(route=Slot.ROUTE), []
    for k in range(20):
        scene = with_route if k < 5 else lane
        command = steering.step(ns(0.05 * k), scene_view(scene, 0.05), Motion(5.0, 0.0))
        states.append(command.state)
    assert SteeringState.HANDOVER not in states[:13]
    assert states[-1] is SteeringState.HANDOVER
    assert command.reason is SteeringReason.NO_LINES


def bend_path(curvature: float, first: float, length: float) -> Path:
    """Straight path with a bend of a curvature, which begins and ends within a centimetre."""
    s = np.linspace(0.0, 20.0, 2001)
    inside = (s >= first - 0.005) & (s <= first + length + 0.005)
    return Path(0.0, 0.0, s, np.where(inside, curvature, 0.0), np.full(len(s), 0.05))


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(
    ("curvature", "share", "reason"),
    [
        pytest.param(0.25, 0.98, SteeringReason.NONE, id="short-peak"),
        pytest.param(0.25, 1.02, SteeringReason.TIGHT, id="bend"),
        pytest.param(0.8, 0.96, SteeringReason.NONE, id="high-peak"),
        pytest.param(0.8, 1.04, SteeringReason.TIGHT, id="corner"),
    ],
)
def test_a_curve_is_too_tight_if_the_car_leaves_the_path_at_full_lock(
    side: int, curvature: float, share: float, reason: SteeringReason
) -> None:
    """With the excess e over L, and k at full lock, it is off by e L^2 / 2 + (e L)^2 / 2 k."""
    k = SteeringLimits().curvature
    e = curvature - k
    length = math.sqrt(2 * CUT / (e + e**2 / k))
    path = bend_path(side * curvature, 0.0, share * length)
    assert fastest(path, 2.0, 2.0, SteeringLimits())[0] is reason


@pytest.mark.parametrize(
    ("radius", "turn", "speed"), [(8.0, 120.0, 2.8), (8.0, 90.0, 2.0), (10.0, 60.0, 2.8)]
)
def test_a_turn_at_a_junction_is_driven(radius: float, turn: float, speed: float) -> None:
    """From the straight road before it to the one behind, as the lines of each place permit."""
    step = 0.25
    arc = np.radians(turn) * radius
    s = np.arange(-60.0, arc + 120.0, step)
    heading = np.clip(s / radius, 0.0, np.radians(turn))
    chords = step * np.column_stack([np.cos(heading), np.sin(heading)])
    points = np.cumsum(chords, axis=0) - [60.0, 0.0]
    normal = np.column_stack([-np.sin(heading), np.cos(heading)])
    lines = {slot: Polyline(points + y * normal) for slot, y in ((LEFT, 1.75), (RIGHT, -1.75))}
    cov = np.diag([0.1, 0.1, 0.003]) ** 2
    steering = LaneSteering(set_speed=speed)
    for k, at in enumerate(np.arange(-15.0, arc + 5.0, 0.05 * speed)):
        i = s.searchsorted(at)
        pose = Gaussian([*points[i], heading[i]], cov)
        motion = Motion.with_sigma(speed, speed / radius * (0 < at < arc), (0.05, 0.003))
        view = scene_view(map_scene(lines, pose, window=WINDOW))
        command = steering.step(ns(0.05 * k), view, motion)
        assert command.state is not SteeringState.HANDOVER, (at, command.reason)


def test_one_cycle_with_a_curve_that_is_too_tight_is_no_handover() -> None:
    """The ends of cubics change from cycle to cycle; a curve that is there remains there."""
    lines = {slot: STREETS["roundabout-12m"].lines[slot] for slot in (LEFT, RIGHT)}
    tight = map_scene(
        lines, Gaussian(np.zeros(3), np.diag([0.1, 0.1, 0.003]) ** 2), window=(-4, 60)
    )
    steering = LaneSteering(SteeringLimits(curvature=1 / 20))
    commands = driven(steering, [straight()] * 3 + [tight] + [straight()] * 3, speed=3.0)
    assert {command.state for command in commands} <= {SteeringState.DRIVING, SteeringState.SLOWING}
    commands = driven(steering, [tight] * 20, speed=3.0, first=0.4)
    assert (commands[-1].state, commands[-1].reason) == (
        SteeringState.HANDOVER,
        SteeringReason.TIGHT,
    )
    begin = [command.state for command in commands].index(SteeringState.HANDOVER)
    assert 0.05 * begin == pytest.approx(0.5, abs=0.1)  # as long as without lines


@pytest.mark.parametrize(
    ("first", "reason"),
    [(2.0, SteeringReason.TIGHT), (5.9, SteeringReason.TIGHT), (6.2, SteeringReason.NONE)],
)
def test_it_hands_over_while_it_can_stop_before_a_tight_curve(
    first: float, reason: SteeringReason
) -> None:
    """At 4.86 m/s, and with 0.3 s and 2.5 m/s^2, it stops within 6.18 m."""
    path = bend_path(0.25, first, 5.0)
    found = fastest(path, 4.86, 3.0, SteeringLimits())[0]
    assert found is reason


def test_a_peak_of_the_curvature_slows_the_car_no_more_than_full_lock() -> None:
    """As at the end of a cubic, beside a car that leaves a corner."""
    limits = SteeringLimits()
    reason, speed = fastest(bend_path(1.0, 0.0, 0.3), 3.0, 13.9, SteeringLimits())
    assert reason is SteeringReason.CURVE
    assert speed == pytest.approx(math.sqrt(limits.lateral_acceleration / limits.curvature))


@pytest.mark.parametrize("name", SteeringLimits.__dataclass_fields__)
@pytest.mark.parametrize("value", [-0.1, math.inf, math.nan])
def test_wrong_limits_raise(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must be finite and"):
        SteeringLimits(**{name: value})


@pytest.mark.parametrize("name", SteeringLimits.__dataclass_fields__)
def test_only_times_of_the_reaction_may_be_zero(name: str) -> None:
    if name in {"delay", "lag", "reaction"}:
        limits = SteeringLimits(**{name: 0.0})
        assert getattr(limits, name) == 0.0
        commands = driven(LaneSteering(limits), [straight(offset=0.3)] * 3)
        assert commands[-1].curvature > 0
    else:
        with pytest.raises(ValueError, match=f"{name} must be finite and more than 0, got 0.0"):
            SteeringLimits(**{name: 0.0})


def test_more_lateral_acceleration_in_curves_than_at_all_raises() -> None:
    limits = SteeringLimits(lateral_acceleration=3.0)
    assert limits.lateral_acceleration == limits.max_lateral_acceleration
    with pytest.raises(ValueError, match="must be max_lateral_acceleration at most, 3 m/s"):
        SteeringLimits(lateral_acceleration=3.1)
    assert SteeringLimits(lateral_acceleration=3.1, max_lateral_acceleration=3.2)


def test_wrong_updates_raise() -> None:
    steering = LaneSteering()
    driven(steering, [straight()], first=1.0)
    for t in (1.0, 0.5, math.nan, math.inf):
        with pytest.raises(ValueError, match="now_ns must be finite and later than 1000000000 ns"):
            steering.step(1e9 * t, None, Motion(10.0, 0.0))  # type: ignore[arg-type]
    for steering.set_speed in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="set_speed must be finite and 0"):
            steering.step(2 * 10**9, None, Motion(10.0, 0.0))
