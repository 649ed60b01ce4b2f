"""The cubic line, the message content ``MapLine``, and the transformation to another pose."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import ffi, lib
from ..core.memory import pointer
from .arrays import floats, is_plain
from .errors import IllPosedError
from .gaussian import Gaussian, variances
from .mixture import GaussianMixture

#: The line's parameters, in the order of every mean and covariance.
PARAMETERS: tuple[str, ...] = ("y_off", "beta", "c0", "c1")

#: Standard deviations of an unknown covariance [m, rad, 1/m, 1/m^2].
#: They are so large that a fusion gives the line practically no weight.
VAGUE_SIGMA = (1000.0, 10.0, 10.0, 10.0)

#: Least valid range of a line that is made, or sent in part [m].
MIN_RANGE = 1.0
#: Largest finite age [s]; still finite as a float in nanoseconds.
MAX_AGE = 1e99
#: Distance from the valid range at which x still counts as in it, for its rounding [m].
#: It is that of the core, in c/src/use.c.
RANGE_TOLERANCE = 2.0**-10


class Slot(IntEnum):
    """Identity of a line around the car. Each slot has its own CAN IDs."""

    EGO_LEFT = 0
    EGO_RIGHT = 1
    NEXT_LEFT = 2
    NEXT_RIGHT = 3
    CENTRE = 4
    EDGE_LEFT = 5
    EDGE_RIGHT = 6
    ROUTE = 7


class Kind(IntEnum):
    """Kind of marking or boundary that a line represents."""

    UNKNOWN = 0
    SOLID = 1
    DASHED = 2
    DOUBLE = 3
    ROAD_EDGE = 4
    KERB = 5
    BARRIER = 6
    VIRTUAL = 7


class Status(IntEnum):
    """Quality of the covariance of a line."""

    UNKNOWN = 0  #: only the mean was sent; the standard deviations are VAGUE_SIGMA
    FULL = 1  #: the covariance covers the sender's, including correlations
    DIAGONAL = 2  #: the variances cover the sender's; correlations were not sent
    REPAIRED = 3  #: as FULL; an indefinite matrix was replaced by one that covers it (upper bound)
    SATURATED = 4  #: as FULL, but wider than necessary: a value reached the end of its range
    OUT_OF_RANGE = 5  #: the line does not fit the message: use neither mean nor covariance


class LeftOut(StrEnum):
    """Reason for which a line of the map is not given, or not sent."""

    NOT_IN_WINDOW = "the line is not in the window"
    ACROSS = "the line is across the car's x axis"
    TOO_SHORT = "the range of the line is shorter than the pose error"
    UNCERTAIN = "the line is less certain than the limit"
    FEW_POINTS = "the points of the line are too few to tell how it bends"
    RANGE = "the message cannot state the range of the line"
    MEAN = "the message cannot state the parameters of the line"
    COVARIANCE = "no covariance of the message covers the line"
    PLACE = "the messages have no place for the line"


#: Reasons of a sender by their numbers, ``maplines_left_out_t``; None: the line is in the scene.
LEFT_OUT = (
    None, LeftOut.ACROSS, LeftOut.RANGE, LeftOut.MEAN, LeftOut.COVARIANCE, LeftOut.PLACE,
)  # fmt: skip


class Estimate(NamedTuple):
    """A quantity with its standard deviation, in the same unit."""

    value: NDArray[np.float64]
    sigma: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MapLine:
    """One map line in the ego frame: a Gaussian over the parameters of a cubic.

    The line is ``l(x) = y_off + tan(beta) x + c0/2 x^2 + c1/6 x^3`` (Map Line Interface, eq. 1), x
    forward and y to the left (ISO 8855), for x in [x_min, x_max]. Outside of this range the line
    says nothing: ``y`` and ``y_sigma`` are NaN. 1 mm is allowed for the rounding of x.

    Args:
        slot: identity of the line around the car.
        gaussian: over (y_off, beta, c0, c1) [m, rad, 1/m, 1/m^2].
        kind: kind of marking or boundary.
        x_min: start of the valid range [m].
        x_max: end of the valid range [m].
        age: time from the pose to the transmission [s]; infinite if the line is too old or its age
            is unknown, so that the sender does not vouch for it.
        status: quality of the covariance.
        t_ns: reception time of the first frame of the line [ns]; None at the sender.
        mixture: distribution of the line if one Gaussian does not describe it well;
            ``gaussian`` then has its mean and covariance. See ``MapLine.of_mixture``.

    Raises:
        ValueError: a value is out of range.
        TypeError: ``gaussian`` or ``mixture`` is of another class.
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
        for name, enum in (("slot", Slot), ("kind", Kind), ("status", Status)):
            if type(value := getattr(self, name)) is not enum:
                object.__setattr__(self, name, enum(value))
        if not isinstance(self.gaussian, Gaussian):
            raise TypeError(
                f"gaussian must be a Gaussian over {PARAMETERS}, got "
                f"{type(self.gaussian).__name__}; use MapLine.mean_only(slot, mean) for a mean "
                "without a covariance"
            )
        if self.gaussian.mean.size != len(PARAMETERS):
            raise ValueError(f"gaussian must be over {PARAMETERS}, got {self.gaussian.mean.size}-D")
        if not isinstance(self.mixture, GaussianMixture | None):
            raise TypeError(
                f"mixture must be a GaussianMixture, or None, got {type(self.mixture).__name__}; "
                "use MapLine.of_mixture(slot, mixture)"
            )
        given: tuple[Any, ...] = self.x_min, self.x_max, self.age
        if not all(map(is_plain, given)):
            given = tuple(floats(given, "x_min, x_max and age").tolist())
        x_min, x_max, age = given
        if not (-math.inf < x_min and x_max < math.inf and self.x_min <= self.x_max):
            raise ValueError(
                f"x_min <= x_max must be finite [m], got x_min={self.x_min!r}, x_max={self.x_max!r}"
            )
        if not (0 <= age <= MAX_AGE or age == math.inf):
            raise age_error(self.age)
        if self.t_ns is not None and self.t_ns != self.t_ns // 1:
            raise ValueError(
                f"t_ns must be a whole number [ns], or None at the sender, got {self.t_ns!r}"
            )

    @classmethod
    def mean_only(cls, slot: Slot, mean: ArrayLike, **rest: Any) -> MapLine:
        """Return a line of known mean and unknown covariance.

        >>> MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0, 0, 0]).status.name
        'UNKNOWN'
        """
        vague = Gaussian(floats(mean, "mean"), np.diag(np.square(VAGUE_SIGMA)))
        return cls(slot, vague, status=Status.UNKNOWN, **rest)

    @classmethod
    def with_sigma(cls, slot: Slot, mean: ArrayLike, sigma: ArrayLike, **rest: Any) -> MapLine:
        """Return a line of known mean and standard deviations, without correlations."""
        gaussian = Gaussian(floats(mean, "mean"), np.diag(variances(sigma)))
        return cls(slot, gaussian, status=Status.DIAGONAL, **rest)

    @classmethod
    def of_mixture(cls, slot: Slot, mixture: GaussianMixture, **rest: Any) -> MapLine:
        """Return a line distributed as a Gaussian mixture.

        Its components are transmitted together: a receiver gets all of them or none.
        """
        return cls(slot, mixture.overall, mixture=mixture, **rest)

    @classmethod
    def trusted(
        cls, slot: Slot, gaussian: Gaussian, kind: Kind, x_min: float, x_max: float
    ) -> MapLine:
        """Return a line of values that are computed, and so of the right types, without checks."""
        line = object.__new__(cls)
        line.__dict__.update(
            slot=slot,
            gaussian=gaussian,
            kind=kind,
            x_min=x_min,
            x_max=x_max,
            age=0.0,
            status=Status.FULL,
            t_ns=None,
            mixture=None,
        )
        return line

    @property
    def is_usable(self) -> bool:
        """Whether the line has values: it fitted the message, and its age is finite.

        Do not use the mean or the covariance of one that has none. `SlotView.usable` says whether
        a controller may use a line: that depends on the state of its slot, too.

        >>> line = MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0, 0, 0], age=0.04)
        >>> too_old = MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0, 0, 0], age=np.inf)
        >>> line.is_usable, too_old.is_usable
        (True, False)
        """
        return self.status is not Status.OUT_OF_RANGE and math.isfinite(self.age)

    def is_valid_at(self, x: ArrayLike) -> NDArray[np.bool_]:
        """Return the (...,) answers whether x is in the valid range [m]; False for NaN.

        >>> line = MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0, 0, 0], x_max=12.0)
        >>> line.is_valid_at([0.0, 12.0, 40.0])
        array([ True,  True, False])
        """
        return are_within(self.x_min, self.x_max, floats(x, "x"))

    def y(self, x: ArrayLike) -> NDArray[np.float64]:
        """Return the (...,) lateral position of the mean line at x [m]; NaN outside of its range.

        >>> line = MapLine.with_sigma(Slot.EGO_LEFT, [1.75, 0, 0, 0], [0.1, 0, 0, 0], x_max=12.0)
        >>> line.y([12.0, 40.0]), line.y_sigma(40.0)
        (array([1.75,  nan]), np.float64(nan))
        """
        if is_plain(x):  # without arrays
            if not are_within(self.x_min, self.x_max, x):
                return np.float64(math.nan)  # type: ignore[return-value]
            return np.float64(lib.maplines_line_y(*self.gaussian.mean.tolist(), x))  # type: ignore[return-value]
        return np.where(self.is_valid_at(x), lateral(self.gaussian.mean, x), math.nan)[()]

    def y_sigma(self, x: ArrayLike) -> NDArray[np.float64]:
        """Return the (...,) standard deviation of the lateral position at x [m], to first order.

        It is NaN outside of the valid range.
        """
        if is_plain(x):
            if not are_within(self.x_min, self.x_max, x):
                return np.float64(math.nan)  # type: ignore[return-value]
            cov = pointer(np.ascontiguousarray(self.gaussian.cov))
            return np.float64(lib.maplines_line_sigma(self.gaussian.mean.item(1), cov, x))  # type: ignore[return-value]
        J = lateral_jacobian(self.gaussian.mean, x)
        with np.errstate(over="ignore", invalid="ignore"):
            sigma = np.sqrt(np.einsum("...i,ij,...j->...", J, self.gaussian.cov, J).clip(0))
        return np.where(self.is_valid_at(x), sigma, math.nan)[()]

    def y_extrapolated(self, x: ArrayLike) -> Estimate:
        """Return the (...,) lateral position at any finite x [m], and what is known of it.

        In the valid range it is ``y`` with its standard deviation. At a distance of d beyond an
        end, the mean goes on with its second derivative at the end. The standard deviations there
        of position, slope and second derivative, s_y, s_m and s_k, add up, and the road may turn as
        tightly as a car can, on a radius of 5 m, which counts as three standard deviations:

            sigma = s_y + s_m d + (s_k + (1 + slope^2)^(3/2) / (3 * 5 m)) d^2 / 2

        It increases with d. On maps of others, 0.15 % (OpenDRIVE) and 0.4 % (Lanelet2) of places
        up to 40 m beyond an end are more than three of it off; 1.7 % and 0.5 % where the range ends
        before the window, as in front of a corner (``tools/evidence sharpness.extrapolated``). What
        turns back, and is no function of x there, is not counted. NaN if x is not finite.

        >>> line = MapLine.with_sigma(Slot.EGO_LEFT, [1.75, 0, 0, 0], [0.1, 0, 0, 0], x_max=12.0)
        >>> line.y_extrapolated([0.0, 12.0, 22.0, 40.0]).sigma.round(2)
        array([ 0.1 ,  0.1 ,  3.43, 26.23])
        """
        given = floats(x, "x")
        mean, root = self.gaussian.mean.tolist(), self.gaussian.root.tolist()
        ends = {"x_min": self.x_min, "x_max": self.x_max}
        line = ffi.new("maplines_line_t *", {"gaussian": {"mean": mean, "factor": root}, **ends})
        y, sigma = np.empty(given.shape), np.empty(given.shape)
        arrays = map(pointer, (np.ascontiguousarray(given), y, sigma))
        lib.maplines_extrapolate(line, given.size, *arrays)
        is_inside = (self.x_min <= given) & (given <= self.x_max)
        return Estimate(
            np.where(is_inside, self.y(given), y)[()],
            np.where(is_inside, self.y_sigma(given), sigma)[()],
        )


