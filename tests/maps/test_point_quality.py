"""What the points of a map tell."""

import numpy as np
import pytest

from maplines_can import LeftOut, Polyline
from maplines_can.maps import Lane, Map, Road
from maplines_can.maps.point_quality import point_quality


def arc_map(spacing: float, noise: float = 0.0, length: float = 600.0) -> Map:
    """A lane along an arc of 400 m."""
    rng = np.random.default_rng(1)
    angle = np.arange(0, length + 1e-9, spacing) / 400

    def line(radius: float) -> Polyline:
        points = radius * np.column_stack([np.sin(angle), -np.cos(angle)])
        return Polyline(points + rng.normal(0, noise, points.shape) if noise else points)

    lane = Lane("1", line(398.25), line(401.75), line(400.0), road="A")
    return Map({"1": lane}, {"A": Road("A", "", length, ("1",))})


def test_spacing_and_noise_are_those_of_the_points() -> None:
    """Runs of 30 points tell the error up to some 20 %, and 20 of them its median to 7 %."""
    quality = point_quality(arc_map(2.0, noise=0.05))

    assert quality.points == 2 * 301
    assert quality.spacing.median == pytest.approx(2.0, rel=0.01)
    assert quality.spacing.low <= quality.spacing.median <= quality.spacing.high
    assert quality.noise is not None
    assert quality.noise.median == pytest.approx(0.05, rel=0.2)
    assert quality.noise.low < quality.noise.median < quality.noise.high


def test_points_that_are_too_far_apart_are_told() -> None:
    """Every 100 m on a radius of 400 m, the arc is 3.1 m beside the chord."""
    quality = point_quality(arc_map(100.0))

    assert quality.lines == 0
    assert quality.left_out.keys() == {LeftOut.FEW_POINTS}
    assert {one.median for one in quality.sigmas} == {None}


def test_a_large_map_is_sampled_by_seed() -> None:
    """Places are the same with the same seed."""
    x = np.arange(0.0, 6000.0, 20.0)
    left, right, centre = (
        Polyline(np.column_stack([x, y + 9 * np.sin(x / 150)])) for y in (3.5, 0, 1.75)
    )
    lane = Lane("1", left, right, centre, road="A")
    road_map = Map({"1": lane}, {"A": Road("A", "", lane.length, ("1",))})
    done: list[float] = []
    first, again, other = (
        point_quality(road_map, seed, lambda n, _: done.append(n)) for seed in (1, 1, 2)
    )

    assert first == again
    assert first.sigmas != other.sigmas
    assert first.places == 500
    assert done[500] == 500


def test_a_map_without_lanes_has_points_only() -> None:
    line = Polyline([[0, 0], [10, 0], [20, 1]])
    quality = point_quality(Map({}, {}, polylines={"a": line}))

    assert quality.places == quality.lines == 0
    assert quality.noise is None
    assert quality.reach is None
    assert quality.as_dict()["noise"] is None
