"""The library ``lanelet2`` is the witness of the reader of this package."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.lanelet_files import ROAD, Osm

from maplines_can.maps import Map
from maplines_can.maps.formats.projection import local_cartesian, utm

lanelet2 = pytest.importorskip("support.lanelet2_library", exc_type=ImportError)
UTM = utm(49.0, 8.4)


def assert_same(road_map: Map, witness: Map) -> None:
    """Assert that two maps are the same within 1 um."""
    assert list(road_map.lanes) == list(witness.lanes)
    assert [road.lanes for road in road_map.roads.values()] == [
        road.lanes for road in witness.roads.values()
    ]
    assert road_map.left_hand_traffic == witness.left_hand_traffic
    for lane, other in zip(road_map.lanes.values(), witness.lanes.values(), strict=True):
        assert (lane.linked, lane.type, lane.speed_limit) == (
            other.linked,
            other.type,
            other.speed_limit,
        )
        for line, its in zip(
            (lane.left, lane.right, lane.centre),
            (other.left, other.right, other.centre),
            strict=True,
        ):
            assert line.kind == its.kind
            assert line.points == pytest.approx(its.points, abs=1e-6)


def town(seed: int) -> Osm:
    """Return a file of bent streets of two to four lanes, of ways in any direction."""
    rng = np.random.default_rng(seed)
    osm = Osm()
    kinds = ("line_thin", "road_border", "curbstone", "virtual")
    for street in range(3):
        heading, curvature = rng.uniform(-math.pi, math.pi), rng.uniform(-0.02, 0.02)
        starts = rng.uniform(-500, 500, 2)
        lanes = int(rng.integers(2, 5))
        forward = rng.integers(0, 2, lanes)
        for part in range(2):
            count = int(rng.integers(2, 9))
            s = np.linspace(40.0 * part, 40.0 * (part + 1), count)
            angle = heading + curvature * s
            x = starts[0] + s * np.cos(angle)
            y = starts[1] + s * np.sin(angle)
            last: list[str] = []
            for row in range(lanes + 1):
                off = 3.3 * row
                points = [
                    (round(float(a - off * math.sin(h)), 6), round(float(b + off * math.cos(h)), 6))
                    for a, b, h in zip(x, y, angle, strict=True)
                ]
                turned = points[::-1] if rng.integers(2) else points
                last.append(osm.way(*turned, type=kinds[(street + row) % 4], subtype="solid"))
            for row in range(lanes):
                sides = (last[row + 1], last[row]) if forward[row] else (last[row], last[row + 1])
                osm.lanelet(*sides, ROAD | {"speed_limit": f"{30 + 10 * row} km/h"})
    return osm


@pytest.mark.parametrize("projection", [UTM, local_cartesian(49.001, 8.402, 110.0)])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_maps_are_those_of_the_library(tmp_path: Path, projection: str, seed: int) -> None:
    """Lines within 1 um; types, links and roads are equal."""
    osm = town(seed)
    path = tmp_path / "town.osm"
    path.write_text(osm.text())
    found = osm.map(projection)
    assert len(found.lanes) >= 12
    assert sum(bool(lane.successors) for lane in found.lanes.values()) >= 3
    assert_same(found, lanelet2.read(path, projection))


def test_heights_count_in_a_tangent_plane_only(tmp_path: Path) -> None:
    osm = Osm()
    osm.strip(0.0, 2000.0)
    osm.elements = [
        one.replace("></node>", '><tag k="ele" v="900"/></node>') for one in osm.elements
    ]
    path = tmp_path / "map.osm"
    path.write_text(osm.text())
    for projection in (UTM, local_cartesian(49.0, 8.4)):
        assert_same(osm.map(projection), lanelet2.read(path, projection))


def test_a_map_of_the_southern_hemisphere(tmp_path: Path) -> None:
    """Its y begins 10 000 km south of the equator."""
    osm = Osm()
    osm.strip(0.0, 2000.0)
    osm.elements = [one.replace('lat="49.', 'lat="-33.') for one in osm.elements]
    path = tmp_path / "map.osm"
    path.write_text(osm.text())
    projection = utm(-33.0, 8.4)
    found = osm.map(projection)
    assert_same(found, lanelet2.read(path, projection))
    (one, *_) = found.lanes.values()
    assert 6e6 < one.left.points[0, 1] < 7e6
