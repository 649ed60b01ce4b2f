"""tools/evidence_shape.py against closed forms, and it finds Gaussians that know too much."""

import json
from pathlib import Path
from typing import Any

import evidence_shape as tool
import numpy as np
import pytest
import shape_figures as figures
import shape_picture
import shape_ways as ways
from drive_files import town
from scipy.special import ndtri

from maplines_can import Gaussian, MapError, MapLineList, Motion, Slot, map_lines

QUICK = ["--json", "-n", "6", "--draws", "5", "--pose", "production"]
DRAWS = 20_000


def run(capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, Any]:
    """Return the exit status and the result of the tool with few cases."""
    status = tool.main([*QUICK, *options])
    return status, json.loads(capsys.readouterr().out)


def cubic(parameters: Any, x: float) -> Any:
    """Return the (...,) lateral positions of (..., 4) lines (Map Line Interface, eq. 1)."""
    y_off, beta, c0, c1 = np.moveaxis(parameters, -1, 0)
    return y_off + np.tan(beta) * x + c0 * x**2 / 2 + c1 * x**3 / 6


def two_lines(rng: Any, components: int = 1) -> figures.Given:
    """Return a random joint distribution of two lines."""
    means = np.zeros((components, 2, 4))
    means[:, 0] = [1.75, 0.1, 1e-3, 1e-5]
    means[:, 1] = [-1.75, 0.1, 1e-3, 1e-5]
    scale = np.tile([0.3, 0.01, 1e-3, 1e-5], 2)
    means += 2 * (rng.standard_normal((components, 8)) * scale).reshape(-1, 2, 4)
    roots = rng.standard_normal((components, 8, 8)) * scale[:, None]
    covs = roots @ roots.swapaxes(1, 2)
    shares = rng.dirichlet(np.ones(components))
    return figures.Given(shares, means, covs, covs, np.array([[-20.0, 80.0]] * 2))


@pytest.mark.parametrize("components", [1, 3])
@pytest.mark.parametrize(("sums", "lines"), [(figures.OF_LINE, [1]), (figures.OF_WIDTH, [0, 1])])
def test_z_is_normal_if_the_parameters_are_as_stated(
    components: int, sums: figures.Sums, lines: list[int]
) -> None:
    """Of one line and of the difference of two; each mean, rms and tail within five sigmas."""
    rng = np.random.default_rng(1)
    given = two_lines(rng, components)
    which = rng.choice(components, DRAWS, p=given.shares)
    roots = np.linalg.cholesky(given.covs)[which]
    errors = (roots @ rng.standard_normal((DRAWS, 8, 1))).reshape(DRAWS, 2, 4)
    drawn = given.means[which] + errors

    z = given.z(sums, lines, lambda i, x: cubic(drawn[:, i], x))

    assert z.shape == (len(sums.names), DRAWS)
    assert np.abs(z.mean(axis=1)).max() < 5 / np.sqrt(DRAWS)
    assert np.abs(z.var(axis=1) - 1).max() < 5 * np.sqrt(2 / DRAWS)
    share = (np.abs(z) > 2).mean(axis=1)
    assert np.abs(share - 0.0455).max() < 5 * np.sqrt(0.0455 / DRAWS)


def test_the_curvature_about_the_car_is_c0() -> None:
    """A cubic has no third difference about its middle."""
    given = two_lines(np.random.default_rng(2))
    sums = figures.Sums.of([("", (-5.0, 0.0, 5.0), (0.04, -0.08, 0.04))])
    mean, variance = given.moments(sums, [0], given.covs)
    assert mean == pytest.approx(given.means[0, 0, 2])
    assert variance == pytest.approx(given.covs[0, 2, 2])


