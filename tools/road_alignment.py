"""Reference lines of roads by tangent polygons: straights and curves with clothoids."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from maplines_can.maps.formats.opendrive.reference_line import clothoid

#: Shorter pieces are left out [m].
SHORTEST = 1e-9


class Pose(NamedTuple):
    """Position [m] and heading [rad]."""

    x: float
    y: float
    heading: float

    @property
    def reversed(self) -> Pose:
        """The same position, seen backward."""
        return Pose(self.x, self.y, self.heading + math.pi)

    def beside(self, t: float) -> Pose:
        """Return the pose at an offset to the left [m]."""
        x, y = self.x - t * math.sin(self.heading), self.y + t * math.cos(self.heading)
        return Pose(x, y, self.heading)


class Piece(NamedTuple):
    """Clothoid, arc or straight: its length [m], and its curvature at both ends [1/m]."""

    length: float
    first: float = 0.0
    last: float = 0.0


@dataclass(frozen=True)
class Alignment:
    """A reference line: pieces after each other from a pose on."""

    start: Pose
    pieces: tuple[Piece, ...]

    @property
    def length(self) -> float:
        """Length [m]."""
        return math.fsum(piece.length for piece in self.pieces)

    @property
    def end(self) -> Pose:
        """Pose at the end."""
        *_, (piece, pose) = self.placed()
        return _advanced(pose, piece)

    def placed(self) -> Iterator[tuple[Piece, Pose]]:
        """Yield the pieces with their start poses."""
        pose = self.start
        for piece in self.pieces:
            yield piece, pose
            pose = _advanced(pose, piece)

    def cut(self, begin: float, end: float) -> Alignment:
        """Return the part between two arc lengths [m]."""
        s, start = 0.0, self.start
        kept: list[Piece] = []
        for piece, pose in self.placed():
            low, high = max(begin - s, 0.0), min(end - s, piece.length)
            if high - low > SHORTEST:
                if not kept:
                    start = _advanced(pose, _part(piece, 0.0, low))
                kept.append(_part(piece, low, high))
            s += piece.length
        return Alignment(start, tuple(kept))


def _part(piece: Piece, low: float, high: float) -> Piece:
    rate = (piece.last - piece.first) / piece.length
    return Piece(high - low, piece.first + rate * low, piece.first + rate * high)


def _advanced(pose: Pose, piece: Piece) -> Pose:
    if piece.length == 0:
        return pose
    rate = (piece.last - piece.first) / piece.length
    ((at,), _) = clothoid(*(np.array([v]) for v in (piece.length, piece.first, rate)))
    at *= complex(math.cos(pose.heading), math.sin(pose.heading))
    turn = piece.length * (piece.first + piece.last) / 2
    return Pose(pose.x + at.real, pose.y + at.imag, pose.heading + turn)


class Vertex(NamedTuple):
    """Vertex of a tangent polygon: position, radius of the curve, length of its clothoids [m]."""

    x: float
    y: float
    radius: float = 0.0
    spiral: float = 0.0


def through(vertices: Sequence[Vertex]) -> Alignment:
    """Return the alignment along a tangent polygon.

    A curve of radius R with clothoids of length L begins T before its vertex: with the deflection
    a, the shift p and the abscissa q of the circle's nearest point, T = (R + p) tan(a / 2) + q.

    Raises:
        ValueError: two curves overlap, or a clothoid is too long for its curve.
    """
    corners = np.array([complex(v.x, v.y) for v in vertices])
    sides = np.diff(corners)
    headings = np.angle(sides)
    room = np.abs(sides)
    pieces: list[Piece] = []
    used = 0.0
    for i, vertex in enumerate(vertices[1:-1]):
        turn = math.remainder(headings[i + 1] - headings[i], 2 * math.pi)
        curve, tangent = _curve(vertex, turn)
        straight = room[i] - used - tangent
        if straight < -SHORTEST or tangent > room[i + 1] + SHORTEST:
            raise ValueError(f"the curve at {vertex} needs {tangent:.3f} m to either side")
        pieces += [Piece(straight), *curve]
        used = tangent
    pieces.append(Piece(room[-1] - used))
    start = Pose(vertices[0].x, vertices[0].y, headings[0])
    return Alignment(start, tuple(piece for piece in pieces if piece.length > SHORTEST))


def _curve(vertex: Vertex, turn: float) -> tuple[list[Piece], float]:
    """Return the pieces of a curve, and its tangent length [m]."""
    k = math.copysign(1 / vertex.radius, turn)
    spiral = vertex.spiral
    arc = abs(turn) * vertex.radius - spiral
    if arc < 0:
        raise ValueError(f"the clothoids at {vertex} are too long for a turn of {turn:.3f} rad")
    half = spiral / (2 * vertex.radius)
    end = _advanced(Pose(0, 0, 0), Piece(spiral, 0.0, abs(k)))
    shift = end.y - vertex.radius * (1 - math.cos(half))
    abscissa = end.x - vertex.radius * math.sin(half)
    tangent = (vertex.radius + shift) * math.tan(abs(turn) / 2) + abscissa
    return [Piece(spiral, 0.0, k), Piece(arc, k, k), Piece(spiral, k, 0.0)], tangent


def between(one: Pose, other: Pose, radius: float) -> Alignment:
    """Return the straight or the single curve from pose to pose."""
    turn = math.remainder(other.heading - one.heading, 2 * math.pi)
    ends = Vertex(one.x, one.y), Vertex(other.x, other.y)
    if abs(turn) < SHORTEST:
        return through(ends)
    direction, back = (np.exp(1j * pose.heading) for pose in (one, other))
    across = complex(other.x - one.x, other.y - one.y) * np.conj(back)
    at = complex(one.x, one.y) + direction * across.imag / (direction * np.conj(back)).imag
    return through([ends[0], Vertex(at.real, at.imag, radius), ends[1]])
