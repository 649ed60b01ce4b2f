"""Consistency of the filter with its sensors: when it no longer knows the pose, and again.

A filter whose model is right has innovations that are white and as large as it states. For each
source (``SOURCES``), three statistics of the last measurements say whether they are:

    rejected   measurements in a row that are beyond the gate
    mean       moving average of the normalised innovations, with their signs: a sensor that drifts
    nis        moving average of their squares (NIS): a sensor that is noisier than it states

Each innovation enters with no more than the gate, so that a single outlier says little, and some in
a row say as much as a drift. Beside them, an estimated error of a sensor that its own model makes
impossible is a contradiction (``implausible``).

    known ──── two rejected in a row, or NIS ───► known, widened: by the residual, or by the NIS
      │ ▲                                           │
      │ └── it agrees again ────────────────────────┘
      │ contradiction, and no other sensor vouches for the pose; odometry missing for too long
      ▼
    lost: no pose; odometry goes on, and all measurements are only compared with it
      │
      ├── all sources that contradicted it agree again, ``AGREED`` times in a row ───────► known
      └── positions fit the odometry along a way, turned and shifted (``alignment``) ────► known

Only a pose that rejected them can agree with them again; one that has followed a drift, or whose
odometry was missing, would agree with anything.

A contradiction says that the pose or the sensor is wrong, not which. A landmark or a pose fix that
agrees vouches for the pose; then the bias of the other sensor is forgotten, and the gate keeps it
out. If a single source contradicts the odometry, its positions must fit the odometry for
``SINGLE_SOURCE`` before they are believed: a wrong sensor may be right again before that.

All arrays are of n cars (n,), or of n cars and the sources (n, S). Nothing here changes in place.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from .association import GATES, Verdict
from .motion_model import GNSS, SCALE, YAW_RATE
from .observation_models import Innovation
from .sensor_errors import SensorErrors

Array = NDArray[np.float64]
Cars = NDArray[np.bool_]

SOURCES = ("gnss", "line", "landmark", "pose")
#: Measurements in a row beyond the gate that contradict the pose, by source. A camera is fast, and
#: false lines last for more than one image.
REJECTED = np.array([5, 10, 5, 5])
#: Sources that determine the position as well as the filter knows it.
_VOUCHING = np.array([False, False, True, True])
#: Measurements over which the moving averages reach, and their weight.
WINDOW = 25
WEIGHT = 2 / (WINDOW + 1)
#: Probability that a window of a right filter is a contradiction, or widens the covariance.
FALSE_ALARM = 1e-8
#: The same for a drift of GNSS: one across the road is followed by the heading, which nothing else
#: measures, so that the innovations exceed what they may be by little, and not for long.
GNSS_FALSE_ALARM = 1e-5
#: Greatest squared mean of normalised innovations by source, which have 2 or 3 values.
MAX_MEAN = {
    source: float(chdtri(m, probability)) * WEIGHT / (2 - WEIGHT)
    for source, m, probability in (
        ("gnss", 2, GNSS_FALSE_ALARM),
        ("line", 2, FALSE_ALARM),
        ("landmark", 2, FALSE_ALARM),
        ("pose", 3, FALSE_ALARM),
    )
}
#: Greatest mean NIS of a value; the mean of a window is about that of so many values of chi-square.
_VALUES = 2 * (2 - WEIGHT) / WEIGHT
MAX_NIS = float(chdtri(_VALUES, FALSE_ALARM)) / _VALUES
#: Estimated errors of sensors beyond this many of their standard deviations are impossible.
IMPLAUSIBLE = 5.0
#: Measurements in a row that must agree for a pose to be known again, and their greatest squared
#: distance: of 5 %.
AGREED = 5
AGREEING = {m: float(chdtri(m, 0.05)) for m in (2, 3)}
#: Time for which a source that has agreed twice vouches for the pose [s].
VOUCHES = 5.0
#: Time for which positions of a single source must fit the odometry [s].
SINGLE_SOURCE = 35.0
#: A residual of the position is taken for a turn of the car about a place so far away [m].
LEVER = 10.0


class Consistency(NamedTuple):
    """What is known of the consistency of n filters."""

    known: Cars  #: (n,) whether the pose is known
    since: Array  #: (n,) time at which it was lost [s]
    misled: (
        Cars  #: (n,) whether a lost pose has followed what contradicts it, so agreeing is no proof
    )
    missed: Cars  #: (n,) whether it was lost since odometry was missing or refused
    contradicts: Cars  #: (n, S) sources that contradict a lost pose
    fits: Array  #: (n,) time since which positions fit the odometry of a lost pose [s]; NaN
    rejected: NDArray[np.intp]  #: (n, S) measurements in a row
    agreed: NDArray[np.intp]  #: (n, S) measurements in a row
    at: Array  #: (n, S) time of the last one that agreed [s]
    mean: Array  #: (n, S, 3) moving average of the normalised innovations
    nis: Array  #: (n, S) that of their mean squares
    residual: Array  #: (n, S) of the last rejected one, across or in the position [m]
    turn: Array  #: (n, S) in the heading [rad]


def unsuspicious(n: int) -> Consistency:
    """Return the consistency of n filters that have not seen a measurement."""
    S = len(SOURCES)
    none, zero = np.zeros((n, S), dtype=bool), np.zeros((n, S))
    return Consistency(
        np.full(n, True), np.full(n, -np.inf), np.full(n, False), np.full(n, False), none,
        np.full(n, np.nan),
        np.zeros((n, S), dtype=np.intp), np.zeros((n, S), dtype=np.intp), zero - np.inf,
        np.zeros((n, S, 3)), np.ones((n, S)), zero, zero,
    )  # fmt: skip


def compared(trust: Consistency, found: Innovation, t: float) -> tuple[Consistency, Cars, Cars]:
    """Return the consistency after a measurement, and (n,) which poses it contradicts.

    The third value is for which of these by a drift, which they have followed.
    """
    s, m = SOURCES.index(found.source), found.residual.shape[-1]
    used, beyond = (found.verdict == one for one in (Verdict.USED, Verdict.OUTLIER))
    is_used = used.any(axis=1)
    judged = np.where(is_used[:, None], used, beyond)  # (n, B)
    count = judged.sum(axis=1)
    any_judged = count > 0
    share = judged / np.maximum(count, 1)[:, None]
    root = np.linalg.cholesky(np.where(judged[..., None, None], found.S, np.eye(m)))
    normal = np.linalg.solve(root, found.residual[..., None])[..., 0]
    squared = (normal**2).sum(axis=-1)
    normal *= np.sqrt(np.minimum(1.0, GATES[m] / np.maximum(squared, 1e-300)))[..., None]
    squared = squared.clip(max=GATES[m])

    rejected, agreed, at = trust.rejected.copy(), trust.agreed.copy(), trust.at.copy()
    mean, nis = trust.mean.copy(), trust.nis.copy()
    residual, turn = trust.residual.copy(), trust.turn.copy()
    is_far = any_judged & ~is_used
    agrees = any_judged & (np.where(judged, squared, np.inf).min(axis=1) <= AGREEING[m])
    agrees = np.where(trust.known, is_used, agrees)
    rejected[:, s] = np.where(is_far, rejected[:, s] + 1, np.where(is_used, 0, rejected[:, s]))
    agreed[:, s] = np.where(agrees, agreed[:, s] + 1, np.where(any_judged, 0, agreed[:, s]))
    at[agrees, s] = t
    keep = np.where(any_judged, 1 - WEIGHT, 1.0)
    mean[:, s] *= keep[:, None]
    mean[:, s, :m] += (1 - keep)[:, None] * (share[..., None] * normal).sum(axis=1)
    nis[:, s] = keep * nis[:, s] + (1 - keep) * (share * squared).sum(axis=1) / m
    size, angle = _sizes(found, share)
    residual[:, s] = np.where(is_far, size, np.where(is_used, 0.0, residual[:, s]))
    turn[:, s] = np.where(is_far, angle, np.where(is_used, 0.0, turn[:, s]))
    trust = trust._replace(
        rejected=rejected, agreed=agreed, at=at, mean=mean, nis=nis, residual=residual, turn=turn
    )
    # The mean of noise that is larger than stated is so, too.
    noise = np.where(nis[:, s] > MAX_NIS, nis[:, s], 1.0)
    drifts = trust.known & ((mean[:, s] ** 2).sum(axis=-1) > MAX_MEAN[found.source] * noise)
    too_many = rejected[:, s] >= REJECTED[s]
    return trust, any_judged & (too_many | drifts), any_judged & drifts & ~too_many


def _sizes(found: Innovation, share: Array) -> tuple[Array, Array]:
    """Return (n,) sizes of the residuals in the position [m], and in the heading [rad]."""
    residual = np.abs(found.residual) * share[..., None]
    if found.source == "line":
        return residual[..., 0].sum(axis=1), residual[..., 1].sum(axis=1)
    size = np.hypot(residual[..., 0], residual[..., 1]).sum(axis=1)
    if found.source == "pose":
        return size, residual[..., 2].sum(axis=1)
    return size, size / LEVER


def implausible(mean: Array, errors: SensorErrors, gnss_sigma: Array) -> tuple[Cars, Cars]:
    """Return (n,) whether the estimated errors of GNSS, and of the odometry, are impossible.

    Only those are judged that would grow without limit if a fault were taken for them.

    Args:
        mean: (n, N) states.
        errors: of the sensors.
        gnss_sigma: (n,) standard deviations of the GNSS error [m].
    """
    far = IMPLAUSIBLE**2
    gnss = (mean[:, GNSS] ** 2).sum(axis=1) > far * gnss_sigma**2
    scale = mean[:, SCALE] ** 2 > far * errors.wheel_scale.sigma**2
    rate = mean[:, YAW_RATE] ** 2 > far * errors.yaw_rate.sigma**2
    return gnss, scale | rate


def vouched(trust: Consistency, source: str | None, t: float) -> Cars:
    """Return (n,) for which another source vouches for the pose.

    Args:
        trust: the consistency.
        source: that contradicts the pose; None for the odometry.
        t: [s].
    """
    other = _VOUCHING & (np.array(SOURCES) != source)
    recent = (trust.agreed >= 2) & (t - trust.at <= VOUCHES)
    return np.asarray((recent & other).any(axis=1))


def forgiven(trust: Consistency, cars: Cars, source: str) -> Consistency:
    """Return the consistency without what (n,) cars know of a source."""
    s = SOURCES.index(source)
    clean = unsuspicious(len(cars))
    changed = {}
    for name in ("rejected", "mean", "nis", "residual", "turn"):
        one = getattr(trust, name).copy()
        one[cars, s] = getattr(clean, name)[cars, s]
        changed[name] = one
    return trust._replace(**changed)


def lost(
    trust: Consistency,
    cars: Cars,
    t: float,
    source: str | None = None,
    *,
    misled: Cars | bool = False,
    missed: bool = False,
) -> Consistency:
    """Return the consistency after the poses of (n,) cars were lost.

    Args:
        trust: the consistency.
        cars: (n,) which ones.
        t: [s].
        source: that contradicts them; None for none.
        misled: (n,) whether the poses have followed what contradicts them.
        missed: whether odometry was missing or refused.
    """
    contradicts, agreed, fits = trust.contradicts.copy(), trust.agreed.copy(), trust.fits.copy()
    new = cars & trust.known
    agreed[new] = 0
    fits[new] = np.nan
    if source is not None:
        s = SOURCES.index(source)
        contradicts[cars, s] = True
        agreed[cars, s] = 0
    return trust._replace(
        known=trust.known & ~cars,
        since=np.where(new | (cars & missed), t, trust.since),
        misled=trust.misled | (new & misled),
        missed=trust.missed | (cars & missed),
        contradicts=contradicts,
        agreed=agreed,
        fits=fits,
    )


def found_again(trust: Consistency, cars: Cars) -> Consistency:
    """Return the consistency after the poses of (n,) cars are known again: all is forgotten."""
    clean = unsuspicious(len(cars))
    return Consistency(
        *(
            np.where(cars.reshape(-1, *[1] * (one.ndim - 1)), new, one)
            for one, new in zip(trust, clean, strict=True)
        )
    )


def agreeing(trust: Consistency) -> Cars:
    """Return (n,) which lost poses are known again, since all that contradicted them agree."""
    agreed = ~trust.contradicts | (trust.agreed >= AGREED)
    is_right = ~trust.known & ~trust.misled & ~trust.missed
    return is_right & trust.contradicts.any(axis=1) & agreed.all(axis=1)


def may_align(trust: Consistency, t: float) -> Cars:
    """Return (n,) which lost poses are known again as positions fit the odometry by now [s]."""
    single = ~trust.missed & (trust.contradicts.sum(axis=1) < 2)
    return ~trust.known & (t - trust.fits >= np.where(single, SINGLE_SOURCE, 0.0))


def widening(trust: Consistency) -> tuple[Array, Array, Array]:
    """Return by what stated covariances are to be widened, as sensors begin to contradict them.

    Returns:
        (n,) factors, 1 or more; (n,) variances to add to x and y [m^2], and to the heading [rad^2].
    """
    nis = np.where(trust.nis > MAX_NIS, trust.nis, 1.0).max(axis=1)
    doubt = trust.rejected >= 2
    position, turn = (
        np.where(doubt, one**2, 0.0).max(axis=1) for one in (trust.residual, trust.turn)
    )
    return nis, position, turn
