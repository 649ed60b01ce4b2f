"""Lanelets in any shape and point order, against the road that they are sampled from."""

import io
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.lane_maps import WIDTH, arc, lane
from support.lanelet_files import Osm

from maplines_can.maps.formats.lanelet_tags import Side
from maplines_can.maps.formats.lanelets import Lanelet, boundary, centre_line, lanelet_map, linked
from maplines_can.maps.formats.osm import aligned
from maplines_can.maps.formats.osm import read as read_osm
from maplines_can.maps.formats.points import read as read_points
from maplines_can.values.errors import MapFileError
from maplines_can.values.line import Kind
from maplines_can.values.polyline import Polyline


def road(curvatures: Any, places: Any, t: float, step: float = 12.0) -> Any:
    """Points of a line at an offset from a road of arcs, at shares of its length."""
    points, start = [], (3.0, -7.0, 0.4)
    for curvature in curvatures:
        part = arc(start, step, curvature, np.full(121, t))
        points.append(part)
        x, y = arc(start, step, curvature, np.zeros(2))[-1]
        start = (x, y, start[2] + curvature * step)
    dense = np.vstack(points)
    at = np.clip(np.asarray(places) * (len(dense) - 1), 0, len(dense) - 1)
    return np.column_stack([np.interp(at, np.arange(len(dense)), v) for v in dense.T])


@given(
    st.lists(st.integers(-90, 90), min_size=1, max_size=4),
    st.integers(2, 12),
    st.integers(2, 12),
    st.booleans(),
    st.booleans(),
    st.booleans(),
)
def test_boundaries_are_turned_into_the_driving_direction(
    curvatures: Any, n: int, m: int, flip_left: bool, flip_right: bool, mirrored: bool
) -> None:
    """Whatever the order of their points: the left one is on the left of the right one."""
    curvatures = np.array(curvatures) / 1000
    n, m = max(n, 2 * len(curvatures)), max(m, 2 * len(curvatures))
    sides = [
        road(curvatures, np.linspace(0, 1, count), t)
        for count, t in ((n, WIDTH / 2), (m, -WIDTH / 2))
    ]
    if mirrored:  # driven the other way
        sides = [side[::-1] for side in sides[::-1]]
    given_ = [
        Side(tuple(map(str, range(len(points)))), points, {})
        for points in (
            sides[0][::-1] if flip_left else sides[0],
            sides[1][::-1] if flip_right else sides[1],
        )
    ]
    for side, expected, is_flipped in zip(
        aligned(*given_), sides, (flip_left, flip_right), strict=True
    ):
        assert np.array_equal(side.points, expected)
        nodes = [*map(str, range(len(expected)))]
        assert [*side.nodes] == (nodes[::-1] if is_flipped else nodes)


@given(
    st.lists(st.integers(-60, 60), min_size=1, max_size=3),
    st.integers(8, 40),
    st.integers(8, 40),
    st.integers(0, 2**32),
)
def test_the_centre_is_as_far_from_both_boundaries(
    curvatures: Any, n: int, m: int, seed: int
) -> None:
    """Of roads whose boundaries have points at any places, to the sagitta of their steps."""
    curvatures, rng = np.array(curvatures) / 1000, np.random.default_rng(seed)

    def places(count: int) -> Any:
        inside = (np.arange(1, count - 1) + rng.uniform(-0.3, 0.3, count - 2)) / (count - 1)
        return np.array([0.0, *inside, 1.0])

    shared = places(n)
    left = Polyline(road(curvatures, shared, WIDTH / 2))
    right = Polyline(road(curvatures, shared if m == n else places(m), -WIDTH / 2))
    centre = centre_line(left, right)
    dense = road(curvatures, np.linspace(0, 1, 4001), 0.0)
    away = np.hypot(*(centre.points[:, None] - dense).transpose(2, 0, 1)).min(axis=1)
    longest = 12.0 * len(curvatures) * 1.6 / (min(n, m) - 1)
    bend = np.abs(curvatures).max() / (1 - np.abs(curvatures).max() * WIDTH / 2)
    assert (
        away.max()
        <= longest**2 * bend / 8 + 0.12 * longest * np.ptp(np.append(0.0, curvatures)) + 0.02
    )
    assert np.hypot(*(centre.points[0] - dense[0])) < 1e-6
    assert np.hypot(*(centre.points[-1] - dense[-1])) < 1e-6


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_repeated_points_are_left_out(turn: int) -> None:
    """Those nearer than a micrometre to the one before, in each direction of the plane."""
    d = np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])[turn]
    points = np.array([0.0, 1e-6, 5.0, 5.0 + 1.1e-6, 9.0])[:, None] * d
    assert np.array_equal(boundary(points).points, points[[0, 2, 3, 4]])
    for far in (1e8, 1.0001e8):
        if far > 1e8:
            with pytest.raises(ValueError, match="at most 1e"):
                boundary(np.array([[0.0, 0.0], d * far]))
        else:
            assert boundary(np.array([[0.0, 0.0], d * far])).length == far


