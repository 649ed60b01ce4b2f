"""Check of scenes against camera lines: faults, missing lines, the suspect."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from maplines_can import Gaussian, MapError, MapLine, Motion, Polyline, Scene, Slot, map_scene
from maplines_can.consumers import WHITE_NOISE, scene_view
from maplines_can.consumers.plausibility import (
    CameraBias,
    Check,
    Outcome,
    PlausibilityCheck,
    residuals,
)

LEFT, RIGHT = Slot.EGO_LEFT, Slot.EGO_RIGHT
NOISE = np.diag([0.05, 0.003, 2e-4, 2e-6]) ** 2
SIGMA = np.array([0.3, 0.1, 0.003])
STILL = Motion(0.0, 0.0)


def lane_scene(
    pose_error: Any = (0, 0, 0), bend: float = 0.0, time: float = 5.0, offset: float = 0.03
) -> Scene:
    """Scene of a lane of constant curvature, as seen from a pose that is wrong."""
    x = np.linspace(-40, 120, 161)
    lines = {
        slot: Polyline(np.column_stack([x, y + bend * x**2 / 2]))
        for slot, y in ((LEFT, 1.75), (RIGHT, -1.75))
    }
    ego = Gaussian(np.array(pose_error, float), np.diag(SIGMA**2))
    return map_scene(lines, ego, correlation_time=time, map_error=MapError(0.03, offset, 0.0005))


def camera(scene: Scene, **shifts: float) -> dict[Slot, Gaussian]:
    """Lines of a camera, as in the scene but for shifts of the offsets by slot name."""
    return {
        line.slot: Gaussian(
            line.gaussian.mean + np.eye(4)[0] * shifts.get(line.slot.name, 0.0), NOISE
        )
        for line in scene.lines
    }


def step(
    check: PlausibilityCheck,
    t: float,
    scene: Scene | None,
    seen: Mapping[Slot, Gaussian | MapLine],
    motion: Motion = STILL,
) -> Check:
    """Compare the lines of an image at a time [s], with those of a scene of the same time."""
    lines = [
        line if isinstance(line, MapLine) else MapLine(slot, line, x_min=-20, x_max=80)
        for slot, line in seen.items()
    ]
    return check.step(round(1e9 * t), scene_view(scene), motion, lines)


def test_residuals_follow_the_pose_error() -> None:
    """The model's H times the pose error is what the lines move by, in a bend as well."""
    error = np.array([0.2, 0.05, 0.002])
    true, wrong = lane_scene(bend=0.02), lane_scene(error, bend=0.02)
    compared = residuals(wrong, camera(true))
    assert compared is not None
    slots, z, model = compared
    assert slots == (LEFT, RIGHT)
    assert z == pytest.approx(model.H @ error, abs=0.015)


def test_residuals_take_the_displacement_into_account() -> None:
    """A camera image 0.5 m further on, with the car turned, by an uncertain odometry."""
    bend, moved = lane_scene(bend=0.01), lane_scene((0.5, 0.1, 0.01), bend=0.01)
    noises = []
    for sigma in (0.0, 0.1):
        displacement = Gaussian([0.5, 0.1, 0.01], np.diag([0.0, sigma, 0.0]) ** 2)
        compared = residuals(bend, camera(moved), displacement)
        assert compared is not None
        assert compared[1] == pytest.approx(np.zeros(4), abs=2e-3)
        noises.append(compared[2].noise_cov)
    of_a_line = np.kron(np.eye(2), np.ones((2, 2)))  # far and near, but not left and right
    assert noises[1] - noises[0] == pytest.approx(0.01 * of_a_line, abs=1e-3)


@pytest.mark.parametrize(
    ("shifts", "suspect"),
    [
        pytest.param({"EGO_LEFT": -3.5}, LEFT, id="left-of-next-lane"),
        pytest.param({"EGO_RIGHT": 3.5}, RIGHT, id="right-of-next-lane"),
        pytest.param({"EGO_LEFT": 0.8, "EGO_RIGHT": 0.8}, None, id="common-shift"),
    ],
)
@pytest.mark.parametrize(
    ("known", "images"),
    [
        pytest.param({"camera_noise": WHITE_NOISE, "longest_pose_time": 0.0}, 1, id="as-stated"),
        pytest.param({"camera_noise": WHITE_NOISE}, 1, id="white-camera"),
        pytest.param({}, 4, id="default"),
    ],
)
def test_faults_are_found_in_a_few_images(
    shifts: dict[str, float], suspect: Any, known: Any, images: int
) -> None:
    """In the first one if the noise is known to be Gaussian, else in the fourth."""
    scene = lane_scene()
    check = PlausibilityCheck(**known)
    for k in range(20):
        assert step(check, 0.05 * k, scene, camera(scene)).outcome is Outcome.CONSISTENT
    found = [step(check, 1.0 + 0.05 * k, scene, camera(scene, **shifts)) for k in range(5)]
    first = found[images - 1]
    assert [one.raised for one in found].index(True) == images - 1
    assert first.outcome is Outcome.INCONSISTENT
    assert first.suspect is suspect
    assert first.statistic > 1
    assert (found[4].outcome, found[4].raised) == (Outcome.INCONSISTENT, False)


