"""The map of the package: what it contains, that its lines are continuous, and its tour."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.lane_maps import crossing

from maplines_can import Slot
from maplines_can.maps import LaneTracker, Map, link_gaps, load, town_path, town_tour
from maplines_can.maps.joints import gap
from maplines_can.simulation.trajectory import SimulatedDrive
from maplines_can.values.errors import RouteError

ROOT = Path(__file__).resolve().parents[2]
#: Lanes that end: the acceleration lane, and the third lane of the motorway.
ENDING = {"3:0:-4", "4:2:-4"}


@pytest.fixture(scope="module")
def town() -> Map:
    return load(town_path())


def test_the_map_is_up_to_date() -> None:
    """The file is what the generator writes."""
    check = [sys.executable, str(ROOT / "tools" / "make_town.py"), "--check"]
    done = subprocess.run(check, capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stdout + done.stderr


def test_everything_in_the_file_is_used(town: Map) -> None:
    assert town.skipped == ()
    assert list(link_gaps(town.lanes)) == []
    assert town.projection is not None


def test_lines_are_continuous_to_1_mm(town: Map) -> None:
    """Both boundaries and the centre line, at each of the links between drivable lanes."""
    gaps = [
        gap(getattr(lane, side), getattr(town.lanes[other], side))
        for lane in town.lanes.values()
        for other in lane.successors
        for side in ("left", "right", "centre")
    ]

    assert len(gaps) > 400
    assert max(gaps) < 1e-3


def test_every_drivable_lane_of_the_town_can_be_reached(town: Map) -> None:
    """From each street to each other one; the motorway only in the direction of its ramps."""
    streets = [f"{road}:0:{side}" for road in range(11, 17) for side in (1, -1)]
    for goal in [*streets, "5:0:-1", "6:0:-1", "430:0:-1", *ENDING]:
        for start in streets:
            assert town.route(start, goal).lanes[-1] == goal


def test_a_tour_returns_after_more_than_10_km(town: Map) -> None:
    """It passes both ramps, the lane that ends, the roundabout and each street."""
    tour = town_tour(town)
    roads = {town.lanes[key].road for key in tour.lanes}

    assert tour.length > 10_000
    assert np.hypot(*(tour.line.points[0] - tour.line.points[-1])) < 1e-3
    assert {"1", "3", "4", "5", "6", "11", "12", "13", "14", "15", "16", "30"} <= roads
    assert set(tour.lanes) >= ENDING
    assert [(one.origin, one.target) for one in tour.changes] == [
        ("3:0:-4", "3:0:-3"), ("4:1:-3", "4:1:-4"), ("4:2:-4", "4:2:-3"), ("1:1:-3", "1:1:-4"),
    ]  # fmt: skip


def test_a_tour_of_several_rounds(town: Map) -> None:
    one, three = town_tour(town), town_tour(town, rounds=3)

    assert three.lanes == one.lanes * 3
    assert three.length == pytest.approx(3 * one.length)


def test_a_tour_needs_a_round_and_the_town(town: Map) -> None:
    with pytest.raises(ValueError, match="rounds must be 1 or more, got 0"):
        town_tour(town, rounds=0)
    with pytest.raises(RouteError, match="lane '15:0:-1' is not in the map"):
        town_tour(crossing())


def test_a_drive_has_left_lines_on_the_left_and_changes_lanes_where_the_route_does(
    town: Map,
) -> None:
    """Around the whole tour, twice a second."""
    tour = town_tour(town)
    drive = SimulatedDrive(tour.line, speed_limits=20.0)
    tracker = LaneTracker(town, tour)
    changes = 0
    for k, pose in enumerate(drive.at(drive.times(2.0)).pose):
        tracked = tracker.lines(pose)
        assert tracked.match is not None
        assert tracked.match.lane in tour.lane_set
        changes += k > 0 and tracked.lane_changed
        for slot, side in ((Slot.EGO_LEFT, 1), (Slot.EGO_RIGHT, -1)):
            assert side * offset(tracked.lines[slot].points, pose) > -0.35, (pose, slot)

    assert changes == len(tour.changes)


def offset(points: NDArray[np.float64], pose: NDArray[np.float64]) -> float:
    """Return the offset of a line from the car, to the left, where it is nearest [m]."""
    direction = np.exp(-1j * pose[2])
    ego = (points[:, 0] - pose[0] + 1j * (points[:, 1] - pose[1])) * direction
    one, other = ego[:-1], ego[1:]
    step = other - one
    share = np.clip((-one * step.conj()).real / np.abs(step) ** 2, 0, 1)
    nearest = one + share * step
    return float(nearest[np.abs(nearest).argmin()].imag)
