"""Long routes chosen at random, and routes through lanes in between."""

import pytest
from lane_maps import crossing, lane, network, roundabout

from maplines_can.maps import Map, random_tour
from maplines_can.values.errors import RouteError

RING = roundabout()


def test_a_route_leads_through_the_lanes_in_between() -> None:
    """Once around the ring, and as long as its legs."""
    route = RING.route("ring0", "ring1", via=["ring3"])
    assert route.lanes == ("ring0", "ring1", "ring2", "ring3", "ring0", "ring1")
    legs = [RING.route("ring0", "ring3"), RING.route("ring3", "ring1")]
    shared = RING.lanes["ring3"].length
    assert route.length == pytest.approx(sum(leg.length for leg in legs) - shared, abs=0.01)


def test_a_lane_in_between_may_be_that_of_an_end() -> None:
    assert RING.route("ring0", "ring0", via=["ring0"]).lanes == ("ring0",)
    assert RING.route("ring0", "ring0", via=["ring1"]).lanes == (
        *("ring0", "ring1", "ring2", "ring3", "ring0"),
    )


def test_an_unknown_lane_in_between_is_refused() -> None:
    with pytest.raises(RouteError, match="'nowhere' is not in the map"):
        RING.route("ring0", "ring1", via=["nowhere"])


@pytest.mark.parametrize("seed", range(5))
def test_a_tour_is_long_where_the_map_permits_it(seed: int) -> None:
    """Many times around the ring; each lane continues the one before."""
    tour = random_tour(RING, 2000.0, seed)
    assert tour.length >= 2000.0 or tour.lanes[-1].startswith("out")
    for one, following in zip(tour.lanes, tour.lanes[1:], strict=False):
        assert following in RING.lanes[one].successors


def test_a_tour_ends_where_the_map_does() -> None:
    """On a crossing without a way back, it is one way across at most; the seed decides which."""
    found = crossing()
    tours = {random_tour(found, 2000.0, seed).lanes for seed in range(6)}
    assert all(1 <= len(lanes) <= 3 for lanes in tours)
    assert len(tours) > 1
    assert random_tour(found, 2000.0, 4).lanes == random_tour(found, 2000.0, 4).lanes


def test_a_map_of_one_lane_has_a_tour() -> None:
    found = network(lane("only"))
    assert random_tour(found).lanes == ("only",)
    with pytest.raises(RouteError, match="no lane to drive on"):
        random_tour(Map({}, {}))
