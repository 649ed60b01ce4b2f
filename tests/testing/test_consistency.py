"""Tests of assert_consistent: false alarms, power, and what its messages say."""

import re
from typing import Any

import numpy as np
import pytest
from support.lasting_errors import Array, N, T, gauss_markov

from maplines_can import Gaussian, MapLine, Slot
from maplines_can.testing import assert_consistent
from maplines_can.testing.effective_samples import effective_samples


def estimates(white: Array, factor: float = 1.0) -> tuple[Array, Array]:
    """Return means and covariances of correlated variables, with sigmas that are too small."""
    d = white.shape[1]
    root = np.tril(np.full((d, d), 0.3)) + np.eye(d)
    return white @ root.T, np.broadcast_to(root @ root.T / factor**2, (len(white), d, d))


def fails(white: Array, factor: float = 1.0) -> bool:
    """Return whether the assertion fails; a run that is too short does not."""
    try:
        assert_consistent(estimates(white, factor), np.zeros(white.shape))
    except AssertionError:
        return True
    except ValueError as error:
        if "too short" not in str(error):
            raise
    return False


def passes(white: Array, factor: float = 1.0) -> bool:
    """Return whether the assertion passes."""
    try:
        assert_consistent(estimates(white, factor), np.zeros(white.shape))
    except (AssertionError, ValueError):
        return False
    return True


@pytest.mark.parametrize(
    ("n", "time", "d"),
    [(N, 0, 4), (N, 20, 1), (N, 240, 4), (N, 2400, 1), (50, 0, 1), (50, 20, 4), (50, 2400, 4)],
)
def test_right_estimates_pass(n: int, time: float, d: int) -> None:
    """1 % of false alarms at most: 6 of 100 have the probability 5e-4."""
    rng = np.random.default_rng([n, int(time), d])

    assert sum(fails(gauss_markov(rng, n, d, time * n / N)) for _ in range(100)) < 6


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_right_estimates_pass_whose_errors_last_in_part(share: float) -> None:
    rng = np.random.default_rng(7)

    def mixed() -> Array:
        lasting = gauss_markov(rng, d=4, time=120)
        return np.sqrt(share) * lasting + np.sqrt(1 - share) * gauss_markov(rng, d=4)

    assert sum(fails(mixed()) for _ in range(100)) < 6


@pytest.mark.parametrize(
    ("d", "time", "least"), [(1, 0, 100), (4, 0, 100), (4, 20, 85), (1, 6, 75), (1, 20, 20)]
)
def test_sigmas_that_are_20_percent_too_small_are_found(d: int, time: float, least: int) -> None:
    """Of 100 runs; if errors last, one needs more samples."""
    rng = np.random.default_rng([int(time), d])

    assert sum(fails(gauss_markov(rng, d=d, time=time), 1.25) for _ in range(100)) >= least


@pytest.mark.parametrize(
    ("n", "time"), [(N, 0), (N, 20), (5 * N, 20)], ids=["white", "1-s", "1-s-for-5-min"]
)
def test_the_bias_and_the_scale_that_it_names_are_found(n: int, time: float) -> None:
    """In 90 % of the runs: of 50, 37 or fewer have the probability 1e-3; of half the bias, few."""
    rng = np.random.default_rng([n, int(time)])

    def verdicts(factor: float = 1.0, bias: float = 0.0) -> int:
        return sum(passes(gauss_markov(rng, n, 1, time) + bias, factor) for _ in range(50))

    right = gauss_markov(rng, n, 1, time)
    found = assert_consistent((right, np.ones((n, 1, 1))), np.zeros((n, 1)))
    assert verdicts(bias=found.bias_found) <= 12
    assert verdicts(bias=found.bias_found / 2) >= 25
    assert verdicts(found.scale_found) <= 12
    assert verdicts(found.scale_found**0.5) >= 25


