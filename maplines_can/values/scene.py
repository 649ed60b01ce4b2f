"""Lines that are seen from one pose, with their joint distribution; errors of pose and map."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import floats
from .gaussian import Gaussian
from .linalg import block_diagonal, is_covariance, positive_part
from .line import PARAMETERS, Estimate, LeftOut, MapLine, Slot, lateral, lateral_jacobian
from .seen_lines import SeenLines, bases

#: Parameters of a line.
N = len(PARAMETERS)


@dataclass(frozen=True, slots=True)
class MapError:
    """Standard deviations of the errors of the map points.

    Published errors of the lane geometry of HD maps are 5 to 20 cm (Liu, Wang, Zhang
    2020, tables 3, 5 and 6). Some are common to a section of a road, some are local.

    Args:
        point_sigma: independent error of each map point, in any direction [m]. What the points
            show of it counts, if that is more.
        offset_sigma: common offset of all points of a line, in any direction [m].
        heading_sigma: common rotation of all points of a line about the car [rad].

    Raises:
        ValueError: a value is negative or not finite.
    """

    point_sigma: float = 0.0
    offset_sigma: float = 0.0
    heading_sigma: float = 0.0

    def __post_init__(self) -> None:
        for name in ("point_sigma", "offset_sigma", "heading_sigma"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(
                    f"{name} must be 0 or more and finite, got {getattr(self, name)!r}"
                )


@dataclass(frozen=True, eq=False)
class PoseError:
    """Error of the pose from which the lines of a scene are seen.

    Args:
        cov: (3, 3) covariance in the ego frame: along [m], across [m], heading [rad].
        correlation_time: time after which the error is a different one [s]; infinite if it is
            unknown. The errors of scenes that are closer in time are not independent.

    Raises:
        ValueError: ``cov`` is not a covariance, or the time is not positive.
    """

    cov: NDArray[np.float64]
    correlation_time: float = math.inf

    def __post_init__(self) -> None:
        cov = floats(self.cov, "cov")
        if cov.shape != (3, 3):
            raise ValueError(f"cov must be (3, 3), over along, across and heading, got {cov.shape}")
        object.__setattr__(self, "cov", Gaussian(np.zeros(3), cov).cov)
        if not self.correlation_time > 0:
            raise ValueError(
                f"correlation_time must be more than 0 s, got {self.correlation_time!r}"
            )


class Conditional(NamedTuple):
    """Parameters of lines as a linear function of the pose error, and what else varies."""

    J: NDArray[np.float64]  #: (4 L, 3) derivatives with respect to along, across and heading
    cov: NDArray[np.float64]  #: (4 L, 4 L) of the lines if the pose error is known


@dataclass(frozen=True, eq=False)
class Scene:
    """Lines that are seen from one pose, with the Gaussian over all of their parameters.

    The lines of a scene share the error of the pose: they are not independent. The variance of a
    quantity of several lines, such as the width of the lane, needs their joint covariance. Scenes
    of successive cycles share it, too, for ``pose_error.correlation_time``.

    ``map_scene`` makes a scene at the sender, ``Receiver.latest_scene`` at the receiver. Methods
    raise ValueError if the scene has no line of a slot that they are asked for.

    Args:
        lines: the lines, each of another slot, without mixtures. Their covariances are the blocks
            of ``cov``.
        cov: (4 L, 4 L) joint covariance of the parameters of all lines, in their order.
        pose_error: error of the pose.
        fit_ranges: (L, 2) ranges in which the cubics were fitted, which contain the valid ranges
            [m].
        map_error: error of the map as far as it is known; None if it is not.
        left_out: reasons of the lines that are not in the scene, by slot.
        quartics: (L,) coefficients of the Chebyshev polynomial T_4 that the cubics leave of the
            lines in their fit ranges [m]; 0 if they are empty. See ``SeenLines``.
        specific_covs: (L, 4, 4) line-specific covariances: the part of the covariance of each line
            that is not due to the pose error and independent from line to line, of the map error
            and of the misfit of the cubic. None if it is not known.

    Raises:
        ValueError: a shape is wrong, two lines have the same slot, a line has a mixture, a
            range is empty, or ``cov`` or one of ``specific_covs`` is not a covariance.

    >>> pose = PoseError(np.diag([0.1, 0.2, 0.01]) ** 2)
    >>> lines = [MapLine(slot, Gaussian([y, 0, 0, 0], np.diag([0.05, 1e-4, 1e-8, 1e-12])))
    ...          for slot, y in ((Slot.EGO_LEFT, 1.75), (Slot.EGO_RIGHT, -1.75))]
    >>> common = np.kron(np.ones((2, 2)), np.diag([0.04, 1e-4, 0, 0]))
    >>> own = np.kron(np.eye(2), np.diag([0.01, 0, 1e-8, 1e-12]))
    >>> scene = Scene(lines, common + own, pose, [[-20, 80], [-20, 80]])
    >>> scene.width(0.0).sigma.round(3)
    np.float64(0.141)
    >>> scene.centre(0.0).sigma.round(3)
    np.float64(0.212)
    """

    lines: tuple[MapLine, ...]
    cov: NDArray[np.float64]
    pose_error: PoseError
    fit_ranges: NDArray[np.float64]
    map_error: MapError | None = None
    left_out: Mapping[Slot, LeftOut] = field(default_factory=dict)
    quartics: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    specific_covs: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        lines = tuple(self.lines)
        object.__setattr__(self, "lines", lines)
        object.__setattr__(self, "left_out", dict(self.left_out))
        if len({line.slot for line in lines}) < len(lines):
            raise ValueError(f"lines must be of different slots, got {[*map(_name, lines)]}")
        if mixtures := [line for line in lines if line.mixture is not None]:
            raise ValueError(
                f"lines must not be mixtures, but that of {_name(mixtures[0])} is; a receiver "
                "splits the pose error itself"
            )
        if not len(self.quartics):
            object.__setattr__(self, "quartics", np.zeros(len(lines)))
        shapes = {
            "cov": (N * len(lines),) * 2,
            "fit_ranges": (len(lines), 2),
            "quartics": (len(lines),),
        }
        if self.specific_covs is not None:
            shapes["specific_covs"] = (len(lines), N, N)
        for name, shape in shapes.items():
            values = np.array(floats(getattr(self, name), name))
            values = values if lines else values.reshape(shape)
            if values.shape != shape:
                raise ValueError(
                    f"{name} must be {shape} for {len(lines)} lines, got {values.shape}"
                )
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if not is_covariance(self.cov):
            raise ValueError(
                "cov must be finite, symmetric and positive semidefinite; for rounding errors, use "
                f"nearest_covariance(cov); got {self.cov!r}"
            )
        for cov in () if self.specific_covs is None else self.specific_covs:
            if not is_covariance(cov):
                raise ValueError(
                    "each of specific_covs must be finite, symmetric and positive semidefinite, "
                    f"got {cov!r}"
                )
        if not all(-math.inf < low < high < math.inf for low, high in self.fit_ranges.tolist()):
            raise ValueError(f"fit_ranges must be finite and not empty, got {self.fit_ranges!r} m")
        if not np.isfinite(self.quartics).all():
            raise ValueError(f"quartics must be finite, got {self.quartics!r} m")

    @classmethod
    def trusted(
        cls,
        lines: tuple[MapLine, ...],
        cov: NDArray[np.float64],
        pose_error: PoseError,
        fit_ranges: NDArray[np.float64],
        map_error: MapError | None,
        left_out: dict[Slot, LeftOut],
        quartics: NDArray[np.float64],
        specific_covs: NDArray[np.float64] | None,
    ) -> Scene:
        """Return a scene of the given values without copying or checking them.

        The arrays are read-only. For those that the C core has checked; otherwise call
        ``Scene``.
        """
        scene = object.__new__(cls)
        vars(scene).update(
            lines=lines,
            cov=cov,
            pose_error=pose_error,
            fit_ranges=fit_ranges,
            map_error=map_error,
            left_out=left_out,
            quartics=quartics,
            specific_covs=specific_covs,
        )
        return scene

    @cached_property
    def index(self) -> dict[Slot, int]:
        """Place of each slot's line in ``lines``."""
        return {line.slot: i for i, line in enumerate(self.lines)}

    @property
    def means(self) -> NDArray[np.float64]:
        """(L, 4) means of the lines."""
        return np.array([line.gaussian.mean for line in self.lines]).reshape(-1, N)

    def line(self, slot: Slot) -> MapLine:
        """Return the line of a slot."""
        return self.lines[self._place(slot)]

    def joint(self, slots: Iterable[Slot] | None = None) -> Gaussian:
        """Return the Gaussian over the parameters of some lines in this order; None for all."""
        places = [*range(len(self.lines))] if slots is None else [*map(self._place, slots)]
        if not places:
            raise ValueError("the scene has no lines")
        return Gaussian.trusted(self.means[places].ravel(), self._joint_cov(places))

    def subset(self, slots: Iterable[Slot]) -> Scene:
        """Return the scene with only the lines of these slots, in this order."""
        places = [*map(self._place, slots)]
        return replace(
            self,
            lines=tuple(self.lines[i] for i in places),
            cov=self._joint_cov(places),
            fit_ranges=self.fit_ranges[places],
            quartics=self.quartics[places],
            specific_covs=None if self.specific_covs is None else self.specific_covs[places],
        )

    def conditional(self) -> Conditional:
        """Return the lines conditional on the pose error.

        Their joint covariance is J P J' and that of the rest: the line-specific covariances, and
        what is not linear in the pose error. The rest is positive semidefinite.

        >>> lines = [MapLine(Slot.CENTRE, Gaussian(np.zeros(4), np.diag([0.05, 0.02, 0, 0])))]
        >>> pose = PoseError(np.diag([0.0, 0.2, 0.1]) ** 2)
        >>> rest = Scene(lines, lines[0].gaussian.cov, pose, [[-20, 80]]).conditional().cov
        >>> rest.diagonal().round(6)
        array([0.01, 0.01, 0.  , 0.  ])
        """
        seen = SeenLines(self.means, self.fit_ranges, self.quartics)
        J = seen.jacobian().reshape(-1, 3)
        rest = self.cov - J @ self.pose_error.cov @ J.T
        in_metres = block_diagonal(bases(self.means, self.fit_ranges))
        return Conditional(J, positive_part(rest, in_metres))

    def x_range(self, slots: Iterable[Slot]) -> tuple[float, float]:
        """Return the range in which all lines of these slots are valid [m]; it may be empty."""
        lines = [self.line(slot) for slot in slots]
        if not lines:
            raise ValueError("slots must be one slot or more, got none")
        return max(line.x_min for line in lines), min(line.x_max for line in lines)

    def lateral(self, weights: Mapping[Slot, float], x: ArrayLike) -> Estimate:
        """Return the weighted sum of the lateral positions of lines at (...,) x [m].

        The standard deviation is to first order. Both are NaN where x is not in the valid ranges of
        all of these lines.
        """
        x = floats(x, "x")
        value = np.zeros(x.shape)
        is_valid = np.full(x.shape, True)
        J = np.zeros((*x.shape, N * len(self.lines)))
        for slot, weight in weights.items():
            i = self._place(slot)
            mean = self.lines[i].gaussian.mean
            is_valid &= self.lines[i].is_valid_at(x)
            value = value + weight * lateral(mean, x)
            J[..., N * i : N * i + N] = weight * lateral_jacobian(mean, x)
        variance = np.einsum("...i,ij,...j->...", J, self.cov, J)
        sigma = np.sqrt(variance.clip(0))
        nothing = math.nan
        return Estimate(
            np.where(is_valid, value, nothing)[()], np.where(is_valid, sigma, nothing)[()]
        )

    def width(
        self, x: ArrayLike, left: Slot = Slot.EGO_LEFT, right: Slot = Slot.EGO_RIGHT
    ) -> Estimate:
        """Return the lateral distance of two lines at (...,) x [m], by default the lane's width."""
        return self.lateral({left: 1.0, right: -1.0}, x)

    def centre(
        self, x: ArrayLike, left: Slot = Slot.EGO_LEFT, right: Slot = Slot.EGO_RIGHT
    ) -> Estimate:
        """Return the lateral position of the middle between two lines at (...,) x [m]."""
        return self.lateral({left: 0.5, right: 0.5}, x)

    def _joint_cov(self, places: list[int]) -> NDArray[np.float64]:
        """Return the joint covariance of the lines at these places."""
        keep = (N * np.array(places, dtype=int)[:, None] + np.arange(N)).ravel()
        return np.asarray(self.cov[np.ix_(keep, keep)])

    def _place(self, slot: Slot) -> int:
        if slot not in self.index:
            names = ", ".join(map(_name, self.lines)) or "none"
            raise ValueError(f"the scene has no line of slot {Slot(slot).name}; it has {names}")
        return self.index[slot]


def _name(line: MapLine) -> str:
    return line.slot.name
