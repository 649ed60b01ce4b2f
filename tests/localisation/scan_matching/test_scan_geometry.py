"""Parts of the scan matching: surfaces, cells, derivatives and covariances, each one by one."""

import math

import numpy as np
import pytest

from maplines_can import Polyline
from maplines_can.localisation.scan_matching import ScanReference, simulated_scan
from maplines_can.localisation.scan_matching.match import (
    Minimum,
    no_match,
    result,
)
from maplines_can.localisation.scan_matching.ndt import (
    MIN_IN_CELL,
    WALL_RATIO,
    cells_of,
)
from maplines_can.maps import Landmark, LandmarkKind, Map

BOX = Polyline([[-10, -6], [12, -6], [12, 7], [-10, 7], [-10, -6]])
POLE = Landmark("p", LandmarkKind.POLE, 4.0, 2.0)
REFERENCE = ScanReference(Map({}, {}, buildings=(BOX,), landmarks=(POLE,)))


def minimum(hessian: np.ndarray, used: int, converged: bool) -> Minimum:
    """Return a minimum at (1, 1, 1) of one term, without objects."""
    return Minimum(np.ones(3), np.zeros((1, 3)), hessian, np.zeros((0, 3, 2)), used, converged)


@pytest.mark.parametrize("map_error", [0.0, 0.3])
def test_the_covariance_is_that_of_huber(map_error: float) -> None:
    """H^-1 (sum g g') H^-1, and what scans share: the model and the errors of the objects."""
    rng = np.random.default_rng(1)
    gradients, pulls = rng.standard_normal((50, 3)), rng.standard_normal((4, 3, 2))
    A = rng.standard_normal((3, 3))
    H = A @ A.T + np.eye(3)
    least = Minimum(np.arange(3.0), gradients, H, pulls, used=40, converged=True)
    found = result(least, 60, (0.1, 0.2, 0.3), map_error)
    inverse = np.linalg.inv(H)
    shared = np.diag([0.01, 0.04, 0.09])
    for pull in pulls:
        shared = shared + map_error**2 * inverse @ pull @ pull.T @ inverse
    assert found.shared == pytest.approx(shared)
    own = sum(np.outer(inverse @ g, inverse @ g) for g in gradients)
    assert found.cov == pytest.approx(own + shared)
    assert np.array_equal(found.cov, found.cov.T)
    fix = found.fix(2.0)
    assert fix.cov == pytest.approx(own)
    assert fix.shared is found.shared
    assert fix.pose.tolist() == [[0.0, 1.0, 2.0]]


@pytest.mark.parametrize(
    ("points", "used", "converged", "valid"),
    [(60, 30, True, True), (60, 29, True, False), (62, 30, True, False), (100, 50, True, True),
     (101, 50, True, False), (40, 30, True, True), (60, 60, False, False)],
)  # fmt: skip
def test_which_matches_are_valid(points: int, used: int, converged: bool, valid: bool) -> None:
    """Of at least 30 points, half of the scan and a search that converged."""
    found = result(minimum(np.eye(3), used, converged), points, (0.0, 0.0, 0.0), 0.0)
    assert found.is_valid is valid
    assert found.used == used


@pytest.mark.parametrize(("least", "determined"), [(1.9e-9, False), (2.1e-9, True), (-1.0, False)])
def test_a_scan_that_does_not_determine_the_pose(least: float, determined: bool) -> None:
    """Its least curvature is next to nothing beside the trace."""
    found = result(minimum(np.diag([1.0, 1.0, least]), 40, True), 40, (0.0, 0.0, 0.0), 0.0)
    assert found.is_valid is determined
    if not determined:
        assert np.isinf(found.cov.diagonal()).all()
        assert (found.pose == 1).all()
        assert not no_match(np.zeros(3)).is_valid


