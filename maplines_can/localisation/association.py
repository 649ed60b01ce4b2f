"""Association of what a car sees with what its map has, by Mahalanobis distance."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

Array = NDArray[np.float64]

#: Probability that the gate rejects a good measurement.
FALSE_ALARM = 1e-3
#: The second candidate must be this many times less likely than the first one.
MIN_RATIO = 100.0


class Verdict(IntEnum):
    """What became of a measurement."""

    MISSING = 0  #: there is none
    USED = 1
    OUTLIER = 2  #: its innovation is beyond the gate
    AMBIGUOUS = 3  #: two candidates of the map are nearly as likely
    UNMATCHED = 4  #: the map has no candidate near it
    TOO_LATE = 5  #: it is older than the history
    NO_ODOMETRY = 6  #: it is too far ahead of the last odometry
    UNCONFIRMED = 7  #: the pose is so uncertain that another one must confirm it, but none does
    INVALID = 8  #: a number is not finite, or a shape is wrong
    COVARIANCE = 9  #: its covariance is not symmetric, or not positive definite
    SINGULAR = 10  #: it is exact, and the filter knows exactly what it measures
    SPEED = 11  #: no car drives so fast
    YAW_RATE = 12  #: no car turns so fast, or not at its speed
    ACCELERATION = 13  #: speed or yaw rate differ too much from the odometry before
    AHEAD = 14  #: its time is ahead of the odometry before, and no other one confirms it
    LOST = 15  #: the pose is not known, so it was only compared: see ``Consistency``


#: Gates of the squared Mahalanobis distance by the number of values.
GATES = {m: float(chdtri(m, FALSE_ALARM)) for m in (2, 3, 4)}


class Candidates(NamedTuple):
    """What k pairs of a measurement and an object of the map would give."""

    of: NDArray[np.intp]  #: (k,) measurement, ascending
    squared: Array  #: (k,) squared Mahalanobis distances
    cost: Array  #: (k,) -2 log of the likelihoods, but for a constant
    place: Array  #: (k, d) of the objects, to compare them [m]
    same: float  #: distance within which objects are the same one [m]


class Association(NamedTuple):
    """Candidates of n measurements, k in all."""

    best: NDArray[np.intp]  #: (n,) the nearest one; 0 without one
    share: Array  #: (k,) probability of each, among those that are taken for the nearest one
    verdict: NDArray[np.intp]  #: (n,) ``Verdict`` without MISSING


def associate(count: int, candidates: Candidates, gate: float) -> Association:
    """Return the candidates that each measurement is of, and the verdict on it.

    Nearest is that of the greatest likelihood. A second candidate within the distance ``same`` of
    it is taken for the same object, such as the boundary that two lanes have in common. Which of
    them is seen remains open: each has its share.

    Args:
        count: number n of measurements.
        candidates: of them.
        gate: of the squared distance.
    """
    of, squared, cost, place, same = candidates
    best = np.zeros(count, dtype=np.intp)
    verdict = np.full(count, Verdict.UNMATCHED, dtype=np.intp)
    if not len(of):
        return Association(best, np.empty(0), verdict)
    order = np.lexsort((cost, of))
    first = order[np.append(True, np.diff(of[order]) > 0)]
    some = of[first]
    best[some] = first
    verdict[some] = np.where(squared[first] <= gate, Verdict.USED, Verdict.OUTLIER)
    is_other = np.linalg.norm(place - place[best[of]], axis=1) > same
    rival = np.full(count, np.inf)
    np.minimum.at(rival, of[is_other], cost[is_other])
    close = rival[some] - cost[first] < 2 * np.log(MIN_RATIO)
    ambiguous = some[close & (squared[first] <= gate)]
    verdict[ambiguous] = Verdict.AMBIGUOUS
    weight = np.where(is_other, 0.0, np.exp((cost[best[of]] - cost) / 2))
    return Association(best, weight / np.bincount(of, weight, count)[of], verdict)
