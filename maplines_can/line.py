"""The cubic line, its Gaussian with all that is known of it, and its move to another pose."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import floats, number_text
from .errors import IllPosedError
from .gaussian import Gaussian, variances
from .mixture import GaussianMixture

__all__ = [
    "STATES",
    "VAGUE_SIGMA",
    "Kind",
    "MapLine",
    "Slot",
    "Status",
    "lateral",
    "lateral_jacobian",
    "line_of_cubic",
    "transform_line",
    "transform_line_or_nan",
]

#: The line's parameters, in the order of every mean and covariance.
STATES = ("y_off", "beta", "c0", "c1")

#: Standard deviations that stand for "unknown": [m, rad, 1/m, 1/m^2].
#: So wide that a fusion gives the line no weight, and never a claim of exactness.
VAGUE_SIGMA = (1000.0, 10.0, 10.0, 10.0)

#: A line must advance along the car's x axis by this share of its way (it lies within 80 deg).
LEAST_ADVANCE = 0.17

#: No age is longer [s]; in nanoseconds it is still a float.
LONGEST_AGE = 1e99
#: More points of a line need more memory than they are worth.
MOST_POINTS = 10_000


class Slot(IntEnum):
    """Which line of the scene a message carries; each slot has its CAN IDs."""

    EGO_LEFT = 0
    EGO_RIGHT = 1
    NEXT_LEFT = 2
    NEXT_RIGHT = 3
    CENTRE = 4
    EDGE_LEFT = 5
    EDGE_RIGHT = 6
    ROUTE = 7


class Kind(IntEnum):
    """What the line is on the road."""

    UNKNOWN = 0
    SOLID = 1
    DASHED = 2
    DOUBLE = 3
    ROAD_EDGE = 4
    KERB = 5
    BARRIER = 6
    VIRTUAL = 7


class Status(IntEnum):
    """What the covariance of a line is worth."""

    UNKNOWN = 0  #: only the mean was sent; the covariance is VAGUE_SIGMA
    FULL = 1  #: covers the sender's covariance, correlations included
    DIAGONAL = 2  #: covers the sender's variances; correlations were not sent
    REPAIRED = 3  #: as FULL, but the sender's matrix was indefinite and had to be covered
    SATURATED = 4  #: as FULL, but wider than need be: a value met the end of its range
    OUT_OF_RANGE = 5  #: the line does not fit the message: use neither mean nor covariance


@dataclass(frozen=True, eq=False)
class MapLine:
    """One line of the map as the car sees it: a Gaussian over a cubic, in the ego frame.

    The line is ``l(x) = y_off + tan(beta) x + c0/2 x^2 + c1/6 x^3`` (Map Line
    Interface, eq. 1), x forward and y to the left (ISO 8855), for x in
    [x_min, x_max].

    Args:
        slot: which line of the scene.
        gaussian: over (y_off, beta, c0, c1) in [m, rad, 1/m, 1/m^2].
        kind: what it is on the road.
        x_min: where the cubic begins to hold [m].
        x_max: where it ends to hold [m].
        age: time from the pose to the sending [s].
        status: what the covariance is worth.
        mixture: what is known of the line beyond one Gaussian; ``gaussian`` then has its
            mean and covariance. See ``MapLine.of_mixture``.
        t_ns: when the first frame of the line was received [ns]; None at the sender.

    Raises:
        ValueError: a value is out of range.
    """

    slot: Slot
    gaussian: Gaussian
    kind: Kind = Kind.UNKNOWN
    x_min: float = 0.0
    x_max: float = 80.0
    age: float = 0.0
    status: Status = Status.FULL
    t_ns: int | None = None
    mixture: GaussianMixture | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "slot", Slot(self.slot))
        object.__setattr__(self, "kind", Kind(self.kind))
        object.__setattr__(self, "status", Status(self.status))
        if self.gaussian.dimension != len(STATES):
            raise ValueError(f"gaussian must be over {STATES}, got {self.gaussian.dimension}-D")
        numbers = floats([self.x_min, self.x_max, self.age], "x_min, x_max and age")
        if not (np.isfinite(numbers[:2]).all() and self.x_min <= self.x_max):
            raise ValueError(
                f"x_min <= x_max must be finite [m], got x_min={self.x_min!r}, x_max={self.x_max!r}"
            )
        if not 0 <= numbers[2] <= LONGEST_AGE:
            raise ValueError(
                f"age must be 0 s or more and finite (up to {LONGEST_AGE:g}), got {self.age!r}"
            )
        if self.t_ns is not None and self.t_ns != self.t_ns // 1:
            raise ValueError(f"t_ns must be whole [ns], or None at a sender, got {self.t_ns!r}")

    @classmethod
    def mean_only(cls, slot: Slot, mean: ArrayLike, **rest: Any) -> MapLine:
        """A line of which only the mean is known.

        >>> MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0, 0, 0]).status.name
        'UNKNOWN'
        """
        vague = Gaussian(floats(mean, "mean"), np.diag(np.square(VAGUE_SIGMA)))
        return cls(slot, vague, status=Status.UNKNOWN, **rest)

    @classmethod
    def with_sigma(cls, slot: Slot, mean: ArrayLike, sigma: ArrayLike, **rest: Any) -> MapLine:
        """A line of which the mean and the standard deviations are known."""
        gaussian = Gaussian(floats(mean, "mean"), np.diag(variances(sigma)))
        return cls(slot, gaussian, status=Status.DIAGONAL, **rest)

    @classmethod
    def of_mixture(cls, slot: Slot, mixture: GaussianMixture, **rest: Any) -> MapLine:
        """A line that is known as a Gaussian mixture; all its parts travel together."""
        return cls(slot, mixture.overall, mixture=mixture, **rest)

    def y(self, x: ArrayLike) -> NDArray[np.float64]:
        """(...,) lateral position of the mean line at x [m]."""
        return lateral(self.gaussian.mean, x)

    def y_sigma(self, x: ArrayLike) -> NDArray[np.float64]:
        """(...,) standard deviation of the lateral position at x [m], to first order."""
        J = lateral_jacobian(self.gaussian.mean, x)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.sqrt(np.einsum("...i,ij,...j->...", J, self.gaussian.cov, J).clip(0))


@np.errstate(over="ignore", invalid="ignore")
def lateral(parameters: ArrayLike, x: ArrayLike) -> NDArray[np.float64]:
    """Lateral position l(x) of lines (Map Line Interface, eq. 1).

    Infinite or NaN, without a warning, where x is, or where the value is beyond the floats.

    Args:
        parameters: (..., 4) lines [m, rad, 1/m, 1/m^2].
        x: broadcasts against the leading axes of ``parameters`` [m].

    >>> lateral([1.0, 0.0, 0.01, 0.0], [0, 10, 20])
    array([1. , 1.5, 3. ])
    """
    y_off, beta, c0, c1 = _states(parameters)
    x = floats(x, "x")
    return y_off + x * (np.tan(beta) + x * (c0 / 2 + x * c1 / 6))


@np.errstate(over="ignore", invalid="ignore")
def lateral_jacobian(parameters: ArrayLike, x: ArrayLike) -> NDArray[np.float64]:
    """(..., 4) derivative of l(x) with respect to (y_off, beta, c0, c1)."""
    _, beta, _, _ = _states(parameters)
    x, beta = np.broadcast_arrays(floats(x, "x"), beta)
    return np.stack([np.ones_like(x), (1 + np.tan(beta) ** 2) * x, x**2 / 2, x**3 / 6], axis=-1)


def _states(parameters: ArrayLike) -> NDArray[np.float64]:
    """(4, ...) of (..., 4) lines."""
    lines = floats(parameters, "parameters")
    if lines.shape[-1:] != (len(STATES),):
        raise ValueError(f"parameters must have shape (..., 4), got {lines.shape}")
    return np.moveaxis(lines, -1, 0)


def line_of_cubic(
    q: NDArray[np.float64], centre: ArrayLike, half: ArrayLike
) -> NDArray[np.float64]:
    """The line of a cubic that is written in the normalised ``w = (u - centre) / half``.

    Args:
        q: (4, ...) coefficients of w^0 .. w^3 [m].
        centre: (...) [m].
        half: (...) [m], positive.

    Returns:
        (..., 4) lines: the Taylor coefficients at u = 0, beta from its tangent.
    """
    q0, q1, q2, q3 = q
    r = 1 / np.asarray(half, dtype=float)
    w = -np.asarray(centre, dtype=float) * r
    lines = np.empty((4, *np.broadcast_shapes(np.shape(q0), np.shape(w))))
    q3_w = q3 * w
    lines[0] = q0 + w * (q1 + w * (q2 + q3_w))
    lines[1] = np.arctan((q1 + w * (2 * q2 + 3 * q3_w)) * r)
    lines[2] = (2 * q2 + 6 * q3_w) * (r * r)
    lines[3] = 6 * q3 * (r * r * r)
    return np.moveaxis(lines, 0, -1)


def transform_line(
    parameters: ArrayLike, motion: ArrayLike, window: tuple[float, float], points: int = 32
) -> NDArray[np.float64]:
    """Lines as seen from another pose (Map Line Interface, section III-A-1).

    Points of the line itself are carried into the new frame and fitted again.
    Through 4 points (the Chebyshev ones) the fit is exact at them. More points are spread
    evenly, as those of a map are, and fitted with the least squares: after 5 m and 10 deg the line
    is then where a refit of the map points from there would have it, within 1 mm over the same
    window for 100 m of a road of radius 200 m or more; not in a street turn, where the road is no
    cubic either.

    Args:
        parameters: (..., 4) lines in the old ego frame.
        motion: (..., 3) the new pose in the old ego frame (x [m], y [m], heading [rad]).
        window: where the line holds (x_min, x_max) in the old ego frame [m].
        points: how many points of the line, 4 to 10 000.

    Raises:
        ValueError: fewer than 4 points or more than 10 000, an empty window, or a wrong shape.
        IllPosedError: seen from the new pose, a line doubles back or stands
            across the car (80 deg and more), or a number is NaN.

    >>> transform_line([2.0, 0.0, 0.0, 0.0], [10.0, 0.5, 0.0], window=(0, 80)).round(9) + 0.0
    array([1.5, 0. , 0. , 0. ])
    """
    lines = transform_line_or_nan(parameters, motion, window, points)
    lost = np.isnan(lines).any(axis=-1)
    if lost.any():
        worst = np.broadcast_to(np.asarray(motion, dtype=float), (*lost.shape, 3))[lost][0]
        raise IllPosedError(
            f"a line doubles back or stands across the car after the motion {worst} (m, m, rad), "
            "so no cubic y(x) follows it; shorten the window or check the heading"
        )
    return lines


@np.errstate(over="ignore", invalid="ignore")
def transform_line_or_nan(
    parameters: ArrayLike, motion: ArrayLike, window: tuple[float, float], points: int = 32
) -> NDArray[np.float64]:
    """As ``moved``, with a row of NaN for a line that no cubic follows: for moment transforms."""
    x_min, x_max = (floats(end, "window").item() for end in window)
    if points < 4 or not -np.inf < x_min < x_max < np.inf:
        raise ValueError(
            f"needs 4 points or more in a window, got {number_text(points)} points "
            f"in ({x_min:g}, {x_max:g}) m"
        )
    if points > MOST_POINTS:
        raise ValueError(f"needs {MOST_POINTS} points or fewer, got {number_text(points)}")
    nodes = np.cos(np.pi * (np.arange(4) + 0.5) / 4)
    if points > 4:
        nodes = np.linspace(1, -1, points)
    x = (x_min + x_max) / 2 + (x_max - x_min) / 2 * nodes
    lines, motion = np.moveaxis(_states(parameters), 0, -1), floats(motion, "motion")
    if motion.shape[-1:] != (3,):
        raise ValueError(f"motion must have shape (..., 3), got {motion.shape}")
    dx, dy, heading = (motion[..., i, None] for i in range(3))
    s, t = x - dx, lateral(lines[..., None, :], x) - dy  # (..., points)
    c, d = np.cos(heading), np.sin(heading)
    u, v = c * s + d * t, c * t - d * s
    advance = np.diff(u, axis=-1) * np.sign(u[..., -1:] - u[..., :1])
    follows = advance > LEAST_ADVANCE * np.hypot(advance, np.diff(v, axis=-1))
    lost = ~(follows.all(axis=-1) & (np.abs(lines[..., 1]) < np.pi / 2))  # tan knows no backwards
    u = np.where(lost[..., None], nodes, u)  # any places that can be fitted at; the fit is not used
    centre = (u.max(axis=-1) + u.min(axis=-1)) / 2
    half = (u.max(axis=-1) - u.min(axis=-1)) / 2
    w = (u - centre[..., None]) / half[..., None]
    Q, R = np.linalg.qr(w[..., None] ** np.arange(4))
    q = np.linalg.solve(R, np.swapaxes(Q, -1, -2) @ v[..., None])[..., 0]
    fitted = line_of_cubic(np.moveaxis(q, -1, 0), centre, half)
    fitted[lost] = np.nan
    return fitted
