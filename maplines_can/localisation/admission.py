"""Admission of observations: what cannot be a measurement is refused with a reason.

What a sensor sends never raises, and never stays in the filter where it would stop what comes
after it. A value that is NaN is missing; one that is infinite is wrong.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.arrays import floats
from ..values.linalg import ROUNDING, asymmetric, indefinite
from .association import Verdict
from .measurements import CameraLines, GnssFix, Observation, PoseFix, SeenLandmarks

Array = NDArray[np.float64]

#: Greatest size of a coordinate [m] and of a time [s]; beyond it, a double has no micrometre.
LARGEST = 1e10
#: Least variance of a line or a landmark [m^2, rad^2].
MIN_VARIANCE = 1e-10


class Admitted(NamedTuple):
    """An observation as the filter takes it, and the cars of which it is refused."""

    observation: Observation | None  #: None if there is none that the filter can take
    refused: dict[Verdict, int]  #: cars by reason


def finite_time(t: Any) -> float | None:
    """Return a time as a number [s]; None if it is not finite.

    >>> finite_time(1.5), finite_time(float("nan")), finite_time("now")
    (1.5, None, None)
    """
    try:
        found = float(t)
    except (TypeError, ValueError, OverflowError):
        return None
    return found if abs(found) <= LARGEST else None


def admitted(observation: Observation, cars: int) -> Admitted:
    """Return an observation with full shapes, and NaN for each car of which it is refused.

    A GNSS position or a pose may be exact in some direction, see ``Verdict.SINGULAR``; lines and
    landmarks must have a covariance that is positive definite, as their association needs it.

    Args:
        observation: of any content.
        cars: number n of cars.

    Raises:
        TypeError: it is no observation.
    """
    if not isinstance(observation, GnssFix | CameraLines | SeenLandmarks | PoseFix):
        raise TypeError(
            "a measurement must be Odometry, GnssFix, CameraLines, SeenLandmarks or PoseFix, got "
            f"{type(observation).__name__}"
        )
    t = finite_time(observation.t)
    try:
        values, covs, kind = _arrays(observation, cars)
        error = _stated_error(observation, cars)
    except (TypeError, ValueError, OverflowError):
        t = None
    if t is None:
        return Admitted(None, {Verdict.INVALID: cars})
    is_exact = isinstance(observation, GnssFix | PoseFix)
    given = ~np.isnan(values).any(axis=-1)  # (n, B)
    wrong = given & ~np.asarray((np.abs(values) <= LARGEST).all(axis=-1))
    bad = np.zeros(given.shape, dtype=bool)
    for i, cov in enumerate(covs):
        bad |= given & ~wrong & ~is_covariance(cov, 0.0 if is_exact else MIN_VARIANCE)
        covs[i] = np.where((given & ~wrong & ~bad)[..., None, None], cov, np.eye(cov.shape[-1]))
    if error is not None:
        sigma, time = error.T
        is_error = (sigma >= 0) & (sigma <= LARGEST) & (time > 0)
        bad |= given & ~wrong & ~(is_error | np.isnan(sigma))[:, None]
        error = np.where(is_error[:, None], error, np.nan)
    values = np.where((wrong | bad)[..., None], np.nan, values)
    refused = {
        verdict: int(some.any(axis=1).sum())
        for verdict, some in ((Verdict.INVALID, wrong), (Verdict.COVARIANCE, bad))
        if some.any()
    }
    if refused and np.isnan(values).any(axis=-1).all():
        return Admitted(None, refused)
    if isinstance(observation, GnssFix):
        return Admitted(GnssFix(t, values[:, 0], covs[0][:, 0], error), refused)
    if isinstance(observation, PoseFix):
        shared = covs[1][:, 0] if len(covs) > 1 else None
        return Admitted(PoseFix(t, values[:, 0], covs[0][:, 0], shared), refused)
    if isinstance(observation, SeenLandmarks):
        return Admitted(SeenLandmarks(t, values, covs[0]), refused)
    return Admitted(CameraLines(t, values[..., 0], values[..., 1], kind, covs[0]), refused)


def _arrays(observation: Observation, n: int) -> tuple[Array, list[Array], NDArray[np.intp]]:
    """Return (n, B, m) values, (n, B, m, m) covariances, and (n, B) kinds of lines.

    Raises:
        ValueError: a shape is wrong, or something is no number.
    """
    kind = np.zeros((n, 0), dtype=np.intp)
    if isinstance(observation, CameraLines):
        lines = floats(observation.offset, "offset"), floats(observation.heading, "heading")
        values = np.stack(np.broadcast_arrays(*lines), axis=-1)
        kind = np.asarray(observation.kind)
        if kind.dtype.kind not in "iu" or values.ndim != 3:
            raise ValueError("lines must have shape (n, L), and whole numbers as kinds")
        values = np.broadcast_to(values, (n, *values.shape[1:]))
        kind = np.broadcast_to(kind, values.shape[:2]).astype(np.intp)
    elif isinstance(observation, SeenLandmarks):
        values = floats(observation.position, "position")
        if values.ndim != 3:
            raise ValueError("landmarks must have shape (n, K, 2)")
        values = np.broadcast_to(values, (n, values.shape[1], 2))
    elif isinstance(observation, GnssFix):
        values = np.broadcast_to(floats(observation.position, "position"), (n, 2))[:, None]
    else:
        values = np.broadcast_to(floats(observation.pose, "pose"), (n, 3))[:, None]
    given = [observation.cov]
    if isinstance(observation, PoseFix) and observation.shared is not None:
        given.append(observation.shared)
    *shape, m = values.shape
    covs = []
    for one in given:
        cov = floats(one, "cov")
        if cov.ndim == 3 and isinstance(observation, GnssFix | PoseFix):
            cov = cov[:, None]  # (n, m, m) of one block
        covs.append(np.array(np.broadcast_to(cov, (*shape, m, m))))
    return values, covs, kind


def _stated_error(observation: Observation, n: int) -> Array | None:
    """Return the (n, 2) correlated error that a GNSS position states; None without one.

    Raises:
        ValueError: the shape is wrong, or something is no number.
    """
    if not isinstance(observation, GnssFix) or observation.error is None:
        return None
    return np.broadcast_to(floats(observation.error, "error"), (n, 2))


def is_covariance(cov: Array, least: float = 0.0) -> NDArray[np.bool_]:
    """Return (...,) which of (..., m, m) matrices are covariances.

    Args:
        cov: the matrices.
        least: least variance; more than 0 also requires that they are positive definite.
    """
    finite = np.asarray((np.abs(cov) <= LARGEST**2).all(axis=(-2, -1)))
    safe = np.where(finite[..., None, None], cov, np.eye(cov.shape[-1]))
    variance = np.diagonal(safe, axis1=-2, axis2=-1)
    row_of_zero = ((variance == 0)[..., None] & (safe != 0)).any(axis=(-2, -1))
    fine = finite & (variance >= least).all(axis=-1) & ~row_of_zero & ~asymmetric(safe)
    safe = np.where(
        fine[..., None, None], (safe + safe.swapaxes(-1, -2)) / 2, np.eye(cov.shape[-1])
    )
    return np.asarray(fine & ~indefinite(safe, -ROUNDING if least > 0 else ROUNDING))