def aged(line: MapLine, age: float) -> MapLine:
    """Return a line with another age, 0 s or more or infinite, without checking it again."""
    copy = object.__new__(type(line))
    copy.__dict__.update(line.__dict__, age=age)
    return copy


class MapLineList(list[MapLine]):
    """Result of ``map_lines``: lines, and the reasons of those that are left out.

    Args:
        lines: the lines.
        left_out: reason of each line that is left out, by its slot.
    """

    def __init__(
        self, lines: Iterable[MapLine] = (), left_out: Mapping[Slot, LeftOut] | None = None
    ) -> None:
        super().__init__(lines)
        self.left_out = dict(left_out or {})


def age_error(age: object) -> ValueError:
    """Return the error of an age that no line or scene can have."""
    return ValueError(
        f"age must be 0 s or more (up to {MAX_AGE:g}), or infinite if it is too old or unknown, "
        f"got {age!r}"
    )


def are_within(x_min: Any, x_max: Any, x: Any) -> Any:
    """Return whether x is in a range, up to ``RANGE_TOLERANCE`` [m]; for floats or arrays."""
    return (x >= x_min - RANGE_TOLERANCE) & (x <= x_max + RANGE_TOLERANCE)


@np.errstate(over="ignore", invalid="ignore")
def lateral(parameters: ArrayLike, x: ArrayLike) -> NDArray[np.float64]:
    """Return the value l(x) of cubics at any x [m] (Map Line Interface, eq. 1).

    They have no range, unlike a ``MapLine``: for fits, and for places known to be in it. The result
    is infinite or NaN where x is, and on overflow; there is no warning.

    Args:
        parameters: (..., 4) lines [m, rad, 1/m, 1/m^2].
        x: longitudinal positions that broadcast against the leading axes of ``parameters`` [m].

    >>> lateral([1.0, 0.0, 0.01, 0.0], [0, 10, 20])
    array([1. , 1.5, 3. ])
    """
    (y_off, beta, c0, c1), x = _rows(parameters), floats(x, "x")
    return y_off + x * (np.tan(beta) + x * (c0 / 2 + x * c1 / 6))


