"""What lane fusion takes of scenes and camera lines, by a source that a test controls."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag

from maplines_can import Gaussian, MapLine, Motion, PoseError, Scene, Slot
from maplines_can.consumers import LaneFusion, scene_view
from maplines_can.consumers.lane_filter import LaneFilter, move_lines
from maplines_can.propagation import predict
from maplines_can.values.seen_lines import SeenLines
from maplines_can.wire import ReceivedScene, SceneView

LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
P = np.diag([0.3, 0.2, 0.003]) ** 2
OWN = np.diag([0.05, 1e-3, 1e-5, 1e-7]) ** 2
RANGES = np.array([[-20.0, 80.0], [-10.0, 60.0]])
MEANS = np.array([[1.75, 0.01, 1e-3, 1e-6], [-1.75, 0.01, 1e-3, 0.0]])
CAMERA = np.diag([0.05, 0.005, 5e-4, 2e-5]) ** 2
STILL, DRIVING = Motion(0.0, 0.0), Motion.with_sigma(10.0, 0.05, (0.3, 0.01))
#: Of each parameter, what moves a line by 1 m at 20 m.
AT_20 = np.array([1.0, 1 / 20, 1 / 200, 6 / 8000])
SECOND = 1_000_000_000


def scene_of(slots: Any = LANE, means: Any = MEANS, time: float = 10.0, pose: Any = P) -> Scene:
    """Lines with their own errors, and those of the pose."""
    keep = [LANE.index(slot) for slot in slots]
    seen = SeenLines(means[keep], RANGES[keep])
    J = seen.jacobian().reshape(-1, 3)
    cov = J @ pose @ J.T + np.kron(np.eye(len(keep)), OWN)
    lines = tuple(
        MapLine(
            slot,
            Gaussian(mean, cov[4 * i : 4 * i + 4, 4 * i : 4 * i + 4]),
            x_min=RANGES[k, 0] + 5,
            x_max=RANGES[k, 1] - 5,
        )
        for i, (slot, mean, k) in enumerate(zip(slots, means[keep], keep, strict=True))
    )
    return Scene(lines, cov, PoseError(pose, time), RANGES[keep])


class Source:
    """Source of one scene at a time."""

    def __init__(self, scene: Scene | None = None, age: float = 0.0) -> None:
        self.scene, self.age, self.usable, self.t_ns, self.counter = scene, age, True, 0, 0
        self.slots: set[Slot] = set(LANE)  #: of the lines that have come

    @property
    def view(self) -> SceneView:
        scene = (
            None
            if self.scene is None
            else self.scene.subset(
                line.slot for line in self.scene.lines if line.slot in self.slots
            )
        )
        received = None if scene is None else ReceivedScene(scene, self.counter, self.t_ns, 0.0)
        return scene_view(scene, self.age)._replace(stale=not self.usable, received=received)


def lateral_sigmas(lane: Any) -> list[float]:
    assert lane.scene is not None
    return [float(line.y_sigma(0.0)) for line in lane.scene.lines]


def seen_by_camera(y: float = 0.0, slots: Any = LANE, **rest: Any) -> list[MapLine]:
    means = {slot: MEANS[i] + [y, 0, 0, 0] for i, slot in enumerate(LANE)}
    return [MapLine(slot, Gaussian(means[slot], CAMERA), x_max=50.0, **rest) for slot in slots]


@pytest.mark.parametrize("age", [0.0, 0.2])
@pytest.mark.parametrize("slots", [LANE, LANE[:1], LANE[1:], LANE[::-1]])
def test_the_first_scene_is_the_lane(age: float, slots: Any) -> None:
    """Moved to the present as ``predict`` does; its own errors count twice, with their noise."""
    scene = scene_of(slots)
    lane = LaneFusion().step(SECOND, Source(scene, age).view, DRIVING)
    assert lane.scene is not None
    moved = DRIVING.over(age, 0.004)
    for slot in slots:
        line = lane.scene.line(slot)
        expected = predict(scene.line(slot).gaussian, moved, (-20.0, 60.0))
        error = (line.gaussian.mean - expected.mean) / AT_20
        assert np.abs(error).max() <= 1e-2
        doubled = scene.line(slot).gaussian.cov + OWN
        doubled[2, 2] += 7e-5**2
        i = scene.index[slot]
        _, F, G = move_lines(scene.means[None, i], moved.mean, scene.fit_ranges[None, i])
        cov = F[0] @ doubled @ F[0].T + 2 * G[0] @ moved.cov @ G[0].T
        got = line.gaussian.cov / np.outer(AT_20, AT_20)
        want = cov / np.outer(AT_20, AT_20)
        assert got == pytest.approx(want, abs=2e-2 * want.max())
        shift = moved.mean[0]
        given = scene.line(slot)
        assert [line.x_min, line.x_max] == pytest.approx([given.x_min - shift, given.x_max - shift])
    for slot in set(LANE) - {*slots}:
        assert lane.scene.line(slot).y_sigma(0.0) > 25
    assert lane.map_age == pytest.approx(age)
    assert lane.scene.pose_error.correlation_time == 10.0
    assert lane.pose_error is not None
    assert lane.pose_error.cov == pytest.approx(P)
    assert not lane.pose_error.mean.any()


@pytest.mark.parametrize(
    ("change", "is_used"),
    [
        ({}, True),
        ({"usable": False}, False),
        ({"scene": None}, False),
        ({"age": 0.5}, True),
        ({"age": 0.501}, False),
        ({"slots": set()}, False),
    ],
)
def test_which_scenes_are_used(change: Any, is_used: bool) -> None:
    source = Source(scene_of())
    for name, value in change.items():
        setattr(source, name, value)
    lane = LaneFusion().step(0, source.view, STILL)
    assert (lane.scene is not None) is is_used
    assert math.isfinite(lane.map_age) is is_used


def test_a_line_that_comes_later_in_its_scene_is_added() -> None:
    """And the line that was there is not fused again."""
    source = Source(scene_of())
    source.slots = {Slot.EGO_LEFT}
    fusion = LaneFusion()
    first = lateral_sigmas(fusion.step(0, source.view, STILL))
    source.slots = set(LANE)
    second = lateral_sigmas(fusion.step(0, source.view, STILL))
    third = lateral_sigmas(fusion.step(0, source.view, STILL))
    assert second[0] == pytest.approx(first[0], rel=0.03)
    assert second[1] < 0.3 < 25 < first[1]
    assert third == second


@pytest.mark.parametrize("name", ["t_ns", "counter"])
def test_another_scene_is_used(name: str) -> None:
    """With another time or another counter."""
    source = Source(scene_of())
    fusion = LaneFusion()
    first = fusion.step(0, source.view, STILL)
    setattr(source, name, 1)
    second = fusion.step(0, source.view, STILL)
    assert first.scene is not None
    assert second.scene is not None
    assert second.scene.width(0.0).sigma < 0.95 * first.scene.width(0.0).sigma


def test_the_age_of_the_map_is_that_of_the_newest_scene_that_was_used() -> None:
    source = Source(scene_of(), age=0.25)
    fusion = LaneFusion()
    assert fusion.step(2 * SECOND, source.view, STILL).map_age == pytest.approx(0.25)
    source.usable = False
    assert fusion.step(3 * SECOND, source.view, STILL).map_age == pytest.approx(1.25)
    source.usable, source.counter = True, 1
    assert fusion.step(3 * SECOND + 1, source.view, STILL).map_age == pytest.approx(0.25)


@pytest.mark.parametrize(("gap_ns", "lasts"), [(2 * SECOND, True), (2 * SECOND + 1, False)])
def test_a_gap_of_more_than_two_seconds_starts_again(gap_ns: int, lasts: bool) -> None:
    source = Source(scene_of())
    fusion = LaneFusion()
    fusion.step(0, source.view, STILL)
    source.usable = False
    lane = fusion.step(gap_ns, source.view, STILL)
    assert (lane.scene is not None) is lasts
    assert (lane.pose_error is not None) is lasts
    assert math.isfinite(lane.map_age) is lasts


@pytest.mark.parametrize("metres", [5.0, 50.0, 54.9, 55.1, 90.0])
def test_the_lane_ends_where_its_shorter_line_does(metres: float) -> None:
    """The valid ranges move with the car; the right line is valid up to 55 m."""
    source = Source(scene_of())
    fusion = LaneFusion()
    fusion.step(0, source.view, STILL)
    source.usable = False
    lane = fusion.step(SECOND, source.view, Motion(metres, 0.0))
    if metres > 55:
        assert lane.scene is None
        return
    assert lane.scene is not None
    expected = RANGES + np.array([5, -5]) - metres
    for line, (low, high) in zip(lane.scene.lines, expected, strict=True):
        assert [line.x_min, line.x_max] == pytest.approx([low, high])
    assert lane.scene.fit_ranges == pytest.approx(RANGES - metres)


def test_a_lane_that_the_car_stands_across_starts_again() -> None:
    """After a turn of 100 degrees no line is a function of x."""
    source = Source(scene_of())
    fusion = LaneFusion()
    fusion.step(0, source.view, STILL)
    source.usable = False
    lane = fusion.step(SECOND, source.view, Motion(0.0, 1.75))
    assert (lane.scene, lane.pose_error, lane.map_age) == (None, None, math.inf)
    source.usable = True
    assert fusion.step(SECOND, source.view, STILL).scene is not None


@pytest.mark.parametrize(
    ("ages", "is_used"),
    [
        ({"age": 0.0}, True),
        ({"age": 0.5}, True),
        ({"age": 0.501}, False),
        ({"age": math.inf}, False),
        ({"age": 0.1, "t_ns": 4 * SECOND}, False),  # 1.1 s old
        ({"age": 0.1, "t_ns": 5 * SECOND - 300_000_000}, True),
        ({"age": 0.1, "t_ns": 5 * SECOND + 100_000_000}, True),
        ({"age": 0.1, "t_ns": 5 * SECOND + 100_000_001}, False),  # of the future
    ],
)
def test_which_camera_lines_are_used(ages: Any, is_used: bool) -> None:
    """By the age that they state, and the time since their reception."""
    lane = LaneFusion().step(5 * SECOND, None, STILL, seen_by_camera(**ages))
    assert lane.used == (LANE if is_used else ())
    assert lane.rejected == ()
    assert (lane.scene is not None) is is_used


def test_a_camera_line_is_not_used_before_the_first_scene() -> None:
    """If there is a source of scenes: no gate would find that it is a false one."""
    source = Source(scene_of())
    source.usable = False
    fusion = LaneFusion()
    lane = fusion.step(0, source.view, STILL, seen_by_camera())
    assert (lane.scene, lane.used, lane.rejected) == (None, (), ())
    source.usable = True
    assert fusion.step(0, source.view, STILL, seen_by_camera()).used == LANE


@pytest.mark.parametrize("age", [0.0, 0.3])
def test_the_first_camera_lines_are_the_lane(age: float) -> None:
    """Without a map: the line of its time, moved to the present, with the biases of the camera."""
    slots = LANE[:1]
    lane = LaneFusion(bias_sigma=(0.04, 0.003, 1e-4, 0.0)).step(
        SECOND, None, DRIVING, seen_by_camera(slots=slots, age=age)
    )
    assert lane.scene is not None
    moved = DRIVING.over(age)
    mean, F, G = move_lines(MEANS[:1], moved.mean, np.array([[0.0, 50.0]]))
    line = lane.scene.line(LANE[0])
    assert (line.gaussian.mean - mean[0]) / AT_20 == pytest.approx(np.zeros(4), abs=1e-3)
    cov = F[0] @ CAMERA @ F[0].T + G[0] @ moved.cov @ G[0].T
    cov += np.diag([0.04, 0.003, 1e-4, 0.0]) ** 2
    scale = np.outer(AT_20, AT_20)
    assert line.gaussian.cov / scale == pytest.approx(cov / scale, abs=5e-3 * (cov / scale).max())
    assert [line.x_min, line.x_max] == pytest.approx([0 - moved.mean[0], 50 - moved.mean[0]])
    assert lane.scene.line(LANE[1]).y_sigma(0.0) > 25
    assert lane.pose_error is None
    assert lane.scene.pose_error.correlation_time == math.inf
    assert not lane.scene.pose_error.cov.any()


@pytest.mark.parametrize("turn", [0.5, -0.3])
@pytest.mark.parametrize("frame", ["map", "ego"])
def test_the_pose_error_lasts_in_its_frame(frame: Any, turn: float) -> None:
    """While the car turns, one in the frame of the map turns the other way relative to the car."""
    pose = np.diag([0.3, 0.3, 1e-4]) ** 2
    source = Source(scene_of(pose=pose, time=1e6))
    fusion = LaneFusion(error_frame=frame, handling="state")
    for k in range(5):
        source.counter = k
        lane = fusion.step(0, source.view, STILL, seen_by_camera(0.3))
    assert lane.pose_error is not None
    along, across = before = lane.pose_error.mean[:2]
    assert across == pytest.approx(0.3, abs=0.15)
    source.scene = scene_of(means=MEANS - [0, turn, 0, 0], pose=pose, time=1e6)
    source.usable = False
    for k in (1, 2):  # what the car has turned adds up
        fusion.step(k * SECOND, source.view, Motion(0.0, turn / 2))
    source.usable, source.counter = True, 99
    lane = fusion.step(2 * SECOND, source.view, STILL)
    assert lane.pose_error is not None
    c, d = math.cos(turn), math.sin(turn)
    turned = [c * along + d * across, c * across - d * along]
    expected = turned if frame == "map" else before
    assert lane.pose_error.mean[:2] == pytest.approx(expected, abs=1e-5)
    source.counter = 100  # the turn counts once
    lane = fusion.step(2 * SECOND, source.view, STILL)
    assert lane.pose_error is not None
    assert lane.pose_error.mean[:2] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("time", "handling", "estimates"),
    [
        (10.0, None, True),
        (math.inf, None, False),
        (math.inf, "state", True),
        (10.0, "consider", False),
    ],
)
def test_who_estimates_the_pose_error(time: float, handling: Any, estimates: bool) -> None:
    """A known correlation time, or the caller's will."""
    fusion, source = LaneFusion(handling=handling), Source(scene_of(time=time))
    lane = fusion.step(0, source.view, STILL, seen_by_camera(0.2))
    assert lane.pose_error is not None
    assert bool(lane.pose_error.mean.any()) is estimates
    assert bool(lane.pose_error.sigma[1] < 0.19) is estimates
    assert lane.scene is not None
    assert lane.scene.pose_error.cov == pytest.approx(lane.pose_error.cov)
    assert lane.scene.pose_error.correlation_time == time


