"""Lines of the camera where the car does not know which part of the map it sees.

Each test failed when a line was compared with the map at the estimated pose alone.
"""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from support.lane_maps import lane, network

from maplines_can.localisation import CameraLines, LocalisationLayer, SensorErrors, Verdict
from maplines_can.localisation.confirmation import IN_A_ROW, PAUSE, confirmed
from maplines_can.localisation.motion_model import POSE, initial, update
from maplines_can.localisation.observation_models import innovation
from maplines_can.maps import Lane
from maplines_can.values.line import Kind
from maplines_can.values.polyline import Polyline

COV = np.diag([0.05, math.radians(0.3)]) ** 2
ALONG = 0.85  #: standard deviation of the place along the road [m]
#: Beyond it are 0.01 % of the normalised errors squared of a right filter.
MOST = float(chi2.isf(1e-4, 3))


def layer_of(*lanes: Any) -> LocalisationLayer:
    return LocalisationLayer(network(*lanes))


def seen_at(layer: LocalisationLayer, pose: Any) -> CameraLines:
    """The nearest line on each side of a car, as a camera without noise sees them."""
    beside = layer.lines_beside(np.array([pose], dtype=float))
    sides = [np.flatnonzero(sign * beside.offset > 0) for sign in (1, -1)]
    rows = [side[np.abs(beside.offset[side]).argmin()] for side in sides if len(side)]
    offset, heading = beside.offset[None, rows], beside.heading[None, rows]
    return CameraLines(0.0, offset, heading, beside.kind[None, rows], COV)