def test_quantiles_of_a_mixture_do_not_saturate() -> None:
    """Far from all components they are those of the widest; near zero, of the average."""
    shares = np.array([0.5, 0.5])
    u = np.array([[-40.0, 60.0], [-80.0, 20.0]])
    z = figures.normal_quantiles(u[..., None], shares)[:, 0]
    assert z == pytest.approx([-40.0, 20.0], abs=0.05)
    middle = figures.normal_quantiles(np.array([[1.0], [-0.5]]), shares)
    cdf = (0.841345 + 0.308538) / 2
    assert middle == pytest.approx(ndtri(cdf), abs=1e-5)


def test_the_motion_ends_where_the_closed_form_says() -> None:
    """The mean pose of the witness is that of ``Motion``, from any pose, on arcs and straight."""
    for yaw_rate in (0.0, 1e-4, 0.5, -0.3):
        local = Motion(ways.SPEED, yaw_rate).over(ways.SECONDS).mean
        c, s = np.cos(0.7), np.sin(0.7)
        expected = [10 + c * local[0] - s * local[1], 5 + s * local[0] + c * local[1]]
        found = ways.arc(10.0, 5.0, 0.7, ways.SPEED, yaw_rate)
        assert found == pytest.approx([*expected, 0.7 + local[2]], abs=1e-6)


@pytest.mark.parametrize("errors_in", ["map", "truth", "none"])
def test_errors_are_where_they_are_said_to_be(
    monkeypatch: pytest.MonkeyPatch, errors_in: str
) -> None:
    """One draw in the map, one for each pose in the true line, or none."""
    points = np.column_stack([np.arange(-50.0, 100.0, 0.5), np.full(300, 2.0)])
    error = MapError(point_sigma=0.05)
    pose, rng = np.array([0.0, 0.0, 0.0]), np.random.default_rng(1)
    settings = tool.Settings("line", "production", error, errors_in, 1, 400, 1)
    cases: list[ways.Case] = []

    def keep(case: ways.Case) -> ways.Result:
        cases.append(case)
        return ways.Result([], [], [], 0)

    monkeypatch.setitem(ways.WAYS, "line", keep)
    tool.evaluate({Slot.EGO_LEFT: points}, pose, settings, rng, figures.Tally())

    in_map = cases[0].lines[Slot.EGO_LEFT].points - points
    seen, s = tool.view(points, np.zeros((401, 3)), settings, rng)
    in_truth = seen - points[: len(s)]

    sigmas = {"map": (0.05, 0.0), "truth": (0.0, 0.05), "none": (0.0, 0.0)}[errors_in]
    assert (in_map.std(), in_truth.std()) == pytest.approx(sigmas, rel=0.1, abs=1e-9)


@pytest.mark.parametrize("way", ways.WAYS)
def test_every_way_gives_lines(capsys: pytest.CaptureFixture[str], way: str) -> None:
    """Their band holds at each x, and the width of a scene is there."""
    _, result = run(capsys, "--by", way, "--shape", "rural", "--map-error", "0.05")
    row = result[f"{way}, production pose, map error 0.05 m"]["all roads"]
    assert row["lines"] + row["lost"] == 12
    assert row["values"]["y"] >= 100
    assert row["beyond 3 sigma"]["y"] <= 0.02
    assert ("width, y" in row["values"]) == (way in ("scene", "scene-wire"))


def test_maps_and_roads_have_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, result = run(capsys, town(tmp_path), "--shape", "motorway", "--map-error", "0")
    rows = result["line, production pose, map error 0 m"]
    assert [*rows] == ["map.xodr", "all maps", "motorway", "all roads"]
    assert rows["map.xodr"] == rows["all maps"]
    assert rows["motorway"]["lines"] == 12


def test_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    tool.main([*QUICK[1:], "--by", "scene", "--shape", "motorway"])
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("all roads ") for line in lines) == 4
    assert sum(line.startswith("width ") for line in lines) == 2


def test_without_a_map_there_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.xodr").write_text("<OpenDRIVE>")
    assert tool.main([str(tmp_path)]) == 2
    assert "none of the files is a map" in capsys.readouterr().err


