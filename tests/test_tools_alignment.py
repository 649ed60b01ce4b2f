"""Alignments of the generated map: they end where their polygon does, and can be cut."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from road_alignment import Alignment, Piece, Pose, Vertex, between, through


@given(
    st.floats(-2.5, 2.5).filter(lambda turn: abs(turn) > 0.2),
    st.floats(5, 300),
    st.sampled_from([0.0, 0.2, 0.7, 0.99]),
)
def test_a_curve_ends_at_the_last_vertex(turn: float, radius: float, share: float) -> None:
    """In the direction of the last side, with or without clothoids."""
    spiral = share * abs(turn) * radius
    far = 20 * radius
    end = complex(far, 0) + far * np.exp(1j * turn)
    line = through([Vertex(0, 0), Vertex(far, 0, radius, spiral), Vertex(end.real, end.imag)])

    assert math.hypot(line.end.x - end.real, line.end.y - end.imag) < 1e-8 * far
    assert line.end.heading == pytest.approx(turn, abs=1e-9)


@given(st.floats(0, 1), st.floats(0, 1))
def test_a_cut_has_the_poses_of_the_whole(one: float, other: float) -> None:
    """At both of its ends."""
    whole = through([Vertex(0, 0), Vertex(200, 0, 60, 30), Vertex(200, 200)])
    begin, end = sorted((one * whole.length, other * whole.length))
    if end - begin < 1e-6:
        return
    part, before = whole.cut(begin, end), whole.cut(0.0, begin)

    assert part.length == pytest.approx(end - begin)
    assert part.end == pytest.approx(whole.cut(0.0, end).end)
    if before.pieces:
        assert part.start == pytest.approx(before.end)


def test_between_poses() -> None:
    """A straight if they look in the same direction, else a quarter of a circle here."""
    straight = between(Pose(0, 0, 0), Pose(30, 0, 2 * math.pi), 8)
    quarter = between(Pose(0, 0, 0), Pose(20, 20, math.pi / 2), 20)

    assert straight.pieces == (Piece(30.0),)
    assert len(quarter.pieces) == 1
    assert tuple(quarter.pieces[0]) == pytest.approx((10 * math.pi, 1 / 20, 1 / 20))


def test_curves_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"needs 50\.000 m to either side"):
        through([Vertex(0, 0), Vertex(40, 0, 50), Vertex(40, 100)])
    with pytest.raises(ValueError, match="too long for a turn"):
        through([Vertex(0, 0), Vertex(400, 0, 50, 200), Vertex(400, 400)])


def test_an_alignment_from_an_arc() -> None:
    """A quarter of a circle ends where geometry says."""
    line = Alignment(Pose(0, 0, 0), (Piece(4 * math.pi, 1 / 8, 1 / 8),))

    assert line.end == pytest.approx((8, 8, math.pi / 2))
