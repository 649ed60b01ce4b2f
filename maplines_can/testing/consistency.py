"""Assertion that estimates are as certain as they say: NEES, bands and peaks with their bounds.

Without an overconfidence, the normalised estimation error squared (NEES) of d variables is
chi-square distributed with d degrees of freedom in each sample, whatever the correlation in time
(Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, section
5.4). Its mean over n samples has about that of ``d n_eff`` degrees of freedom, over n_eff
(``effective_samples``). The probability of a false alarm is shared by

    mean    of the NEES: half of it
    bands   mean squares of each variable in its stated standard deviations: a quarter, together
    bias    the mean of each variable (``bias``): an eighth, together
    peak    the largest NEES, by Bonferroni's inequality, with any correlation: the rest
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtr, chdtri

from .bias import bias_found, bias_probability
from .effective_samples import effective_samples
from .series import Errors, Estimates, errors_of

#: Fewest samples, and fewest effective samples that can be told from one. With fewer, the errors
#: last for so long that their correlation time cannot be seen.
MIN_SAMPLES, MIN_EFFECTIVE = 20, 5.0
#: Share of the runs in which an error is found that ``Consistency`` names.
FOUND = 0.9
#: Parts of the time, of which a message names the worst one.
PARTS = 10
#: A part with more than this share of all excess of the NEES is an event of its own.
EVENT = 0.5
#: A mean error of more than this share of the root mean square is called a bias.
BIAS = 0.8
#: A smaller share is no bias, but a wrong scale.
LEAST_BIAS = 0.3


class Consistency(NamedTuple):
    """What was seen of the consistency of estimates."""

    nees: float  #: mean NEES
    least: float  #: bound of the mean NEES with ``max_pessimism``; 0 without
    most: float  #: bound of the mean NEES
    effective_samples: float
    peak: float  #: largest NEES
    most_peak: float  #: its bound
    #: root mean square of the errors of each variable in its stated standard deviations
    ratios: dict[str, float]
    #: what is found in 90 % of the runs of so many samples whose errors last for so long: standard
    #: deviations that are all so many times too small
    scale_found: float
    #: and a constant error of any one variable, in its stated standard deviations
    bias_found: float

    @property
    def finds(self) -> str:
        """What a run like this one finds, as a sentence."""
        return (
            f"{FOUND:.0%} of such runs find standard deviations that are "
            f"{1 - 1 / self.scale_found:.0%} too small, or a bias of {self.bias_found:.2g} of them"
        )


def assert_consistent(
    estimates: Estimates,
    truth: ArrayLike,
    confidence: float = 0.99,
    *,
    x: ArrayLike | None = None,
    t: ArrayLike | None = None,
    max_pessimism: float | None = None,
) -> Consistency:
    """Fail if the errors of estimates are larger than their covariances say.

    Estimates that are right fail with the probability ``1 - confidence`` at most, also if their
    errors last, such as those of successive lines of one pose. If errors last, only gross
    overconfidence is found. What is found in 90 % of the runs of such a length and with errors that
    last for so long is in the result: ``scale_found`` and ``bias_found``. A bias may be an error
    that lasts for the whole run, so a small one is not found however long the run is.

    Args:
        estimates: n Gaussians, n lines, or their means (n, d) and covariances (n, d, d), or
            (n,) means and (n,) variances, in equal steps of time.
        truth: (n, d) true values; of lines their parameters, or (n, len(x)) true y at x.
        confidence: probability with which right estimates pass.
        x: 1 to 4 positions at which lines are compared [m]; None: by their parameters.
        t: (n,) times for messages [s]; None: they have the numbers of samples.
        max_pessimism: greatest factor by which standard deviations may be too large; None: any.

    Returns:
        What was seen.

    Raises:
        AssertionError: the estimates are overconfident, or too pessimistic.
        ValueError: the run is too short to say anything, as its errors last for too long; or an
            argument is wrong.

    >>> rng = np.random.default_rng(0)
    >>> error = 0.1 * rng.standard_normal(400)
    >>> found = assert_consistent((error, np.full(400, 0.01)), np.zeros(400))
    >>> round(found.nees, 2), round(found.most, 2)
    (0.99, 1.2)
    >>> found.finds
    '90% of such runs find standard deviations that are 13% too small, or a bias of 1.4 of them'
    >>> assert_consistent((error, np.full(400, 0.08**2)), np.zeros(400))
    Traceback (most recent call last):
    ...
    AssertionError: the estimates are overconfident: the mean NEES is 1.549, but at most 1.2 with \