def known(estimate: Any, sigma: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    errors = SensorErrors()
    return initial(np.array([estimate], dtype=float), np.diag(np.square(sigma)), errors)


def nees_after(
    layer: LocalisationLayer, true: Any, estimate: Any, sigma: Any, images: int
) -> float:
    """Normalised error squared of the pose after images that are all used."""
    mean, cov = known(estimate, sigma)
    for _ in range(images):
        found = innovation(seen_at(layer, true), mean, cov, layer)
        used = found.verdict == Verdict.USED
        mean, cov, _ = update(mean, cov, found.residual, found.H, found.R, used)
    error = mean[0, POSE] - true
    return float(error @ np.linalg.solve(cov[0, POSE, POSE], error))


@pytest.mark.parametrize("error", np.linspace(-2, 2, 17) * ALONG)
@pytest.mark.parametrize("radius", [10.0, 25.0, 80.0])
def test_where_a_bend_begins_the_pose_is_as_exact_as_stated(error: float, radius: float) -> None:
    """Wherever within 2 sigma along the car is, the bend begins 0.8 m behind the estimate."""
    straight = lane("1", length=50.0, kinds=(Kind.DASHED, Kind.SOLID))
    bent = lane("2", (50, 0, 0), 15.0, curvature=1 / radius, kinds=(Kind.DASHED, Kind.SOLID))
    layer, estimate = layer_of(straight, bent), np.array([50.8, 0, 0])
    true = estimate + np.array([error, 0, 0])
    assert nees_after(layer, true, estimate, [ALONG, 0.05, 0.002], 2) < MOST


@pytest.mark.parametrize("ahead", [True, False])
@pytest.mark.parametrize("error", [0.8, 1.2, 1.6])
def test_a_line_that_begins_or_ends_beside_the_car_contradicts_nothing(
    ahead: bool, error: float
) -> None:
    """It is not taken for another one of its kind, which would be an outlier in each image."""
    whole = lane("1", t=3.5, kinds=(Kind.SOLID, Kind.DASHED))
    start, length = ((100, 0, 0), 100.0) if ahead else ((0, 0, 0), 100.0)
    short = lane("2", start, length, kinds=(Kind.DASHED, Kind.SOLID))
    side = 1 if ahead else -1
    true, estimate = [100.0 + side * 0.1, 0, 0], [100.0 + side * (0.1 - error), 0, 0]
    layer = layer_of(whole, short)
    mean, cov = known(estimate, [ALONG, 0.3, 0.01])
    found = innovation(seen_at(layer, true), mean, cov, layer)
    assert found.verdict.tolist() == [[Verdict.USED, Verdict.USED]]
    assert np.abs(found.residual[0, :, 0]).max() < 0.01


@pytest.mark.parametrize("turn", np.linspace(-0.05, 0.05, 11))
@pytest.mark.parametrize("which", [0, 1])
def test_of_two_lines_that_cross_it_is_open_which_is_seen(turn: float, which: int) -> None:
    """The direction of neither is taken for the one that is seen, if the pose cannot tell."""
    both = [
        lane("1", length=100, kinds=(Kind.SOLID, Kind.UNKNOWN), width=3.0),
        lane(
            "2",
            (50 * (1 - math.cos(0.08)), 1.5 - 50 * math.sin(0.08), 0.08),
            100,
            t=-1.5,
            kinds=(Kind.SOLID, Kind.UNKNOWN),
            width=3.0,
        ),
    ]
    own = LocalisationLayer(network(both[which]))
    true, estimate = np.array([50.0, 0.0, 0.04 + turn]), np.array([50.0, 0.0, 0.04])
    mean, cov = known(estimate, [ALONG, 0.05, 0.02])
    layer = layer_of(*both)
    found = innovation(seen_at(own, true), mean, cov, layer)
    used = found.verdict == Verdict.USED
    mean, cov, _ = update(mean, cov, found.residual, found.H, found.R, used)
    error = mean[0, POSE] - true
    assert error @ np.linalg.solve(cov[0, POSE, POSE], error) < MOST


def images(places: Any, times: Any, layer: LocalisationLayer) -> list[Verdict]:
    """The verdicts on a single line that is seen at lateral places, from an uncertain pose."""
    mean, cov = known([50, 0, 0], [ALONG, 0.8, 0.01])
    before, verdicts = None, []
    for y, t in zip(places, times, strict=True):
        seen = CameraLines(t, np.array([[y]]), np.zeros((1, 1)), np.array([[Kind.DASHED]]), COV)
        found, before = confirmed(innovation(seen, mean, cov, layer), cov, before, t)
        verdicts.append(Verdict(found.verdict[0, 0]))
    return verdicts


ONE_MARKING = lane("1", kinds=(Kind.DASHED, Kind.UNKNOWN))


@pytest.mark.parametrize("seed", range(5))
def test_a_line_without_another_one_beside_it_is_used_after_some_images(seed: int) -> None:
    """A road with one marking: whatever the lateral error, but not after a pause."""
    rng = np.random.default_rng(seed)
    layer, count = layer_of(ONE_MARKING), IN_A_ROW + 3
    places = 1.75 + rng.uniform(-1.5, 1.5) + 0.05 * rng.standard_normal(count)
    expected = [Verdict.UNCONFIRMED] * (IN_A_ROW - 1) + [Verdict.USED] * 4
    assert images(places, 0.1 * np.arange(count), layer) == expected
    paused = 0.1 * np.arange(count) + np.where(np.arange(count) >= 3, PAUSE, 0.0)
    assert images(places, paused, layer)[IN_A_ROW - 1] == Verdict.UNCONFIRMED


@pytest.mark.parametrize("spacing", [0.2, 0.35, 0.5])
@pytest.mark.parametrize("radius", [10.5, 50.0])
def test_the_curvature_of_a_line_is_that_of_its_road(spacing: float, radius: float) -> None:
    """A filter finds its place along a circle by curvature that changes where there is none."""
    s = spacing * np.arange(int(40 / spacing))
    rng = np.random.default_rng(3)
    angle = (s + spacing * rng.uniform(-0.3, 0.3, len(s))) / radius
    points = np.column_stack([radius * np.sin(angle), radius * (1 - np.cos(angle))])
    road = Lane(
        "1",
        Polyline(points + np.array([0, 1.5]), Kind.UNKNOWN),
        Polyline(points, Kind.SOLID),
        Polyline(points, Kind.VIRTUAL),
        road="1",
    )
    layer = layer_of(road)
    middle = np.linspace(5, 30, 101) / radius
    x, y = (radius + 0.1) * np.sin(middle), radius - (radius + 0.1) * np.cos(middle)
    beside = layer.lines_beside(np.column_stack([x, y, middle]))
    own = np.abs(beside.offset - 0.1) < 0.05
    assert own.sum() == len(middle)
    assert np.sqrt(np.mean((radius * beside.curvature[own] - 1) ** 2)) < 0.05