@np.errstate(over="ignore", invalid="ignore")
def lateral_jacobian(parameters: ArrayLike, x: ArrayLike) -> NDArray[np.float64]:
    """Return the (..., 4) derivative of l(x) with respect to (y_off, beta, c0, c1)."""
    _, beta, _, _ = _rows(parameters)
    x = floats(x, "x")
    slope = np.tan(beta)
    by_slope = (1 + slope * slope) * x
    J = np.empty((*np.shape(by_slope), len(PARAMETERS)))
    J[..., 0], J[..., 1], J[..., 2], J[..., 3] = 1.0, by_slope, x * x / 2, x * x * x / 6
    return J


def _rows(parameters: ArrayLike) -> NDArray[np.float64]:
    """Return (..., 4) lines as an array of shape (4, ...)."""
    lines = floats(parameters, "parameters")
    if lines.shape[-1:] != (len(PARAMETERS),):
        raise ValueError(f"parameters must have shape (..., 4), got {lines.shape}")
    return lines.transpose(-1, *range(lines.ndim - 1))


def transform_line(
    parameters: ArrayLike, displacement: ArrayLike, window: tuple[ArrayLike, ArrayLike]
) -> NDArray[np.float64]:
    """Transform lines to the ego frame of another pose (Map Line Interface, section III-A-1).

    Points of the line are transformed to the new frame, and a cubic is fitted to them by least
    squares. The result agrees with a refit of the line of the map from the new pose within 1 mm
    over the same window, for displacements up to 5 m and 10 deg, on 100 m of road with radius
    >= 200 m. It does not hold in a street turn.

    Args:
        parameters: (..., 4) lines in the old ego frame.
        displacement: (..., 3) the new pose in the old ego frame (x [m], y [m], heading [rad]).
        window: (x_min, x_max) valid range of the line in the old ego frame, or of each [m].

    Returns:
        (..., 4) lines in the new ego frame.

    Raises:
        ValueError: an empty window, or a wrong shape.
        IllPosedError: in the new frame a line is not a function of x or is nearly
            perpendicular to the x axis (80 deg or more), or an input is NaN.

    >>> transform_line([2.0, 0.0, 0.0, 0.0], [10.0, 0.5, 0.0], window=(0, 80)).round(9) + 0.0
    array([1.5, 0. , 0. , 0. ])
    """
    lines = transform_line_or_nan(parameters, displacement, window)
    ill_posed = np.isnan(lines).any(axis=-1)
    if ill_posed.any():
        given = np.broadcast_to(np.asarray(displacement, dtype=float), (*ill_posed.shape, 3))
        first = given[ill_posed][0]
        raise IllPosedError(
            "a line is not a function of x, or nearly perpendicular to the x axis, after the "
            f"displacement {first} (m, m, rad), so no cubic describes it; shorten the window "
            "or check the heading"
        )
    return lines


