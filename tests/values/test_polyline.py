"""The points of a map line, and their selection by a window."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from maplines_can.values.line import Kind, LeftOut
from maplines_can.values.polyline import INDEXED, Polyline, stretches, to_ego, to_map

STRAIGHT = Polyline([[x, 0.0] for x in range(101)])


def hairpin(gap: float = 10.0) -> Any:
    """A line of 100 m ahead, a turn, and a branch back at ``gap`` [m] to the left."""
    x, arc = np.arange(0.0, 101.0, 2.0), np.linspace(-np.pi / 2, np.pi / 2, 9)[1:-1]
    turn = np.column_stack([100 + gap / 2 * np.cos(arc), gap / 2 + gap / 2 * np.sin(arc)])
    out, back = np.column_stack([x, 0 * x]), np.column_stack([x[::-1], 0 * x + gap])
    return Polyline(np.vstack([out, turn, back]))


@pytest.mark.parametrize(
    ("points", "words"),
    [
        pytest.param([[0, 0]], r"\(n, 2\) with n >= 2, got \(1, 2\)", id="one-point"),
        pytest.param([0, 1], r"got \(2,\)", id="flat"),
        pytest.param(np.zeros((4, 3)), r"got \(4, 3\)", id="with-heights"),
        pytest.param([[0, 0], [1, np.nan]], r"finite \[m\], but point 1 is \[ 1. nan\]", id="nan"),
        pytest.param([[np.inf, 0], [1, 0]], "but point 0 is", id="inf"),
    ],
)
def test_invalid_points_raise(points: Any, words: str) -> None:
    """The message has the shape or the value."""
    with pytest.raises(ValueError, match=words):
        Polyline(points)


def test_a_polyline_copies_its_points_and_makes_them_read_only() -> None:
    """Validated points cannot be changed."""
    points = np.zeros((2, 2))
    line = Polyline(points)
    points[0, 0] = np.nan

    assert np.isfinite(line.points).all()
    with pytest.raises(ValueError, match="read-only"):
        line.points[0, 0] = 1


@given(arrays(float, (5, 2), elements=st.floats(-100, 100, width=16)), st.floats(0.5, 300))
def test_resampled_points_are_evenly_spaced_on_the_line(points: Any, spacing: float) -> None:
    """The ends stay, the points are at most the spacing apart, and all of them are on the line."""
    line = Polyline(points)
    fine = line.resampled(spacing)
    count = max(1, np.ceil(line.length / spacing))
    s = np.linspace(0, line.length, int(count) + 1)

    assert np.allclose(fine.points[[0, -1]], points[[0, -1]], atol=1e-9)
    assert len(fine.points) == len(s)
    assert (np.hypot(*np.diff(fine.points, axis=0).T) <= spacing * (1 + 1e-9)).all()
    for p, distance in zip(fine.points, s, strict=True):
        i = min(np.searchsorted(line.distance, distance, side="right") - 1, len(points) - 2)
        step = line.distance[i + 1] - line.distance[i]
        share = (distance - line.distance[i]) / step if step else 0.0
        assert np.allclose(p, points[i] + share * (points[i + 1] - points[i]), atol=1e-9)


@pytest.mark.parametrize("spacing", [0.0, -1.0, np.nan])
def test_a_spacing_of_zero_raises(spacing: Any) -> None:
    """A spacing must be positive."""
    with pytest.raises(ValueError, match="spacing must be more than 0 m"):
        STRAIGHT.resampled(spacing)


def test_the_kind_travels_with_the_line() -> None:
    """It is unknown by default, and a resampled line keeps it."""
    line = Polyline([[0, 0], [10, 0]], Kind.KERB)

    assert STRAIGHT.kind is Kind.UNKNOWN
    assert line.resampled(1.0).kind is Kind.KERB
    assert Polyline([[0, 0], [1, 0]], 2).kind is Kind.DASHED  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="9 is not a valid Kind"):
        Polyline([[0, 0], [1, 0]], 9)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("east", "accepted"),
    [pytest.param(1.6e4, True, id="16-km"), pytest.param(3.3e4, False, id="33-km")],
)
def test_item_6_single_precision_is_refused_where_it_loses_a_millimetre(
    east: float, accepted: bool
) -> None:
    """Its spacing is 2 mm from 16384 m on: half of that is the rounding error."""
    points = np.array([[east, 0], [east + 10, 1]], dtype=np.float32)
    if accepted:
        assert Polyline(points).points.dtype == np.float64
    else:
        with pytest.raises(
            ValueError, match=r"float32 rounds coordinates of 33010 m by up to 0.002"
        ):
            Polyline(points)
    assert Polyline(points.astype(float)).length > 10


def test_item_6_single_precision_of_utm_size_is_refused() -> None:
    """At 5300 km it loses 25 cm; the message has the cure."""
    utm = np.array([[4e5, 5.3e6], [4e5, 5.3e6 + 9]], dtype=np.float32)
    with pytest.raises(
        ValueError, match=r"rounds coordinates of 5.30001e.06 m by up to 0.25 m; subtract"
    ):
        Polyline(utm)


@pytest.mark.parametrize(
    ("x_min", "x_max", "first", "last"),
    [
        pytest.param(-20, 50, 10, 80, id="inside"),
        pytest.param(-20.5, 50.5, 9.5, 80.5, id="between-points"),
        pytest.param(-50, 20, 0, 50, id="before-the-start"),
        pytest.param(0, 500, 30, 100, id="beyond-the-end"),
        pytest.param(20, 30, 50, 60, id="ahead-only"),
        pytest.param(-20, -10, 10, 20, id="behind-only"),
    ],
)
def test_a_window_ends_where_it_says(x_min: float, x_max: float, first: float, last: float) -> None:
    """Its ends are interpolated between points, here of a car at x = 30 m."""
    seen = STRAIGHT.window([30.0, 2.0, 0.0], x_min, x_max)

    assert seen[[0, -1], 0] == pytest.approx([first, last])
    assert len(seen) == 1 + np.floor(last) - np.ceil(first) + (first % 1 > 0) + (last % 1 > 0)
    assert np.allclose(seen[:, 1], 0.0)


def test_two_points_are_a_line() -> None:
    """A window between them has its two ends."""
    seen = Polyline([[-100, 1.75], [200, 1.75]]).window([0, 0, 0], -20, 80)

    assert np.allclose(seen, [[-20, 1.75], [80, 1.75]])


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        pytest.param([[500, 0], [600, 0]], LeftOut.NOT_IN_WINDOW, id="beyond"),
        pytest.param([[20, -9], [20, 9]], LeftOut.ACROSS, id="across"),
        pytest.param([[5, 1], [5, 1]], LeftOut.ACROSS, id="one-place"),
    ],
)
def test_a_line_that_is_not_seen_gives_an_empty_window(points: Any, reason: Any) -> None:
    """No error is raised: the caller decides; the reason is that of ``stretches``."""
    line = Polyline(points)

    assert line.window([0.0, 0.0, 0.0], -20, 80).shape == (0, 2)
    assert stretches([line], [0.0, 0.0, 0.0], (-20, 80)).left_out == {0: reason}


@pytest.mark.parametrize(
    ("pose", "y"), [((20.0, 1.0, 0.0), 0.0), ((20.0, 9.0, np.pi), 10.0)], ids=["out", "back"]
)
def test_a_window_contains_the_near_branch_of_a_hairpin(pose: Any, y: float) -> None:
    """The branch that returns beside the car is excluded, also if the turn is in the window."""
    for x_max in (60.0, 200.0):
        seen = hairpin().window(pose, -10.0, x_max)

        assert np.allclose(seen[to_ego(seen, pose)[:, 0] <= 60.0, 1], y)
        assert np.all(np.diff(to_ego(seen, pose)[:, 0]) > 0)
        assert to_ego(seen, pose)[-1, 0] >= (20.0 if y else 60.0) - 1e-9


def test_near_refers_to_the_car_and_not_to_the_start_of_the_window() -> None:
    """Of a line that crosses behind the car, the branch that passes the car is selected."""
    road = Polyline(np.array([[-20, 2], [0, 2], [50, 2], [100, 16], [50, 9.5], [0, 3], [-20, 0.4]]))
    seen = road.resampled(1.0).window([0.0, 0.0, 0.0], -15.0, 40.0)

    assert np.allclose(seen[:, 1], 2.0)


def test_item_1_a_line_ends_where_it_turns_away() -> None:
    """A corner of 8 m: it is followed until it is 65 deg from the car's x axis."""
    angle = np.linspace(0, np.pi / 2, 91)
    arc = np.column_stack([40 + 8 * np.sin(angle), 8 - 8 * np.cos(angle)])
    line = Polyline(np.vstack([[-40.0, 0.0], arc, [48.0, 68.0]]))
    end = line.window([0, 0, 0], -20, 80)[-1]

    assert end == pytest.approx(arc[65], abs=0.15)


