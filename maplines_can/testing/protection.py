"""Assertion that errors exceed their protection levels no more often than the stated risk.

Of a risk for a sample, two numbers are compared with binomial distributions, each with half of the
probability of a false alarm. Errors that last exceed a level in clusters:

    samples     n / tau of them are independent (``effective_samples``). That is more correlation
                than excesses have, whose autocorrelation is that of squares or less: by Mehler's
                formula it is a mean of the powers 2, 4, 6 ... of the autocorrelation of the errors.
    episodes    excesses that are tau or more apart. There are no more of them than of samples, so
                for few of them the risk itself is a bound, whatever the correlation.

Of a risk for a time, each such span of time is a trial, in which an episode begins or not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betainc

from ..values.arrays import floats
from .consistency import MIN_SAMPLES
from .effective_samples import effective_samples
from .series import times_of

#: Excesses that a message lists.
LISTED = 3


class Protection(NamedTuple):
    """What was seen of errors beyond their protection levels."""

    excesses: int  #: samples in which the error is beyond the level
    episodes: int  #: excesses in a row, or with gaps that are shorter than the errors last
    expected: float  #: number of samples, or of spans of time, that the risk allows in the mean
    effective_samples: float
    probability: float  #: of so many excesses, or more, if the risk is as stated


def assert_protected(
    levels: ArrayLike,
    errors: ArrayLike,
    risk: float,
    *,
    per: float | None = None,
    t: ArrayLike | None = None,
    confidence: float = 0.99,
) -> Protection:
    """Fail if errors exceed their protection levels more often than the stated risk.

    A pass says only that so many excesses are not too many: 60 s cannot show a risk of 1e-7 in an
    hour. One excess fails if the risk makes it less likely than ``1 - confidence``.

    Args:
        levels: (n,) protection levels, 0 or more, in equal steps of time.
        errors: (n,) errors of any sign, in the unit of the levels.
        risk: probability that the error exceeds the level, in a sample or in the time ``per``.
        per: time to which the risk refers [s], such as ``consumers.integrity.HOUR``; None: a
            sample.
        t: (n,) times [s]; needed with ``per``.
        confidence: probability with which levels of this risk pass.

    Returns:
        What was seen.

    Raises:
        AssertionError: there are too many excesses.
        ValueError: no number of excesses could fail; or an argument is wrong.

    >>> levels, errors = np.full(100, 0.3), np.zeros(100)
    >>> assert_protected(levels, errors, risk=1e-5).excesses
    0
    >>> errors[40:45] = [-0.31, -0.35, -0.36, -0.33, -0.31]
    >>> assert_protected(levels, errors, risk=1e-5, t=0.05 * np.arange(100))
    Traceback (most recent call last):
    ...
    AssertionError: the levels do not protect: 5 of 100 errors exceed their level, in 1 episode, \