def transform_line_or_nan(
    parameters: ArrayLike, displacement: ArrayLike, window: tuple[ArrayLike, ArrayLike]
) -> NDArray[np.float64]:
    """Transform lines as ``transform_line`` does, with a row of NaN in place of IllPosedError."""
    x_min, x_max = (floats(end, "window") for end in window)
    check_window(x_min, x_max)
    lines, poses = np.moveaxis(_rows(parameters), 0, -1), floats(displacement, "displacement")
    if poses.shape[-1:] != (3,):
        raise ValueError(f"displacement must have shape (..., 3), got {poses.shape}")
    shape = np.broadcast_shapes(lines.shape[:-1], poses.shape[:-1], x_min.shape, x_max.shape)
    curves = np.zeros((*shape, 7))
    curves[..., :4], curves[..., 4], curves[..., 5] = lines, x_min, x_max
    given, found = np.broadcast_to(poses, (*shape, 3)), np.empty((*shape, 4))
    arrays = map(pointer, (curves, np.ascontiguousarray(given), found))
    lib.maplines_transform_curves(math.prod(shape), *arrays)
    return found


def check_window(x_min: NDArray[np.float64], x_max: NDArray[np.float64]) -> None:
    """Raise ValueError if a window of ``transform_line`` is empty or not finite."""
    if not ((-math.inf < x_min) & (x_min < x_max) & (x_max < math.inf)).all():
        ends = ", ".join(f"{end:g}" if end.ndim == 0 else str(end) for end in (x_min, x_max))
        raise ValueError(f"window must have finite x_min < x_max [m], got ({ends})")
