"""Lines seen from a displaced pose, against points that are moved by hand."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from support.strategies import covariances, mild_lines, motions

from maplines_can.model import lines
from maplines_can.model.matrices import Vector
from maplines_can.propagation import SigmaPoints
from maplines_can.values.errors import IllPosedError
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import lateral, lateral_jacobian, transform_line_or_nan
from maplines_can.values.seen_lines import SeenLines, bases

RANGES = np.array([[-20.0, 80.0], [-10.0, 60.0]])
MEANS = np.array([[1.75, 0.02, 1e-3, 1e-6], [-1.75, 0.0, -1e-3, 0.0]])


@given(mild_lines(), mild_lines(), motions())
def test_each_line_is_transformed_by_itself(first: Any, second: Any, motion: Any) -> None:
    """As ``transform_line_or_nan`` transforms it in its range."""
    seen = SeenLines([first, second], RANGES)(motion[None])[0]
    for line, mean, window in zip(seen, (first, second), RANGES, strict=True):
        expected = transform_line_or_nan(mean, motion, tuple(window))
        assert np.allclose(line, expected, rtol=0, atol=1e-12)


@given(mild_lines(), motions(1.0, 3.0))
def test_a_seen_line_goes_through_the_moved_points(mean: Any, motion: Any) -> None:
    """Points of the line, in the frame of the new pose, are on it within 5 mm."""
    x = np.linspace(-20, 80, 201)
    dx, dy, turn = motion
    c, d = np.cos(turn), np.sin(turn)
    p, q = x - dx, lateral(mean, x) - dy
    u, v = c * p + d * q, c * q - d * p
    line = SeenLines(mean[None], RANGES[:1])(motion[None])[0, 0]
    assert np.abs(lateral(line, u) - v).max() <= 5e-3


@pytest.mark.parametrize(
    ("mean", "x_range", "quartic"),
    [
        ([1.75, 0.05, 0.002, 1e-5], (-5.0, 80.0), 0.09),
        ([1.75, 0.05, 0.03, -6e-4], (-5.0, 40.0), 0.1),
        ([10.0, 0.05, 0.1, -0.01], (0.0, 12.0), 0.0),
    ],
)
def test_the_changes_by_the_pose_are_those_of_a_fit(mean: Any, x_range: Any, quartic: Any) -> None:
    """Derivatives by differences, of cubics through the moved roots of T_8.

    Of T_4, what moves by second order is neglected: 0.2 % of the greatest one here.
    """
    w = np.polynomial.chebyshev.chebpts1(8)
    x = np.mean(x_range) + (x_range[1] - x_range[0]) / 2 * w
    y = lateral(np.array(mean), x) + quartic * np.polynomial.chebyshev.chebval(w, [0, 0, 0, 0, 1])

    def seen(a: float, b: float, t: float) -> Any:
        c, d = np.cos(t), np.sin(t)
        u, v = c * (x - a) + d * (y - b), c * (y - b) - d * (x - a)
        fit = np.polynomial.Polynomial.fit(u, v, 3).convert().coef
        return np.array([fit[0], np.arctan(fit[1]), 2 * fit[2], 6 * fit[3]])

    e = 1e-3 * np.eye(3)
    first = np.array([(seen(*d) - seen(*-d)) / 2e-3 for d in e])
    second = [
        (seen(*d + f) - seen(*d - f) - seen(*f - d) + seen(*-d - f)) / 4e-6 / (2 if i == j else 1)
        for i, j in [(2, 2), (2, 0), (2, 1), (0, 0)]
        for d, f in [(e[i], e[j])]
    ]
    line = SeenLines([mean], [x_range], [quartic])
    to_metres = np.linalg.inv(bases(line.means, line.fit_ranges)[0])
    assert np.abs(to_metres @ (line.jacobian()[0] - first.T)).max() <= 1e-3
    changes = lines.changes_of(lines.Curve(Vector(mean), x_range[0], x_range[1], quartic)).of_line()
    found, wanted = to_metres @ np.array(changes[1]).T, to_metres @ np.array(second).T
    assert np.abs(found - wanted).max() <= 2e-3 * np.abs(wanted).max()


@pytest.mark.parametrize("turn", [1.45, -1.6])
def test_a_line_across_the_car_is_extrapolated_from_the_mean_pose(turn: float) -> None:
    """Linearly, through the pose halfway, which sees it as a function of x."""
    displacements = np.array([[0.0, 0, 0], [0, 0, turn], [0, 0.5, 0]])
    seen = SeenLines(MEANS, RANGES)
    values = seen(displacements)
    assert np.array_equal(values[[0, 2]], seen(displacements[[0, 2]]))
    for i, window in enumerate(RANGES):

        def at(share: float, line: Any = MEANS[i], window: Any = window) -> Any:
            pose = share * displacements[1]
            return transform_line_or_nan(line, pose, tuple(window))

        assert np.isnan(at(1.0)).all()
        expected = at(0.0) + (at(0.5) - at(0.0)) / 0.5
        assert np.allclose(values[1, i], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("means", "ranges", "error", "words"),
    [
        (MEANS[:1], RANGES, ValueError, r"must be \(L, 4\) and fit_ranges \(L, 2\)"),
        (MEANS, RANGES[:, :1], ValueError, r"must be \(L, 4\) and fit_ranges \(L, 2\)"),
        (MEANS, RANGES[:, ::-1], ValueError, "x_min < x_max"),
        ([[0, 0, 1.0, 0]], [[-20, 80]], IllPosedError, "nearly perpendicular"),
        ([[0, 2.0, 0, 0]], [[-20, 80]], IllPosedError, "nearly perpendicular"),
    ],
)
def test_wrong_lines_are_refused(means: Any, ranges: Any, error: Any, words: str) -> None:
    with pytest.raises(error, match=words):
        SeenLines(means, ranges)


@given(covariances(3))
def test_the_spread_is_that_of_sigma_points_about_the_means(P: Any) -> None:
    """Symmetric and positive semidefinite, and as the transform of the package has it.

    The rest is of third order in pose errors of 3 cm and 0.03 rad.
    """
    P = P * 1e-3 / max(1e-3, np.abs(P).max())
    bends = np.array([[1.75, 0.1, 8e-3, 0.0], [-1.75, -0.2, 0.02, 1e-5]])
    ranges, quartics = [[-20, 60], [0, 40]], [0.2, 0.0]
    cov = SeenLines(bends, ranges, quartics).spread(P)
    assert np.allclose(cov, cov.T, rtol=1e-12, atol=1e-18)
    scale = np.sqrt(cov.diagonal().clip(1e-30))
    assert np.linalg.eigvalsh(cov / scale / scale[:, None])[0] >= -1e-9

    centred = SeenLines(bends, ranges, quartics).centred(P)
    pose = Gaussian(np.zeros(3), P)
    moments = SigmaPoints().moments(lambda p: centred(p).reshape(len(p), -1), pose)
    x = np.array([-10.0, 0.0, 30.0, 60.0])
    J = np.zeros((8, 8))
    for i in range(2):
        J[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = lateral_jacobian(bends[i], x)
    found, wanted = (J @ matrix @ J.T for matrix in (cov, moments.cov))
    assert np.abs(found - wanted).max() <= 5e-3 * np.abs(wanted).max() + 1e-12


@pytest.mark.parametrize("heading", [0.3, 0.65, 2.0, 5.0])
def test_the_spread_of_a_huge_pose_error_is_a_covariance(heading: float) -> None:
    """Even where the lines are no functions of x from poses that are likely."""
    P = np.diag([300.0, 300.0, heading]) ** 2
    P[0, 1] = P[1, 0] = 0.999 * 300**2
    cov = SeenLines(MEANS, RANGES).spread(P)
    scale = np.sqrt(cov.diagonal())
    assert np.linalg.eigvalsh(cov / scale / scale[:, None])[0] >= -1e-12
