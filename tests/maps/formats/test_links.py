"""Links between lanes follow the driving directions."""

from typing import Any

import pytest
from support.xodr_files import WIDTH, geometry, lane, linked, read_map, reasons, road, section

from maplines_can.maps import Map


def pairs(road_map: Map) -> list[str]:
    """Return "lane > successor" of all lanes; predecessors must be the same the other way round."""
    forth = {(one.id, other) for one in road_map.lanes.values() for other in one.successors}
    back = {(other, one.id) for one in road_map.lanes.values() for other in one.predecessors}
    assert forth == back
    return sorted(f"{one} > {other}" for one, other in forth)


def two(s: float = 0.0, *, successor: int | None = None, predecessor: int | None = None) -> str:
    """Return a section with the lanes 1 and -1, each linked to its like."""
    return section(
        *(
            lane(
                side,
                successor=side * successor if successor else None,
                predecessor=side * predecessor if predecessor else None,
            )
            for side in (1, -1)
        ),
        s=s,
    )


FORK = (
    '<lane id="-1" type="driving"><link><successor id="-1"/><successor id="-2"/></link>'
    f"{WIDTH}</lane>"
)
ONE = section(lane(-1))
INTO = linked("successor", "9", "", "junction")
OUT_OF = linked("predecessor", "9", "", "junction")
INSIDE: dict[str, Any] = {"road_id": "5", "attributes": 'junction="9"'}


def connection(to: str, lane_id: int = -1, tag: str = "connectingRoad") -> str:
    """Return a connection from the road 1 to the lane -1 of another one."""
    return (
        f'<connection incomingRoad="1" {tag}="{to}" contactPoint="start">'
        f'<laneLink from="{lane_id}" to="-1"/></connection>'
    )


LINKS = {
    "right-hand-traffic": ([road(two(successor=1), two(50.0))], "1:0:-1 > 1:1:-1, 1:1:1 > 1:0:1"),
    "left-hand-traffic": (
        [road(two(), two(50.0, predecessor=1), attributes='rule="LHT"')],
        "1:0:1 > 1:1:1, 1:1:-1 > 1:0:-1",
    ),
    # Lanes that divide, as since OpenDRIVE 1.6.
    "fork": (
        [road(section(FORK), section(lane(-1), lane(-2), s=50.0))],
        "1:0:-1 > 1:1:-1, 1:0:-1 > 1:1:-2",
    ),
    "end-at-start": (
        [
            road(two(successor=1), link=linked("successor", "2")),
            road(two(predecessor=1), road_id="2", link=linked("predecessor", "1", "end")),
        ],
        "1:0:-1 > 2:0:-1, 2:0:1 > 1:0:1",
    ),
    # The links of the other road tell.
    "no-contact-point": (
        [
            road(two(successor=1), link=linked("successor", "2", "")),
            road(two(predecessor=1), road_id="2", link=linked("predecessor", "1", "end")),
        ],
        "1:0:-1 > 2:0:-1, 2:0:1 > 1:0:1",
    ),
    # Lanes change the sign of their ids.
    "end-at-end": (
        [
            road(two(successor=-1), link=linked("successor", "2", "end")),
            road(two(), two(60.0, successor=-1), road_id="2", link=linked("successor", "1", "end")),
        ],
        "1:0:-1 > 2:1:1, 2:1:-1 > 1:0:1",
    ),
    "start-at-start": (
        [
            road(two(predecessor=-1), link=linked("predecessor", "2", "start")),
            road(two(), road_id="2", link=linked("predecessor", "1", "start")),
        ],
        "1:0:1 > 2:0:-1, 2:0:1 > 1:0:-1",
    ),
    # The connecting road names neither its lanes' neighbours nor its own.
    "lane-links-of-a-junction": (
        [
            road(two(), link=INTO),
            road(ONE, plan=geometry(x=100.0), **INSIDE),
            f'<junction id="9">{connection("5")}</junction>',
        ],
        "1:0:-1 > 5:0:-1",
    ),
    # The nearer end is taken.
    "both-ends-at-one-junction": (
        [
            road(two(), link=OUT_OF + INTO),
            road(ONE, plan=geometry(x=100.0), **INSIDE),
            road(ONE, plan=geometry(heading=3.14159), **INSIDE | {"road_id": "6"}),
            f'<junction id="9">{connection("5")}{connection("6", 1)}</junction>',
        ],
        "1:0:-1 > 5:0:-1, 1:0:1 > 6:0:-1",
    ),
    # A linked road takes the place of the connecting road (OpenDRIVE 1.7).
    "direct-junction": (
        [
            road(two(), link=INTO),
            road(ONE, road_id="2", plan=geometry(x=100.0), link=OUT_OF),
            f'<junction id="9" type="direct">{connection("2", tag="linkedRoad")}</junction>',
        ],
        "1:0:-1 > 2:0:-1",
    ),
    # It has no lanes in the map.
    "section-without-length": (
        [road(two(successor=1), two(50.0, successor=1), two(50.0, successor=1), two(50.0))],
        "1:0:-1 > 1:3:-1, 1:3:1 > 1:0:1",
    ),
    "ring": (
        [
            road(
                two(successor=1, predecessor=1),
                link=linked("successor", "1", "start") + linked("predecessor", "1", "end"),
            )
        ],
        "1:0:-1 > 1:0:-1, 1:0:1 > 1:0:1",
    ),
    # The other side is continued.
    "section-of-a-single-side": (
        [
            road(
                section(lane(1), lane(-1, successor=-1)),
                section(lane(-1), s=50.0, attributes='singleSide="true"'),
            )
        ],
        "1:0:-1 > 1:1:-1, 1:1:1 > 1:0:1",
    ),
    # A link without a contact point is to the end that is linked with the road, not with it.
    "junction-with-the-id-of-a-road": (
        [
            road(two(successor=1), link=linked("successor", "2", "")),
            road(two(), road_id="2", link=linked("successor", "1", "", "junction")),
        ],
        "1:0:-1 > 2:0:-1, 2:0:1 > 1:0:1",
    ),
}


