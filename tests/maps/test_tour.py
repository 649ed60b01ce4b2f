"""Long routes chosen at random, and routes through lanes in between."""

import math
from itertools import pairwise

import pytest
from support.lane_maps import WIDTH, crossing, lane, network

from maplines_can.maps import Map, random_tour
from maplines_can.values.errors import RouteError


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


def beside(lengths: tuple[float, ...], *, exit_of: str = "", entry: float = 0.0) -> Map:
    """Return sections "a", "b" ... of two lanes, 1 on the left, and an exit of one of the lanes.

    Args:
        lengths: of the sections [m].
        exit_of: lane that leads to "exit".
        entry: length of a lane "in" before the first section on the left [m]; 0 for none.
    """
    names, x, lanes = "abcdef"[: len(lengths)], 0.0, []
    links = {f"{one}{i}": f"{other}{i}" for one, other in pairwise(names) for i in (1, 2)}
    for name, length in zip(names, lengths, strict=True):
        lanes += [lane(f"{name}{i}", (x, 0.0, 0.0), length, t=-i * WIDTH) for i in (1, 2)]
        x += length
    if exit_of:
        lanes.append(lane("exit", (x, -2 * WIDTH, 0.0), 400.0, curvature=-0.01))
        links[exit_of] = "exit"
    if entry:
        lanes.append(lane("in", (-entry, -WIDTH, 0.0), entry))
        links["in"] = "a1"
    return network(*lanes, links=links, rows=[f"{name}1 {name}2" for name in names])


@pytest.mark.parametrize("lengths", [(60.0,), (1500.0,), (200.0, 300.0, 5.0, 200.0)])
@pytest.mark.parametrize("seed", range(4))
def test_a_lane_change_is_no_progress(lengths: tuple[float, ...], seed: int) -> None:
    """On lanes beside each other that lead nowhere else, the car stays in its lane to the end."""
    tour = random_tour(beside(lengths), 2000.0, seed)
    assert tour.changes == ()
    assert tour.length == pytest.approx(sum(lengths))


@pytest.mark.parametrize("seed", range(4))
def test_a_tour_changes_lanes_to_what_only_another_lane_leads_to(seed: int) -> None:
    """Once, and where there is room."""
    found = beside((20.0, 200.0, 20.0), exit_of="c2", entry=50.0)
    tour = random_tour(found, 2000.0, seed)
    assert (tour.lanes[0], tour.lanes[-1]) == ("in", "exit")
    (change,) = tour.changes
    assert (change.origin, change.target) == ("b1", "b2")
    assert change.end - change.start == pytest.approx(60.0)


def test_a_tour_changes_no_lane_without_room() -> None:
    """Nor two of them where there is room for one."""
    short = beside((20.0, 25.0), exit_of="b2", entry=500.0)
    assert short.route("in", "exit").changes
    assert random_tour(short, 2000.0).changes == ()
    three = [lane(f"a{i}", length=40.0, t=-i * WIDTH) for i in (1, 2, 3)]
    after = lane("exit", (40.0, -3 * WIDTH, 0.0), 900.0)
    before = lane("in", (-900.0, -WIDTH, 0.0), 900.0)
    found = network(*(*three, after, before), links={"a3": "exit", "in": "a1"}, rows=["a1 a2 a3"])
    assert len(found.route("in", "exit").changes) == 2
    assert random_tour(found, 2000.0).length == pytest.approx(940.0, abs=0.5)


def test_a_tour_goes_round_a_road_that_is_its_own_successor() -> None:
    circle = lane("circle", length=199.99, curvature=2 * math.pi / 200)
    tour = random_tour(network(circle, links={"circle": "circle"}), 1000.0)
    assert 1000.0 <= tour.length < 1201.0
    assert set(tour.lanes) == {"circle"}


def test_a_tour_crosses_no_gap_between_lanes() -> None:
    """A link to a lane elsewhere is an error of the map, which no car can follow."""
    lanes = [lane("a"), lane("b", (200.9, 0.0, 0.0)), lane("c", (402.4, 0.0, 0.0))]
    tour = random_tour(network(*lanes, links={"a": "b", "b": "c"}), 2000.0)
    assert tour.lanes == ("a", "b")
