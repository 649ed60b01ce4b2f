"""Links between lanes follow the driving directions."""

import pytest
from support.xodr_files import WIDTH, geometry, ids, lane, linked, read_map, reasons, road, section

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


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("", ["1:0:-1 > 1:1:-1", "1:1:1 > 1:0:1"]),
        ('rule="RHT"', ["1:0:-1 > 1:1:-1", "1:1:1 > 1:0:1"]),
        ('rule="LHT"', ["1:0:1 > 1:1:1", "1:1:-1 > 1:0:-1"]),
    ],
)
def test_sections_of_a_road(rule: str, expected: list[str]) -> None:
    """With right-hand traffic, lanes with a negative id are driven along s."""
    assert pairs(read_map(road(two(successor=1), two(50.0), attributes=rule))) == expected
    assert pairs(read_map(road(two(), two(50.0, predecessor=1), attributes=rule))) == expected


def test_a_lane_can_have_several_successors() -> None:
    """Lanes that divide, as since OpenDRIVE 1.6."""
    fork = '<lane id="-1" type="driving"><link><successor id="-1"/><successor id="-2"/></link>'
    found = read_map(road(section(f"{fork}{WIDTH}</lane>"), section(lane(-1), lane(-2), s=50.0)))
    assert pairs(found) == ["1:0:-1 > 1:1:-1", "1:0:-1 > 1:1:-2"]


@pytest.mark.parametrize("contact", ["start", ""])
def test_the_end_of_a_road_at_the_start_of_another(contact: str) -> None:
    """Without a contact point, the links of the other road tell."""
    found = read_map(
        road(two(successor=1), link=linked("successor", "2", contact)),
        road(two(predecessor=1), road_id="2", link=linked("predecessor", "1", "end")),
    )
    assert pairs(found) == ["1:0:-1 > 2:0:-1", "2:0:1 > 1:0:1"]
    assert found.roads["1"].successors == found.roads["1"].predecessors == ("2",)


def test_the_end_of_a_road_at_the_end_of_another() -> None:
    """Lanes change the sign of their ids."""
    found = read_map(
        road(two(successor=-1), link=linked("successor", "2", "end")),
        road(two(), two(60.0, successor=-1), road_id="2", link=linked("successor", "1", "end")),
    )
    assert pairs(found) == ["1:0:-1 > 2:1:1", "2:1:-1 > 1:0:1"]


def test_the_start_of_a_road_at_the_start_of_another() -> None:
    found = read_map(
        road(two(predecessor=-1), link=linked("predecessor", "2", "start")),
        road(two(), road_id="2", link=linked("predecessor", "1", "start")),
    )
    assert pairs(found) == ["1:0:1 > 2:0:-1", "2:0:1 > 1:0:-1"]


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


def test_lane_links_of_a_junction_alone_are_enough() -> None:
    """The connecting road names neither its lanes' neighbours nor its own."""
    found = read_map(
        road(two(), link=linked("successor", "9", "", "junction")),
        road(section(lane(-1)), road_id="5", attributes='junction="9"', plan=geometry(x=100.0)),
        '<junction id="9"><connection id="0" incomingRoad="1" connectingRoad="5" '
        'contactPoint="start"><laneLink from="-1" to="-1"/></connection></junction>',
    )
    assert pairs(found) == ["1:0:-1 > 5:0:-1"]


def test_a_road_with_both_ends_at_one_junction() -> None:
    """The nearer end is taken."""
    both = linked("predecessor", "9", "", "junction") + linked("successor", "9", "", "junction")
    found = read_map(
        road(two(), link=both),
        road(section(lane(-1)), road_id="5", attributes='junction="9"', plan=geometry(x=100.0)),
        road(
            section(lane(-1)),
            road_id="6",
            attributes='junction="9"',
            plan=geometry(heading=3.14159),
        ),
        '<junction id="9">'
        '<connection incomingRoad="1" connectingRoad="5" contactPoint="start">'
        '<laneLink from="-1" to="-1"/></connection>'
        '<connection incomingRoad="1" connectingRoad="6" contactPoint="start">'
        '<laneLink from="1" to="-1"/></connection></junction>',
    )
    assert pairs(found) == ["1:0:-1 > 5:0:-1", "1:0:1 > 6:0:-1"]


