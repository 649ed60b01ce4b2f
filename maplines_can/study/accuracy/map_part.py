"""Whether the error of the map is as large as the lines of a drive state.

The truth of a drive has the true pose and the reported one with its covariance P. So each lateral
error e of a line has a part that the pose explains, and a rest, which is that of the map and of the
cubic; and so has its variance s^2, with the Jacobian J of the lateral position by the pose:

    e_map = e - (y(pose that was reported) - y(true pose)),  s_map^2 = s^2 - J P J'

The mean square of e_map / s_map is tested by chi-square, as ``consistency`` does. Its degrees of
freedom are the independent errors of a line along the road, by the autocorrelation; several lines
of a cycle count as one, as the drift of a survey is common to them.
"""

from __future__ import annotations

from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...simulation.truth import PLACES
from .consistency import UNCLEAR, WRONG, independent_errors
from .evaluation import Accuracy

Array = NDArray[np.float64]

#: A stated map error is called too large if the errors are surely less than this part of it.
TOO_LARGE_RATIO = 0.4
#: The message rounds variances up. Where the pose has a sigma of so many times that of the map, the
#: rest of the variance is mostly of that.
MAX_POSE_RATIO = 3.0


class MapVerdict(Enum):
    """Whether the stated map error is right."""

    RIGHT = "The stated map error is right"
    UNCLEAR = "It is unclear whether the stated map error is right"
    TOO_SMALL = "The stated map error is too small"
    TOO_LARGE = "The stated map error is too large"
    HIDDEN = "This drive does not tell whether the stated map error is right"


class MapConsistency(NamedTuple):
    """The part of the lateral errors that the pose does not explain, and what is stated for it."""

    verdict: MapVerdict
    x: int  #: place [m]
    ratio: float  #: rms of the errors in stated standard deviations
    independent: float  #: number of independent errors
    error: float  #: rms of the errors [m]
    sigma: float  #: rms of the stated standard deviations [m]
    pose_sigma: float  #: the same of the part of the pose [m]

    def as_dict(self) -> dict[str, Any]:
        """Return all figures, for JSON."""
        return self._asdict() | {"verdict": self.verdict.name}

    def text(self) -> str:
        """Return the verdict as a sentence."""
        errors = (
            f"without the pose error, the lateral errors are {100 * self.error:.2g} cm, "
            f"{self.ratio:.2g} times the sigma of {100 * self.sigma:.2g} cm that is stated for the "
            f"map and its cubics (rms, {self.x} m ahead; {self.independent:.0f} independent)."
        )
        rest = {
            MapVerdict.UNCLEAR: "\nA longer drive tells.",
            MapVerdict.HIDDEN: "\nIt is hidden by the sigma of the pose, "
            f"{100 * self.pose_sigma:.2g} cm; a drive with a better pose tells.",
        }
        return f"{self.verdict.value}: {errors}{rest.get(self.verdict, '')}"


def map_consistency_of(accuracy: Accuracy) -> MapConsistency | None:
    """Return whether the stated map error is right.

    None if no line has an error that is compared, or the truth has no reported pose.
    """
    from scipy.special import chdtr, chdtrc

    part = accuracy.of_map
    found: list[tuple[float, float, MapConsistency]] = []
    for i, x in enumerate(PLACES):
        known = np.isfinite(part.error[:, i]) & np.isfinite(part.sigma[:, i])
        if not known.any():
            continue
        error, sigma, pose_sigma = (values[known, i] for values in part)
        ratios = error / sigma
        n = _independent(accuracy.slot[known], ratios)
        square = float(np.mean(ratios**2))
        rms = [float(np.sqrt(np.mean(values**2))) for values in (error, sigma, pose_sigma)]
        is_hidden = rms[2] > MAX_POSE_RATIO * rms[1]
        verdict = MapVerdict.HIDDEN if is_hidden else MapVerdict.RIGHT
        one = MapConsistency(verdict, x, float(np.sqrt(square)), n, *rms)
        larger = float(chdtrc(n, square * n))
        smaller = 1.0 if is_hidden else float(chdtr(n, square * n / TOO_LARGE_RATIO**2))
        found.append((larger, smaller, one))
    if not found:
        return None
    larger, _, one = min(found, key=lambda place: (place[0], -place[2].ratio))
    if larger * len(found) < UNCLEAR:
        is_wrong = larger * len(found) < WRONG
        return one._replace(verdict=MapVerdict.TOO_SMALL if is_wrong else MapVerdict.UNCLEAR)
    told = [place for place in found if place[2].verdict is not MapVerdict.HIDDEN]
    if not told:
        return one
    _, smaller, one = max(told, key=lambda place: place[1])
    if smaller < WRONG:  # at all places
        return one._replace(verdict=MapVerdict.TOO_LARGE)
    return max(told, key=lambda place: place[2].ratio)[2]


def _independent(slot: NDArray[np.int_], errors: Array) -> float:
    """Return the number of independent errors of a line, as a mean over the slots."""
    own = [errors[slot == one] for one in np.unique(slot)]
    counts = [independent_errors(values) for values in own]
    return float(np.average(counts, weights=[*map(len, own)]))
