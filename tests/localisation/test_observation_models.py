"""What a car sees of its map: the lines beside it, Jacobians, and the association."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.lane_maps import arc, lane, network

from maplines_can.localisation import (
    CameraLines,
    LocalisationLayer,
    SeenLandmarks,
    SensorErrors,
    Verdict,
)
from maplines_can.localisation.confirmation import confirmed
from maplines_can.localisation.motion_model import initial
from maplines_can.localisation.observation_models import innovation
from maplines_can.maps import Landmark, LandmarkKind
from maplines_can.values.line import Kind
from maplines_can.values.polyline import Polyline

KINDS = (Kind.DASHED, Kind.SOLID)
COV = np.diag([0.05, 0.005]) ** 2


def layer_of(curvature: float = 0.0, **landmarks: tuple[float, float]) -> LocalisationLayer:
    """Return the layer of one lane of width 3.5 m from (0, 0), 200 m long, and of poles."""
    poles = tuple(Landmark(name, LandmarkKind.POLE, *at) for name, at in landmarks.items())
    return LocalisationLayer(network(lane("1", curvature=curvature, kinds=KINDS), landmarks=poles))


def prior(pose: Any, sigma: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return state and covariance for a pose with standard deviations."""
    return initial(np.array([pose], dtype=float), np.diag(sigma) ** 2.0, SensorErrors())


def lines(*seen: tuple[float, float], kinds: Any = KINDS) -> CameraLines:
    offset, heading = np.array(seen).T[:, None]
    return CameraLines(0.0, offset, heading, np.array([kinds[: len(seen)]]), COV)


def landmarks(*seen: tuple[float, float]) -> SeenLandmarks:
    return SeenLandmarks(0.0, np.array([seen]), 0.04 * np.eye(2))


def verdicts(observation: Any, mean: Any, cov: Any, layer: LocalisationLayer) -> list[Verdict]:
    found = innovation(observation, mean, cov, layer)
    return [Verdict(v) for v in confirmed(found, cov, None, 0.0)[0].verdict[0]]


@pytest.mark.parametrize("curvature", [0.0, 0.02, -0.05])
@pytest.mark.parametrize("turn", [0.0, 0.2, math.pi + 0.1])
def test_lines_beside_a_car(curvature: float, turn: float) -> None:
    """Where they cross its y axis, and their direction there, on a road of known curvature."""
    layer = layer_of(curvature)
    (x, y), t = arc((0, 0, 0), 30.0, curvature, np.full(2, 0.4))[-1], 0.4
    pose = np.array([x, y, 30.0 * curvature + turn])
    beside = layer.lines_beside(pose[None])
    assert len(beside.car) == 2
    for i in range(2):
        side = 1.75 if beside.kind[i] == Kind.DASHED else -1.75
        # A circle around the centre of the arc, or a straight line, in the frame of the car.
        if curvature:
            centre = (1 / curvature - t) * np.array([math.sin(turn), math.cos(turn)])
            radius = abs(1 / curvature - side)
            root = math.sqrt(radius**2 - centre[0] ** 2)
            roots = [centre[1] + root, centre[1] - root]
            offset = min(roots, key=lambda root: abs(root - beside.offset[i]))
            heading = math.atan(centre[0] / (offset - centre[1]))
        else:
            offset, heading = (side - t) / math.cos(turn), math.remainder(-turn, math.pi)
        assert beside.offset[i] == pytest.approx(offset, abs=5e-3)
        assert beside.heading[i] == pytest.approx(heading, abs=5e-3)


def test_lines_that_cannot_be_seen_are_none() -> None:
    """Those without a marking, behind the end of the road, and across the car."""
    unmarked = LocalisationLayer(network(lane("1", kinds=(Kind.VIRTUAL, Kind.SOLID))))
    poses = np.array([[50.0, 0, 0], [-5.0, 0, 0], [50.0, 0, 1.5], [50.0, 50.0, 0.0]])
    beside = unmarked.lines_beside(poses)
    assert beside.car.tolist() == [0]
    assert beside.offset == pytest.approx([-1.75])


