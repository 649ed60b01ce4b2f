"""Scenes: quantities of several lines have the variance of their joint covariance."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import covariances

from maplines_can import Gaussian, GaussianMixture, MapLine, PoseError, Scene, Slot

LEFT, RIGHT, NEXT = Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.NEXT_LEFT
POSE = PoseError(np.diag([0.1, 0.2, 0.003]) ** 2, 2.0)
MEANS = np.array([[1.7, 0.02, 1e-3, 1e-6], [-1.8, 0.021, 1.1e-3, 0], [5.2, 0.02, 9e-4, 1e-6]])
#: Standard deviations of a line: common to all lines, and its own.
COMMON, OWN = np.array([0.2, 5e-3, 1e-5, 1e-7]), np.array([0.02, 5e-4, 1e-5, 2e-7])
COV = np.kron(np.ones((3, 3)), np.diag(COMMON**2)) + np.kron(np.eye(3), np.diag(OWN**2))


def lines(means: Any = MEANS, cov: Any = COV) -> list[MapLine]:
    """Lines of the first slots, with the blocks of a joint covariance."""
    return [
        MapLine(Slot(i), Gaussian(mean, cov[4 * i : 4 * i + 4, 4 * i : 4 * i + 4]), x_min=-20.0)
        for i, mean in enumerate(means)
    ]


def scene(means: Any = MEANS, cov: Any = COV, **rest: Any) -> Scene:
    return Scene(
        tuple(lines(means, cov)), cov, POSE, np.tile([-20.0, 80.0], (len(means), 1)), **rest
    )


def test_a_sum_is_known_where_all_of_its_lines_are() -> None:
    """Where one of them ends, it is NaN; another pair of lines goes on."""
    first, *rest = lines()
    made = Scene((replace(first, x_max=30.0), *rest), COV, POSE, np.tile([-20.0, 80.0], (3, 1)))
    x = np.array([-21.0, -20.0, 30.0, 31.0, np.nan])
    for estimate in (made.width(x), made.centre(x), made.lateral({LEFT: 0.0, NEXT: 1.0}, x)):
        for values in estimate:
            assert np.isnan(values).tolist() == [True, False, False, True, True]
    assert np.isfinite(made.width(31.0, NEXT, RIGHT)).all()
    whole = scene().width(x)
    assert np.array_equal(made.width(x).sigma[1:3], whole.sigma[1:3])
    assert np.isnan(made.centre(31.0)).all()


@given(covariances(8), st.floats(-20, 80))
def test_a_line_by_itself_is_as_in_the_joint(cov: Any, x: float) -> None:
    """And the variances of width and centre add up to those of both lines."""
    cov = cov + cov.T
    made = scene(MEANS[:2], cov)
    for line in made.lines:
        joint = made.joint([line.slot])
        assert np.array_equal(joint.mean, line.gaussian.mean)
        assert np.array_equal(joint.cov, line.gaussian.cov)
    variances = [line.y_sigma(x) ** 2 for line in made.lines]
    both = made.width(x).sigma ** 2 / 2 + 2 * made.centre(x).sigma ** 2
    assert both == pytest.approx(sum(variances), rel=1e-6, abs=1e-9 * float(max(variances)))


def test_a_missing_line_is_named() -> None:
    for call in (
        lambda: scene().line(Slot.ROUTE),
        lambda: scene().joint([LEFT, Slot.ROUTE]),
        lambda: scene().width(0.0, left=Slot.ROUTE),
    ):
        with pytest.raises(ValueError, match="no line of slot ROUTE; it has EGO_LEFT, EGO_RIGHT"):
            call()
    empty = Scene((), np.zeros((0, 0)), POSE, np.zeros((0, 2)))
    assert empty.means.shape == (0, 4)
    with pytest.raises(ValueError, match="the scene has no lines"):
        empty.joint()
    with pytest.raises(ValueError, match="it has none"):
        empty.centre(0.0)


def test_wrong_scenes_are_refused() -> None:
    good = lines()
    ranges = np.tile([-20.0, 80.0], (3, 1))
    indefinite = COV.copy()
    indefinite[0, 4] = indefinite[4, 0] = 1.0
    asymmetric = COV.copy()
    asymmetric[0, 4] *= 1.01
    mixture = MapLine.of_mixture(
        NEXT, GaussianMixture([0.5, 0.5], [line.gaussian for line in good[:2]])
    )
    for arguments, words in (
        ((good, COV[:8, :8], POSE, ranges), r"cov must be \(12, 12\) for 3 lines, got \(8, 8\)"),
        ((good, COV, POSE, ranges[:2]), r"fit_ranges must be \(3, 2\)"),
        ((good, COV, POSE, ranges[:, ::-1]), "fit_ranges must be finite and not empty"),
        ((good, COV, POSE, ranges * np.nan), "fit_ranges must be finite and not empty"),
        ((good[:2] + good[:1], COV, POSE, ranges), "different slots"),
        (([*good[:2], mixture], COV, POSE, ranges), "that of NEXT_LEFT is"),
        ((good, indefinite, POSE, ranges), "positive semidefinite"),
        ((good, asymmetric, POSE, ranges), "symmetric"),
        ((good, np.full((12, 12), np.inf), POSE, ranges), "finite"),
        ((good, -COV, POSE, ranges), "positive semidefinite"),
    ):
        with pytest.raises(ValueError, match=words):
            Scene(*arguments)
    own = np.array([line.gaussian.cov for line in good])
    for specific_covs, words in (
        (own[:2], r"specific_covs must be \(3, 4, 4\) for 3 lines, got \(2, 4, 4\)"),
        (-own, "each of specific_covs must be finite, symmetric and positive semidefinite"),
        (own * np.nan, "each of specific_covs must be finite"),
        (own + np.eye(4, k=1) * 1e-9, "each of specific_covs must be finite, symmetric"),
    ):
        with pytest.raises(ValueError, match=words):
            scene(specific_covs=specific_covs)


@pytest.mark.parametrize("slots", [[], [NEXT], [RIGHT, LEFT], [LEFT, RIGHT, NEXT]])
def test_a_subset_has_all_of_its_lines(slots: list[Slot]) -> None:
    """Each array has the rows of the lines, in their order; a slot without a line is refused."""
    own = np.array([line.gaussian.cov * (i + 1) for i, line in enumerate(lines())])
    whole = scene(quartics=np.array([0.1, 0.2, 0.3]), specific_covs=own)
    part = whole.subset(slots)
    places = [whole.index[slot] for slot in slots]
    assert [line.slot for line in part.lines] == slots
    if slots:
        assert np.array_equal(part.cov, whole.joint(slots).cov)
    assert part.specific_covs is not None
    for got, expected in (
        (part.means, whole.means),
        (part.fit_ranges, whole.fit_ranges),
        (part.quartics, whole.quartics),
        (part.specific_covs, own),
    ):
        assert np.array_equal(got, expected[places])
    assert scene().subset(slots).specific_covs is None
    with pytest.raises(ValueError, match="has no line of slot ROUTE"):
        whole.subset([*slots, Slot.ROUTE])


@pytest.mark.parametrize(
    ("cov", "time", "words"),
    [
        (np.eye(4), 1.0, r"cov must be \(3, 3\), over along, across and heading"),
        (np.ones((3, 3)) - 2 * np.eye(3), 1.0, "variances of 0 or more"),
        (np.eye(3), 0.0, "correlation_time must be more than 0 s"),
        (np.eye(3), np.nan, "correlation_time must be more than 0 s"),
    ],
)
def test_wrong_pose_errors_are_refused(cov: Any, time: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        PoseError(cov, time)


def test_the_joint_is_in_the_order_of_the_slots() -> None:
    joint = scene().joint([NEXT, LEFT])
    assert np.array_equal(joint.mean, np.concatenate([MEANS[2], MEANS[0]]))
    keep = [8, 9, 10, 11, 0, 1, 2, 3]
    assert np.array_equal(joint.cov, COV[np.ix_(keep, keep)])
    assert np.array_equal(scene().joint().cov, COV)
    assert scene().line(NEXT).slot is NEXT


def test_a_scene_cannot_be_changed() -> None:
    cov = COV.copy()
    made = scene(cov=cov)
    cov[0, 0] = 7
    assert made.cov[0, 0] == COV[0, 0]
    own = scene(specific_covs=np.zeros((len(MEANS), 4, 4))).specific_covs
    assert own is not None
    for array in (made.cov, made.fit_ranges, made.pose_error.cov, own):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1.0
