"""Whether the errors of a drive are as large as its sender states, and those of its map.

If the stated covariances are right, the squares of the errors in standard deviations have the mean
1. Their mean over a drive is tested by chi-square (Bar-Shalom, Li and Kirubarajan, Estimation with
Applications to Tracking and Navigation, section 5.4: consistency of a filter). The errors of a pose
persist, so a drive has far fewer independent errors than lines. For a Gaussian error of mean 0 with
the autocorrelation rho, the mean of N squares has as much variance as that of

    n = N / sum (1 - |k|/N) rho(k)^2,  k = -N .. N

independent ones. All lines of a cycle have the same pose error, so they count as one.

The truth of a drive has the true pose and the reported one with its covariance P. So each lateral
error e of a line has a part that the pose explains, and a rest, which is that of the map and of the
cubic; and so has its variance s^2, with the Jacobian J of the lateral position by the pose:

    e_map = e - (y(pose that was reported) - y(true pose)),  s_map^2 = s^2 - J P J'

The mean square of e_map / s_map is tested by chi-square, too. Its degrees of freedom are the
independent errors of a line along the road, by the autocorrelation; several lines of a cycle count
as one, as the drift of a survey is common to them.
"""

from __future__ import annotations

from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .accuracy import REQUIREMENTS, Accuracy
from .truth import PLACES

Array = NDArray[np.float64]

#: Probabilities that a sender that is right has errors so large that it counts as wrong, or that it
#: is unclear.
WRONG, UNCLEAR = 0.001, 0.05
#: The sum over lags ends where the autocorrelation falls below this value; the rest is noise.
MIN_CORRELATION = 0.1


class SenderVerdict(Enum):
    """Whether the sender is right."""

    RIGHT = "The sender is right"
    UNCLEAR = "It is unclear whether the sender is right"
    WRONG = "The sender is wrong"


class SenderConsistency(NamedTuple):
    """Lateral errors compared with what the sender states; at the place where they are largest."""

    verdict: SenderVerdict
    x: int  #: place [m]
    ratio: float  #: rms of the errors in stated standard deviations
    independent: float  #: number of independent errors
    sigma: tuple[float, float]  #: rms of the stated standard deviations, least and most place [m]

    def as_dict(self) -> dict[str, Any]:
        """Return all figures, for JSON."""
        return self._asdict() | {"verdict": self.verdict.name}

    def text(self, accuracy: Accuracy) -> str:
        """Return the verdict as a sentence, and then what to do."""
        low, high = (100 * sigma for sigma in self.sigma)
        many = f"{self.independent:.0f} independent error" + "s" * (round(self.independent) != 1)
        errors = (
            f"the lateral errors are {self.ratio:.2g} times the stated sigma of {low:.2g} to "
            f"{high:.2g} cm (rms, {self.x} m ahead; {many} in this drive)."
        )
        if self.verdict is SenderVerdict.WRONG:
            return (
                f"{self.verdict.value}: {errors}\nIt states too small a covariance, or its map is "
                "not that of the truth."
            )
        if self.verdict is SenderVerdict.UNCLEAR:
            return f"{self.verdict.value}: {errors}\nA longer drive tells."
        lateral = [one for one in REQUIREMENTS if one.quantity == "lateral"]
        missed = any(met is False for one in lateral for met in accuracy.met(one).values())
        if not missed:
            return f"{self.verdict.value}: {errors}"
        return (
            f"{self.verdict.value}, but its sigma is large: {errors}\nFor smaller errors it needs "
            "a better pose, such as a smaller --sigma of 'maplines drive'."
        )


def consistency_of(accuracy: Accuracy) -> SenderConsistency | None:
    """Return whether the lateral errors are as large as stated; None without errors."""
    from scipy.special import chdtrc

    found: list[tuple[float, int, float, float]] = []
    stated: list[float] = []
    for i, x in enumerate(PLACES):
        known = np.isfinite(accuracy.sigmas[:, i])
        if not known.any():
            continue
        errors = accuracy.sigmas[known, i]
        n = independent_errors(_by_cycle(accuracy.time[known], errors))
        mean = float(np.mean(errors**2))
        found.append((float(chdtrc(n, mean * n)), x, float(np.sqrt(mean)), n))
        moved = known & (accuracy.sigmas[:, i] != 0)
        sigma = accuracy.errors["lateral"][moved, i] / accuracy.sigmas[moved, i]
        stated += [float(np.sqrt(np.mean(sigma**2)))] if len(sigma) else []
    if not found or not stated:
        return None
    p, x, ratio, n = min(found, key=lambda one: (one[0], -one[2]))
    p *= len(found)  # the least of as many
    verdict = (
        SenderVerdict.WRONG
        if p < WRONG
        else SenderVerdict.UNCLEAR
        if p < UNCLEAR
        else SenderVerdict.RIGHT
    )
    return SenderConsistency(verdict, x, ratio, n, (min(stated), max(stated)))


def independent_errors(errors: Array) -> float:
    """Return how many independent errors have a mean square as uncertain as that of (n,) errors.

    >>> round(independent_errors(np.ones(100)), 3), independent_errors(np.eye(100)[0])
    (1.0, 100.0)
    """
    n = len(errors)
    spectrum = np.abs(np.fft.rfft(errors, 2 * n)) ** 2
    overlap = 1 - np.arange(n) / n
    rho = np.fft.irfft(spectrum)[:n] / overlap
    if not rho[0] > 0:
        return 1.0
    rho /= rho[0]
    below = np.abs(rho) < MIN_CORRELATION
    end = int(below.argmax()) if below.any() else n
    return max(1.0, n / (1 + 2 * float(np.sum(overlap[1:end] * rho[1:end] ** 2))))


def _by_cycle(time: Array, errors: Array) -> Array:
    """Return the mean error of each cycle, in the order of time."""
    _, cycle = np.unique(time, return_inverse=True)
    return np.asarray(np.bincount(cycle, errors) / np.bincount(cycle))


# ---- the error of the map -----------------------------------------------------------------------

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
