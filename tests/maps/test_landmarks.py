"""Landmarks of OpenDRIVE maps: where objects and signals stand."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.xodr_files import geometry, read_map, reasons, road

from maplines_can.maps import LandmarkKind, load, town_path

ARC = geometry('<arc curvature="0.01"/>', length=100.0)


def with_objects(objects: str = "", signals: str = "", plan: str = geometry()) -> Any:
    """Return the map of a road of 100 m with objects and signals."""
    content = f"<objects>{objects}</objects><signals>{signals}</signals>"
    return read_map(road(plan=plan).replace("</road>", f"{content}</road>"))


def pole(attributes: str, content: str = "", kind: str = "pole") -> str:
    return f'<object type="{kind}" {attributes}>{content}</object>'


@pytest.mark.parametrize("kind", ["pole", "tree", "streetLamp"])
def test_a_pole_stands_beside_the_reference_line(kind: str) -> None:
    """At s along it and t to the left of it."""
    (found,) = with_objects(pole('id="7" s="30" t="5"', kind=kind)).landmarks
    assert (found.id, found.kind, found.x, found.y) == ("1:pole:7", LandmarkKind.POLE, 30.0, 5.0)


def test_the_offset_is_normal_to_a_curve() -> None:
    """On the arc of radius 100 m around (0, 100), after a quarter of a rad."""
    (found,) = with_objects(signals='<signal id="a" s="25" t="-4"/>', plan=ARC).landmarks
    assert found.kind is LandmarkKind.SIGN
    assert (found.x, found.y) == pytest.approx((104 * np.sin(0.25), 100 - 104 * np.cos(0.25)))


def test_a_row_ends_with_the_road() -> None:
    repeat = '<repeat s="10" length="1e9" distance="40" tStart="4" tEnd="4"/>'
    assert [one.x for one in with_objects(pole('id="1"', repeat)).landmarks] == [10, 50, 90]


@pytest.mark.parametrize("kind", ["building", "parkingSpace", "none", ""])
def test_other_objects_are_no_landmarks(kind: str) -> None:
    assert with_objects(pole('id="1" s="0" t="0"', kind=kind)).landmarks == ()


@pytest.mark.parametrize(
    ("attributes", "content", "why"),
    [
        ('id="1" t="0"', "", "s is missing"),
        ('id="1" s="5"', "", "t is missing"),
        ('s="5" t="0"', "", "needs an id"),
        ('id="1" s="100.1" t="0"', "", "s must be from"),
        ('id="1" s="-1" t="0"', "", "s must be from"),
        ('id="1" s="nan" t="0"', "", "finite"),
        ('id="1"', '<repeat s="0" length="9" distance="0" tStart="1"/>', "more than 0"),
        ('id="1"', '<repeat s="0" length="99" distance="1e-6" tStart="1"/>', "more than 10000"),
        ('id="1"', '<repeat s="0" length="-1" distance="1" tStart="1"/>', "length"),
    ],
)
def test_a_bad_object_is_skipped(attributes: str, content: str, why: str) -> None:
    """With a reason; the road and the other objects are used."""
    found = with_objects(pole(attributes, content) + pole('id="good" s="1" t="1"'))
    assert [one.id for one in found.landmarks] == ["1:pole:good"]
    assert len(found.lanes) == 2
    (reason,) = reasons(found)
    assert why in reason


def test_the_town_has_landmarks_beside_its_streets() -> None:
    """None stands on a lane; all are near one."""
    town = load(town_path())
    places = np.array([(one.x, one.y) for one in town.landmarks])
    assert len({one.id for one in town.landmarks}) == len(places) == 300
    lanes = [lane for lane in town.lanes.values() if lane.type.is_drivable]
    centres = np.vstack([lane.centre.resampled(0.5).points for lane in lanes])
    width = np.concatenate(
        [np.full(len(lane.centre.resampled(0.5).points), lane.width) for lane in lanes]
    )
    distance, nearest = cKDTree(centres).query(places)
    assert (distance > width[nearest] / 2 + 0.4).all()
    assert distance.max() < 15


def building(attributes: str, content: str = "") -> str:
    return f'<object type="building" {attributes}>{content}</object>'


def test_a_building_is_a_rectangle() -> None:
    """Its length is along the road, turned by its heading, and its outline is closed."""
    found = with_objects(building('id="1" s="30" t="10" length="12" width="8" hdg="0"'))
    (outline,) = found.buildings
    assert sorted(map(tuple, outline.points[:4])) == [(24, 6), (24, 14), (36, 6), (36, 14)]
    assert (outline.points[0] == outline.points[-1]).all()
    (turned,) = with_objects(
        building(f'id="1" s="30" t="10" length="12" width="8" hdg="{np.pi / 2}"')
    ).buildings
    corners = sorted(map(tuple, turned.points[:4].round(9)))
    assert corners == [(26, 4), (26, 16), (34, 4), (34, 16)]


def test_a_building_without_a_size_is_skipped() -> None:
    found = with_objects(building('id="1" s="30" t="10"'))
    assert found.buildings == ()
    assert "length is missing" in reasons(found)[0]


@pytest.mark.parametrize(("s", "is_used"), [(-0.9e-6, True), (-1.1e-6, False), (100 + 0.9e-6, True),
                                            (100 + 1.1e-6, False)])  # fmt: skip
def test_a_landmark_stands_along_its_road(s: float, is_used: bool) -> None:
    """Up to a micrometre beyond its ends."""
    found = with_objects(pole(f'id="1" s="{s!r}" t="0"'))
    assert bool(found.landmarks) is is_used
    assert bool(reasons(found)) is not is_used
