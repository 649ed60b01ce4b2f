"""Protection level of the lateral position: a bound that is exceeded with a stated risk only.

An error u_k that is normalised by its standard deviation is taken as a Gaussian process, looked at
in steps of a period. The number of samples is finite, and each excursion beyond a level K begins at
the first sample or at a sample whose predecessor was within:

    P(an excursion within n samples) <= P(|u_0| > K) + (n - 1) P(|u_1| > K, |u_0| <= K)

Only the correlation r of successive samples counts, whatever the process is otherwise. With the
bivariate normal density f of the two,

    d/dr P(|u_1| > K, |u_0| <= K) = -2 (f(K, K; r) - f(K, -K; r)) <= 0 for r >= 0

so the bound holds for all processes in which r is at least the stated one, at each time. For a sum
of Gauss-Markov processes with correlation times of T or more, and a share w of white noise, it is:

    r >= (1 - w) exp(-period / T)

The protection level is K sigma with the least K for which this bound is the risk. (Rice's formula
does not apply: in continuous time, a Gauss-Markov process is not differentiable.) With r = 0 the
bound is that of independent samples. It holds for any correlation of a Gaussian error, by Sidak's
inequality (J. Amer. Statist. Assoc. 62, 1967).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats

#: Time to which a risk refers [s].
HOUR = 3600.0
#: Risks of misleading information in an hour.
RISKS = (1e-5, 1e-7)
#: Time between two looks at the error [s].
PERIOD = 0.05
#: Lateral alert limit of a car in a lane of a local street and of a motorway [m] (Reid et al.,
#: Localization Requirements for Autonomous Vehicles, SAE Int. J. CAV 2(3), 2019, arXiv:1906.01061).
ALERT_LIMITS = {"street": 0.29, "motorway": 0.57}
#: Nodes and weights of Gauss-Legendre quadrature from -1 to 1.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(100)
#: Least probability that counts.
TINY = 1e-300
#: Steps in which ``Tolerance.sigma_spread`` is integrated, in its standard deviations.
SPREAD_STEPS = np.linspace(-4.0, 9.0, 1301)


class Level(NamedTuple):
    """Protection level against an alert limit."""

    protection_level: NDArray[np.float64]  #: [m]
    available: NDArray[np.bool_]  #: whether it is at most the alert limit


@dataclass(frozen=True)
class Tolerance:
    """How far an error may differ from a Gauss-Markov process of the stated standard deviation.

    Args:
        white_share: greatest share of the variance that is new at each look.
        sigma_ratio: greatest ratio of the true standard deviation to the stated one, at any time.
        sigma_spread: standard deviation of the logarithm of a ratio that is random, the same for an
            hour, with the median 1. It comes on top of ``sigma_ratio``.

    Raises:
        ValueError: a value is out of range.
    """

    white_share: float = 0.0
    sigma_ratio: float = 1.0
    sigma_spread: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.white_share <= 1:
            raise ValueError(f"white_share must be 0 to 1, got {self.white_share!r}")
        if not 1 <= self.sigma_ratio < math.inf:
            raise ValueError(f"sigma_ratio must be finite and 1 or more, got {self.sigma_ratio!r}")
        if not 0 <= self.sigma_spread <= 1:
            raise ValueError(f"sigma_spread must be 0 to 1, got {self.sigma_spread!r}")


#: The error is as stated.
EXACT = Tolerance()


def protection_level(
    sigma: ArrayLike,
    risk: float,
    correlation_time: float | Sequence[float] = 0.0,
    period: float = PERIOD,
    tolerance: Tolerance = EXACT,
) -> NDArray[np.float64]:
    """Return the (...,) protection levels of errors with (...,) standard deviations [m].

    The error is Gaussian with mean 0. The level holds for the faultless case only: a wrong map, or
    a sender that errs about its pose beyond the tolerance, needs a monitor of its own.

    Args:
        sigma: standard deviations [m], such as ``scene.centre(x).sigma``.
        risk: probability that the error exceeds the level at any time within an hour.
        correlation_time: of the error, or the shortest and the longest that it may have [s]. The
            level is that of the shortest one; it holds for all longer ones, for a time that
            changes, and for sums of errors with such times. 0: nothing is known of the time, each
            sample may be a new error.
        period: time between two samples of the error [s].
        tolerance: how far the error may differ from what is stated.

    Raises:
        ValueError: a value is out of range.

    >>> protection_level([0.1, 0.2], 1e-5, correlation_time=10.0).round(2)
    array([0.62, 1.24])
    >>> protection_level([0.1, 0.2], 1e-5, (1.0, 30.0), tolerance=Tolerance(0.3, 1.3)).round(2)
    array([0.83, 1.67])
    """
    sigma = floats(sigma, "sigma")
    if not ((sigma >= 0) & (sigma < np.inf)).all():
        raise ValueError(f"sigma must be 0 m or more and finite, got {sigma!r}")
    times = np.atleast_1d(floats(correlation_time, "correlation_time")).tolist()
    if len(times) > 2 or sorted(times) != times:
        raise ValueError(
            "correlation_time must be a time or the shortest and the longest one, "
            f"got {correlation_time!r} s"
        )
    return np.asarray(sigma * multiplier(risk, times[0], period, tolerance))


@lru_cache(maxsize=1024)
def multiplier(
    risk: float,
    correlation_time: float = 0.0,
    period: float = PERIOD,
    tolerance: Tolerance = EXACT,
) -> float:
    """Return the protection level for a standard deviation of 1; see ``protection_level``.

    >>> round(multiplier(1e-7), 2)  # 72000 independent samples
    7.09
    """
    from scipy.optimize import brentq

    if not 0 < risk < 1:
        raise ValueError(f"risk must be more than 0 and less than 1 in an hour, got {risk!r}")
    if not correlation_time >= 0:
        raise ValueError(f"correlation_time must be 0 s or more, got {correlation_time!r}")
    if not 0 < period <= HOUR:
        raise ValueError(f"period must be more than 0 s and at most {HOUR:g} s, got {period!r}")

    def excess(K: float) -> float:
        return math.log(max(risk_bound(K, correlation_time, period, tolerance), TINY) / risk)

    high = 40.0
    while excess(high) > 0:
        high *= 2
    return float(brentq(excess, 0.0, high, xtol=1e-12))


def risk_bound(
    K: float,
    correlation_time: float,
    period: float = PERIOD,
    tolerance: Tolerance = EXACT,
) -> float:
    """Return a bound on the probability that an error exceeds K sigma within an hour.

    Importance sampling finds 0.9 of it for a correlation time of 1 s and 0.4 for 30 s, where one
    excursion has several beginnings, since the error crosses the level back and forth.

    >>> risk_bound(0.0, 10.0)
    1.0
    """
    from scipy.special import ndtr

    rho = math.exp(-period / correlation_time) if correlation_time > 0 else 0.0
    r = (1 - tolerance.white_share) * rho
    K /= tolerance.sigma_ratio
    if tolerance.sigma_spread == 0:
        return float(_stationary_bound(np.array(K), r, period))
    # The bound increases with the ratio, so the upper sum is at least the integral.
    z = SPREAD_STEPS
    bounds = _stationary_bound(K * np.exp(-tolerance.sigma_spread * z), r, period)
    shares = np.diff(ndtr(z), prepend=0.0)
    return float(min(1.0, (bounds * shares).sum() + ndtr(-z[-1])))


def _stationary_bound(K: NDArray[np.float64], r: float, period: float) -> NDArray[np.float64]:
    """Return the bound for (...,) levels, for the correlation r of successive samples."""
    from scipy.special import erfc

    found = erfc(K / math.sqrt(2)) + (samples_of(period) - 1) * onset(K, r)
    return np.asarray(np.minimum(1.0, found))


def samples_of(period: float) -> int:
    """Return the number of samples in an hour."""
    return math.ceil(HOUR / period - 1e-9)


def onset(K: ArrayLike, rho: float) -> NDArray[np.float64]:
    """Return P(|u_1| > K, |u_0| <= K) for (...,) levels, with the correlation rho of both.

    >>> onset([2.0, 2.0], 0.0).round(4), onset(2.0, 0.9).round(4)
    (array([0.0434, 0.0434]), np.float64(0.0188))
    """
    from scipy.special import erfc

    K = np.asarray(K, float)
    outside = erfc(K / math.sqrt(2))
    if rho == 0:
        return np.asarray(outside * (1 - outside))
    s = math.sqrt(-math.expm1(2 * math.log(rho))) if rho < 1 else 0.0
    if s == 0:
        return np.zeros_like(K)
    # It is the same for both signs of u_0, and nearly all of it comes from near the level.
    width = np.minimum(K, 12 * s + (1 - rho) * K)
    u = K[..., None] - width[..., None] / 2 * (1 - _NODES)
    density = np.exp(-(u**2) / 2) / math.sqrt(2 * math.pi)
    leaves = sum(erfc((K[..., None] + sign * rho * u) / (s * math.sqrt(2))) for sign in (-1, 1))
    return np.asarray((_WEIGHTS * density * leaves).sum(axis=-1) * width / 2)


def availability(protection_levels: ArrayLike, alert_limit: float) -> Level:
    """Return (...,) protection levels with the places at which they are at most the alert limit.

    Raises:
        ValueError: the limit is not positive.

    >>> availability([0.3, 0.9], alert_limit=0.57).available
    array([ True, False])
    """
    levels = floats(protection_levels, "protection_levels")
    if not alert_limit > 0:
        raise ValueError(f"alert_limit must be more than 0 m, got {alert_limit!r}")
    return Level(levels, levels <= alert_limit)
