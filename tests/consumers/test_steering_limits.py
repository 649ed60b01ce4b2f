"""Search for inputs that break the limits of the curvature demand, in each state; none is found."""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings, target
from hypothesis import strategies as st

from maplines_can import Gaussian, MapLine, Motion, Scene, Slot
from maplines_can.consumers import scene_view
from maplines_can.consumers.curvature_limiter import MAX_DECELERATION, CurvatureLimiter
from maplines_can.consumers.speed_limit import SteeringReason
from maplines_can.consumers.steering import Command, LaneSteering, SteeringState
from maplines_can.values.scene import PoseError

LEFT, RIGHT = Slot.EGO_LEFT, Slot.EGO_RIGHT
#: ISO 11270:2014, 5.4 [m/s^2, m/s^3].
MAX_ACCELERATION, MAX_JERK = 3.0, 5.0
PERIOD = 0.05
#: The car brakes by this in a handover [m/s^2].
BRAKING = 3.75


class Lane(NamedTuple):
    """Lines of a straight or bent lane."""

    shift: float = 0.0  #: to the left [m]
    bend: float = 0.0  #: curvature [1/m]
    turn: float = 0.0  #: heading [rad]
    sigma: float = 0.05  #: [m]
    half: float = 1.75  #: half of the width; negative if the slots are swapped [m]
    slots: tuple[Slot, ...] = (LEFT, RIGHT)  #: of which there are lines


@lru_cache(None)
def scene_of(lane: Lane) -> Scene:
    """Return the scene; it is not checked, so that there may be NaN."""
    cov = np.diag([lane.sigma, 1e-4, 1e-7, 1e-9]) ** 2
    side = {LEFT: lane.half, RIGHT: -lane.half}
    means = [np.array([side[slot] + lane.shift, lane.turn, lane.bend, 0.0]) for slot in lane.slots]
    lines = tuple(
        MapLine(slot, Gaussian.trusted(mean, cov), x_min=-4.0, x_max=90.0)
        for slot, mean in zip(lane.slots, means, strict=True)
    )
    pose_error = PoseError(np.diag([0.1, 0.1, 0.003]) ** 2)
    n = len(lines)
    return Scene(lines, np.kron(np.eye(n), cov), pose_error, np.array([[-4.0, 90.0]] * n))


class Cycle(NamedTuple):
    """What the lane keeping gets in one update."""

    lane: Lane | None
    age: float = PERIOD
    dt: float = PERIOD
    acceleration: float = 0.0
    yaw_rate: float | None = None  #: None for that of a car which follows the last demand


def numbers(low: float, high: float) -> Any:
    return st.floats(low, high, allow_nan=False)


LANES = st.builds(
    Lane,
    shift=st.sampled_from([0.0, 1.1, -1.1, 3.5]) | numbers(-4.0, 4.0),
    bend=st.sampled_from([0.0, 0.005]) | numbers(-0.1, 0.1),
    turn=st.just(0.0) | numbers(-0.4, 0.4),
    sigma=st.sampled_from([0.05, 0.3]),
    half=st.just(1.75),
    slots=st.just((LEFT, RIGHT)),
)
SWAPPED = Lane(half=-1.75)
BROKEN = st.sampled_from(
    [
        *(None, SWAPPED, Lane(shift=math.nan), Lane(bend=math.nan), Lane(bend=math.inf)),
        *(Lane(turn=1.5), Lane(bend=1e6), Lane(slots=(LEFT,)), Lane(shift=2.0, slots=(RIGHT,))),
    ]
)
CYCLES = st.builds(
    Cycle,
    lane=LANES | BROKEN,
    age=st.just(PERIOD) | numbers(-0.2, 0.7) | st.sampled_from([math.nan, math.inf]),
    dt=st.just(PERIOD) | numbers(1e-3, 0.7),
    acceleration=st.sampled_from([0.0, -BRAKING, 1.5]) | numbers(-MAX_DECELERATION, 4.0),
    yaw_rate=st.none() | numbers(-60.0, 60.0),
)
SPEEDS = st.sampled_from([1.0, 4.0, 8.0, 14.0, 25.0, 35.0]) | numbers(0.0, 40.0)


def drive(steering: LaneSteering, cycles: list[Cycle], speed: float) -> tuple[list[Command], Any]:
    """Return the commands and the (n, 2) times and speeds at which they were given."""
    t, curvature, commands, rows, steering.set_speed = 0.0, 0.0, [], [], 40.0
    for cycle in cycles:
        t += cycle.dt
        speed = max(0.0, speed + cycle.acceleration * cycle.dt)
        turning = speed * curvature if cycle.yaw_rate is None else cycle.yaw_rate
        motion = Motion(speed, turning)
        scene = None if cycle.lane is None else scene_of(cycle.lane)
        now_ns = round(1e9 * t)
        command = steering.step(now_ns, scene_view(scene, cycle.age), motion)
        curvature = command.curvature
        commands.append(command)
        rows.append((now_ns * 1e-9, speed))
    return commands, np.array(rows)


