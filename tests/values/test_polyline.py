"""The points of a map line."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from maplines_can.values.line import Kind
from maplines_can.values.polyline import Polyline, to_ego, to_map

STRAIGHT = Polyline([[x, 0.0] for x in range(101)])


@given(arrays(float, (5, 2), elements=st.floats(-100, 100, width=16)), st.floats(0.5, 300))
def test_resampled_points_are_evenly_spaced_on_the_line(points: Any, spacing: float) -> None:
    """The ends stay, the points are at most the spacing apart, and all of them are on the line."""
    line = Polyline(points)
    fine = line.resampled(spacing)
    count = max(1, np.ceil(line.length / spacing))
    s = np.linspace(0, line.length, int(count) + 1)

    assert np.allclose(fine.points[[0, -1]], points[[0, -1]], atol=1e-9)
    assert len(fine.points) == len(s)
    assert (np.hypot(*np.diff(fine.points, axis=0).T) <= spacing * (1 + 1e-9)).all()
    for p, distance in zip(fine.points, s, strict=True):
        i = min(np.searchsorted(line.distance, distance, side="right") - 1, len(points) - 2)
        step = line.distance[i + 1] - line.distance[i]
        share = (distance - line.distance[i]) / step if step else 0.0
        assert np.allclose(p, points[i] + share * (points[i + 1] - points[i]), atol=1e-9)


@pytest.mark.parametrize(
    ("east", "accepted"),
    [pytest.param(1.6e4, True, id="16-km"), pytest.param(3.3e4, False, id="33-km")],
)
def test_item_6_single_precision_is_refused_where_it_loses_a_millimetre(
    east: float, accepted: bool
) -> None:
    """Its spacing is 2 mm from 16384 m on: half of that is the rounding error."""
    points = np.array([[east, 0], [east + 10, 1]], dtype=np.float32)
    if accepted:
        assert Polyline(points).points.dtype == np.float64
    else:
        with pytest.raises(
            ValueError, match=r"float32 rounds coordinates of 33010 m by up to 0.002"
        ):
            Polyline(points)
    assert Polyline(points.astype(float)).length > 10


@given(arrays(float, (6, 2), elements=st.floats(-100, 100)), st.floats(-np.pi, np.pi))
def test_the_ego_frame_is_rotated_by_the_heading(points: Any, heading: float) -> None:
    """In complex numbers: (z - pose) e^(-i heading)."""
    z = (points @ [1, 1j] - (3 - 4j)) * np.exp(-1j * heading)

    assert np.allclose(to_ego(points, [3, -4, heading]) @ [1, 1j], z, atol=1e-12)


@given(arrays(float, (6, 2), elements=st.floats(-100, 100)), st.floats(-np.pi, np.pi))
def test_to_map_is_the_inverse_of_to_ego(points: Any, heading: float) -> None:
    """Up to rounding."""
    pose = [3.0, -4.0, heading]

    assert np.allclose(to_map(to_ego(points, pose), pose), points, atol=1e-12)


def test_the_kinds_of_a_line_that_changes() -> None:
    """One of them is that of the greatest length; others apply from where they begin."""
    line = Polyline([[0, 0], [4, 0], [9, 0]], [(0, Kind.DASHED), (2, Kind.DASHED), (3, Kind.SOLID)])
    assert line.kinds == ((0.0, Kind.DASHED), (3.0, Kind.SOLID))
    assert line.kind is Kind.SOLID
    assert [line.kind_at(s) for s in (-1.0, 2.9, 3.0, 99.0)] == [
        *(Kind.DASHED, Kind.DASHED, Kind.SOLID, Kind.SOLID)
    ]
    parts = [(part.kind, part.points[:, 0].tolist()) for part in line.parts()]
    assert parts == [(Kind.DASHED, [0, 3]), (Kind.SOLID, [3, 4, 9])]
    assert Polyline([[0, 0], [9, 0]], [(0, Kind.KERB)]).kinds == ()
    (whole,) = STRAIGHT.parts()
    assert whole is STRAIGHT
    assert STRAIGHT.kind_at(50.0) is Kind.UNKNOWN


def test_a_resampled_line_keeps_its_kinds_where_they_are() -> None:
    """Also where it cuts a corner, and so is shorter."""
    line = Polyline([[0, 0], [10, 0], [10, 10]], [(0, Kind.DASHED), (10, Kind.SOLID)])
    found = line.resampled(20.0)
    assert found.length == pytest.approx(np.sqrt(200))
    assert [kind for _, kind in found.kinds] == [Kind.DASHED, Kind.SOLID]
    assert [s for s, _ in found.kinds] == pytest.approx([0, np.sqrt(50)])


@pytest.mark.parametrize(
    "kinds",
    [
        pytest.param([], id="none"),
        pytest.param([(1, Kind.SOLID)], id="not-from-the-start"),
        pytest.param([(0, Kind.SOLID), (0, Kind.DASHED)], id="twice"),
        pytest.param([(0, Kind.SOLID), (5, Kind.KERB), (4, Kind.DASHED)], id="not-in-order"),
        pytest.param([(0, Kind.SOLID), (9, Kind.DASHED)], id="at-the-end"),
        pytest.param([(0, Kind.SOLID), (np.nan, Kind.DASHED)], id="nan"),
    ],
)
def test_kinds_without_an_order_are_refused(kinds: Any) -> None:
    with pytest.raises(ValueError, match="increasing s from 0 to less than the length of 9 m"):
        Polyline([[0, 0], [9, 0]], kinds)


def test_a_polyline_copies_its_points_and_makes_them_read_only() -> None:
    """Validated points cannot be changed."""
    points = np.zeros((2, 2))
    line = Polyline(points)
    points[0, 0] = np.nan

    assert np.isfinite(line.points).all()
    with pytest.raises(ValueError, match="read-only"):
        line.points[0, 0] = 1