def lanelet(name: str, left: str, right: str, **rest: Any) -> Lanelet:
    """A lane with named points; the places of the points follow from their names."""
    at = {
        c: np.array([10.0 * int(c[1]), 3.5 * "abcde".index(c[0])])
        for c in f"{left} {right}".split()
    }
    ids = tuple(left.split()), tuple(right.split())
    lines = [Polyline(np.array([at[c] for c in side])) for side in ids]
    centre = centre_line(*lines)
    base = lane(name)
    return Lanelet(
        replace(base, left=lines[0], right=lines[1], centre=centre, road="", **rest), *ids
    )


@pytest.mark.parametrize("turned", [False, True])
def test_the_side_of_oncoming_traffic(turned: bool) -> None:
    """Two lanes have their left boundaries in common, or their right ones in left-hand traffic.

    Turned, both are driven in the other direction.
    """
    for ids, left_hand in (
        (("b0 b1 b2", "a0 a1 a2", "b2 b1 b0", "c2 c1 c0"), False),
        (("c0 c1 c2", "b0 b1 b2", "a2 a1 a0", "b2 b1 b0"), True),
    ):
        sides = [" ".join(side.split()[::-1]) for side in (*ids[1::-1], *ids[:1:-1])]
        one, other, third, fourth = sides if turned else ids
        found = lanelet_map(linked([lanelet("1", one, other), lanelet("2", third, fourth)]), "test")
        assert found.lanes["1"].opposite_left == "2"
        assert found.lanes["2"].opposite_left == "1"
        assert found.left_hand_traffic is (left_hand is not turned)


@given(st.floats(-80, 80), st.floats(0.5, 179.9), st.booleans())
def test_a_geojson_map_is_around_its_middle(latitude: float, longitude: float, both: bool) -> None:
    """The middle of all of its positions is at 0, also across the 180th meridian."""
    d, around = 0.01, -360 * both
    lines = [[[longitude - d, latitude - d], [longitude, latitude]]]
    lines.append([[longitude + d + around, latitude + d], [longitude + d, latitude]])
    features = [
        {"type": "Feature", "id": str(i), "properties": {"kind": "solid"},
         "geometry": {"type": "LineString", "coordinates": line}}
        for i, line in enumerate(lines)
    ]  # fmt: skip
    text = json.dumps({"type": "FeatureCollection", "features": features})
    found = read_points(io.BytesIO(text.encode()), "x.geojson")
    assert found.polylines["0"].kind == Kind.SOLID
    assert found.polylines["0"].points[-1] == pytest.approx([0.0, 0.0], abs=0.1)
    metre = np.radians(d) * 6.37e6
    corner = found.polylines["0"].points[0]
    expected = [-metre * np.cos(np.radians(latitude)), -metre]
    assert corner == pytest.approx(expected, rel=0.01, abs=2.0)
    if not both:
        assert found.polylines["1"].points[0] == pytest.approx(-corner, rel=0.01, abs=2.0)


@pytest.mark.parametrize("parts", [1, 2])
def test_a_side_of_a_lane_is_one_line(parts: int) -> None:
    """A feature of several lines is none; without a lane, each of them is a line."""
    lines = [[[0.001 * k, 0.0], [0.001 * (k + 1), 0.0]] for k in range(parts)]
    for lane_name in ("a", None):
        feature = {
            "type": "Feature", "properties": {"lane": lane_name, "side": "left"},
            "geometry": {"type": "MultiLineString", "coordinates": lines},
        }  # fmt: skip
        other = {
            "type": "Feature", "properties": {"lane": "a", "side": "right"},
            "geometry": {"type": "LineString", "coordinates": [[0.0, -3e-5], [0.001, -3e-5]]},
        }  # fmt: skip
        text = json.dumps({"type": "FeatureCollection", "features": [feature, other, feature]})
        if lane_name and parts == 1:
            found = read_points(io.BytesIO(text.encode()), "x.geojson")
            assert [*found.lanes] == ["a"]
        elif lane_name:
            with pytest.raises(MapFileError, match="a side of a lane must be one LineString"):
                read_points(io.BytesIO(text.encode()), "x.geojson")
        else:
            found = read_points(io.BytesIO(text.encode()), "x.geojson")
            assert len(found.polylines) == 2 * parts


@pytest.mark.parametrize(
    ("longitude", "zone"),
    [(179.8, 60), (-179.8, 1), (173.9, 59), (-173.9, 2), (-0.1, 30), (0.1, 31)],
)
def test_the_zone_of_a_map_is_that_of_its_middle(longitude: float, zone: int) -> None:
    """On both sides of the 180th meridian, and of the zero one."""
    osm = Osm(origin=(10.0, longitude))
    osm.strip(-50.0, 50.0)
    found = read_osm(io.BytesIO(osm.text().encode()), "map.osm")
    assert f"+zone={zone} " in str(found.projection)