@settings(max_examples=40)
@given(cycles=st.lists(CYCLES, min_size=3, max_size=15), speed=SPEEDS, bend=numbers(-0.02, 0.02))
def test_no_inputs_break_the_limits(cycles: list[Cycle], speed: float, bend: float) -> None:
    """Jumps, NaN, swapped and lost lines, latencies, late updates, wrong yaw rates, and brakes.

    The lateral acceleration rises by the largest jerk at most. It falls by no more either, unless
    the car brakes harder than in a handover; then it falls as it does with the last demand.
    """
    steering = LaneSteering()
    good = min(bend, 1.5 / max(speed, 1.0) ** 2, key=abs)
    commands, rows = drive(steering, [Cycle(Lane(bend=good))] * 5 + cycles, speed)
    t, v = rows.T
    k = np.array([command.curvature for command in commands])
    a, held, dt = v**2 * k, v[1:] ** 2 * k[:-1], np.diff(t)
    rate = np.diff(a) / dt
    target(float(np.abs(a).max()), label="lateral acceleration")
    target(float(np.abs(rate).max()), label="rate")
    assert np.isfinite(k).all()
    assert np.abs(a).max() <= MAX_ACCELERATION + 1e-9
    assert np.abs(k).max() <= 0.2
    softly = np.diff(v) / dt >= -BRAKING - 1e-9
    assert np.abs(rate[softly]).max(initial=0.0) <= MAX_JERK + 1e-6
    high, low = np.maximum(a[:-1], held), np.minimum(a[:-1], held)
    assert (a[1:] <= high + MAX_JERK * dt + 1e-9).all()
    assert (a[1:] >= low - MAX_JERK * dt - 1e-9).all()
    # Nothing jumps after a late update either.
    slower = np.diff(v) <= 0
    change = (v[1:] ** 2 * np.abs(np.diff(k)))[slower]
    assert (change <= MAX_JERK * np.minimum(dt[slower], PERIOD) + 1e-9).all()


@settings(max_examples=100)
@given(
    steps=st.lists(
        st.tuples(
            numbers(-1.0, 1.0) | st.sampled_from([math.nan, math.inf]),
            st.sampled_from([0.0, 0.1, 20.0]) | numbers(-60.0, 60.0),
            numbers(1e-4, 1.0),
        ),
        min_size=1,
        max_size=12,
    ),
    first=numbers(-0.5, 0.5),
)
def test_no_speeds_break_the_limits(steps: list[tuple[float, float, float]], first: float) -> None:
    """Speeds as of a sensor that fails: standstill, reverse, jumps.

    A speed that falls faster than a car can brake does not permit more than this deceleration does.
    """
    limiter = CurvatureLimiter(0.2, 0.2, MAX_ACCELERATION, MAX_JERK, BRAKING)
    speed, last = abs(steps[0][1]), 0.0
    limiter.begin(first, speed)
    for wanted, measured, dt in steps:
        before, a = limiter.demand, speed**2 * limiter.demand
        speed, last = max(abs(measured), speed - MAX_DECELERATION * dt), speed
        demand = limiter.advance(wanted, measured, dt)
        assert abs(demand) <= 0.2
        assert speed**2 * abs(demand) <= MAX_ACCELERATION + 1e-9
        if speed >= last:  # also the last demand gets smaller, as far as needed
            assert abs(speed**2 * demand - a) <= MAX_JERK * dt + 1e-9
        else:
            assert speed**2 * abs(demand - before) <= MAX_JERK * dt + 1e-9
            assert abs(demand - before) <= 0.2 * dt + 1e-12
            if math.isfinite(wanted):  # nothing else than what is wanted changes it
                assert min(before, wanted) <= demand <= max(before, wanted)
        if not math.isfinite(wanted) and speed <= last:
            assert demand == pytest.approx(before)


@pytest.mark.parametrize("speed", [0.0, 3.0, 3.4, 6.0, 25.0])
def test_what_is_wanted_is_reached_at_the_limits(speed: float) -> None:
    """As fast and as far as they permit, and no slower: a limit that is too tight would show."""
    limiter = CurvatureLimiter(0.2, 0.2, MAX_ACCELERATION, MAX_JERK, BRAKING)
    limiter.begin(0.0, speed)
    rate = min(0.2, MAX_JERK / max(speed, 0.1) ** 2)
    most = min(
        0.2, MAX_ACCELERATION / max(speed, 0.1) ** 2, MAX_JERK / (2 * BRAKING * max(speed, 0.1))
    )
    for side in (1, -1):
        demands = [limiter.demand]
        demands += [limiter.advance(side * 1.0, speed, PERIOD) for _ in range(60)]
        assert demands[1] - demands[0] == pytest.approx(side * rate * PERIOD)
        assert demands[-1] == pytest.approx(side * most)
    late = limiter.advance(1.0, speed, dt=1.0, step=PERIOD)
    assert abs(late - demands[-1]) <= rate * PERIOD + 1e-12


