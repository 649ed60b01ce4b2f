"""Streets from their curvature: corner, roundabouts, motorway exit, S-bend, changing lanes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats
from ..values.line import Kind, Slot
from ..values.polyline import Polyline

#: Gauss-Legendre nodes and weights; exact to rounding for a piece that turns by a full circle.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)


class StreetPiece(NamedTuple):
    """Piece of a street: straight, arc, or clothoid, whose curvature changes linearly."""

    length: float  #: [m]
    begin: float = 0.0  #: curvature at its begin [1/m], positive to the left
    end: float = 0.0  #: curvature at its end [1/m]


@dataclass(frozen=True, eq=False)
class Street:
    """Centre line of a street as a function of its arc length s.

    It goes through the origin along x at s = 0, so that a car there sees it as in the ego frame.

    Args:
        pieces: the pieces in order; each turns by at most a full circle.
        behind: arc length from the begin of the first piece to the origin [m].

    Raises:
        ValueError: there is no piece, a length is not positive, or the origin is not on the street.

    >>> quarter = Street([StreetPiece(20), StreetPiece(4 * np.pi, 1 / 8, 1 / 8)], behind=20)
    >>> quarter.line([0, quarter.end]).round(9)
    array([[0., 0.],
           [8., 8.]])
    """

    pieces: Sequence[StreetPiece]
    behind: float = 0.0
    _s: NDArray[np.float64] = field(init=False, repr=False)
    _rows: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        pieces = np.array([StreetPiece(*map(float, piece)) for piece in self.pieces]).reshape(-1, 3)
        if not len(pieces) or not np.isfinite(pieces).all() or not (pieces[:, 0] > 0).all():
            raise ValueError("pieces must have at least one, of a finite length of more than 0 m")
        length, begin, end = pieces.T
        s = np.append(0.0, length.cumsum()) - self.behind
        if not s[0] <= 0 <= s[-1]:
            raise ValueError(
                f"behind must be 0 to {length.sum():g} m, the length of the street, "
                f"got {self.behind!r}"
            )
        heading = np.append(0.0, (length * (begin + end) / 2).cumsum())
        rows = np.column_stack([s[:-1], heading[:-1], begin, (end - begin) / (2 * length)])
        object.__setattr__(self, "_rows", rows)
        object.__setattr__(self, "_s", s)

    @property
    def begin(self) -> float:
        """Arc length at the begin of the street [m], 0 or less."""
        return float(self._s[0])

    @property
    def end(self) -> float:
        """Arc length at the end of the street [m]."""
        return float(self._s[-1])

    def heading(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the (...,) directions at (...,) arc lengths [rad], 0 at s = 0."""
        return self._turn(floats(s, "s")) - self._turn(np.zeros(()))

    def line(self, s: ArrayLike, offset: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Return the (..., n, 2) points of lines beside the street [m].

        Args:
            s: (n,) arc lengths of the centre line, in any order [m].
            offset: (..., n) or scalar distances to the left of the centre line [m].

        Raises:
            ValueError: an arc length is not on the street.
        """
        s = floats(s, "s")
        tolerance = 1e-9 * (self.end - self.begin)
        if not ((s >= self.begin - tolerance) & (s <= self.end + tolerance)).all():
            raise ValueError(
                f"s must be {self.begin:g} to {self.end:g} m, got {s.min():g} to {s.max():g} m"
            )
        # Between two neighbouring knots the curvature is linear and the direction smooth.
        knots = np.unique(np.concatenate([s, self._s, [0.0]]))
        half = np.diff(knots)[:, None] / 2
        nodes = knots[:-1, None] + half * (1 + _NODES)
        steps = (np.exp(1j * self.heading(nodes)) * _WEIGHTS * half).sum(axis=1)
        centre = np.append(0.0, steps.cumsum())
        centre = (centre - centre[knots.searchsorted(0.0)])[knots.searchsorted(s)]
        beside = centre + floats(offset, "offset") * 1j * np.exp(1j * self.heading(s))
        return np.stack([beside.real, beside.imag], axis=-1)

    def _turn(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        i = (self._s.searchsorted(s, side="right") - 1).clip(0, len(self.pieces) - 1)
        begin, heading, curvature, growth = np.moveaxis(self._rows[i], -1, 0)
        t = s - begin
        return np.asarray(heading + t * (curvature + t * growth))


def widening(s: ArrayLike, begin: float, length: float) -> NDArray[np.float64]:
    """Return the (n,) share of a lane change of a line, from 0 at ``begin`` to 1 after ``length``.

    It is a cubic without a kink at both ends, as lane widths are in OpenDRIVE.
    """
    t = ((floats(s, "s") - begin) / length).clip(0, 1)
    return np.asarray(t * t * (3 - 2 * t))


#: Kind and distance to the left of the centre of the car's lane [m], of each line of a road with
#: three lanes. The route leads to the left.
LANES: dict[Slot, tuple[Kind, float]] = {
    Slot.EGO_LEFT: (Kind.DASHED, 1.75),
    Slot.EGO_RIGHT: (Kind.DASHED, -1.75),
    Slot.NEXT_LEFT: (Kind.SOLID, 5.25),
    Slot.NEXT_RIGHT: (Kind.SOLID, -5.25),
    Slot.CENTRE: (Kind.VIRTUAL, 0.0),
    Slot.EDGE_LEFT: (Kind.ROAD_EDGE, 5.75),
    Slot.EDGE_RIGHT: (Kind.KERB, -5.75),
    Slot.ROUTE: (Kind.VIRTUAL, 3.5),
}


def lanes(
    street: Street, s: ArrayLike, shift: Mapping[Slot, NDArray[np.float64]] | None = None
) -> dict[Slot, Polyline]:
    """Return the lines of a road with three lanes; the car drives in the middle of the street.

    Args:
        street: centre line of the car's lane.
        s: (n,) arc lengths of the points of each line [m].
        shift: (n,) distances to the left by which lines deviate from ``LANES`` [m]; a line ends
            where it is NaN.
    """
    s, shift = floats(s, "s"), shift or {}
    across = np.array(
        [offset + shift.get(slot, 0.0) + 0 * s for slot, (_, offset) in LANES.items()]
    )
    points, there = street.line(s, across), np.isfinite(across)
    return {
        slot: Polyline(points[i, there[i]], kind)
        for i, (slot, (kind, _)) in enumerate(LANES.items())
    }


def streets() -> Iterator[tuple[str, str, dict[Slot, Polyline]]]:
    """Yield name, description and lines of streets as a car at the origin sees them along x."""

    def each_metre(street: Street) -> NDArray[np.float64]:
        return np.linspace(street.begin, street.end, round(street.end - street.begin) + 1)

    corner = Street(
        [StreetPiece(60), StreetPiece(8 * np.pi / 2, 1 / 8, 1 / 8), StreetPiece(60)], behind=40
    )
    yield (
        "corner",
        "straight for 20 m, then a 90 deg corner to the left of radius 8 m",
        lanes(corner, each_metre(corner)),
    )
    for radius in (12.0, 50.0):
        circle = Street(
            [StreetPiece(1.9 * np.pi * radius, 1 / radius, 1 / radius)], np.pi * radius / 2
        )
        yield (
            f"roundabout-{radius:g}m",
            f"in a roundabout of radius {radius:g} m",
            lanes(circle, each_metre(circle)),
        )
    ramp = [StreetPiece(60, 0, -1 / 60), StreetPiece(90, -1 / 60, -1 / 60)]
    leaving = Street([StreetPiece(90), *ramp], behind=60)
    yield (
        "exit",
        "motorway exit: straight for 30 m, then a clothoid of 60 m to the right to radius 60 m",
        lanes(leaving, each_metre(leaving)),
    )
    bends = [
        StreetPiece(10, 0, 1 / 40),
        StreetPiece(20, 1 / 40, 1 / 40),
        StreetPiece(20, 1 / 40, -1 / 40),
    ]
    s_bend = Street(
        [StreetPiece(45), *bends, StreetPiece(20, -1 / 40, -1 / 40), StreetPiece(60)], behind=30
    )
    yield (
        "s-bend",
        "straight for 15 m, then bends of radius 40 m to the left and to the right",
        lanes(s_bend, each_metre(s_bend)),
    )
    straight = Street([StreetPiece(150)], behind=50)
    s = each_metre(straight)
    taper = 3.5 * widening(s, 0.0, 40.0)
    ends = {
        Slot.EGO_RIGHT: np.where(s <= 40, 0.0, np.nan),
        Slot.NEXT_RIGHT: taper,
        Slot.EDGE_RIGHT: taper,
    }
    yield (
        "lane-ends",
        "the lane on the right ends 40 m ahead, and with it the marking between the lanes",
        lanes(straight, s, ends),
    )
    wider = -3.5 * widening(s, 15.0, 30.0)
    right = dict.fromkeys((Slot.EGO_RIGHT, Slot.NEXT_RIGHT, Slot.EDGE_RIGHT), wider)
    yield (
        "lane-widens",
        "the lane widens to the right by 3.5 m, from 15 m to 45 m ahead",
        lanes(straight, s, right | {Slot.CENTRE: wider / 2}),
    )
    bend = Street([StreetPiece(600, 1 / 1500, 1 / 1500)], behind=150)
    yield (
        "motorway-coarse",
        "motorway of radius 1500 m whose points are 45 m to 90 m apart",
        lanes(bend, np.cumsum([-150.0, 45, 75, 60, 90, 45, 90, 75, 60, 60])),
    )
