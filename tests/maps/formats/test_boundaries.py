"""Boundaries of lanes: exact at any s, and sampled within the chord error."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support.xodr_files import (
    WIDTH,
    boundaries,
    cubic,
    geometry,
    lane,
    read_map,
    reasons,
    road,
    section,
)

from maplines_can import Polyline
from maplines_can.maps.formats.opendrive.boundaries import Boundaries, _pieces, sampled
from maplines_can.maps.formats.opendrive.reader import distinct
from maplines_can.maps.formats.opendrive.reference_line import Complex

S = np.linspace(0.0, 100.0, 21)


def complexes(line: Polyline) -> Complex:
    x, y = line.points.T
    return np.asarray(x + 1j * y, dtype=complex)


def distance(points: Complex, line: Complex) -> float:
    """Return the largest distance of points from a polyline [m]."""
    a, chord = line[:-1], np.diff(line)
    along = ((points[:, None] - a) * chord.conj()).real / np.abs(chord) ** 2
    return float(np.abs(points[:, None] - a - np.clip(along, 0, 1) * chord).min(axis=1).max())


def deviation(found: Boundaries, count: int = 1500) -> float:
    """Return the largest distance of the exact boundaries from the sampled ones [m]."""
    s = np.linspace(found.start, found.end, count)
    rows = found(s, np.minimum(s, math.nextafter(found.end, 0)))
    (lines,) = sampled(found.road, [found])
    return max(distance(exact, line) for exact, line in zip(rows, lines, strict=True))


def width(a: float, b: float = 0.0, c: float = 0.0, d: float = 0.0, *, at: float = 0.0) -> str:
    return cubic("width", a, b, c, d, sOffset=at)


def border(a: float, b: float = 0.0) -> str:
    return cubic("border", a, b, sOffset=0.0)


LATE = np.maximum(S - 50, 0)
WIDTHS = section(
    lane(2, width(2.0)),
    lane(1, width(3.0, 0.01)),
    lane(-1, width(3.5) + width(3.5, 0.02, at=50.0)),
    lane(-2, width(1.0, 0.0, 1e-4, -1e-6)),
)
OUTER = -3.5 - 0.02 * LATE - 1 - 1e-4 * S**2 + 1e-6 * S**3
BORDERS = section(
    lane(1, border(3.0, 0.01)),
    lane(-1, border(-3.25)),
    lane(-2, border(-5.0)),
    lane(-3, width(1.0)),
)
OFFSETS = cubic("laneOffset", 1.0, s=0.0) + cubic("laneOffset", 1.0, 0.1, s=50.0)


@pytest.mark.parametrize(
    ("text", "edges"),
    [
        pytest.param(road(WIDTHS), {2: 5 + 0.01 * S, -2: OUTER}, id="widths-add-up"),
        pytest.param(road(section(lane(-1), lane(-3))), {-3: -7 + 0 * S}, id="ids-with-gaps"),
        pytest.param(
            road(BORDERS, offsets=cubic("laneOffset", 0.5, s=0.0)),
            {1: 3.5 + 0.01 * S, -1: -2.75 + 0 * S, -2: -4.5 + 0 * S, -3: -5.5 + 0 * S},
            id="borders-are-offsets",
        ),
        pytest.param(
            road(section(lane(-1, border(-9.0) + WIDTH))), {-1: -3.5 + 0 * S}, id="width-wins"
        ),
        pytest.param(road(offsets=OFFSETS), {0: 1 + 0.1 * LATE, -1: 0.1 * LATE - 2.5}, id="offset"),
        pytest.param(
            road(lateral=cubic("superelevation", 0.0, 0.002, s=0.0)),
            {-1: -3.5 * np.cos(0.002 * S)},
            id="roll",
        ),
    ],
)
def test_where_boundaries_are(text: str, edges: dict[int, Complex]) -> None:
    """The outer edges of lanes, to the left of the reference line; lane 0 has an inner one."""
    found = boundaries(text)
    for lane_id, t in edges.items():
        inner, outer = found.edges(lane_id or -1, S)
        assert (outer if lane_id else inner) == pytest.approx(S + 1j * t)


@pytest.mark.parametrize("jump", [5.0, -0.3])
def test_the_end_of_a_section_has_the_lane_offset_from_before_it(jump: float) -> None:
    """Where the offset jumps with a new lane section, neither side has a value of the other."""
    offsets = cubic("laneOffset", 0.0, s=0.0) + cubic("laneOffset", jump, s=50.0)
    text = road(section(lane(-1)), section(lane(-1), s=50.0), offsets=offsets)
    assert boundaries(text, 0).edges(-1, np.array([50.0]))[0] == pytest.approx([50])
    assert boundaries(text, 1).edges(-1, np.array([50.0]))[0] == pytest.approx([50 + 1j * jump])
    found = read_map(text)
    assert complexes(found.lanes["1:0:-1"].left) == pytest.approx([0, 50])
    assert complexes(found.lanes["1:1:-1"].left) == pytest.approx([50 + 1j * jump, 100 + 1j * jump])


@pytest.mark.parametrize(
    ("offsets", "width", "step"),
    [
        pytest.param(
            cubic("laneOffset", 0.0, s=0.0) + cubic("laneOffset", 2.0, s=30.0),
            WIDTH,
            2,
            id="offset",
        ),
        pytest.param("", WIDTH + cubic("width", 5.5, sOffset=30.0), -2, id="width"),
    ],
)
def test_a_jump_within_a_section_is_a_step(offsets: str, width: str, step: float) -> None:
    """Both values are points."""
    text = road(section(lane(-1, width)), offsets=offsets, plan=geometry(length=60.0), length=60.0)
    line = complexes(read_map(text).lanes["1:0:-1"].right)
    assert line.real == pytest.approx([0, 30, 30, 60])
    assert np.diff(line.imag) == pytest.approx([0, step, 0])


def test_a_gap_in_width_is_filled_and_listed() -> None:
    """Before its first record, a width is that of its start."""
    width = cubic("width", 3.0, 0.1, sOffset=20.0)
    found = read_map(road(section(lane(-1, width))))
    assert reasons(found) == [
        "its width is not defined over the first 20 m; that after them is used"
    ]
    points = complexes(found.lanes["1:0:-1"].right)
    assert points[[0, 1, -1]] == pytest.approx([-3j, 20 - 3j, 100 - 11j])


def test_a_negative_width_is_0_and_listed() -> None:
    found = read_map(road(section(lane(-1, cubic("width", 2.0, -0.05, sOffset=0.0)), lane(-2))))
    assert reasons(found) == ["its width is negative in part; 0 is used"]
    right = complexes(found.lanes["1:0:-1"].right)
    assert right.imag.max() == 0
    assert right[-1] == pytest.approx(100)
    assert distance(np.array([20 - 1j, 40 + 0j, 70 + 0j]), right) < 0.5e-3
    assert complexes(found.lanes["1:0:-2"].right)[-1] == pytest.approx(100 - 3.5j)


@pytest.mark.parametrize("length", [0.002, 1e-5])
def test_short_sections_are_lanes(length: float) -> None:
    """A section of 2 mm has its ends as points."""
    found = read_map(
        road(
            section(lane(-1, successor=-1)),
            section(lane(-1, successor=-1), s=50.0),
            section(lane(-1), s=50.0 + length),
        )
    )
    assert complexes(found.lanes["1:1:-1"].left) == pytest.approx([50, 50 + length], abs=1e-12)
    assert found.lanes["1:0:-1"].successors == ("1:1:-1",)
    assert found.lanes["1:1:-1"].successors == ("1:2:-1",)


SHAPES = [
    '<spiral curvStart="{k}" curvEnd="{j}"/>',
    '<arc curvature="{k}"/>',
    '<poly3 a="0" b="{k}" c="-0.01" d="1e-4"/>',
]


@given(
    st.sampled_from(SHAPES),
    st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    st.tuples(st.floats(-0.05, 0.05), st.floats(-0.002, 0.002)),
    st.floats(1.0, 90.0),
    st.sampled_from(["", cubic("laneOffset", 0, 0, 3e-3, -2e-5, s=0.0)]),
    st.sampled_from(["", cubic("superelevation", 0, 0, 1e-3, -1e-5, s=0.0)]),
)
@example(SHAPES[0], (-0.1171875, -0.1171875), (0.0, -0.000889482991651568), 89.98828125, "", "")
@example(SHAPES[1], (-0.28, 0.0), (0.0, 0.0), 90.0, "", "")  # the inner radius is 0.07 m
def test_sampled_lines_of_any_road_are_within_half_a_millimetre(
    shape: str,
    bend: tuple[float, float],
    taper: tuple[float, float],
    length: float,
    offsets: str,
    lateral: str,
) -> None:
    text = road(
        section(lane(1, width(8.0, *taper)), lane(-1)),
        plan=geometry(shape.format(k=bend[0], j=bend[1]), length=length),
        length=length,
        offsets=offsets,
        lateral=lateral,
    )
    assert deviation(boundaries(text), 1000) < 0.5e-3


def test_a_boundary_that_is_a_point_has_two_points() -> None:
    """An arc around the outer boundary, which is the right one of a lane on the left."""
    arc = geometry(f'<arc curvature="{1 / 3.5!r}"/>', length=5.0)
    found = read_map(road(section(lane(1)), plan=arc, length=5.0)).lanes["1:0:1"]
    assert found.right.points == pytest.approx(np.array([[0, 3.5], [0, 3.5]]))
    assert found.left.length == pytest.approx(5, abs=1e-3)


@given(st.lists(st.sampled_from([0.0, 5e-5, 0.9e-4, 1.1e-4, 1.0, 3.0]), min_size=1, max_size=9),
       st.floats(-3, 3))  # fmt: skip
def test_repeated_points_are_left_out_but_for_the_ends(steps: list[float], angle: float) -> None:
    """In any direction of the plane: those within 0.1 mm of the one before; two points remain."""
    points = 5 - 3j + np.exp(1j * angle) * np.cumsum([0.0, *steps])
    found = distinct(points)
    assert found[0] == points[0]
    assert found[-1] == points[-1]
    keep = [0] + [i for i in range(1, len(points)) if steps[i - 1] > 1e-4]
    if len(points) > 2 and keep[-1] != len(points) - 1:
        keep = [*(keep if len(keep) < 2 else keep[:-1]), len(points) - 1]
    if len(points) == 2:
        keep = [0, 1]
    assert found.tolist() == points[keep].tolist()


def test_pieces_are_as_many_as_the_second_difference_says() -> None:
    """Parabolas across x: an eighth of it is the distance from the chord of a piece."""
    x = np.linspace(0, 1, 5)
    for curvature in (0.01, 0.5, 40.0):
        points = np.array([[100 * x + 0.5j * curvature * x**2, 100 * x]])[0][:, None]
        (count,) = _pieces(points)
        needed = math.sqrt(curvature / (8 * 0.43e-3))
        assert count == min(max(2, math.ceil(round(needed, 9))), 1000)
    # The second difference of a cubic is extrapolated to the end where it is the largest.
    for cubic_ in (x**3, (1 - x) ** 3):
        (count,) = _pieces((100 * x + 1j * cubic_)[None, None])
        ends = 2 * 6 * 0.75 * 0.25**2 - 6 * 0.5 * 0.25**2
        assert count == math.ceil(4 * math.sqrt(ends / (8 * 0.43e-3)))