def test_no_demand_holds_up_what_falls_since_the_car_brakes() -> None:
    """At 8 m/s^2 in a tight bend: the lateral acceleration falls by 10 m/s^3, and may do so."""
    limiter = CurvatureLimiter(0.2, 0.2, MAX_ACCELERATION, MAX_JERK, BRAKING)
    limiter.begin(0.14, 4.6)
    demands = [limiter.advance(0.14, 4.6 - 0.4 * k, PERIOD) for k in range(12)]
    assert demands == pytest.approx([0.14] * 12)


def test_a_speed_sensor_that_fails_permits_no_lock() -> None:
    """The measured speed is 0 m/s for a second at 25 m/s; then it is right again."""
    limiter = CurvatureLimiter(0.2, 0.2, MAX_ACCELERATION, MAX_JERK, BRAKING)
    limiter.begin(0.0, 25.0)
    true = [25.0**2 * limiter.advance(0.2, 0.0, PERIOD) for _ in range(20)]
    assert max(true) <= MAX_ACCELERATION * (25.0 / 15.0) ** 2
    assert 25.0**2 * limiter.advance(0.2, 25.0, PERIOD) <= MAX_ACCELERATION + 1e-9


@pytest.mark.parametrize("shift", [3.5, -3.5, 1.5, -20.0])
@pytest.mark.parametrize("bend", [0.0, 0.002])
def test_the_path_that_makes_it_hand_over_is_not_followed(shift: float, bend: float) -> None:
    """The last accepted path is: the demand remains what it is without the jump."""
    cycles = [Cycle(Lane(bend=bend))] * 40
    jump = [Cycle(Lane(shift, bend), acceleration=-BRAKING)] * 100
    commands, rows = drive(LaneSteering(), cycles + jump, 25.0)
    first = next(i for i, c in enumerate(commands) if c.state is SteeringState.HANDOVER)
    assert first == 40
    assert {c.reason for c in commands[40:]} == {SteeringReason.OFF_LANE}
    paths = [c.path for c in commands[40:] if c.path is not None]
    assert len(paths) == 100
    assert max(abs(path.offset) for path in paths) < 0.3  # the car is one that does as demanded
    a = rows[:, 1] ** 2 * [c.curvature for c in commands]
    assert a[39:] == pytest.approx(rows[39:, 1] ** 2 * bend, abs=0.25)


@pytest.mark.parametrize(
    "broken",
    [
        pytest.param(SWAPPED, id="swapped"),
        pytest.param(Lane(shift=math.nan), id="nan"),
        pytest.param(Lane(bend=math.inf), id="infinite"),
    ],
)
def test_lines_that_are_no_lane_count_as_none(broken: Lane) -> None:
    """It drives on by the last path for 0.5 s, and hands over then; if they are back, it drives."""
    for n, state in ((9, SteeringState.DRIVING), (12, SteeringState.HANDOVER)):
        cycles = [Cycle(Lane())] * 5 + [Cycle(broken)] * n + [Cycle(Lane())] * 3
        commands, _ = drive(LaneSteering(), cycles, 39.0)
        assert commands[13].state is not SteeringState.HANDOVER
        assert (commands[-1].state is SteeringState.HANDOVER) == (state is SteeringState.HANDOVER)
        assert all(abs(c.curvature) < 1e-3 for c in commands)


@pytest.mark.parametrize("age", [math.nan, math.inf, -math.inf, -0.06, 0.51])
def test_a_scene_of_a_wrong_age_is_not_used(age: float) -> None:
    commands, _ = drive(
        LaneSteering(), [Cycle(Lane())] * 5 + [Cycle(Lane(shift=1.0), age=age)] * 5, 10.0
    )
    assert max(abs(c.path.offset) for c in commands if c.path) < 0.01


def test_the_driver_is_not_steered_against_before_it_drives() -> None:
    """Without lines, the demand is the curvature of the car. It begins with this and its speed."""
    steering = LaneSteering()
    driver = [Cycle(None, acceleration=1.0, yaw_rate=0.1)] * 200
    commands, rows = drive(steering, [*driver, Cycle(Lane(bend=0.1 / 15), yaw_rate=0.1)], 5.0)
    assert {c.state for c in commands[:-1]} == {SteeringState.HANDOVER}
    assert [c.curvature for c in commands] == pytest.approx(0.1 / rows[:, 1], rel=0.02)
    assert commands[-1].state is not SteeringState.HANDOVER
    assert commands[-1].speed == pytest.approx(rows[-1, 1], abs=0.2)


def test_a_late_update_brakes_for_its_time() -> None:
    """In a handover, the demanded speed falls by 3.75 m/s^2, however long the cycles are."""
    steering = LaneSteering()
    for dt in (0.02, 0.05, 0.2):
        drive(steering, [Cycle(Lane())] * 5 + [Cycle(None, dt=0.6)], 20.0)
        speeds = [
            steering.step(10**9 + round(1e9 * dt) * k, None, Motion(20.0, 0.0)).speed
            for k in range(5)
        ]
        assert np.diff(speeds) == pytest.approx([-BRAKING * dt] * 4)
        steering.reset()
