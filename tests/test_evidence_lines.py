"""tools/evidence_lines.py against closed forms, and it finds lines that are not honest."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import evidence_lines as tool
import line_witness as witness
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_roads import SHAPES, random_case

from maplines_can import Gaussian, MapError, map_lines
from maplines_can.simulation.scenarios import STREETS

#: Draws of the pose for each line; at least this share of them must be within three sigmas.
DRAWS, WITHIN = 1000, 0.98


@given(st.floats(-0.5, 0.5), st.floats(-3, 3), st.floats(-60, 60))
def test_a_straight_line_is_crossed_where_it_lies(angle: float, y: float, x: float) -> None:
    """Seen from a pose that is turned by an angle, and from the origin."""
    points = np.column_stack([np.linspace(-100, 100, 7), np.full(7, y)])
    poses = np.array([[0, 0, 0], [0, 0, angle]])

    local = witness.seen_from(points, poses)
    _, s = witness.place_of(local[0])

    expected = [y, y / np.cos(angle) - x * np.tan(angle)]
    assert np.allclose(witness.crossings(local, s, x), expected)


def test_a_line_that_ends_is_not_crossed() -> None:
    points = np.array([[0.0, 1], [10, 1], [20, 1]])
    assert np.isnan(witness.crossings(points[None], np.array([0.0, 10, 20]), 25.0)).all()


def test_a_line_that_comes_back_is_crossed_where_it_is_followed() -> None:
    """Of a circle, the side on which the car is; its other side is not a line ahead."""
    angle = np.linspace(-0.7 * np.pi, 1.2 * np.pi, 400)
    circle = 12 * np.column_stack([np.cos(angle), 1 + np.sin(angle)])
    local = circle - [0, 0.3]
    _, s = witness.place_of(local)
    near, far = witness.crossings(np.array([local, local + np.array([0, 40])]), s, 4.0)
    assert near == pytest.approx(12 - np.sqrt(12**2 - 4**2) - 0.3, abs=1e-3)
    assert far == pytest.approx(near + 40)
    assert np.isnan(witness.crossings(local[None], s, 12.5)).all()


def test_an_oncoming_line_is_known_by_its_direction_at_the_car() -> None:
    """Whatever its direction is farther along."""
    hairpin = np.array([[-50.0, 2], [50, 2], [50, 30], [-50, 30]])
    assert not witness.is_oncoming(hairpin)
    assert witness.is_oncoming(hairpin[::-1])
    assert witness.is_oncoming(hairpin - [0, 31])


def test_the_nearest_place_is_between_points() -> None:
    nearest, s = witness.place_of(np.array([[-30.0, 4], [-10, 4], [30, 4]]))
    assert nearest == 1
    assert s.tolist() == [-30, -10, 30]


@given(st.floats(0.5, 50), st.floats(-40, 40), st.floats(1e-6, 1e-3))
@settings(max_examples=20)
def test_the_misfit_of_a_quartic_is_that_of_chebyshev(
    half: float, centre: float, scale: float
) -> None:
    """x^4 on [-1, 1] deviates from its best cubic, x^2 - 1/8, by 1/8."""
    w = np.linspace(-1, 1, 401)
    misfit = tool.chebyshev_misfit(centre + half * w, scale * half**4 * w**4)
    assert misfit == pytest.approx(scale * half**4 / 8, rel=1e-4, abs=1e-6)


def test_the_limit_of_a_quartic_is_known() -> None:
    """A cubic follows a x^4 over a range of length 2 (8 max_misfit / a)^(1/4), wherever it is."""
    x = np.linspace(-20, 80, 2001)
    a = 1e-5
    y = a * (x - 5) ** 4
    view = tool.View(np.column_stack([x, y]), 400)
    length = 2 * (8 * tool.MAX_MISFIT / a) ** 0.25

    assert view.is_seen
    assert view.farthest(-15.0, -15.0) == pytest.approx(length - 15, abs=0.15)
    assert view.longest(1.0) == pytest.approx(length, abs=0.3)
    assert view.longest(length + 1) == length + 1


def test_a_view_ends_where_the_line_turns_away() -> None:
    """Both ways along an arc, at the angle of the limit."""
    angle = np.linspace(-1.5, 1.5, 3001)
    arc = 12 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    view = tool.View(arc, 1500)
    assert [view.low, view.high] == pytest.approx(12 * np.sin([-tool.TURN, tool.TURN]), abs=0.05)


@pytest.mark.parametrize("shape", SHAPES)
def test_random_roads_are_as_their_shape_says(shape: str) -> None:
    """The car is beside the line, whose points have the distances of the shape."""
    rng = np.random.default_rng(1)
    for _ in range(10):
        case = random_case(shape, rng)
        steps = np.hypot(*np.diff(case.points, axis=0).T)
        least, most = SHAPES[shape][1]

        assert case.points.min() > 1e5
        assert steps.max() <= 2.5 * most + 3.5
        assert np.median(steps) >= 0.2 * least
        if shape not in ("lane-ends", "city", "imprecise"):  # a city road may cross itself
            local = witness.seen_from(case.points, case.pose[None])[0]
            near = np.hypot(*local.T).min()
            assert near < 6 + most + 3.5


@given(st.sampled_from(sorted(STREETS)), st.integers(0, 10_000))
@settings(max_examples=15)
def test_the_lines_of_streets_are_honest(name: str, seed: int) -> None:
    """Of all lines, within three sigmas at both ends and between them, as a Gaussian is."""
    scene, rng = STREETS[name], np.random.default_rng(seed)
    poses = scene.ego.sample(DRAWS, seed)
    for line in map_lines(scene.lines, scene.ego, window=scene.window):
        local = witness.seen_from(scene.lines[line.slot].points, poses)
        _, s = witness.place_of(local[0])
        for x in [line.x_min, line.x_max, *rng.uniform(line.x_min, line.x_max, 3)]:
            z = (witness.crossings(local, s, x) - line.y(x)) / line.y_sigma(x)
            assert (np.abs(z) <= 3).mean() >= WITHIN, (line.slot, x)


def run(capsys: Any, *arguments: str) -> tuple[int, Any]:
    """Return the exit status and the result of the tool."""
    status = tool.main(["--quick", "--json", "--pose", "production", *arguments])
    return status, json.loads(capsys.readouterr().out)


def test_the_quick_evidence(capsys: pytest.CaptureFixture[str]) -> None:
    """Every shape has figures, and few values have no share."""
    _, result = run(capsys)
    rows = result["production"]
    assert list(rows) == list(SHAPES)
    for row in rows.values():
        assert row["values"]["x_min"] == row["values"]["x_max"] == 200
        assert max(row["beyond 3 sigma"].values()) <= 0.05
        assert row["range"][0] > 10
        assert row["ratio, same x_min"][1] > 0.5


@pytest.mark.parametrize("option", ["--wire", "--map-error"])
def test_the_wire_and_a_map_error(capsys: pytest.CaptureFixture[str], option: str) -> None:
    """Both leave the lines honest, and change the figures."""
    _, plain = run(capsys, "--shape", "city")
    _, changed = run(capsys, "--shape", "city", option)
    plain, changed = (result["production"]["city"] for result in (plain, changed))
    assert changed["rms"] != plain["rms"]
    assert max(changed["beyond 3 sigma"].values()) <= 0.05


def test_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert tool.main(["--quick", "--shape", "motorway", "--shape", "corner"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith(("motorway", "corner")) for line in lines) == 4
    assert lines[-1] == "All bounds are met."


def test_dishonest_lines_are_found(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sigmas of half the size, and ranges of half the length."""

    def halved(*arguments: Any, **options: Any) -> Any:
        lines = map_lines(*arguments, **options)
        for i, line in enumerate(lines):
            small = Gaussian(line.gaussian.mean, line.gaussian.cov / 4)
            lines[i] = replace(line, gaussian=small, x_max=(line.x_min + line.x_max) / 2)
        return lines

    monkeypatch.setattr(tool, "map_lines", halved)
    monkeypatch.setattr(witness, "MIN_VALUES", 100)
    status, result = run(capsys, "--shape", "city")
    text = "\n".join(result["missed"])
    assert status == 1
    for words in ("beyond 3 sigma at x = x_min", "rms of z", "same x_min: the median is 0."):
        assert words in text