@pytest.mark.parametrize("size", [1.0, 3.7])
def test_cells_hold_the_moments_of_their_points(size: float) -> None:
    """One by one; a wall says nothing along itself, and few points nothing at all."""
    rng = np.random.default_rng(2)
    wall = np.column_stack(
        [np.full(60, 13.5) + 0.01 * rng.standard_normal(60), np.linspace(-9, 9, 60)]
    )
    points = np.vstack([rng.uniform(-9, 9, (300, 2)), wall, [[15.0, 15.0], [15.1, 15.1]]])
    shift, sigma = np.array([0.4, 0.1]), 0.2
    cells = cells_of(points, size, shift, sigma)
    low = points.min(axis=0) - shift
    at = rng.uniform(-14, 20, (500, 2))
    rows = cells.of(at)
    number = np.floor((points - low) / size)
    walls = 0
    for point, row in zip(np.vstack([at, points]), [*rows, *cells.of(points)], strict=True):
        inside = (number == np.floor((point - low) / size)).all(axis=1)
        if inside.sum() < MIN_IN_CELL:
            assert row == -1
            continue
        own = points[inside]
        assert cells.mean[row] == pytest.approx(own.mean(axis=0))
        values, vectors = np.linalg.eigh(np.cov(own.T, bias=True))
        information = np.outer(vectors[:, 0], vectors[:, 0]) / (values[0] + sigma**2)
        if values[0] >= WALL_RATIO * values[1]:
            information += np.outer(vectors[:, 1], vectors[:, 1]) / (values[1] + sigma**2)
        else:
            walls += 1
        assert cells.information[row] == pytest.approx(information, abs=1e-9)
    assert walls > 0
    assert (rows >= 0).any()


def test_surfaces_have_a_point_every_ten_centimetres() -> None:
    """On their segments, in the middle of even parts, with normals of length 1 across them."""
    points, normals = REFERENCE.points, REFERENCE.normals
    box = [(p, n) for p, n in zip(points, normals, strict=True) if np.hypot(*(p - [4, 2])) > 1]
    assert len(box) == 2 * (220 + 130)
    for p, n in box:
        on_x, on_y = p[0] in (-10, 12), p[1] in (-6, 7)
        assert on_x != on_y
        assert np.abs(n).tolist() == ([1, 0] if on_x else [0, 1])
        free = p[1] + 6 if on_x else p[0] + 10
        assert free / 0.1 - 0.5 == pytest.approx(round(free / 0.1 - 0.5), abs=1e-6)
    pole = points[np.hypot(*(points - [4, 2]).T) < 1]
    assert len(pole) == 8 * 2  # eight sides of 11.5 cm
    radius = np.hypot(*(pole - [4, 2]).T)
    assert (radius <= 0.15 + 1e-9).all()
    assert (radius >= 0.15 * math.cos(math.pi / 8) - 1e-9).all()
    assert np.hypot(*normals.T) == pytest.approx(np.ones(len(normals)))


def test_objects_are_those_that_are_nearest() -> None:
    rng = np.random.default_rng(4)
    at = rng.uniform(-9, 11, (200, 2)) * [1, 0.5]
    to_pole = np.hypot(*(at - [4, 2]).T) - 0.15
    to_box = np.minimum(np.abs(at - [-10, -6]), np.abs(at - [12, 7])).min(axis=1)
    clear = np.abs(to_pole - to_box) > 0.2
    assert (REFERENCE.objects_at(at)[clear] == (to_pole < to_box)[clear]).all()
    near, _ = REFERENCE.near(np.array([4.0, 2.0]), 5.2)
    assert len(near) == 16 + np.count_nonzero(
        (np.hypot(*(REFERENCE.points - [4, 2]).T) <= 5.2)
        & (np.hypot(*(REFERENCE.points - [4, 2]).T) > 1)
    )


def test_the_noise_of_a_scan_is_as_stated() -> None:
    """Of the range, and the share of rays that end before the surface; within four errors."""
    rng = np.random.default_rng(6)
    pose = np.array([1.0, 0.5, 0.3])
    exact = simulated_scan(REFERENCE, pose, rng, sigma=0.0, false_share=0.0)
    assert len(exact) == 720
    r = np.hypot(*exact.T)
    assert np.arctan2(exact[:, 1], exact[:, 0])[1] == pytest.approx(2 * math.pi / 720)
    scans = [simulated_scan(REFERENCE, pose, rng, sigma=0.05, false_share=0.0) for _ in range(10)]
    noise = np.array([np.hypot(*scan.T) - r for scan in scans])
    assert noise.std() == pytest.approx(0.05, rel=4 / math.sqrt(2 * noise.size))
    scans = [simulated_scan(REFERENCE, pose, rng, sigma=0.0, false_share=0.2) for _ in range(10)]
    shares = np.array([np.hypot(*scan.T) / r for scan in scans])
    blocked = shares < 1 - 1e-9
    assert blocked.mean() == pytest.approx(0.2, abs=4 * math.sqrt(0.16 / blocked.size))
    assert shares[blocked].min() >= 0.05
    sigma = 0.95 / math.sqrt(12 * blocked.sum())
    assert shares[blocked].mean() == pytest.approx(0.525, abs=4 * sigma)