def test_item_1_a_jump_ends_the_line() -> None:
    """Of 3.5 m within 1 m of length: the line does not go on beyond it."""
    line = Polyline([[x, 0.0] for x in range(31)] + [[x, 3.5] for x in range(31, 80)])

    assert line.window([0, 1, 0], -20, 80)[-1] == pytest.approx([30, 0])
    assert line.window([50, 1, 0], -40, 20)[0] == pytest.approx([31, 3.5])


@pytest.mark.parametrize("count", [50, INDEXED + 1, 20_000])
def test_points_of_several_lines_are_selected_independently(count: int) -> None:
    """The stretches of several lines are those of each line alone."""
    x = np.linspace(-100, 200, count)
    wave = Polyline(np.column_stack([x, 3 * np.sin(x / 40)]))
    lines = [
        STRAIGHT,
        wave,
        Polyline([[20, -90], [20, 90]]),
        hairpin(),
        Polyline(wave.points[::-1]),
    ]
    pose, window = [20.0, 1.0, 0.1], (-10.0, 60.0)
    together = stretches(lines, pose, window)

    assert together.left_out == {2: LeftOut.ACROSS}
    assert together.given.tolist() == [0, 1, 3, 4]
    for row, i in enumerate(together.given):
        alone = stretches([lines[i]], pose, window)
        at = np.linspace(alone.x_range[0, 0], alone.x_range[0, 1], 50)
        assert np.allclose(together.x_range[row], alone.x_range[0], rtol=0, atol=1e-9)
        at_all = np.linspace(together.x_range[:, 0], together.x_range[:, 1], 50).T
        assert np.allclose(together.lateral(at_all)[row], alone.lateral(at[None])[0], atol=1e-9)