def test_the_pose_error_is_forgotten_with_its_correlation_time() -> None:
    """A prediction of T ln 2 takes half of its mean."""
    source = Source(scene_of(time=2.0))
    fusion = LaneFusion()
    first = fusion.step(0, source.view, STILL, seen_by_camera(0.2))
    source.usable = False
    lane = fusion.step(round(2 * math.log(2) * SECOND), source.view, STILL)
    assert first.pose_error is not None
    assert lane.pose_error is not None
    assert lane.pose_error.mean == pytest.approx(first.pose_error.mean / 2)


def test_the_steps_are_those_of_a_lane_filter() -> None:
    """Scenes of other ages, camera lines and motions, against the filter with the same inputs."""
    source, peer = Source(scene_of(time=5.0)), LaneFilter()
    fusion, fits = LaneFusion(), RANGES
    root = np.linalg.cholesky(P)
    for k in range(4):
        source.counter, source.age = k, 0.05 * k
        if k:
            moved = DRIVING.over(0.1)
            peer.predict(moved.mean, moved.cov, 0.1, fits, 5.0)
        lane = fusion.step(k * 100_000_000, source.view, DRIVING, seen_by_camera(0.01 * k, age=0.1))
        assert source.scene is not None
        moved = DRIVING.over(source.age, 0.004)
        lines, F, G = move_lines(MEANS, moved.mean, RANGES)
        fits = RANGES - moved.mean[0]
        F, G = block_diag(*F), G.reshape(-1, 3)
        J = SeenLines(MEANS, RANGES).jacobian().reshape(-1, 3)
        own = F @ np.kron(np.eye(2), OWN) @ F.T + G @ moved.cov @ G.T
        peer.update_map(lines.ravel(), F @ J @ root, own, None, np.ones(8, dtype=bool))
        for i, line in enumerate(seen_by_camera(0.01 * k)):
            moved = DRIVING.over(0.1)
            mean, F, G = move_lines(line.gaussian.mean[None], moved.mean, np.array([[0.0, 50.0]]))
            cov = F[0] @ CAMERA @ F[0].T + G[0] @ moved.cov @ G[0].T
            peer.update_camera(np.tile(mean, (2, 1)), np.tile(cov, (2, 1, 1)), np.arange(2) == i)
    assert lane.scene is not None
    scale = np.tile(AT_20, 2)
    assert lane.scene.means.ravel() / scale == pytest.approx(peer.mean[:8] / scale, abs=1e-6)
    error = (lane.scene.cov - peer.cov[:8, :8]) / np.outer(scale, scale)
    assert np.abs(error).max() <= 1e-6


@pytest.mark.parametrize(
    "wrong", [(math.inf, 0, 0, 0), (0, 0, 0, math.nan), (0, -1e-9, 0, 0), (0, 0, 0), 0.1]
)
def test_biases_are_four_finite_standard_deviations(wrong: Any) -> None:
    with pytest.raises(ValueError, match="bias_sigma must be 4 numbers"):
        LaneFusion(bias_sigma=wrong)
    assert LaneFusion(bias_sigma=(0, 0, 0, 0)).step(0, None, STILL).scene is None