def test_a_misfit_in_y_off_alone_is_found(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is true at each x, not of second differences."""

    excess_covs = ways.excess_covs

    def in_y_off(lines: Any, ego: Gaussian, **options: Any) -> MapLineList:
        found = map_lines(lines, ego, **options)
        case = ways.Case(lines, ego, np.zeros((0, 3)), None, np.random.default_rng(0))
        excess = excess_covs(case, 0.0)
        return MapLineList([ways.with_less(x, excess[x.slot]) for x in found], found.left_out)

    monkeypatch.setattr(figures, "MIN_VALUES", 100)
    monkeypatch.setattr(ways, "map_lines", in_y_off)
    monkeypatch.setattr(
        ways, "excess_covs", lambda case, _: dict.fromkeys(case.lines, np.zeros(()))
    )
    options = ("--shape", "rural", "--map-error", "0")
    status, result = run(capsys, *options)
    text = "\n".join(result["missed"])
    assert status == 1
    assert "2nd 5 m" in text
    assert "curvature" in text
    assert " y: " not in text


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        pytest.param(4.0, "sigma of y at 40 m is 2.000 times the reference", id="too wide"),
        pytest.param(0.25, "y: 13.", id="too narrow: share"),
        pytest.param(0.25, "rms of z of y is 2.0", id="too narrow: rms"),
        pytest.param(4.0, "rms of z of y is 0.5", id="too wide: rms"),
    ],
)
def test_wrong_sigmas_are_found(scale: float, words: str) -> None:
    """A Gaussian whose covariance is scaled misses the bounds."""
    rng, tally = np.random.default_rng(1), figures.Tally()
    given = two_lines(rng)
    drawn = rng.multivariate_normal(given.means.ravel(), given.covs[0], DRAWS).reshape(DRAWS, 2, 4)
    wrong = given._replace(covs=scale * given.covs)
    tally.evaluate(wrong, lambda i, x: cubic(drawn[:, i], x))
    row = tally.figures()
    row["lines at x"] = dict.fromkeys(row["lines at x"], 1000)
    assert any(words in text for text in figures.missed("case", row))


def test_a_line_that_does_not_cross_counts_as_beyond() -> None:
    """As in the other evidence, and only in sums that need that place."""
    given, tally = two_lines(np.random.default_rng(1)), figures.Tally()
    mean = given.means[0, 0]
    tally.evaluate(
        given._replace(ranges=given.ranges[:1]),
        lambda _, x: np.full(7, np.nan) if x == 40.0 else np.full(7, cubic(mean, x)),
    )
    beyond = tally.figures()["beyond 3 sigma"]
    assert beyond["y"] == pytest.approx(1 / 3)
    assert beyond["slope 10 m"] == pytest.approx(1 / 3)
    assert beyond["curvature"] == 0.0


def test_the_picture_shows_a_band_that_holds_the_road(tmp_path: Path) -> None:
    """Ahead of the bend the curvature is 0: within the band, and beyond it with y_off alone."""
    bend = shape_picture.bend()
    x, road, mean, sigma, before = bend.of(shape_picture.ROWS[2])
    ahead = x < 30.0

    assert np.abs(road[ahead]).max() < 1e-4
    assert mean[0] < -0.002
    assert (np.abs(road - mean) <= 3 * sigma).all()
    assert np.abs(mean[0]) > 10 * before[0]
    shape_picture.draw([bend], tmp_path / "shape.png")
    assert (tmp_path / "shape.png").read_bytes().startswith(b"\x89PNG")


def test_a_line_whose_range_the_mean_leaves_empty_is_left_out() -> None:
    """With a poor pose: its range from the mean that is sent is shorter than from the mean pose."""
    settings = tool.Settings("scene", "poor", MapError(point_sigma=0.05), "map", 8, 2, 1)
    assert tool.roads("lane-ends", settings, lambda: None).lines > 0
