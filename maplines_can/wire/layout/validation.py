"""Validation of the Gaussians, mixtures and records that a caller passes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import lib
from ...core.memory import pointer
from ...values.arrays import floats
from ...values.linalg import MAX_COV, asymmetric, rounding_of
from .record_signals import PARAMETER_SIGNALS

#: Greatest difference of the sum of weights from 1.
WEIGHT_TOLERANCE = 1e-5


class CheckedGaussians(NamedTuple):
    """Gaussians that may be sent."""

    mean: NDArray[np.float64]  #: (N, 4)
    cov: NDArray[np.float64]  #: (N, 4, 4) exactly symmetric
    indefinite: NDArray[np.bool_]  #: (N,) covariances that are indefinite beyond rounding


def checked_gaussians(means: ArrayLike, covs: ArrayLike | None) -> CheckedGaussians:
    """Return Gaussians as arrays, of covariance 0 without ``covs``; see ``BatchCodec.encode``."""
    rounding = rounding_of(covs)
    mean = floats(means, "means")
    if mean.ndim != 2 or mean.shape[1] != len(PARAMETER_SIGNALS):
        raise ValueError(f"means must have shape (N, 4), got {mean.shape}")
    n = len(mean)
    cov = np.zeros((n, 4, 4)) if covs is None else floats(covs, "covs")
    if cov.shape != (n, 4, 4):
        raise ValueError(f"covs must have shape ({n}, 4, 4), as the means, got {cov.shape}")
    symmetric, strange = np.empty((n, 4, 4)), np.empty(n, dtype=bool)
    given = np.ascontiguousarray(mean), np.ascontiguousarray(cov), symmetric, strange
    if lib.maplines_check_gaussians(n, rounding, *map(pointer, given)):
        return CheckedGaussians(mean, symmetric, strange)
    _refuse("means must be finite", np.asarray(~np.isfinite(mean).all(axis=1)), mean)
    too_large = np.asarray(~(np.abs(cov) <= MAX_COV).all(axis=(1, 2)))  # or NaN
    _refuse("covs must be finite", too_large, cov)
    negative = (np.einsum("nii->ni", cov) < 0).any(axis=1)
    _refuse("covs must have variances of 0 or more", negative, cov)
    _refuse("covs must be symmetric", asymmetric(cov, rounding), cov)
    raise ValueError("the core refuses the Gaussians: one of them has a value that is none")


def checked_mixtures(
    weights: ArrayLike, means: ArrayLike, covs: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return weights, means and covs of mixtures as arrays; see ``BatchCodec.encode_mixtures``."""
    weights, means = floats(weights, "weights"), floats(means, "means")
    covs = floats(covs, "covs")
    if weights.ndim != 2:
        raise ValueError(f"weights must have shape (N, k), got {weights.shape}")
    n, k = weights.shape
    if means.shape != (n, k, 4) or covs.shape != (n, k, 4, 4):
        raise ValueError(
            f"means and covs must have shapes {(n, k, 4)} and {(n, k, 4, 4)}, as the weights, "
            f"got {means.shape} and {covs.shape}"
        )
    valid = ((weights > 0) & (weights < 2)).all()
    if not valid or (np.abs(weights.sum(axis=1) - 1) > WEIGHT_TOLERANCE).any():
        raise ValueError("weights must be positive and each row of sum 1")
    return weights, means, covs


def checked_payloads(payloads: ArrayLike, record_bytes: int) -> NDArray[np.uint8]:
    """Return records as an array; see ``BatchCodec.decode``."""
    payloads = np.asarray(payloads)
    if payloads.ndim != 2 or payloads.shape[1] != record_bytes:
        raise ValueError(f"payloads must have shape (N, {record_bytes}), got {payloads.shape}")
    if payloads.dtype != np.uint8:
        raise ValueError(f"payloads must be uint8, got {payloads.dtype}")
    return payloads


def _refuse(message: str, bad: NDArray[np.bool_], rows: NDArray[np.float64]) -> None:
    if bad.any():
        i = int(bad.argmax())
        raise ValueError(f"{message}, but row {i} is {rows[i].tolist()}")