@pytest.mark.parametrize("spacing", [0.5, 45.0])
def test_item_6_a_search_tree_finds_the_same_stretch(spacing: float) -> None:
    """A line of many points, also far apart, against its part near the car.

    Of dense points a sample is used, at most 0.6 m apart, which costs less than 0.1 mm here.
    """
    x = np.append(np.arange(0.0, 3000.0, 0.5), np.arange(3000.0, 9000.0, spacing))
    points = np.column_stack([x, 20 * np.sin(x / 300)])
    line = Polyline(points)
    assert len(points) > INDEXED
    for at in (10.0, 2990.0, 3010.0, 5000.0):
        pose = [at, 20 * np.sin(at / 300), np.arctan(np.cos(at / 300) / 15)]
        near = np.abs(x - at) < 500
        part, seen = Polyline(points[near][: INDEXED - 1]), line.window(pose, -20, 80)
        expected = part.window(pose, -20, 80)
        assert seen[[0, -1]] == pytest.approx(expected[[0, -1]], abs=1e-4)
        assert np.interp(seen[:, 0], *expected.T) == pytest.approx(seen[:, 1], abs=1e-4)


@given(arrays(float, (6, 2), elements=st.floats(-100, 100)), st.floats(-np.pi, np.pi))
def test_the_ego_frame_is_rotated_by_the_heading(points: Any, heading: float) -> None:
    """In complex numbers: (z - pose) e^(-i heading)."""
    z = (points @ [1, 1j] - (3 - 4j)) * np.exp(-1j * heading)

    assert np.allclose(to_ego(points, [3, -4, heading]) @ [1, 1j], z, atol=1e-12)


@given(arrays(float, (6, 2), elements=st.floats(-100, 100)), st.floats(-np.pi, np.pi))
def test_to_map_is_the_inverse_of_to_ego(points: Any, heading: float) -> None:
    """Up to rounding."""
    pose = [3.0, -4.0, heading]

    assert np.allclose(to_map(to_ego(points, pose), pose), points, atol=1e-12)