but 0.001 are expected of a risk of 1e-05 in a sample
      how likely: 5.2e-06, if the risk were right; the bound is 0.005
      where: from 2 to 2.2 s, with an error of -0.36 and a level of 0.3
      look at: what happened then: a level of this risk has hardly one excess in this time
    """
    __tracebackhide__ = True  # pytest shows the line of the test
    level, error = floats(levels, "levels"), floats(errors, "errors")
    n = level.size
    if level.ndim != 1 or error.shape != level.shape or not n:
        raise ValueError(
            f"levels and errors must be (n,) with n >= 1, got {level.shape} and {error.shape}"
        )
    if not (level >= 0).all() or not np.isfinite(error).all():  # infinite: nothing is promised
        raise ValueError("levels must be 0 or more, and errors finite; none may be NaN")
    if not 0 < risk < 1:
        raise ValueError(f"risk must be more than 0 and less than 1, got {risk!r}")
    if not 0.5 <= confidence < 1:
        raise ValueError(f"confidence must be 0.5 or more and less than 1, got {confidence!r}")
    if per is not None and (t is None or not per > 0):
        raise ValueError(f"per must be more than 0 s, and needs the times t, got {per!r}")
    times, unit = times_of(t, n)
    beyond = np.abs(error) > level
    n_eff = _effective(error, level)
    episodes = _episodes(beyond, n / n_eff)
    excesses, alarm = int(beyond.sum()), 1 - confidence
    if per is None:
        expected, bound = n * risk, alarm / 2
        probability = min(
            tail(excesses * n_eff / n, n_eff, risk) if n >= MIN_SAMPLES else 1.0,
            tail(len(episodes), n, risk),
        )
        possible = tail(n, n, risk)
        of = "a sample"
    else:
        # Where the time ends within a span, it has less risk than a whole one.
        spans = (times - times[0]) // per
        trials = int(spans[-1]) + 1
        begun = len({spans[first] for first, _ in episodes})
        expected, bound = trials * risk, alarm
        probability, possible = tail(begun, trials, risk), tail(trials, trials, risk)
        of = f"{per:g} s"
    if possible > bound:
        raise ValueError(
            f"the run is too short: if each error exceeded its level, that would have the "
            f"probability {possible:.3g} with a risk of {risk:g} in {of}, and nothing could fail"
        )
    found = Protection(excesses, len(episodes), expected, n_eff, probability)
    if probability >= bound:
        return found
    raise AssertionError(_message(found, error, level, episodes, times, unit, risk, of, bound))


def tail(k: float, n: float, p: float) -> float:
    """Return the probability of k or more of n trials, also between whole numbers.

    >>> round(tail(1, 10, 0.1), 6), tail(0, 10, 0.1)  # 1 - 0.9^10
    (0.651322, 1.0)
    """
    return 1.0 if k <= 0 else float(betainc(k, n - k + 1, p))


def _effective(error: NDArray[np.float64], level: NDArray[np.float64]) -> float:
    known = np.isfinite(level) & (level > 0)
    if not known.all() or len(error) < 2:  # without a scale, only the errors themselves
        return effective_samples(error[:, None]) if len(error) > 1 else 1.0
    return effective_samples((error / level)[:, None])


def _episodes(beyond: NDArray[np.bool_], apart: float) -> list[tuple[int, int]]:
    """Return the first and the last sample of each episode."""
    found: list[tuple[int, int]] = []
    for i in np.flatnonzero(beyond).tolist():
        if found and i - found[-1][1] < max(apart, 2):
            found[-1] = (found[-1][0], i)
        else:
            found.append((i, i))
    return found


def _message(
    found: Protection,
    error: NDArray[np.float64],
    level: NDArray[np.float64],
    episodes: list[tuple[int, int]],
    times: NDArray[np.float64],
    unit: str,
    risk: float,
    of: str,
    bound: float,
) -> str:
    """Return what is wrong, how much, where in time, and what to look at."""
    n, many = len(error), "" if found.episodes == 1 else "s"
    head = (
        f"the levels do not protect: {found.excesses} of {n} errors exceed their level, in "
        f"{found.episodes} episode{many}, but {found.expected:.3g} are expected of a risk of "
        f"{risk:g} in {of}"
    )

    def described(first: int, last: int) -> str:
        worst = first + int(np.argmax((np.abs(error) - level)[first : last + 1]))
        ends = (
            f"from {times[first]:.4g} to {times[last]:.4g} s"
            if unit == "s"
            else f"from sample {first} to {last}"
        )
        return f"{ends}, with an error of {error[worst]:.3g} and a level of {level[worst]:.3g}"

    longest = sorted(episodes, key=lambda one: one[0] - one[1])[:LISTED]
    where = "; ".join(described(*one) for one in longest)
    hint = (
        "what happened then: a level of this risk has hardly one excess in this time"
        if found.episodes == 1
        else "the standard deviations under the levels, with assert_consistent; or the correlation "
        "time and the tolerance that the levels assume"
    )
    return "\n".join(
        [
            head,
            f"  how likely: {found.probability:.2g}, if the risk were right; the bound is "
            f"{bound:g}",
            f"  where: {where}",
            f"  look at: {hint}",
        ]
    )
