"""Innovations of the observations: residuals with their Jacobians, and what they are of.

An observation has blocks, each with its own verdict: a GNSS position, each line of the camera, each
landmark, a pose.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.linalg import squared_distance
from ..values.line import Kind
from .association import GATES, Candidates, Verdict, associate
from .localisation_layer import LocalisationLayer
from .measurements import CameraLines, GnssFix, Observation, PoseFix, SeenLandmarks
from .motion_model import CAMERA, FIX, GNSS, HEADING, POSE, N, X, Y

Array = NDArray[np.float64]
Verdicts = NDArray[np.intp]

#: Lines whose offsets differ by less are the same one [m].
SAME_LINE = 0.3
#: Landmarks that are closer to each other are the same one, and farthest from the place where it
#: is seen that one is looked for [m].
SAME_LANDMARK, LANDMARK_REACH = 0.05, 10.0
#: Places at which lines are looked for, ahead of the estimate [standard deviations along].
PLACES = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
#: Least eigenvalue of the covariance of an innovation [m^2, rad^2], or share of the variances of
#: which it is the difference, if they are more than 1; below, it is rounding.
SINGULAR = 1e-12


class Innovation(NamedTuple):
    """Residuals of n cars: B blocks of m values each. Blocks that are not used are 0."""

    source: str  #: "gnss", "line", "landmark" or "pose"
    residual: Array  #: (n, B, m) measurement less its prediction
    H: Array  #: (n, B, m, N) Jacobian of the prediction
    R: Array  #: (n, B, m, m) covariance of the measurement
    S: Array  #: (n, B, m, m) covariance of the residual
    verdict: Verdicts  #: (n, B)

    @property
    def squared(self) -> Array:
        """(n, B) normalised innovations squared (NIS)."""
        return squared_distance(self.residual, self.S)


def innovation(
    observation: Observation, mean: Array, cov: Array, layer: LocalisationLayer | None
) -> Innovation:
    """Return the innovation of an observation.

    Args:
        observation: of n cars.
        mean: (n, N) states.
        cov: (n, N, N).
        layer: of the map; without it, lines and landmarks have no candidates.
    """
    if isinstance(observation, GnssFix):
        return _gnss(observation, mean, cov)
    if isinstance(observation, PoseFix):
        return _pose(observation, mean, cov)
    if isinstance(observation, CameraLines):
        return _lines(observation, mean, cov, layer)
    return _landmarks(observation, mean, cov, layer)


def _gnss(fix: GnssFix, mean: Array, cov: Array) -> Innovation:
    H = np.zeros((len(mean), 2, N))
    H[:, :, X : Y + 1] = H[:, :, GNSS] = np.eye(2)
    residual = fix.position - mean[:, :HEADING] - mean[:, GNSS]
    return _direct("gnss", residual, H, cov, fix.cov)


def _pose(fix: PoseFix, mean: Array, cov: Array) -> Innovation:
    H = np.zeros((len(mean), 3, N))
    H[:, :, POSE] = np.eye(3)
    residual = fix.pose - mean[:, POSE]
    if fix.shared is not None:
        # The symmetric root changes as little as its covariance does from fix to fix.
        values, vectors = np.linalg.eigh(fix.shared)
        H[:, :, FIX] = root = (vectors * np.sqrt(values.clip(0))[..., None, :]) @ vectors.mT
        residual = residual - (root @ mean[:, FIX, None])[..., 0]
    residual[:, 2] = (residual[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return _direct("pose", residual, H, cov, fix.cov)


def _direct(source: str, residual: Array, H: Array, cov: Array, R: Array) -> Innovation:
    """Return the innovation of a measurement that needs no association."""
    S = H @ cov @ H.transpose(0, 2, 1) + R
    R = np.broadcast_to(R, S.shape)
    given = np.asarray(np.isfinite(residual).all(axis=1))
    # An exact measurement of what is known exactly, such as a second one at the same time.
    size = np.diagonal(np.abs(H) @ np.abs(cov) @ np.abs(H.mT) + np.abs(R), axis1=-2, axis2=-1)
    unit = np.sqrt(size.clip(min=1.0))
    singular = np.linalg.eigvalsh(S / unit[:, :, None] / unit[:, None])[:, 0] <= SINGULAR
    good = given & ~singular
    residual = np.where(good[:, None], residual, 0.0)
    S, R = (np.where(good[:, None, None], one, np.eye(R.shape[-1])) for one in (S, R))
    inside = squared_distance(residual, S) <= GATES[residual.shape[1]]
    verdict = np.where(inside, Verdict.USED, Verdict.OUTLIER)
    verdict = np.where(given, np.where(singular, Verdict.SINGULAR, verdict), Verdict.MISSING)
    return Innovation(
        source, residual[:, None], H[:, None], R[:, None], S[:, None], verdict[:, None]
    )


def _lines(
    lines: CameraLines, mean: Array, cov: Array, layer: LocalisationLayer | None
) -> Innovation:
    seen = np.stack([lines.offset, lines.heading], axis=-1)  # (n, B, 2)
    n, B = lines.offset.shape
    R = np.broadcast_to(lines.cov, (n, B, 2, 2))
    given = np.asarray(np.isfinite(seen).all(axis=-1))
    if layer is None:
        return _unmatched("line", given, R)
    places = places_ahead(mean, cov)
    beside = layer.lines_beside(places.reshape(-1, 3))
    # Each block of each car with each line beside this car, in the order of blocks n B.
    row_place, block = (a.ravel() for a in np.broadcast_arrays(beside.car[:, None], np.arange(B)))
    row = np.repeat(np.arange(len(beside.car)), B)
    car, k = np.divmod(row_place, len(PLACES))
    kind = lines.kind[car, block]
    fits = given[car, block] & ((kind == Kind.UNKNOWN) | (kind == beside.kind[row]))
    order = np.flatnonzero(fits)
    order = order[np.argsort(car[order] * B + block[order], kind="stable")]
    car, k, block, row = car[order], k[order], block[order], row[order]
    there = places[car, k]
    expected = np.stack([beside.offset[row], beside.heading[row]], axis=-1)
    H = line_jacobian(expected, beside.curvature[row], there[:, 2])
    expected = expected + (H[:, :, POSE] @ (mean[car, POSE] - there)[..., None])[..., 0]
    residual = seen[car, block] - expected - mean[car, CAMERA]
    found = _Pairs(car, block, residual, H, expected[:, :1], SAME_LINE, PLACES[k] ** 2)
    return _associated("line", found, cov, R, given)


def places_ahead(mean: Array, cov: Array) -> Array:
    """Return (n, 5, 3) poses of n cars if they are ahead of, or behind, their estimate.

    A line is straight here and bent there, or begins, ends, or changes its kind: at one place only,
    the filter would take it for what it is at its own estimate. So lines are looked for at
    ``PLACES`` standard deviations along the car, at each with the pose that is the most likely one
    there. Each is a line of its own, with its own Jacobian.
    """
    along = np.stack([np.cos(mean[:, HEADING]), np.sin(mean[:, HEADING])], axis=-1)
    P = cov[:, POSE, POSE]
    gain = (P[:, :, :2] @ along[..., None])[..., 0]  # (n, 3)
    variance = (along * gain[:, :2]).sum(axis=-1)
    step = gain / np.sqrt(variance.clip(min=1e-12))[:, None]
    return np.asarray(mean[:, None, POSE] + PLACES[:, None] * step[:, None])


def line_jacobian(expected: Array, curvature: Array, heading: Array) -> Array:
    """Return the (k, 2, N) Jacobian of y_off and beta of lines beside a car.

    A car that moves by a ahead, by l to the left and turns by h sees, to first order,

        y_off + tan(beta) a - l - tan(beta) y_off h
        beta + c0 cos^2(beta) (a - y_off h) - h

    Args:
        expected: (k, 2) y_off [m], beta [rad].
        curvature: (k,) c0 [1/m].
        heading: (k,) of the cars [rad].
    """
    y, slope = expected[:, 0], np.tan(expected[:, 1])
    bend = curvature * np.cos(expected[:, 1]) ** 2
    c, s = np.cos(heading), np.sin(heading)
    H = np.zeros((len(expected), 2, N))
    H[:, 0, X], H[:, 0, Y] = slope * c + s, slope * s - c
    H[:, 0, HEADING] = -slope * y
    H[:, 1, X], H[:, 1, Y] = bend * c, bend * s
    H[:, 1, HEADING] = -1 - bend * y
    H[:, :, CAMERA] = np.eye(2)
    return H


def _landmarks(
    seen: SeenLandmarks, mean: Array, cov: Array, layer: LocalisationLayer | None
) -> Innovation:
    B = seen.position.shape[1]
    given = np.asarray(np.isfinite(seen.position).all(axis=-1))
    R = np.where(given[..., None, None], seen.cov, np.eye(2))
    if layer is None:
        return _unmatched("landmark", given, R)
    c, s = np.cos(mean[:, HEADING, None]), np.sin(mean[:, HEADING, None])
    x, y = seen.position[..., 0], seen.position[..., 1]
    in_map = mean[:, None, :HEADING] + np.stack([c * x - s * y, s * x + c * y], axis=-1)
    flat, place = layer.landmarks_near(in_map.reshape(-1, 2), LANDMARK_REACH)
    car, block = np.divmod(flat, B)
    c, s, d = c[car, 0], s[car, 0], place - mean[car, :HEADING]
    expected = np.stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]], axis=-1)
    H = np.zeros((len(car), 2, N))
    H[:, 0, X], H[:, 0, Y], H[:, 0, HEADING] = -c, -s, expected[:, 1]
    H[:, 1, X], H[:, 1, Y], H[:, 1, HEADING] = s, -c, -expected[:, 0]
    residual = seen.position[car, block] - expected
    found = _Pairs(car, block, residual, H, place, SAME_LANDMARK)
    return _associated("landmark", found, cov, R, given)


class _Pairs(NamedTuple):
    """Residuals of k pairs of a block and an object of the map, ordered by car and block."""

    car: NDArray[np.intp]  #: (k,)
    block: NDArray[np.intp]  #: (k,)
    residual: Array  #: (k, 2)
    H: Array  #: (k, 2, N)
    place: Array  #: (k, d) of the objects [m]
    same: float  #: distance within which objects are the same one [m]
    rarity: Array | float = 0.0  #: (k,) -2 log of the prior probabilities


def _associated(
    source: str, found: _Pairs, cov: Array, R: Array, given: NDArray[np.bool_]
) -> Innovation:
    """Return the innovations of the nearest candidates: see ``associate``.

    Candidates that are the same object become one, of their mean; what they differ by is noise.

    Args:
        source: of the innovation.
        found: the pairs.
        cov: (n, N, N).
        R: (n, B, 2, 2).
        given: (n, B) whether there is a measurement.
    """
    car, block, residual, H = found[:4]
    full = _unmatched(source, given, R)
    n, B = given.shape
    of = car * B + block
    S = H @ cov[car] @ H.mT + R[car, block]
    squared = squared_distance(residual, S)
    cost = squared + np.log(np.linalg.det(S)) + found.rarity
    candidates = Candidates(of, squared, cost, found.place, found.same)
    nearest = associate(n * B, candidates, GATES[2])
    verdict = nearest.verdict.reshape(n, B)
    matched = given & (verdict != Verdict.UNMATCHED)
    full.verdict[matched] = verdict[matched]
    for array, values in ((full.residual, residual), (full.H, H)):
        flat = array.reshape(n * B, *values.shape[1:])
        np.add.at(flat, of, nearest.share.reshape(-1, *[1] * (values.ndim - 1)) * values)
    # What the candidates differ by, at the estimate and within its covariance, is noise.
    r = residual - full.residual.reshape(n * B, 2)[of]
    d = H - full.H.reshape(n * B, 2, N)[of]
    spread = r[:, :, None] * r[:, None] + d @ cov[car] @ d.mT
    noise = np.zeros((n * B, 2, 2))
    np.add.at(noise, of, nearest.share[:, None, None] * spread)
    R = R + noise.reshape(n, B, 2, 2)
    return full._replace(R=R, S=full.H @ cov[:, None] @ full.H.mT + R)


def _unmatched(source: str, given: NDArray[np.bool_], R: Array) -> Innovation:
    """Return the innovations of (n, B) blocks for which the map has nothing."""
    verdict = np.where(given, Verdict.UNMATCHED, Verdict.MISSING)
    shape = given.shape
    return Innovation(source, np.zeros((*shape, 2)), np.zeros((*shape, 2, N)), R, R.copy(), verdict)
