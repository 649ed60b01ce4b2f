"""Drift of GNSS: a ramp is sought in the innovations, and covered by what is stated.

A drift is as smooth as the motion of the car, so each fix agrees with the ones before it, and the
filter follows: it takes the drift for an error of the odometry, as the wheel scale or the heading.
Only over some time is it more than those may be. So for ramps of GNSS that began at different times
the response of the filter is kept: what 1 m/s to the east and to the north have changed of its
states r and of its innovations g since then. Both follow from its own matrices,

    g = (t - begin) I - H r,   r <- r + K g,   r <- F r between the fixes

so the innovations are the matched filter for the rate of the ramp (generalised likelihood ratio,
Willsky and Jones, IEEE Trans. Automatic Control 21, 1976): with the innovations v and their
covariances S, the rate and its information are

    rate = J^-1 sum g S^-1 v,   J = sum g S^-1 g',   z^2 = rate' J rate ~ chi-square of 2

    z^2 small         nothing
    beyond ``SEEN``   the stated covariance grows by what the ramp has changed of the pose: GNSS or
                      the odometry is off, and what there is cannot tell which
    beyond ``SURE``   the filter itself takes both for possible from now on: GNSS goes on drifting,
                      or the odometry is off by as much. What vouches for the pose, as a landmark
                      does, says that it is GNSS.

Along a straight road, no test tells a slow ramp from an error of the wheel scale or of the heading.
If GNSS is said to drift (``SensorErrors.gnss_drift``), the stated covariance has what such a ramp
may have changed unnoticed (``possible``).

If the error of GNSS is found out (``gnss_hypotheses``), a ramp is sought with the hypothesis of the
open road, as long as that is the likeliest one, and believed as long as it is likelier than
``step.OPEN``. The other hypotheses are not asked: the errors of a canyon may change as fast.

The ramps begin every ``EVERY`` seconds; the older they are, the farther apart are those kept.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from .association import Verdict
from .motion_model import GNSS, HEADING, POSE, SCALE, N, X, Y
from .observation_models import Innovation

Array = NDArray[np.float64]
Cars = NDArray[np.bool_]

#: Time between two begins of ramps [s], and how far those kept are apart, as a share of their age.
EVERY, APART = 2.0, 0.4
#: Youngest ramp that is tested, and oldest one that is kept [s].
YOUNGEST, OLDEST = 3.0, 150.0
#: Squared distances from which on the stated covariance grows, and from which on it is a ramp, of
#: the probabilities 3e-3 and 1e-5 in a right filter, for a single begin.
SEEN, SURE = (float(chdtri(2, probability)) for probability in (3e-3, 1e-5))
#: Fastest drift of GNSS [m/s]. What is faster is wrong odometry, or a jump.
FASTEST = 1.5
#: A drift is taken to go on for so long [s], and to be forgotten within so long [s].
GOES_ON, FORGOTTEN = 100.0, 150.0
#: Least speed at which an error of the odometry is derived from a rate [m/s].
MIN_SPEED = 3.0


class Ramps(NamedTuple):
    """Ramps of GNSS in the filters of R rows, of J begins."""

    begin: Array  #: (J,) [s]
    response: Array  #: (R, J, 2, N) change of the states by 1 m/s to the east, and to the north
    score: Array  #: (R, J, 2)
    information: Array  #: (R, J, 2, 2)
    valid: NDArray[np.bool_]  #: (R, J) whether the filter has not started again since

    @property
    def rate(self) -> Array:
        """(R, J, 2) likeliest rates [m/s]."""
        return np.asarray(
            np.linalg.solve(self.information + 1e-9 * np.eye(2), self.score[..., None])
        )[..., 0]

    def best(self, t: float) -> BestRamps:
        """Return the ramps of the greatest squared distances of all that are old enough."""
        old = np.flatnonzero(t - self.begin >= YOUNGEST)
        every = np.arange(len(self.score))
        if not len(old):
            none = np.zeros(len(every))
            return BestRamps(none, np.zeros((len(every), 2)), np.zeros((len(every), N)), none)
        rate = self.rate
        squared, rate = self._squared(rate)[:, old], rate[:, old]
        j = squared.argmax(axis=1)
        rate = rate[every, j]
        change = (rate[:, None] @ self.response[every, old[j]])[:, 0]
        return BestRamps(squared[every, j], rate, change, t - self.begin[old[j]])

    @property
    def squared(self) -> Array:
        """(R, J) squared distances; 0 where the filter has started again since."""
        return self._squared(self.rate)

    def _squared(self, rate: Array) -> Array:
        return np.where(self.valid, (rate * self.score).sum(axis=-1), 0.0)


class BestRamps(NamedTuple):
    """The likeliest ramp of each of R rows."""

    squared: Array  #: (R,) squared distances
    rate: Array  #: (R, 2) to the east and to the north [m/s]
    change: Array  #: (R, N) what they have changed of the states
    age: Array  #: (R,) [s]

    def beyond(self, squared: float) -> Cars:
        """Return (R,) whether a ramp that GNSS may have has a squared distance of more."""
        return np.asarray((self.squared > squared) & (np.hypot(*self.rate.T) <= FASTEST))

    def repeated(self, K: int) -> BestRamps:
        """Return those of K rows for each of these."""
        return BestRamps(*(np.repeat(one, K, axis=0) for one in self))


def no_ramps(rows: int) -> Ramps:
    """Return the ramps of R rows before the first fix."""
    shape = (rows, 0)
    return Ramps(
        np.empty(0), np.empty((*shape, 2, N)), np.empty((*shape, 2)), np.empty((*shape, 2, 2)),
        np.empty(shape, dtype=bool),
    )  # fmt: skip


def carried(ramps: Ramps, transition: Array) -> Ramps:
    """Return the ramps after a (R, N, N) transition of the states."""
    response = ramps.response
    if not response.size:
        return ramps
    R, J = response.shape[:2]
    moved = response.reshape(R, 2 * J, N) @ transition.mT
    return ramps._replace(response=moved.reshape(response.shape))


def measured(ramps: Ramps, found: Innovation, reduction: Array, t: float) -> Ramps:
    """Return the ramps after a fix.

    Args:
        ramps: before it.
        found: innovations of the R rows.
        reduction: (R, N, N) matrices I - K H of the update; I where the fix is not used.
        t: time of it [s].
    """
    used = (found.verdict[:, 0] == Verdict.USED)[:, None, None, None]
    r = ramps.response
    since = (t - ramps.begin)[:, None, None]
    g = np.where(used, since * np.eye(2) - r[..., X : Y + 1] - r[..., GNSS], 0.0)
    weighted = g @ np.linalg.inv(found.S)  # (R, J, 2, 2)
    K = (np.eye(N) - reduction)[:, None, :, X : Y + 1]
    ramps = ramps._replace(
        response=r + g @ K.mT,
        score=ramps.score + (weighted @ found.residual[:, :, :, None])[..., 0],
        information=ramps.information + weighted @ g.mT,
    )
    return _begun(ramps, t)


def _begun(ramps: Ramps, t: float) -> Ramps:
    """Return the ramps with one that begins now, if it is time, and without some older ones."""
    if len(ramps.begin) and t - ramps.begin[-1] < EVERY:
        return ramps
    kept = [j for j in range(len(ramps.begin)) if t - ramps.begin[j] <= OLDEST]
    squared = ramps.squared
    best = squared.argmax(axis=1)[squared.max(axis=1) > SEEN] if len(kept) else []
    for j in [one for one in kept[-2:0:-1] if one not in best]:
        i = kept.index(j)
        if ramps.begin[kept[i + 1]] - ramps.begin[kept[i - 1]] <= APART * (
            t - ramps.begin[kept[i + 1]]
        ):
            del kept[i]
    rows = len(ramps.score)
    new = no_ramps(rows)
    found = [
        np.concatenate(
            [one[:, kept], np.zeros_like(one, shape=(rows, 1, *empty.shape[2:]))], axis=1
        )
        for one, empty in zip(ramps[1:], new[1:], strict=True)
    ]
    found[-1][:, -1] = True
    return Ramps(np.append(ramps.begin[kept], t), *found)


def forgotten(ramps: Ramps, rows: Cars) -> Ramps:
    """Return the ramps without those of (R,) rows, which have started again."""
    return ramps._replace(valid=ramps.valid & ~rows[:, None]) if rows.any() else ramps


def growth(best: BestRamps) -> Array:
    """Return the (R, 3, 3) covariances by which those of the poses grow."""
    share = (1 - SEEN / best.squared.clip(min=SEEN))[:, None, None]
    pose = best.change[:, POSE]
    return np.asarray(share * pose[:, :, None] * pose[:, None])


def possible(ramps: Ramps, sigma: float) -> Array:
    """Return the (R, 3, 3) covariances of what a ramp that is not seen has changed of the poses.

    A rate r of standard deviation sigma, of which the innovations have the information J, has the
    covariance (J + sigma^-2 I)^-1; the pose has changed by r times the response. As with the
    parameters that a filter considers, but does not estimate (Schmidt 1966; Tapley, Schutz and
    Born, Statistical Orbit Determination, chapter 6). Of all begins, that of the greatest change.

    Args:
        ramps: of R rows.
        sigma: standard deviation of the rate, to the east and to the north alike [m/s].
    """
    if not len(ramps.begin):
        return np.zeros((len(ramps.score), 3, 3))
    cov = np.linalg.inv(ramps.information + np.eye(2) / sigma**2)
    pose = ramps.response[..., POSE]  # (R, J, 2, 3)
    change = np.where(ramps.valid[..., None, None], pose.mT @ cov @ pose, 0.0)
    place = change[..., X, X] + change[..., Y, Y]
    return np.asarray(change[np.arange(len(place)), place.argmax(axis=1)])


def opened(cov: Array, heading: Array, best: BestRamps, speed: Array) -> Array:
    """Return the (R, N, N) covariances if GNSS drifts, or the odometry is off by as much.

    Args:
        cov: (R, N, N).
        heading: (R,) of the cars [rad].
        best: the ramps.
        speed: (R,) of the cars [m/s].
    """
    c, s = np.cos(heading), np.sin(heading)
    east, north = best.rate.T / np.maximum(np.abs(speed), MIN_SPEED)
    cov = cov + best.change[:, :, None] * best.change[:, None]
    cov[:, SCALE, SCALE] += (east * c + north * s) ** 2
    cov[:, HEADING, HEADING] += (north * c - east * s) ** 2
    return cov


def doubted(cov: Array, best: BestRamps) -> Array:
    """Return the (R, N, N) covariances of poses that were found by GNSS, if GNSS has drifted.

    GNSS may be off by all of the ramp, and then the pose is so, to the other side of the state.
    """
    d = best.rate * best.age[:, None]
    J = np.zeros((len(d), N, 2))
    J[:, X : Y + 1], J[:, GNSS] = np.eye(2), -np.eye(2)
    both = (J @ d[..., None])[..., 0]
    return cov + both[:, :, None] * both[:, None]
