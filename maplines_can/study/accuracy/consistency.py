"""Whether the lateral errors of a drive are as large as the sender states.

If the stated covariances are right, the squares of the errors in standard deviations have the mean
1. Their mean over a drive is tested by chi-square (Bar-Shalom, Li and Kirubarajan, Estimation with
Applications to Tracking and Navigation, section 5.4: consistency of a filter). The errors of a pose
persist, so a drive has far fewer independent errors than lines. For a Gaussian error of mean 0 with
the autocorrelation rho, the mean of N squares has as much variance as that of

    n = N / sum (1 - |k|/N) rho(k)^2,  k = -N .. N

independent ones. All lines of a cycle have the same pose error, so they count as one.
"""

from __future__ import annotations

from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...simulation.truth import PLACES
from .evaluation import REQUIREMENTS, Accuracy

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