@pytest.mark.parametrize("name", LINKS)
def test_links(name: str) -> None:
    """As pairs of a lane and its successor, both as driven."""
    elements, expected = LINKS[name]
    found = read_map(*elements)
    assert pairs(found) == expected.split(", ")
    if name == "end-at-start":
        assert found.roads["1"].successors == found.roads["1"].predecessors == ("2",)


def crossing(contact: str = 'contactPoint="start"', junction: str = "") -> Map:
    """Return the road 1, which ends in a junction, and the roads 2 and 3 after it."""
    connection = (
        f'<connection id="0" incomingRoad="1" connectingRoad="5" {contact}>'
        '<laneLink from="-1" to="-1"/></connection>'
    )
    inside = 'junction="9"'
    return read_map(
        road(two(), link=linked("successor", "9", "", "junction")),
        road(two(), road_id="2", link=linked("predecessor", "9", "", "junction")),
        road(
            section(lane(-1, successor=-1, predecessor=-1)),
            road_id="5",
            attributes=inside,
            link=linked("predecessor", "1", "end") + linked("successor", "2", "start"),
        ),
        junction or f'<junction id="9">{connection}</junction>',
    )


@pytest.mark.parametrize("contact", ['contactPoint="start"', ""])
def test_a_junction(contact: str) -> None:
    found = crossing(contact)
    assert not found.skipped
    assert pairs(found) == ["1:0:-1 > 5:0:-1", "5:0:-1 > 2:0:-1"]
    assert found.lanes["5:0:-1"].junction == found.roads["5"].junction == "9"
    assert found.lanes["1:0:-1"].junction is None


@pytest.mark.parametrize(
    ("elements", "reason"),
    [
        ([road(two(successor=7), two(50.0))], "it names lane 1:1:7, which is not in the map"),
        (
            [road(two(successor=1), link=linked("successor", "8"))],
            "its link to lane 1 leads to no road",
        ),
        ([road(two(successor=1))], "its link to lane 1 leads to no road"),
        (
            [
                road(),
                '<junction id="9"><connection incomingRoad="1" connectingRoad="7"/></junction>',
            ],
            "it names road '7', which is not in the map",
        ),
        (
            [road(), '<junction id="9"><connection connectingRoad="7"/></junction>'],
            "it needs the ids of an incoming and a connecting road",
        ),
        (
            [
                road(),
                road(road_id="2", plan=geometry(x=1000.0)),
                '<junction id="9"><connection incomingRoad="1" connectingRoad="2" '
                'contactPoint="start"/></junction>',
            ],
            "no end of road '1' is at the junction",
        ),
        (
            [road(section(lane(-1, successor=1)), section(lane(1), s=50.0))],
            "it meets lane 1:1:1, which has the opposite driving direction",
        ),
        (
            [road(section(lane(1, successor=-1)), section(lane(-1), s=50.0))],
            "it meets lane 1:1:-1, which has the opposite driving direction",
        ),
        (
            [road(link='<predecessor elementType="road" elementId="1" elementS="5"/>')],
            "a connection between the ends of a road (virtual junction) is not used",
        ),
    ],
)
def test_links_that_lead_nowhere_are_listed(elements: list[str], reason: str) -> None:
    found = read_map(*elements)
    assert reason in reasons(found)
    assert pairs(found) == []