def test_refused_lines_are_found(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All are left out, for a reason that is counted."""

    across: Any = SimpleNamespace(name="ACROSS")

    def none(lines: Any, *arguments: Any, **options: Any) -> Any:
        found = map_lines(lines, *arguments, **options)
        found.clear()
        found.left_out = dict.fromkeys(lines, across)
        return found

    monkeypatch.setattr(tool, "map_lines", none)
    status, result = run(capsys, "--shape", "motorway")
    row = result["production"]["motorway"]
    assert status == 1
    assert row["left out"] == {"ACROSS": 20}
    assert row["refused"] == row["refused in view"] == 1
    assert result["missed"] == [
        "MISSED  production, motorway: 100.0% of the lines with 15 m ahead are refused"
    ]


def test_the_true_line_deviates_as_the_map_error_says() -> None:
    """Standard deviations of the common offset, of the rotation and of each point."""
    points = np.column_stack([np.linspace(0, 50, 26), np.full(26, 2.0)])
    points += [5e5, 5e6]
    pose = np.array([5e5, 5e6, 0.4])
    settings = tool.Settings(1, 20_000, 0, True, None)
    true = tool.drawn(points, pose, settings, np.random.default_rng(1)) - points
    error: MapError = tool.MAP_ERROR

    across = true[:, :, 1]
    x = points[:, 0] - pose[0]
    variance = error.point_sigma**2 + error.offset_sigma**2 + (x * error.heading_sigma) ** 2
    assert np.allclose(across.var(axis=0), variance, rtol=0.06)
    assert np.diff(across, axis=1).var() == pytest.approx(
        2 * error.point_sigma**2 + (2 * error.heading_sigma) ** 2, rel=0.03
    )
