"""One step of the localisation: from an odometry or an observation to the next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .alignment import MAX_TIME, Alignment, Position, aligned
from .association import Verdict
from .confirmation import Sightings, confirmed
from .consistency import (
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
from .localisation_layer import LocalisationLayer
from .measurements import CameraLines, GnssFix, Observation, PoseFix, SeenLandmarks
from .motion_model import CAMERA, FIX, GNSS, HEADING, POSE, N, X, Y, initial, predict, update
from .observation_models import Innovation, innovation
from .odometry_stream import OdometryStream
from .sensor_errors import SensorErrors

Array = NDArray[np.float64]
Cars = NDArray[np.bool_]

#: Error states of each source, which are forgotten when it contradicts the pose.
_BIASES = {"gnss": GNSS, "line": CAMERA, "landmark": slice(0, 0), "pose": FIX}


class Outcome(NamedTuple):
    """What became of the B blocks of an observation of n cars, when it can no longer change."""

    t: float  #: [s]
    source: str  #: "gnss", "line", "landmark" or "pose"
    verdict: NDArray[np.intp]  #: (n, B) values of ``Verdict``
    squared: Array  #: (n, B) normalised innovations squared (NIS), of 2 values; of 3 for a pose


class Point(NamedTuple):
    """State of the filter after an odometry or an observation."""

    t: float
    mean: Array
    cov: Array
    transition: Array  #: (n, N, N) of the error since the point before
    trust: Consistency
    positions: tuple[Position, ...] = ()  #: of the cars whose pose is lost
    outcome: Outcome | None = None
    is_new: Cars | None = None  #: (n,) cars whose pose does not follow from the point before
    sightings: Mapping[str, Sightings] = {}  #: of the last image, by source


def predicted(last: Point, t: float, stream: OdometryStream, errors: SensorErrors) -> Point:
    """Return the point at a time up to the last sample of the odometry [s]."""
    dt = t - last.t
    if dt <= 0:
        return last._replace(
            t=t, transition=np.eye(N) + np.zeros_like(last.cov), outcome=None, is_new=None
        )
    speed, rate, since = stream.at((last.t + t) / 2)
    mean, cov, F = predict(last.mean, last.cov, speed, rate, dt, errors)
    widen(cov, *stream.gap_noise(last.t, t, since, speed))
    return last._replace(t=t, mean=mean, cov=cov, transition=F, outcome=None, is_new=None)


def widen(cov: Array, position: Array, heading: Array) -> None:
    """Add (n,) variances to x and y [m^2], and to the heading [rad^2], in place."""
    cov[:, X, X] += position
    cov[:, Y, Y] += position
    cov[:, HEADING, HEADING] += heading


def updated(
    point: Point, observation: Observation, layer: LocalisationLayer | None, errors: SensorErrors
) -> Point:
    """Return the point after an observation at its time."""
    t, mean, cov, transition, trust, *_ = point
    found, sightings = innovation(observation, mean, cov, layer), point.sightings
    if isinstance(observation, CameraLines | SeenLandmarks):
        found, seen = confirmed(found, cov, sightings.get(found.source), t)
        sightings = {**sightings, found.source: seen}
    was_known = trust.known
    trust, contradicted, drifts = compared(trust, found, t)
    trust = _contradicted(trust, contradicted, found.source, t, drifts)
    used = (found.verdict == Verdict.USED) & trust.known[:, None]
    if used.any():
        mean, cov, reduction = update(mean, cov, found.residual, found.H, found.R, used)
        transition = reduction @ transition
    far_gnss, far_odometry = implausible(mean, errors)
    far_gnss, far_odometry = far_gnss & trust.known, far_odometry & trust.known
    far_odometry &= ~vouched(trust, None, t)
    trust = _contradicted(trust, far_gnss, "gnss", t, far_gnss)
    trust = lost(trust, far_odometry, t, misled=True)
    biases = np.zeros((len(mean), N), dtype=bool)
    biases[contradicted & was_known, _BIASES[found.source]] = True
    biases[far_gnss, GNSS] = True
    if biases.any():
        mean, cov, transition = _forgotten(mean, cov, transition, biases, errors)
    trust = found_again(trust, agreeing(trust))
    verdict = np.where((found.verdict == Verdict.USED) & ~used, Verdict.LOST, found.verdict)
    outcome = Outcome(t, found.source, verdict, found.squared)
    after = Point(t, mean, cov, transition, trust, point.positions, outcome, None, sightings)
    return after if trust.known.all() else _sought(after, observation, found, errors)


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
    mean: Array, cov: Array, transition: Array, states: Cars, errors: SensorErrors
) -> tuple[Array, Array, Array]:
    """Return means, covariances and transitions in which (n, N) errors of sensors are unknown."""
    keep = ~states[:, :, None]
    prior = np.append(np.zeros(3), errors.sigmas**2)
    cov = np.where(keep & keep.swapaxes(1, 2), cov, 0.0)
    cov[:, range(N), range(N)] += np.where(states, prior, 0.0)
    return np.where(states, 0.0, mean), cov, np.where(keep, transition, 0.0)


def _sought(
    point: Point, observation: Observation, found: Innovation, errors: SensorErrors
) -> Point:
    """Return the point after a position of cars whose pose is lost, which may find it."""
    if not isinstance(observation, GnssFix | PoseFix):
        return point
    t, trust, n = point.t, point.trust, len(point.mean)
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
    new = Position(
        t, is_gnss, np.where(given[:, None], place, np.nan), noise, common, point.mean[:, :2]
    )
    past = [one for one in point.positions if t - one.t <= MAX_TIME]
    positions = (*past, new)
    fits, poses = trust.fits.copy(), dict[int, Alignment]()
    for car in np.flatnonzero(given).tolist():
        same = [one for one in positions if one.is_gnss == is_gnss]
        pose = aligned(same, car, trust.since[car], point.mean[car, POSE], errors)
        if pose is not None and not pose.fits:
            fits[car] = np.nan
        elif pose is not None:  # a car that stands shows nothing
            poses[car] = pose
            fits[car] = t if np.isnan(fits[car]) else fits[car]
    trust = trust._replace(fits=fits)
    ready = may_align(trust, t) & np.isin(np.arange(n), [*poses])
    point = point._replace(trust=found_again(trust, ready), positions=positions, is_new=ready)
    if not ready.any():
        return point
    mean, cov, transition = (one.copy() for one in point[1:4])
    for car in np.flatnonzero(ready).tolist():
        pose = poses[car]
        mean[car : car + 1], cov[car : car + 1] = initial(pose.pose[None], pose.cov[None], errors)
        if is_gnss:
            cov[car, POSE, GNSS] = pose.bias_cov
            cov[car, GNSS, POSE] = pose.bias_cov.T
        transition[car] = 0.0
    return point._replace(mean=mean, cov=cov, transition=transition)


def missed(point: Point, cars: Cars) -> Point:
    """Return the point after odometry of (n,) cars has been missing for too long."""
    return point._replace(trust=lost(point.trust, cars, point.t, missed=True))