def test_lines_are_found_by_position_and_kind() -> None:
    """A precise pose: the true lines are used, a false one is an outlier."""
    mean, cov = prior([50, 0, 0], [0.1, 0.05, 0.003])
    layer = layer_of()
    assert verdicts(lines((1.75, 0.0), (-1.75, 0.0)), mean, cov, layer) == [Verdict.USED] * 2
    assert verdicts(lines((1.75, 0.0), (-2.6, 0.0)), mean, cov, layer)[1] == Verdict.OUTLIER
    swapped = lines((1.75, 0.0), (-1.75, 0.0), kinds=KINDS[::-1])
    assert verdicts(swapped, mean, cov, layer) == [Verdict.OUTLIER] * 2
    unknown = lines((1.75, 0.0), (-1.75, 0.0), kinds=(Kind.UNKNOWN, Kind.UNKNOWN))
    assert verdicts(unknown, mean, cov, layer) == [Verdict.USED] * 2
    assert verdicts(lines((math.nan, 0.0)), mean, cov, layer) == [Verdict.MISSING]


def test_a_line_between_two_of_the_map_is_ambiguous() -> None:
    """If the pose is too uncertain to tell them apart."""
    mean, cov = prior([50, 0, 0], [1.0, 1.2, 0.003])
    seen = lines((0.1, 0.0), kinds=(Kind.UNKNOWN,))
    assert verdicts(seen, mean, cov, layer_of()) == [Verdict.AMBIGUOUS]


def test_an_uncertain_pose_needs_two_lines_that_agree() -> None:
    """A false line within the wide gate is not used, nor the true one beside it."""
    mean, cov = prior([50, 0.8, 0], [1.0, 0.7, 0.003])
    layer = layer_of()
    both = lines((1.75, 0.0), (-1.75, 0.0))
    assert verdicts(both, mean, cov, layer) == [Verdict.USED] * 2
    assert verdicts(lines((1.75, 0.0)), mean, cov, layer) == [Verdict.UNCONFIRMED]
    disagree = lines((1.75, 0.0), (-1.2, 0.0))
    assert verdicts(disagree, mean, cov, layer) == [Verdict.UNCONFIRMED] * 2


def test_landmarks_are_found_by_position() -> None:
    """Of two close ones it is ambiguous which is seen; far from all, there is none."""
    mean, cov = prior([0, 0, 0], [0.2, 0.2, 0.003])
    layer = layer_of(a=(20.0, 5.0), b=(20.0, 5.4), c=(30.0, -5.0))
    assert verdicts(landmarks((30.1, -5.1)), mean, cov, layer) == [Verdict.USED]
    assert verdicts(landmarks((20.0, 5.2)), mean, cov, layer) == [Verdict.AMBIGUOUS]
    assert verdicts(landmarks((32.0, -5.0)), mean, cov, layer) == [Verdict.OUTLIER]
    assert verdicts(landmarks((60.0, 0.0)), mean, cov, layer) == [Verdict.UNMATCHED]
    assert verdicts(landmarks((math.nan, 0.0)), mean, cov, layer) == [Verdict.MISSING]


def test_without_a_map_nothing_is_matched() -> None:
    mean, cov = prior([0, 0, 0], [0.2, 0.2, 0.003])
    for seen in (lines((1.0, 0.0)), landmarks((9.0, 1.0))):
        assert innovation(seen, mean, cov, None).verdict.tolist() == [[Verdict.UNMATCHED]]


def test_the_kind_of_a_line_is_that_beside_the_car() -> None:
    """A part that a camera does not see is none."""
    one = lane("1", (0.0, 0.0, 0.0), 200.0, kinds=(Kind.KERB, Kind.VIRTUAL))
    kinds = [(0.0, Kind.DASHED), (60.0, Kind.VIRTUAL), (140.0, Kind.SOLID)]
    changing = replace(one, right=Polyline(one.right.points, kinds))
    poses = np.array([[30.0, 0.0, 0.0], [100.0, 0.0, 0.0], [170.0, 0.0, 0.0]])
    found = LocalisationLayer(network(changing)).lines_beside(poses)
    seen = sorted(zip(found.car.tolist(), (found.offset < 0).tolist(), found.kind, strict=True))
    assert seen == [
        (0, False, Kind.KERB), (0, True, Kind.DASHED), (1, False, Kind.KERB),
        (2, False, Kind.KERB), (2, True, Kind.SOLID),
    ]  # fmt: skip