def test_a_direct_junction() -> None:
    """A linked road takes the place of the connecting road (OpenDRIVE 1.7)."""
    found = read_map(
        road(two(), link=linked("successor", "9", "", "junction")),
        road(
            section(lane(-1)),
            road_id="2",
            plan=geometry(x=100.0),
            link=linked("predecessor", "9", "", "junction"),
        ),
        '<junction id="9" type="direct"><connection id="0" incomingRoad="1" linkedRoad="2" '
        'contactPoint="start"><laneLink from="-1" to="-1"/></connection></junction>',
    )
    assert pairs(found) == ["1:0:-1 > 2:0:-1"]


def test_links_pass_through_a_section_without_length() -> None:
    """It has no lanes in the map."""
    found = read_map(
        road(two(successor=1), two(50.0, successor=1), two(50.0, successor=1), two(50.0))
    )
    assert pairs(found) == ["1:0:-1 > 1:3:-1", "1:3:1 > 1:0:1"]
    assert ids(found.lanes) == "1:0:-1 1:0:1 1:3:-1 1:3:1"


def test_a_road_that_succeeds_itself() -> None:
    """A ring."""
    link = linked("successor", "1", "start") + linked("predecessor", "1", "end")
    found = read_map(road(two(successor=1, predecessor=1), link=link))
    assert pairs(found) == ["1:0:-1 > 1:0:-1", "1:0:1 > 1:0:1"]


@pytest.mark.parametrize(
    ("elements", "reason"),
    [
        pytest.param(
            [road(two(successor=7), two(50.0))],
            "it names lane 1:1:7, which is not in the map",
            id="no-such-lane",
        ),
        pytest.param(
            [road(two(successor=1), link=linked("successor", "8"))],
            "its link to lane 1 leads to no road",
            id="no-such-road",
        ),
        pytest.param(
            [road(two(successor=1))], "its link to lane 1 leads to no road", id="no-road-link"
        ),
        pytest.param(
            [
                road(),
                '<junction id="9"><connection incomingRoad="1" connectingRoad="7"/></junction>',
            ],
            "it names road '7', which is not in the map",
            id="no-connecting-road",
        ),
        pytest.param(
            [road(), '<junction id="9"><connection connectingRoad="7"/></junction>'],
            "it needs the ids of an incoming and a connecting road",
            id="no-incoming-road",
        ),
        pytest.param(
            [
                road(),
                road(road_id="2", plan=geometry(x=1000.0)),
                '<junction id="9"><connection incomingRoad="1" connectingRoad="2" '
                'contactPoint="start"/></junction>',
            ],
            "no end of road '1' is at the junction",
            id="far-away",
        ),
        pytest.param(
            [road(section(lane(-1, successor=1)), section(lane(1), s=50.0))],
            "it meets lane 1:1:1, which has the opposite driving direction",
            id="head-on",
        ),
        pytest.param(
            [road(section(lane(1, successor=-1)), section(lane(-1), s=50.0))],
            "it meets lane 1:1:-1, which has the opposite driving direction",
            id="back-to-back",
        ),
        pytest.param(
            [road(link='<predecessor elementType="road" elementId="1" elementS="5"/>')],
            "a connection between the ends of a road (virtual junction) is not used",
            id="virtual-junction",
        ),
    ],
)
def test_links_that_lead_nowhere_are_listed(elements: list[str], reason: str) -> None:
    found = read_map(*elements)
    assert reason in reasons(found)
    assert pairs(found) == []


def test_a_section_of_a_single_side_continues_the_other_one() -> None:
    found = read_map(
        road(
            section(lane(1), lane(-1, successor=-1)),
            section(lane(-1), s=50.0, attributes='singleSide="true"'),
        )
    )
    assert pairs(found) == ["1:0:-1 > 1:1:-1", "1:1:1 > 1:0:1"]
    assert found.lanes["1:1:1"].length == pytest.approx(50)


def test_a_junction_may_have_the_id_of_a_road() -> None:
    """A link without a contact point is to the end that is linked with the road, not with it."""
    found = read_map(
        road(two(successor=1), link=linked("successor", "2", "")),
        road(two(), road_id="2", link=linked("successor", "1", "", "junction")),
    )
    assert pairs(found) == ["1:0:-1 > 2:0:-1", "2:0:1 > 1:0:1"]
