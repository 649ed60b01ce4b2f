"""Confirmation of what a camera sees, by what it sees beside it or saw before.

Where the pose is uncertain, the gate is wide, so that something false passes it, and pulls the pose
far away. So what is seen then is used only if it agrees

- with something else in the same image: both together must pass the gate of their joint innovation
  (joint compatibility, Neira and Tardos 2001), to which an error of the pose is common; or
- with what was seen in the images before: a false line or landmark is elsewhere in the next one. A
  road with a single marking has nothing else to be seen beside it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.linalg import squared_distance
from .association import GATES, Verdict
from .observation_models import Innovation

Array = NDArray[np.float64]

#: Ratio of the covariance of an innovation to that of the measurement beyond which it must be
#: confirmed.
WIDE = 5.0
#: Images in a row in which it must have been at the same place, if nothing beside it agrees.
IN_A_ROW = 5
#: Longest time between two of them [s].
PAUSE = 0.5


class Sightings(NamedTuple):
    """What the last image had, of n cars, that nothing beside it confirmed."""

    t: float  #: [s]
    residual: Array  #: (n, B, m)
    R: Array  #: (n, B, m, m) covariance of the measurements
    S: Array  #: (n, B, m, m) covariance of the residuals
    images: NDArray[np.intp]  #: (n, B) in a row; 0 for none


def confirmed(
    found: Innovation, cov: Array, before: Sightings | None, t: float
) -> tuple[Innovation, Sightings]:
    """Return an innovation without the blocks that are not confirmed, and what remains of it.

    Args:
        found: of m values; blocks that are not USED stay as they are.
        cov: (n, N, N) covariances of the states.
        before: of the image before; None without one.
        t: time of the image [s].
    """
    used = found.verdict == Verdict.USED
    root = np.linalg.inv(np.linalg.cholesky(found.R))
    spread = np.linalg.eigvalsh(root @ found.S @ root.mT)[..., -1]
    alone = used & (spread > WIDE)
    if alone.any():
        alone &= ~_beside(found, cov, used)
    count = np.where(alone, 1, 0)
    if before is not None and alone.any() and t - before.t <= PAUSE:
        count += np.where(alone, _in_a_row(found, before), 0)
    verdict = np.where(alone & (count < IN_A_ROW), Verdict.UNCONFIRMED, found.verdict)
    found = found._replace(verdict=verdict)
    return found, Sightings(t, found.residual, found.R, found.S, count)


def _beside(found: Innovation, cov: Array, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (n, B) which blocks agree with another one of the same image."""
    n, B, m = found.residual.shape
    agrees = np.zeros((n, B), dtype=bool)
    H = found.H @ cov[:, None]
    for i in range(B):
        for j in range(i):
            S = np.empty((n, 2 * m, 2 * m))
            S[:, :m, :m], S[:, m:, m:] = found.S[:, i], found.S[:, j]
            S[:, :m, m:] = H[:, i] @ found.H[:, j].mT
            S[:, m:, :m] = S[:, :m, m:].mT
            both = np.concatenate([found.residual[:, i], found.residual[:, j]], axis=-1)
            agree = used[:, i] & used[:, j] & (squared_distance(both, S) <= GATES[2 * m])
            agrees[:, i] |= agree
            agrees[:, j] |= agree
    return agrees


def _in_a_row(found: Innovation, before: Sightings) -> NDArray[np.intp]:
    """Return (n, B) in how many images before each block was at the same place.

    The error of the pose is common to both images, but for what the filter has learnt or forgotten
    of it since: by as much as the covariances of the residuals differ.
    """
    m = found.residual.shape[-1]
    change = np.abs(
        np.diagonal(found.S[:, :, None], axis1=-2, axis2=-1)
        - np.diagonal(before.S[:, None], axis1=-2, axis2=-1)
    )  # (n, B, B before, m)
    cov = found.R[:, :, None] + before.R[:, None] + change[..., None] * np.eye(m)
    moved = found.residual[:, :, None] - before.residual[:, None]
    same = squared_distance(moved, cov) <= GATES[m]
    return np.asarray(np.where(same, before.images[:, None], 0).max(axis=2, initial=0))
