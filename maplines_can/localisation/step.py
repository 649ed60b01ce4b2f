"""One step of the localisation: from an odometry or an observation to the next.

Each of n cars has K filters, which are n K rows: see ``gnss_hypotheses``. What is known of the
consistency of a car is that of its likeliest row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .alignment import MAX_TIME, Alignment, Position, aligned
from .association import Verdict
from .confirmation import Sightings, confirmed
from .divergence import (
    SOURCES,
    Consistency,
    agreeing,
    compared,
    forgiven,
    found_again,
    implausible,
    lost,
    may_align,
    vouched,
)
from .drift import (
    FORGOTTEN,
    GOES_ON,
    SEEN,
    SURE,
    Ramps,
    carried,
    doubted,
    forgotten,
    measured,
    no_ramps,
    opened,
)
from .gnss_hypotheses import (
    Bank,
    changed,
    discarded,
    first_weight,
    hypotheses,
    mixture,
    renewed,
    stated,
    weighed,
)
from .localisation_layer import LocalisationLayer
from .measurements import CameraLines, GnssFix, Observation, PoseFix, SeenLandmarks
from .motion_model import (
    CAMERA,
    ERRORS,
    FIX,
    GNSS,
    HEADING,
    POSE,
    N,
    X,
    Y,
    initial,
    predict,
    update,
)
from .observation_models import Innovation, innovation
from .odometry_stream import OdometryStream
from .sensor_errors import GaussMarkov, SensorErrors

Array = NDArray[np.float64]
Cars = NDArray[np.bool_]

#: Probability of the open road from which on a ramp is one, not a canyon.
OPEN = 0.7
#: Error states of each source, which are forgotten when it contradicts the pose.
_BIASES = {"gnss": GNSS, "line": CAMERA, "landmark": slice(0, 0), "pose": FIX}


class BlockOutcome(NamedTuple):
    """What became of the B blocks of an observation of n cars, when it can no longer change."""

    t: float  #: [s]
    source: str  #: "gnss", "line", "landmark" or "pose"
    verdict: NDArray[np.intp]  #: (n, B) values of ``Verdict``
    squared: Array  #: (n, B) normalised innovations squared (NIS), of 2 values; of 3 for a pose


class Point(NamedTuple):
    """State of the filter after an odometry or an observation."""

    t: float
    mean: Array  #: (n K, N)
    cov: Array  #: (n K, N, N)
    transition: Array  #: (n K, N, N) of the error since the point before
    bank: Bank
    trust: Consistency
    ramps: Ramps
    positions: tuple[Position, ...] = ()  #: of the cars whose pose is lost
    outcome: BlockOutcome | None = None
    is_new: Cars | None = None  #: (n,) cars whose pose does not follow from the point before
    sightings: Mapping[str, Sightings] = {}  #: of the last image, by source

    @property
    def mixture(self) -> tuple[Array, Array]:
        """(n, N) means and (n, N, N) covariances of the cars, over their hypotheses."""
        return mixture(self.mean, self.cov, self.bank.weight)

    @property
    def mean_transition(self) -> Array:
        """(n, N, N) transition of the error of the mixture since the point before."""
        n, K = self.bank.weight.shape
        rows = self.transition.reshape(n, K, N, N)
        return np.asarray((self.bank.weight[..., None, None] * rows).sum(axis=1))


def first(t: float, mean: Array, cov: Array, held: Bank, trust: Consistency) -> Point:
    """Return the point with which a filter starts."""
    ramps = no_ramps(len(trust.known))
    return Point(t, mean, cov, np.eye(N) + np.zeros_like(cov), held, trust, ramps)


def predicted(last: Point, t: float, stream: OdometryStream, errors: SensorErrors) -> Point:
    """Return the point at a time up to the last sample of the odometry [s]."""
    dt = t - last.t
    if dt <= 0:
        return last._replace(
            t=t, transition=np.eye(N) + np.zeros_like(last.cov), outcome=None, is_new=None
        )
    speed, rate, since = stream.at((last.t + t) / 2)
    both = speed, rate, *stream.gap_noise(last.t, t, since, speed)
    speed, rate, position, heading = (np.repeat(one, last.bank.weight.shape[1]) for one in both)
    mean, cov, F = predict(last.mean, last.cov, speed, rate, dt, errors, last.bank.rows)
    widen(cov, position, heading)
    return last._replace(
        t=t,
        mean=mean,
        cov=cov,
        transition=F,
        ramps=carried(last.ramps, F[last.bank.of_open_road]),
        outcome=None,
        is_new=None,
    )


def widen(cov: Array, position: Array, heading: Array) -> None:
    """Add (n,) variances to x and y [m^2], and to the heading [rad^2], in place."""
    cov[:, X, X] += position
    cov[:, Y, Y] += position
    cov[:, HEADING, HEADING] += heading


def updated(
    point: Point,
    observation: Observation,
    layer: LocalisationLayer | None,
    errors: SensorErrors,
    stream: OdometryStream,
) -> Point:
    """Return the point after an observation at its time."""
    t, mean, cov, transition, held, trust, ramps, *_ = point
    K = held.weight.shape[1]
    if isinstance(observation, GnssFix):
        mean, cov, factor, held = _gnss_error(point, observation, errors)
        transition = factor[:, :, None] * transition
        share = factor[held.of_open_road, None, None]
        ramps = ramps._replace(response=ramps.response * share)
    repeated, sightings = _repeated(observation, K), point.sightings
    found = innovation(repeated, mean, cov, layer)
    expected = found
    if isinstance(observation, GnssFix):
        told = np.full(len(trust.known), K == 1) | _is_stated(observation, len(trust.known))
        cov, is_other = changed(cov, held, found, told & trust.known)
        if is_other.any():
            found = innovation(repeated, mean, cov, layer)
            expected = expected._replace(verdict=found.verdict)
            ramps = forgotten(ramps, is_other[held.of_open_road])  # a ramp does not jump
    if isinstance(observation, CameraLines | SeenLandmarks):
        found, images = confirmed(found, cov, sightings.get(found.source), t)
        expected = found
        sightings = {**sightings, found.source: images}
    likeliest = held.likeliest
    seen = _rows(found, likeliest)
    was_known = trust.known
    trust, contradicted, drifts = compared(
        trust, _predicted_fixes(_rows(expected, likeliest), found, K), t
    )
    is_gnss = found.source == "gnss"
    is_ramp = np.zeros(len(trust.known), dtype=bool)
    if is_gnss:
        best = ramps.best(t)
        # A drift is smooth: a fix beyond the gate says that something else is wrong.
        is_smooth = trust.known & (trust.rejected[:, SOURCES.index("gnss")] == 0)
        is_open = held.weight[:, 0] > OPEN
        is_ramp = best.beyond(SURE) & is_smooth & is_open
        is_seen = drifts & best.beyond(SEEN) & is_open
        explained = is_seen | (drifts & (K > 1))
        held = discarded(held, drifts & ~is_seen) if K > 1 else held
        trust, contradicted = forgiven(trust, explained, "gnss"), contradicted & ~explained
    trust = _contradicted(trust, contradicted, found.source, t, drifts)
    used = (found.verdict == Verdict.USED) & np.repeat(trust.known, K)[:, None]
    if used.any():
        mean, cov, reduction = update(mean, cov, found.residual, found.H, found.R, used)
        transition = reduction @ transition
    else:
        reduction = np.eye(N) + np.zeros_like(cov)
    open_road = held.of_open_road
    if is_gnss:
        ramps = measured(ramps, _rows(found, open_road), reduction[open_road], t)
    else:
        ramps = carried(ramps, reduction[open_road])
    if is_gnss:
        given = (seen.verdict[:, 0] != Verdict.MISSING) & trust.known
        held = weighed(held, found, given, t)
    far_gnss, far_odometry = implausible(mean, errors, held.gnss_sigma)
    far_gnss = (far_gnss.reshape(-1, K).all(axis=1) | held.blames_odometry) & trust.known
    far_odometry = far_odometry[held.likeliest] & trust.known & ~vouched(trust, None, t)
    trust = _contradicted(trust, far_gnss, "gnss", t, far_gnss)
    held = discarded(held, held.blames_odometry & trust.known)
    trust = lost(trust, far_odometry, t, misled=True)
    biases = np.zeros((len(trust.known), N), dtype=bool)
    biases[contradicted & was_known, _BIASES[found.source]] = True
    biases[far_gnss, GNSS] = True
    if biases.any():
        states = np.repeat(biases, K, axis=0)
        mean, cov, transition = _forgotten(mean, cov, transition, states, held)
        ramps = forgotten(ramps, np.asarray(biases.any(axis=1)))
    ramps = forgotten(ramps, held.weight.argmax(axis=1) != 0)  # in a canyon, it is no open road
    trust = found_again(trust, agreeing(trust))
    own = used[likeliest]
    verdict = np.where((seen.verdict == Verdict.USED) & ~own, Verdict.LOST, seen.verdict)
    outcome = BlockOutcome(t, seen.source, verdict, seen.squared)
    after = Point(
        t, mean, cov, transition, held, trust, ramps, point.positions, outcome, None, sightings
    )
    if is_ramp.any():
        after = _drifting(after, is_ramp & trust.known, stream)
    return after if trust.known.all() else _sought(after, observation, seen, errors)


def _drifting(point: Point, sure: Cars, stream: OdometryStream) -> Point:
    """Return the point after a fix, in which a drift of GNSS is possible.

    Args:
        point: after the fix.
        sure: (n,) cars whose GNSS has a ramp.
        stream: of the odometry.
    """
    t, mean, cov, _, held, trust, ramps, *_ = point
    K = held.weight.shape[1]
    best = ramps.best(t)
    # What vouches for the pose says that the odometry is right.
    wide = np.repeat(sure & ~vouched(trust, "gnss", t), K)[:, None, None]
    speed = np.repeat(stream.at(t)[0], K)
    cov = np.where(wide, opened(cov, mean[:, HEADING], best.repeated(K), speed), cov)
    held = held._replace(drift=np.where(sure, GOES_ON * np.hypot(*best.rate.T), held.drift))
    return point._replace(cov=cov, bank=held, ramps=forgotten(ramps, sure))


def _gnss_error(
    point: Point, fix: GnssFix, errors: SensorErrors
) -> tuple[Array, Array, Array, Bank]:
    """Return means, covariances, factors of the states and the bank with the error of a fix."""
    t, mean, cov, _, held, trust, *_ = point
    error = np.full((len(trust.known), 2), np.nan) if fix.error is None else np.asarray(fix.error)
    held = held._replace(drift=held.drift * np.exp(-(t - held.drift_at) / FORGOTTEN), drift_at=t)
    mean, cov, share, held = stated(mean, cov, held, error, hypotheses(errors))
    given = np.isfinite(fix.position).all(axis=1) & trust.known & np.isnan(error[:, 0])
    mean, cov, factor, held = renewed(mean, cov, held, given, t)
    return mean, cov, share * factor, held


def _is_stated(fix: GnssFix, n: int) -> Cars:
    """Return (n,) whether a fix states its error."""
    return np.full(n, False) if fix.error is None else ~np.isnan(np.asarray(fix.error)[:, 0])


def _repeated(observation: Observation, K: int) -> Observation:
    """Return an observation of n cars for n K rows."""
    if K == 1:
        return observation
    rows = (None if one is None else np.repeat(one, K, axis=0) for one in observation[1:])
    return type(observation)(observation.t, *rows)  # type: ignore[arg-type]


def _rows(found: Innovation, rows: NDArray[np.intp] | slice) -> Innovation:
    """Return the innovations of some rows."""
    source, residual, H, R, S, verdict = found
    return Innovation(source, residual[rows], H[rows], R[rows], S[rows], verdict[rows])


def _predicted_fixes(seen: Innovation, found: Innovation, K: int) -> Innovation:
    """Return the innovations of cars without the fixes that not the likeliest hypothesis predicts.

    If another one does, they say that the hypothesis is wrong, not the pose: the weights follow.
    """
    if K == 1 or seen.source != "gnss":
        return seen
    other = (found.verdict == Verdict.USED).reshape(-1, K).any(axis=1)[:, None]
    is_explained = other & (seen.verdict == Verdict.OUTLIER)
    return seen._replace(verdict=np.where(is_explained, Verdict.MISSING, seen.verdict))


def _contradicted(
    trust: Consistency, cars: Cars, source: str, t: float, misled: Cars
) -> Consistency:
    """Return the consistency after a source contradicted the poses of (n,) cars."""
    if not cars.any():
        return trust
    excused = cars & trust.known & vouched(trust, source, t)
    trust = forgiven(trust, excused, source)
    return lost(trust, cars & ~excused, t, source, misled=misled)


def _forgotten(
    mean: Array, cov: Array, transition: Array, states: Cars, held: Bank
) -> tuple[Array, Array, Array]:
    """Return means, covariances and transitions in which (n K, N) errors are unknown."""
    keep = ~states[:, :, None]
    prior = np.zeros(mean.shape)
    prior[:, ERRORS] = held.rows[:, 0] ** 2
    cov = np.where(keep & keep.swapaxes(1, 2), cov, 0.0)
    cov[:, range(N), range(N)] += np.where(states, prior, 0.0)
    return np.where(states, 0.0, mean), cov, np.where(keep, transition, 0.0)


def _sought(
    point: Point, observation: Observation, found: Innovation, errors: SensorErrors
) -> Point:
    """Return the point after a position of cars whose pose is lost, which may find it."""
    if not isinstance(observation, GnssFix | PoseFix):
        return point
    t, trust, n = point.t, point.trust, len(point.trust.known)
    own = point.mean[point.bank.likeliest]
    given = (found.verdict[:, 0] != Verdict.MISSING) & ~trust.known
    is_gnss = isinstance(observation, GnssFix)
    noise = np.broadcast_to(observation.cov, (n, *observation.cov.shape[-2:]))[:, :2, :2]
    common = np.zeros((n, 2, 2))
    if isinstance(observation, PoseFix):
        place = observation.pose[:, :2]
        if observation.shared is not None:
            common = common + observation.shared[..., :2, :2]
    else:
        place = observation.position
    new = Position(t, is_gnss, np.where(given[:, None], place, np.nan), noise, common, own[:, :2])
    past = [one for one in point.positions if t - one.t <= MAX_TIME]
    positions = (*past, new)
    fits, poses = trust.fits.copy(), dict[int, Alignment]()
    for car in np.flatnonzero(given).tolist():
        same = [one for one in positions if one.is_gnss == is_gnss]
        pose = aligned(same, car, trust.since[car], own[car, POSE], _with_error(point, car, errors))
        if pose is not None and not pose.fits:
            fits[car] = np.nan
        elif pose is not None:  # a car that stands shows nothing
            poses[car] = pose
            fits[car] = t if np.isnan(fits[car]) else fits[car]
    trust = trust._replace(fits=fits)
    ready = may_align(trust, t) & np.isin(np.arange(n), [*poses])
    point = point._replace(trust=found_again(trust, ready), positions=positions, is_new=ready)
    return _placed(point, poses, ready, is_gnss, errors) if ready.any() else point


def _with_error(point: Point, car: int, errors: SensorErrors) -> SensorErrors:
    """Return the errors of the sensors of a car by its likeliest hypothesis."""
    sigma, time = point.bank.rows[point.bank.likeliest[car], :, GNSS.start - 3].tolist()
    return replace(errors, gnss=GaussMarkov(sigma, time))


def _placed(
    point: Point, poses: dict[int, Alignment], ready: Cars, is_gnss: bool, errors: SensorErrors
) -> Point:
    """Return the point with the poses that were found, of which the GNSS error is that found by."""
    mean, cov, transition = (one.copy() for one in point[1:4])
    held, K = point.bank, point.bank.weight.shape[1]
    weight, at = held.weight.copy(), np.where(ready, point.t, held.at)
    for car in np.flatnonzero(ready).tolist():
        pose, rows = poses[car], slice(car * K, car * K + K)
        where, spread = np.tile(pose.pose, (K, 1)), np.tile(pose.cov, (K, 1, 1))
        mean[rows], cov[rows] = initial(where, spread, errors, held.rows[rows])
        if is_gnss:
            row = held.likeliest[car]
            cov[row, POSE, GNSS] = pose.bias_cov
            cov[row, GNSS, POSE] = pose.bias_cov.T
        transition[rows] = 0.0
        weight[car] = first_weight(K)
    held = held._replace(weight=weight, at=at)
    best = point.ramps.best(point.t)
    drifts = ready & is_gnss & best.beyond(SURE)
    cov = np.where(np.repeat(drifts, K)[:, None, None], doubted(cov, best.repeated(K)), cov)
    held = held._replace(drift=np.where(drifts, GOES_ON * np.hypot(*best.rate.T), held.drift))
    ramps = forgotten(point.ramps, ready)
    return point._replace(mean=mean, cov=cov, transition=transition, bank=held, ramps=ramps)


def missed(point: Point, cars: Cars) -> Point:
    """Return the point after odometry of (n,) cars has been missing for too long."""
    return point._replace(trust=lost(point.trust, cars, point.t, missed=True))