@pytest.mark.parametrize("known", [{"camera_noise": WHITE_NOISE, "longest_pose_time": 0.0}, {}])
@pytest.mark.parametrize("radius", [math.inf, 500.0, 150.0, 50.0])
@pytest.mark.parametrize(("size", "since", "within"), [(1.0, 0, 6), (1.0, 100, 6), (0.5, 0, 660)])
def test_a_shift_is_found_in_bends_and_from_the_start(
    known: Any, radius: float, size: float, since: int, within: int
) -> None:
    """One of 1 m within 0.3 s, one of 0.5 m from the start within 33 s, by their images."""
    scene, check = lane_scene(bend=1 / radius), PlausibilityCheck(0.01, **known)
    motion, shifts = Motion(15.0, 15.0 / radius), {"EGO_LEFT": size, "EGO_RIGHT": size}
    for k in range(since + within):
        seen = camera(scene, **shifts) if k >= since else camera(scene)
        if step(check, 0.05 * k, scene, seen, motion).raised:
            break
    assert since <= k < since + within - 1


@pytest.mark.parametrize(
    ("scene", "seen"),
    [
        pytest.param(None, {}, id="no-scene"),
        pytest.param(lane_scene(), {}, id="no-camera"),
        pytest.param(lane_scene(), {Slot.NEXT_LEFT: Gaussian([5, 0, 0, 0], NOISE)}, id="others"),
        pytest.param(
            lane_scene(),
            {LEFT: MapLine(LEFT, Gaussian([1.75, 0, 0, 0], NOISE), x_min=0, x_max=3.9)},
            id="camera-line-too-short",
        ),
    ],
)
def test_without_a_common_line_nothing_is_checked(scene: Any, seen: Any) -> None:
    found = step(PlausibilityCheck(), 0.0, scene, seen)
    assert (found.outcome, found.slots) == (Outcome.UNCHECKED, ())


def test_lines_come_and_go_without_an_alarm() -> None:
    both = lane_scene()
    one = both.subset([LEFT])
    check = PlausibilityCheck()
    found = [step(check, 0.05 * k, (both, one)[k // 3 % 2], camera(both)) for k in range(60)]
    assert {check.outcome for check in found} == {Outcome.CONSISTENT}
    assert {check.slots for check in found} == {(LEFT, RIGHT), (LEFT,)}


@pytest.mark.parametrize("known", [{}, {"camera_noise": WHITE_NOISE, "longest_pose_time": 0.0}])
def test_another_line_has_errors_of_its_own(known: dict[str, Any]) -> None:
    """After a lane change, the slots have other lines: what was known of the last ones is not true.

    Each line is off by 1.5 standard deviations, to the other side than the one before it.
    """
    before, after = lane_scene((0, 1.65, 0), offset=0.2), lane_scene((0, -1.85, 0), offset=0.2)
    check, ahead = PlausibilityCheck(1.0, **known), Motion(10.0, 0.0)
    found = [
        step(
            check,
            0.05 * k,
            scene,
            camera(scene, EGO_LEFT=side * 0.3, EGO_RIGHT=-side * 0.3),
            motion=ahead,
        ).outcome
        for k, (scene, side) in enumerate([(before, 1)] * 150 + [(after, -1)] * 150)
    ]
    assert {*found} == {Outcome.CONSISTENT}


def test_the_motion_of_an_outage_counts() -> None:
    """Turned by 90 deg without a camera: the lateral pose error may be another one now."""

    def statistic(yaw_rate: float) -> float:
        check = PlausibilityCheck(camera_bias=CameraBias(0.0, 0.0), camera_noise=WHITE_NOISE)
        scene, t = lane_scene(time=50.0), 0.0
        scene = replace(
            scene, pose_error=replace(scene.pose_error, cov=np.diag([0.5, 0.5, 0.003]) ** 2)
        )
        for _ in range(40):
            t += 0.05
            step(check, t, scene, camera(scene, EGO_LEFT=0.2, EGO_RIGHT=0.2))
        for _ in range(10):
            t += 0.05
            step(check, t, None, {}, motion=Motion(5.0, yaw_rate))
        t += 0.05
        return step(check, t, scene, camera(scene, EGO_LEFT=-0.4, EGO_RIGHT=-0.4)).statistic

    assert statistic(math.pi) < 1 < statistic(0.0)


def test_time_must_increase() -> None:
    check = PlausibilityCheck()
    step(check, 1.0, None, {})
    for t in (1.0, 0.5, math.nan, math.inf):
        with pytest.raises(ValueError, match="now_ns must be finite and later than 1000000000 ns"):
            check.step(1e9 * t, None, STILL)  # type: ignore[arg-type]
