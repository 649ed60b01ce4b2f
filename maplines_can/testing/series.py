"""Estimates and the truth as arrays, for assertions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats
from ..values.gaussian import Gaussian
from ..values.line import PARAMETERS, MapLine, lateral_jacobian

Array = NDArray[np.float64]
#: Estimates: Gaussians, lines, or their (n, d) means and (n, d, d) covariances.
Estimates = Sequence[Gaussian] | Sequence[MapLine] | tuple[ArrayLike, ArrayLike]


class Errors(NamedTuple):
    """Errors of n estimates of d variables, with what is stated of them."""

    error: Array  #: (n, d) estimate less truth
    sigma: Array  #: (n, d) stated
    white: Array  #: (n, d) errors whitened with the stated covariances
    names: tuple[str, ...]  #: of the variables
    times: Array  #: (n,) [s], or the numbers of the samples
    unit: str  #: of the times: "s" or "samples"

    @property
    def period(self) -> float:
        """Time between two samples."""
        return float(np.median(np.diff(self.times)))

    @property
    def ratio(self) -> Array:
        """(n, d) errors in stated standard deviations."""
        return self.error / self.sigma

    @property
    def nees(self) -> Array:
        """(n,) normalised estimation error squared."""
        return np.asarray((self.white**2).sum(axis=1))

    def at(self, i: int | np.intp) -> str:
        """Return the time of a sample as text."""
        return f"at {self.times[i]:.6g} s" if self.unit == "s" else f"in sample {i}"

    def time(self, samples: float) -> str:
        """Return the time of a number of samples as text."""
        return f"{samples * self.period:.3g} {self.unit}"


def errors_of(
    estimates: Estimates, truth: ArrayLike, x: ArrayLike | None, t: ArrayLike | None
) -> Errors:
    """Return the errors of estimates; the arguments and errors are those of assert_consistent."""
    mean, cov, names = _moments(estimates, x)
    true = floats(truth, "truth")
    true = true[:, None] if true.ndim == 1 and mean.shape[1] == 1 else true
    if true.shape != mean.shape:
        raise ValueError(
            f"truth must have the shape of the estimates {mean.shape}, got {true.shape}"
        )
    for name, values in (("estimates", mean), ("covariances", cov), ("truth", true)):
        finite = np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        if not finite.all():
            i = int(np.argmin(finite))
            raise ValueError(f"{name} must be finite, got {values[i]} in sample {i}")
    error = mean - true
    scale = np.sqrt(cov.diagonal(axis1=1, axis2=2).clip(0))
    safe = np.where(scale > 0, scale, 1.0)
    least = np.linalg.eigvalsh(cov / safe[:, :, None] / safe[:, None, :])[:, 0]
    if (least <= 1e-12).any():
        i = int(np.argmin(least))
        raise ValueError(
            f"the covariance must be positive definite, got\n{cov[i]}\nin sample {i}; "
            "compare variables that do not determine each other, such as y at fewer x"
        )
    root = np.linalg.cholesky(cov)
    white = np.linalg.solve(root, error[..., None])[..., 0]
    times, unit = times_of(t, len(mean))
    return Errors(error, scale, white, names, times, unit)


def times_of(t: ArrayLike | None, n: int) -> tuple[Array, str]:
    """Return (n,) times and their unit: seconds if they are given, else samples.

    Raises:
        ValueError: they do not increase, or are not n.
    """
    if t is None:
        return np.arange(float(n)), "samples"
    times = floats(t, "t")
    if times.shape != (n,) or not (np.diff(times) > 0).all() or not np.isfinite(times).all():
        raise ValueError(f"t must be {n} increasing times [s], got {times!r}")
    return times, "s"


def _moments(estimates: Estimates, x: ArrayLike | None) -> tuple[Array, Array, tuple[str, ...]]:
    """Return (n, d) means and (n, d, d) covariances, and names of the variables."""
    lines = [one for one in estimates if isinstance(one, MapLine)]
    gaussians = [one for one in estimates if isinstance(one, Gaussian)]
    if lines and len(lines) == len(estimates):
        return _of_lines(lines, x)
    if x is not None:
        raise ValueError(f"x is for lines, but the estimates are none, got x={x!r}")
    if gaussians and len(gaussians) == len(estimates):
        if len({one.dimension for one in gaussians}) > 1:
            raise ValueError("estimates must be over the same variables")
        mean = np.stack([one.mean for one in gaussians])
        return mean, np.stack([one.cov for one in gaussians]), _numbered(mean.shape[1])
    if lines or gaussians or len(estimates) != 2:
        raise TypeError(
            "estimates must be Gaussians, lines, or (means, covariances), "
            f"got {type(estimates[0]).__name__ if len(estimates) else 'none'}"
        )
    mean, cov = (floats(values, "estimates") for values in cast(Any, estimates))
    if mean.ndim == cov.ndim == 1:
        mean, cov = mean[:, None], cov[:, None, None]
    if mean.ndim != 2 or cov.shape != (*mean.shape, mean.shape[1]):
        raise ValueError(
            "estimates must be means (n, d) and covariances (n, d, d), or (n,) means and (n,) "
            f"variances, got {mean.shape} and {cov.shape}"
        )
    return mean, cov, _numbered(mean.shape[1])


def _numbered(d: int) -> tuple[str, ...]:
    return ("the estimate",) if d == 1 else tuple(f"variable {i}" for i in range(d))


def _of_lines(
    lines: Sequence[MapLine], x: ArrayLike | None
) -> tuple[Array, Array, tuple[str, ...]]:
    """Return the moments of the parameters of lines, or of y at x."""
    mean = np.stack([line.gaussian.mean for line in lines])
    cov = np.stack([line.gaussian.cov for line in lines])
    if x is None:
        return mean, cov, PARAMETERS
    places = np.atleast_1d(floats(x, "x"))
    if places.ndim != 1 or not 1 <= len(set(places.tolist())) == len(places) <= len(PARAMETERS):
        raise ValueError(f"x must be 1 to 4 different positions [m], got {x!r}")
    for line in lines:
        if not (line.x_min <= places.min() and places.max() <= line.x_max):
            raise ValueError(
                f"x must be in the valid range of all lines, got {places.tolist()} m for a line "
                f"that is valid from {line.x_min:g} to {line.x_max:g} m"
            )
    J = lateral_jacobian(mean[:, None, :], places)
    y = np.stack([line.y(places) for line in lines])
    return y, J @ cov @ J.swapaxes(1, 2), tuple(f"y at {place:g} m" for place in places)