def test_a_longer_run_finds_a_smaller_bias() -> None:
    rng = np.random.default_rng(3)
    found = [
        assert_consistent((gauss_markov(rng, n, time=6), np.ones((n, 1, 1))), np.zeros((n, 1)))
        for n in (300, 1200, 4800)
    ]

    assert found[0].bias_found > found[1].bias_found > found[2].bias_found
    assert found[0].scale_found > found[1].scale_found > found[2].scale_found
    assert "or a bias of" in found[1].finds


def changed(white: Array, rows: Any, by: float) -> Array:
    """Return errors with an event."""
    white[rows] += by
    return white


def seeded(seed: int, **settings: Any) -> Array:
    return gauss_markov(np.random.default_rng(seed), **settings)


CORRELATED = np.broadcast_to([[1.0, 0.95], [0.95, 1.0]], (N, 2, 2))
#: Estimates that are wrong, and what the message says.
WRONG: dict[str, tuple[tuple[Array, Array], list[str]]] = {
    "covariances that are too small": (estimates(seeded(0, d=2, time=6), 1.5), [
        r"overconfident: the mean NEES is", r"\(2 is expected\)",
        r"deviations are about 3[2-5]% too small", r" s; largest NEES, ",
        r"successive inputs that are taken as independent: errors last for about 0.3",
    ]),
    "stale lines for half a second": (estimates(changed(seeded(0, d=2), slice(800, 810), 12)), [
        r"from 36 to 41.95 s", r"look at: what happened at 36 s",
    ]),
    "one gross error, if the errors last": (estimates(changed(np.full((N, 1), 0.5), 700, 8.5)), [
        r"the NEES at 35 s is 81, but at most 23\.8",
    ]),
    "three standard deviations that never change": (estimates(0.1 * seeded(0) + 3), [
        r"look at: a bias of the estimate, 3\.\d+ in the",
    ]),
    # So that the mean square is 2.4: 1 could be an error.
    "a bias of 1.2 beside errors that are right": (estimates(seeded(1) + 1.2), [
        r"overconfident: the mean of the errors of the estimate is 1.15",
        r"look at: a bias of the estimate",
    ]),
    "correlations, although each variable alone is right": (
        (np.random.default_rng(0).standard_normal((N, 2)), CORRELATED),
        [r"look at: the correlations between the variables"],
    ),
    "one of four sigmas, although the mean NEES is right": (
        (seeded(0, d=4) * [1.4, 0.8, 0.8, 0.8], np.broadcast_to(np.eye(4), (N, 4, 4))),
        [r"errors of variable 0 is 1\.4\d* stated standard"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_the_message_says_what_is_wrong(name: str) -> None:
    own, patterns = WRONG[name]

    with pytest.raises(AssertionError) as caught:
        assert_consistent(own, np.zeros(own[0].shape), t=T)
    for pattern in patterns:
        assert re.search(pattern, str(caught.value))


def test_a_run_that_is_too_short_says_how_long_it_must_be() -> None:
    """An error that never changes is one sample; two standard deviations may be an error."""
    lasting = seeded(3, time=1000)

    with pytest.raises(ValueError, match=r"too short: its 1200 samples say as much as .* s long"):
        assert_consistent(estimates(lasting), np.zeros(N), t=T)
    with pytest.raises(ValueError, match="too short: it has 19 samples, and 20 are needed"):
        assert_consistent(estimates(lasting[:19]), np.zeros(19))
    with pytest.raises(ValueError, match="too short"):
        assert_consistent(estimates(0.1 * seeded(0) + 2), np.zeros(N))


def test_pessimism_is_a_failure_if_it_is_asked_for() -> None:
    white = gauss_markov(np.random.default_rng(0), d=2)
    pessimistic = estimates(white, 1 / 1.5)

    assert assert_consistent(pessimistic, np.zeros((N, 2))).least == 0
    assert_consistent(pessimistic, np.zeros((N, 2)), max_pessimism=1.5)
    with pytest.raises(AssertionError, match=r"standard deviations are about 1\.5\d* times"):
        assert_consistent(pessimistic, np.zeros((N, 2)), max_pessimism=1.2)


def lines(error: Array, factor: float = 1.0) -> list[MapLine]:
    cov = np.diag([0.1, 0.01, 1e-3, 1e-5]) ** 2 / factor**2
    return [MapLine(Slot.EGO_LEFT, Gaussian([1.75 + e, 0, 1e-3, 0], cov)) for e in error]


def test_lines_are_compared_by_parameters_or_by_y_at_x() -> None:
    rng = np.random.default_rng(0)
    sigma = np.array([0.1, 0.01, 1e-3, 1e-5])
    own = lines(np.zeros(N))
    true = own[0].gaussian.mean + sigma * rng.standard_normal((N, 4))
    x = [0.0, 20.0, 60.0]
    y = np.array([[MapLine.mean_only(Slot.EGO_LEFT, row).y(place) for place in x] for row in true])

    assert set(assert_consistent(own, true).ratios) == {"y_off", "beta", "c0", "c1"}
    found = assert_consistent(own, y, x=x)
    assert set(found.ratios) == {"y at 0 m", "y at 20 m", "y at 60 m"}
    assert found.nees == pytest.approx(3, abs=0.3)
    with pytest.raises(AssertionError, match=r"y at 60 m 1\.5"):
        assert_consistent(lines(np.zeros(N), 1.5), y, x=x)


def test_gaussians_are_as_their_arrays() -> None:
    white = gauss_markov(np.random.default_rng(0), d=2)
    mean, cov = estimates(white)
    gaussians = [Gaussian(m, c) for m, c in zip(mean, cov, strict=True)]

    of_gaussians = assert_consistent(gaussians, np.zeros((N, 2)))
    assert of_gaussians == assert_consistent((mean, cov), np.zeros((N, 2)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"confidence": 1.0}, "confidence must be 0.5 or more and less than 1, got 1.0"),
        ({"max_pessimism": 0.5}, "max_pessimism must be finite and 1 or more, got 0.5"),
        ({"x": 20.0}, "x is for lines"),
        ({"t": T[::-1]}, "t must be 1200 increasing times"),
        ({"truth": np.zeros((N, 3))}, r"truth must have the shape of the estimates \(1200, 2\)"),
        ({"truth": np.full((N, 2), np.nan)}, "truth must be finite, got .* in sample 0"),
        ({"estimates": (np.zeros((N, 2)), np.zeros((N, 2)))}, "must be means .n, d. and cov"),
        ({"estimates": (np.zeros((N, 2)), np.ones((N, 2, 2)))}, "positive definite, got"),
        ({"estimates": []}, "estimates must be Gaussians, lines, or .* got none"),
    ],
)
def test_a_wrong_argument_is_named(arguments: dict[str, Any], message: str) -> None:
    right: dict[str, Any] = {"estimates": estimates(np.zeros((N, 2))), "truth": np.zeros((N, 2))}

    with pytest.raises((ValueError, TypeError), match=message):
        assert_consistent(**right | arguments)


def test_x_must_be_in_the_range_of_the_lines() -> None:
    with pytest.raises(ValueError, match="that is valid from 0 to 80 m"):
        assert_consistent(lines(np.zeros(30)), np.zeros((30, 1)), x=100.0)
    with pytest.raises(ValueError, match="x must be 1 to 4 different positions"):
        assert_consistent(lines(np.zeros(30)), np.zeros((30, 2)), x=[5.0, 5.0])


def test_effective_samples_of_gauss_markov_errors() -> None:
    """In theory n / tau, tau = (1 + rho^2) / (1 - rho^2): squares forget twice as fast."""
    rng = np.random.default_rng(0)
    for time in (2.0, 10.0, 40.0):
        rho2 = np.exp(-2 / time)
        found = np.mean([effective_samples(gauss_markov(rng, 4000, 1, time)) for _ in range(20)])
        assert found == pytest.approx(4000 * (1 - rho2) / (1 + rho2), rel=0.1)


def test_no_errors_are_independent() -> None:
    assert effective_samples(np.zeros((100, 2))) == 100
