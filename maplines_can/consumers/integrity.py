"""Protection level of the lateral position: a bound that is exceeded with a stated risk only.

An error that is normalised by its standard deviation is taken as a stationary first-order
Gauss-Markov process, which is an AR(1) process at the times at which the consumer looks:

    u_k = rho u_{k-1} + sqrt(1 - rho^2) w_k,   rho = exp(-period / correlation_time)

Such a process is not differentiable in continuous time, so Rice's formula does not apply. The
number of samples is finite, though, and each excursion beyond a level begins at the first sample or
at a sample whose predecessor was within:

    P(an excursion within n samples) <= P(|u_0| > K) + (n - 1) P(|u_1| > K, |u_0| <= K)

The protection level is K sigma with the least K for which this bound is the risk.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import floats

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


class Level(NamedTuple):
    """Protection level against an alert limit."""

    protection_level: NDArray[np.float64]  #: [m]
    available: NDArray[np.bool_]  #: whether it is at most the alert limit


def protection_level(
    sigma: ArrayLike, risk: float, correlation_time: float, period: float = PERIOD
) -> NDArray[np.float64]:
    """Return the (...,) protection levels of errors with (...,) standard deviations [m].

    The error is Gaussian with mean 0 and covers that of the decoded covariance, so the level holds
    for the faultless case only: a wrong map, or a sender that errs about its pose, needs a monitor
    of its own.

    Args:
        sigma: standard deviations [m], such as ``scene.centre(x).sigma``.
        risk: probability that the error exceeds the level at any time within an hour.
        correlation_time: of the error [s]. If it is unknown, take 0: then each sample is a new
            error, which is the worst case.
        period: time between two samples of the error [s].

    Raises:
        ValueError: a value is out of range.

    >>> protection_level([0.1, 0.2], 1e-5, correlation_time=10.0).round(2)
    array([0.62, 1.24])
    """
    sigma = floats(sigma, "sigma")
    if not ((sigma >= 0) & (sigma < np.inf)).all():
        raise ValueError(f"sigma must be 0 m or more and finite, got {sigma!r}")
    return np.asarray(sigma * multiplier(risk, correlation_time, period))


@lru_cache(maxsize=1024)
def multiplier(risk: float, correlation_time: float, period: float = PERIOD) -> float:
    """Return the protection level for a standard deviation of 1; see ``protection_level``.

    >>> round(multiplier(1e-7, 0.0), 2)  # 72000 independent samples
    7.09
    """
    if not 0 < risk < 1:
        raise ValueError(f"risk must be more than 0 and less than 1 in an hour, got {risk!r}")
    if not correlation_time >= 0:
        raise ValueError(f"correlation_time must be 0 s or more, got {correlation_time!r}")
    if not 0 < period <= HOUR:
        raise ValueError(f"period must be more than 0 s and at most {HOUR:g} s, got {period!r}")
    low, high = 0.0, 40.0
    for _ in range(60):
        K = (low + high) / 2
        if risk_bound(K, correlation_time, period) > risk:
            low = K
        else:
            high = K
    return high


def risk_bound(K: float, correlation_time: float, period: float = PERIOD) -> float:
    """Return a bound on the probability that an error exceeds K sigma within an hour.

    Importance sampling finds 0.9 of it for a correlation time of 1 s and 0.4 for 30 s, where one
    excursion has several beginnings, since the error crosses the level back and forth.

    >>> risk_bound(0.0, 10.0)
    1.0
    """
    rho = math.exp(-period / correlation_time) if correlation_time > 0 else 0.0
    samples = samples_of(period)
    outside = math.erfc(K / math.sqrt(2))
    return min(1.0, outside + (samples - 1) * onset(K, rho))


def samples_of(period: float) -> int:
    """Return the number of samples in an hour."""
    return math.ceil(HOUR / period - 1e-9)


def onset(K: float, rho: float) -> float:
    """Return P(|u_1| > K, |u_0| <= K) of an AR(1) process with variance 1.

    >>> round(onset(2.0, 0.0), 4), round(onset(2.0, 0.9), 4)
    (0.0434, 0.0188)
    """
    outside = math.erfc(K / math.sqrt(2))
    if rho == 0:
        return outside * (1 - outside)
    s = math.sqrt(-math.expm1(2 * math.log(rho))) if rho < 1 else 0.0
    if s == 0:
        return 0.0
    from scipy.special import erfc

    # It is the same for both signs of u_0, and nearly all of it comes from near the level.
    width = min(K, 12 * s + (1 - rho) * K)
    u = K - width / 2 * (1 - _NODES)
    density = np.exp(-(u**2) / 2) / math.sqrt(2 * math.pi)
    leaves = erfc((K - rho * u) / (s * math.sqrt(2))) + erfc((K + rho * u) / (s * math.sqrt(2)))
    return float((_WEIGHTS * density * leaves).sum() * width / 2)


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