the confidence 0.99 (1 is expected)
      how much: standard deviations are about 20% too small
      where: largest mean NEES, 2.332, from sample 200 to 239; largest NEES, 22.23, in sample 303
      samples: 400, effective ones: 382
      look at: all covariances, which are too small all the time: a noise or a covariance of the \
input that is too small, or correlated inputs that are taken as independent
    """
    __tracebackhide__ = True  # pytest shows the line of the test
    if not 0.5 <= confidence < 1:
        raise ValueError(f"confidence must be 0.5 or more and less than 1, got {confidence!r}")
    if max_pessimism is not None and not 1 <= max_pessimism < math.inf:
        raise ValueError(f"max_pessimism must be finite and 1 or more, got {max_pessimism!r}")
    errors = errors_of(estimates, truth, x, t)
    n, d = errors.error.shape
    if n < max(MIN_SAMPLES, 2 * d):
        raise ValueError(
            f"the run is too short: it has {n} samples, and {max(MIN_SAMPLES, 2 * d)} are needed"
        )
    alarm = 1 - confidence
    n_eff = effective_samples(errors.white)
    most = _most(d, n_eff, alarm / 2)
    found = Consistency(
        float(errors.nees.mean()),
        0.0 if max_pessimism is None else _bound(d, n_eff, confidence) / max_pessimism**2,
        most,
        n_eff,
        float(errors.nees.max()),
        _bound(d, 1.0, alarm / 8 / n),
        dict(zip(errors.names, np.sqrt((errors.ratio**2).mean(axis=0)).tolist(), strict=True)),
        math.sqrt(most * n_eff / float(chdtri(d * n_eff, FOUND))),
        max(bias_found(ratio, alarm / 8 / d, FOUND) for ratio in errors.ratio.T),
    )
    reason = _overconfident(errors, found, confidence)
    if reason is not None:
        raise AssertionError(_message(errors, found, reason, confidence))
    if n_eff < MIN_EFFECTIVE:
        needed = math.ceil(2 * MIN_EFFECTIVE / n_eff * n)
        raise ValueError(
            f"the run is too short: its {n} samples say as much as {n_eff:.2g} independent ones, "
            f"since errors last for about {errors.time(n / n_eff)}, and {MIN_EFFECTIVE:g} are "
            f"needed; let it be {errors.time(needed)} long, or compare less often and in more runs"
        )
    if found.nees < found.least:
        factor = math.sqrt(d / max(found.nees, 1e-300))
        raise AssertionError(
            f"the estimates are too pessimistic: the mean NEES is {found.nees:.3g}, but at least "
            f"{found.least:.3g} with the confidence {confidence:g} if standard deviations are up "
            f"to {max_pessimism:g} times too large ({d} is expected without)\n"
            f"  how much: standard deviations are about {factor:.3g} times too large\n"
            "  look at: a noise that is counted twice, or the mean, if it is not an estimate"
        )
    return found


def _bound(d: int, n_eff: float, probability: float) -> float:
    """Return the value that a mean NEES exceeds with this probability."""
    return float(chdtri(d * n_eff, probability)) / n_eff


def _most(d: int, n_eff: float, probability: float) -> float:
    """Return the bound of a mean NEES; too few samples are taken for a single one."""
    return _bound(d, n_eff if n_eff >= MIN_EFFECTIVE else 1.0, probability)


def _is_biased(ratio: np.ndarray, d: int, confidence: float) -> bool:
    """Return whether one of d variables has a bias, of its errors in standard deviations."""
    is_large = abs(ratio.mean()) > LEAST_BIAS * math.sqrt((ratio**2).mean())
    return bool(is_large and bias_probability(ratio) < (1 - confidence) / 8 / d)


def _overconfident(errors: Errors, found: Consistency, confidence: float) -> str | None:
    """Return what is too large: the mean NEES, its peak, or a band; None if nothing is."""
    n, d = errors.error.shape
    within = f"with the confidence {confidence:g}"
    if found.nees > found.most:
        return (
            f"the mean NEES is {found.nees:.4g}, but at most {found.most:.3g} {within} "
            f"({d} is expected)"
        )
    for ratio, name in zip(errors.ratio.T, errors.names, strict=True):
        if _is_biased(ratio, d, confidence):
            return (
                f"the mean of the errors of {name} is {ratio.mean():.3g} stated standard "
                f"deviations, and without it they are {ratio.std():.3g} of them (root mean "
                f"square), so it is no error that lasts {within}"
            )
    if found.peak > found.most_peak:
        return (
            f"the NEES {errors.at(int(np.argmax(errors.nees)))} is {found.peak:.4g}, but at most "
            f"{found.most_peak:.4g} in all {n} samples {within} ({d} is expected)"
        )
    for i, name in enumerate(errors.names if d > 1 else ()):
        ratio = errors.ratio[:, i]
        n_eff = effective_samples(ratio[:, None])
        most = math.sqrt(_most(1, n_eff, (1 - confidence) / 4 / d))
        if found.ratios[name] > most:
            return (
                f"the root mean square of the errors of {name} is {found.ratios[name]:.3g} stated "
                f"standard deviations, but at most {most:.3g} {within}; "
                f"{(np.abs(ratio) <= 2).mean():.0%} of them are within two, and "
                f"{chdtr(1, 4.0):.0%} are expected"
            )
    return None


def _message(errors: Errors, found: Consistency, reason: str, confidence: float) -> str:
    """Return what is wrong, how much, where in time, and what to look at."""
    n, d = errors.error.shape
    nees = errors.nees
    parts = np.array_split(np.arange(n), min(PARTS, n))
    worst = max(parts, key=lambda part: float(nees[part].mean()))
    share = float((nees[worst] - d).sum() / (nees - d).sum())
    small = 1 - math.sqrt(d / found.nees)
    much = (
        f"standard deviations are about {small:.0%} too small"
        if small > 0
        else ("not in the mean of all variables")
    )
    begin, end = errors.times[worst[[0, -1]]]
    span = (
        f"from {begin:.4g} to {end:.4g} s"
        if errors.unit == "s"
        else (f"from sample {worst[0]} to {worst[-1]}")
    )
    lines = [
        f"the estimates are overconfident: {reason}",
        f"  how much: {much}",
        f"  where: largest mean NEES, {nees[worst].mean():.4g}, {span}; largest NEES, "
        f"{found.peak:.4g}, {errors.at(int(np.argmax(nees)))}",
        f"  samples: {n}, effective ones: {found.effective_samples:.3g}",
    ]
    if d > 1:
        each = ", ".join(f"{name} {ratio:.3g}" for name, ratio in found.ratios.items())
        lines.append(f"  errors in stated standard deviations (root mean square): {each}")
    return "\n".join([*lines, f"  look at: {_hint(errors, found, share, worst, confidence)}"])


def _hint(
    errors: Errors, found: Consistency, share: float, worst: np.ndarray, confidence: float
) -> str:
    """Return what to look at, by the shape of the errors in time and over the variables."""
    n, d = errors.error.shape
    if found.nees > found.most and share > EVENT:
        return (
            f"what happened {errors.at(worst[0])}: most of the errors are from there, such as "
            "those of a line that was too old, of another line, or of a pose that jumped"
        )
    mean, size = errors.ratio.mean(axis=0), np.sqrt((errors.ratio**2).mean(axis=0))
    i = int(np.argmax(np.abs(mean)))
    if found.nees <= found.most:  # it is not the scale
        is_bias = _is_biased(errors.ratio[:, i], d, confidence)
    else:
        is_bias = abs(mean[i]) > BIAS * size[i] and size[i] > 1
    if is_bias:
        return (
            f"a bias of {errors.names[i]}, {errors.error[:, i].mean():.3g} in the mean: an offset, "
            "a frame, a sign, or a delay that is not compensated"
        )
    if found.nees <= found.most and found.peak > found.most_peak:
        return (
            f"what happened {errors.at(int(np.argmax(errors.nees)))}: the rest is consistent, so "
            "think of a line that was too old, of another line, or of a pose that jumped"
        )
    if d > 1 and size.max() < math.sqrt(found.most / d):
        return (
            "the correlations between the variables: each variable is within its own standard "
            "deviation"
        )
    if found.effective_samples < n / 3:
        return (
            f"successive inputs that are taken as independent: errors last for about "
            f"{errors.time(n / found.effective_samples)}; or a covariance that is too small"
        )
    return (
        "all covariances, which are too small all the time: a noise or a covariance of the input "
        "that is too small, or correlated inputs that are taken as independent"
    )
