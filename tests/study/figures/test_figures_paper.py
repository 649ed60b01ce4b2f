"""The figures of the paper: their data, their text, and reproducible files."""

import sys
from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.image import imread

from maplines_can import Codec
from maplines_can.propagation import MonteCarlo, Refit, SigmaPoints
from maplines_can.simulation import scenario
from maplines_can.study.figures import paper as figures
from maplines_can.study.figures import paper_panels as panels
from maplines_can.study.roads import PAPER
from maplines_can.values.errors import MissingExtraError
from maplines_can.values.line import lateral

SAMPLES = 1500
PLANS = {plan.number: plan for plan in figures.FIGURES}
BLUE, VERMILLION = "#0072b2", "#d55e00"


@pytest.fixture(scope="module")
def case_of() -> Any:
    """Return a function for cases, each computed once."""
    known: dict[str, Any] = {}

    def case(number: int) -> Any:
        name = PLANS[number].scenario
        if name not in known:
            known[name] = figures.case_of(scenario(name), SAMPLES, seed=0)
        return known[name]

    return case


@pytest.fixture(scope="module")
def drawn(case_of: Any) -> Any:
    """Return a function for figures before and after the wire, each drawn once."""
    known: dict[Any, Any] = {}

    def figure(number: int, wire: bool = False) -> Any:
        if (number, wire) not in known:
            codec = Codec.from_dbc() if wire else None
            known[number, wire] = figures.draw_case(case_of(number), PLANS[number], codec=codec)
        return known[number, wire]

    return figure


def parts(figure: Any) -> Any:
    """Return map panels, correlations and the grid of marginals, in the order of the page."""
    axes = figure.axes
    assert len(axes) == 4 + 1 + 16
    return axes[:4], axes[4], np.array(axes[5:]).reshape(4, 4)


def texts(ax: Any) -> Any:
    return [text.get_text() for text in ax.texts]


def of_type(ax: Any, name: Any) -> Any:
    return [artist for artist in ax.get_children() if type(artist).__name__ == name]


def test_files_do_not_depend_on_the_user_s_settings(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Files are in order, and depend on the seed, but not on the time or on matplotlibrc."""
    monkeypatch.setattr(figures, "FIGURES", (PLANS[5], PLANS[7]))
    monkeypatch.setattr(figures, "DPI", 30)
    seen: list[Any] = []

    def draw(folder: str, **settings: Any) -> Any:
        paths = figures.draw_figures(tmp_path / "new" / folder, samples=300, **settings)
        return {path.name: path.read_bytes() for path in paths}

    first = draw("first", formats=("svg",), progress=lambda *n: seen.append(n))
    names = ["05-highway", "05-highway-wire", "06-close-up"]
    names += ["07-highway-correlated", "07-highway-correlated-wire"]
    assert list(first) == [f"figure-{name}.svg" for name in names]
    assert seen == [(i, 5) for i in range(1, 6)]
    assert len(first["figure-05-highway.svg"]) < 1_000_000
    monkeypatch.setattr(figures, "FIGURES", (PLANS[7],))
    with mpl.rc_context({"font.size": 20, "svg.hashsalt": "other", "axes.facecolor": "red"}):
        second = draw("second")
        assert mpl.rcParams["font.size"] == 20  # the settings are restored
    assert [name for name in second if second[name] != first.get(name)] == [
        f"figure-{name}.png" for name in names[3:]
    ]
    for path in (tmp_path / "new" / "second").glob("*.png"):
        pixels = imread(path)
        assert pixels[0, 0].tolist() == [1, 1, 1, 1]  # opaque white, on any screen
        assert pixels[..., :3].min() < 0.1
    cases = [figures.case_of(scenario("highway"), 300, seed) for seed in (0, 0, 1)]
    assert np.array_equal(cases[0].lines, cases[1].lines)
    assert not np.array_equal(cases[0].lines, cases[2].lines)


def test_a_case_has_the_results_of_the_transforms(case_of: Any) -> None:
    """A case has the results of MonteCarlo and SigmaPoints for the line EGO_RIGHT."""
    case, example = case_of(10), scenario("street-turn")
    refit = Refit(example.lines[figures.SLOT], example.ego.mean, example.window, **PAPER)
    draws = MonteCarlo(SAMPLES, 0).samples(refit, example.ego)
    np.testing.assert_array_equal(draws.values, case.lines)
    np.testing.assert_allclose(draws.inputs, case.poses, atol=1e-12)
    expected = MonteCarlo(SAMPLES, 0)(refit, example.ego)
    np.testing.assert_allclose(expected.cov, case.monte_carlo.cov, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(SigmaPoints()(refit, example.ego).cov, case.sigma_points.cov)
    assert (case.sigma_poses.shape, case.sigma_lines.shape) == ((7, 3), (7, 4))


@pytest.mark.parametrize("wire", [False, True])
def test_content_of_the_map_panels(case_of: Any, drawn: Any, wire: bool) -> None:
    """200 samples and 7 sigma points as arrows and exact cubics, and 200 lines of each Gaussian."""
    maps, _, _ = parts(drawn(11, wire))
    case, samples = case_of(11), maps[0]
    lines, arrows = (200, 200, 7, 200), ([2, 1, 200], [2, 1], [2, 1, 7], [2, 1])
    for ax, count, quivers in zip(maps, lines, arrows, strict=True):
        (paths,) = of_type(ax, "PathCollection")
        assert len(paths.get_paths()) == count
        # the fan's edges, its middle, the poses
        assert [quiver.N for quiver in of_type(ax, "Quiver")] == quivers
        assert (ax.get_xlim(), ax.get_ylim()) == (samples.get_xlim(), samples.get_ylim())
    assert samples.get_ylim()[1] - samples.get_ylim()[0] < 50  # no outlier changes the scale
    colours = [to_hex(of_type(ax, "PathCollection")[0].get_edgecolor()) for ax in maps]
    assert [colours[1], colours[3]] == [BLUE, VERMILLION]
    assert wire == ("decoded" in maps[1].get_title(loc="left"))
    quiver = of_type(samples, "Quiver")[-1]
    np.testing.assert_allclose(quiver.XY, case.poses[:200, :2])
    np.testing.assert_allclose(np.arctan2(quiver.V, quiver.U), case.poses[:200, 2], atol=1e-12)
    t = np.linspace(0, 1, 50)[:, None]
    weights = np.hstack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    for path, line in zip(
        of_type(samples, "PathCollection")[0].get_paths(), case.lines, strict=False
    ):
        x, y = (weights @ path.vertices).T
        np.testing.assert_allclose(lateral(line, x), y, atol=1e-9 * np.abs(y).max())


def test_car_and_band_are_in_each_map_panel(case_of: Any, drawn: Any) -> None:
    """Ellipse and fan of the car hold 99 %, so does the band; the mean pose's line is dotted."""
    case = case_of(10)
    ego = case.scenario.ego
    for ax in parts(drawn(10))[0]:
        (ellipse,) = (line.get_xydata() for line in ax.lines if len(line.get_xdata()) == 120)
        distances = ego.marginal([0, 1]).mahalanobis(ellipse)
        np.testing.assert_allclose(distances, np.sqrt(-2 * np.log(0.01)))
        fan = of_type(ax, "Quiver")[0]
        assert abs(np.arctan2(fan.V, fan.U)) == pytest.approx(2.5758 * ego.sigma[2])
        (dotted,) = (line for line in ax.lines if line.get_linewidth() == 1.8)
        np.testing.assert_allclose(lateral(case.refit(ego.mean), dotted.get_xdata()),
                                   dotted.get_ydata())  # fmt: skip
        low, high = (line for line in ax.lines if line.get_linewidth() == 0.9)
        for x, bottom, top in zip(low.get_xdata(), low.get_ydata(), high.get_ydata(), strict=True):
            y = lateral(case.lines, x)
            assert np.mean((bottom <= y) & (y <= top)) == pytest.approx(0.99, abs=2 / SAMPLES)


@pytest.mark.parametrize("number", [10, 11])
def test_correlations_are_those_of_the_sigma_points(case_of: Any, drawn: Any, number: int) -> None:
    """Number, colour and area of each square, with Monte Carlo's numbers below."""
    case, matrix = case_of(number), parts(drawn(number))[1]
    R, R_monte_carlo = case.sigma_points.correlation, case.monte_carlo.correlation
    squares = {}
    for square in matrix.patches:
        if square.get_linewidth() == 0:
            x, y = square.get_center()
            squares[round(y), round(x)] = square

    def signed(r: Any) -> str:
        return f"{r:+.3f}" if abs(r) >= 0.0005 else "0"

    for i, j in combinations(range(4), 2):
        for pair in ((i, j), (j, i)):
            r, square = R[pair], squares[pair]
            assert square.get_width() * square.get_height() == pytest.approx(0.96**2 * abs(r))
            red, _, blue, _ = square.get_facecolor()
            assert abs(r) < 0.01 or (red > blue) == (r > 0)
        assert texts(matrix).count(signed(R[i, j])) >= 2
        assert texts(matrix).count(f"MC {signed(R_monte_carlo[i, j])}") >= 2
    assert f"{case.sigma_points.sigma[0]:.3g} m" in texts(matrix)
    assert f"{np.degrees(case.sigma_points.sigma[1]):.3g} deg" in texts(matrix)


def test_figure_9_sends_variances_and_no_covariances(case_of: Any, drawn: Any) -> None:
    """All correlations are zero, also when decoded; the panel shows the original ones."""
    case = case_of(9)
    for codec in (None, Codec.from_dbc()):
        for layer in figures.layers_of(case, PLANS[9], codec):
            np.testing.assert_allclose(layer.gaussian.correlation, np.eye(4), atol=1e-12)
    written = texts(parts(drawn(9))[1])
    assert written.count("0") == 12
    assert written.count(f"was {case.sigma_points.correlation[1, 3]:+.3f}") == 2


@pytest.mark.parametrize("number", PLANS)
def test_after_the_wire_the_layers_are_decoded(case_of: Any, number: int) -> None:
    """Each layer covers the sent Gaussian, and keeps it for comparison."""
    before, after = (
        figures.layers_of(case_of(number), PLANS[number], codec)
        for codec in (None, Codec.from_dbc())
    )
    for sent, layer in zip(before, after, strict=True):
        decoded, S = layer.gaussian, sent.gaussian.cov
        assert layer.before is not None
        np.testing.assert_array_equal(S, layer.before.cov)
        assert not np.array_equal(decoded.cov, S)
        d, scale = decoded.mean - sent.gaussian.mean, np.outer(decoded.sigma, decoded.sigma)
        assert np.linalg.eigvalsh((decoded.cov - S - np.outer(d, d)) / scale)[0] >= -1e-9
        np.testing.assert_allclose(decoded.sigma, sent.gaussian.sigma, rtol=0.15)


def test_marginals(case_of: Any, drawn: Any) -> None:
    """Dots, both ellipses of 99 %, histograms of all samples, and the shares outside."""
    case, grid = case_of(10), parts(drawn(10))[2]
    gaussians = {BLUE: case.monte_carlo, VERMILLION: case.sigma_points}
    for i, j in np.ndindex(4, 4):
        ax = grid[i, j]
        curves = {to_hex(c.get_color()): c.get_xydata() for c in ax.lines if len(c.get_xdata()) > 1}
        assert ax.get_xlim() == grid[3, j].get_xlim()
        if i == j:
            (histogram,) = of_type(ax, "StepPatch")
            values, edges, _ = histogram.get_data()
            assert (values * np.diff(edges)).sum() == pytest.approx(1, abs=0.02)
            for colour in gaussians:
                x, density = curves[colour].T
                assert np.trapezoid(density, x) == pytest.approx(1, abs=0.01)
            continue
        dots = curves[to_hex(panels.TRUE)]
        np.testing.assert_allclose(dots, (case.lines * panels.UNITS)[:, [j, i]])
        for colour, gaussian in gaussians.items():
            distances = gaussian.marginal([j, i]).mahalanobis(curves[colour] / panels.UNITS[[j, i]])
            np.testing.assert_allclose(distances, np.sqrt(-2 * np.log(0.01)))
        if i < j:
            assert texts(ax) == [
                f"{100 * (1 - g.marginal([i, j]).coverage(case.lines[:, [i, j]])):.1f} %"
                for g in gaussians.values()
            ]
    shares = [f"{100 * (1 - g.coverage(case.lines)):.1f} %" for g in gaussians.values()]
    assert texts(grid[0, 0]) == [*shares, "4-D:"]
    assert all(ax.lines[0].get_rasterized() for ax in grid[np.triu_indices(4, 1)])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        pytest.param({"formats": ("png", "bmp")}, r"png, svg, pdf, got \['bmp'\]", id="format"),
        pytest.param({"samples": 99}, "100 or more, got 99", id="samples"),
        pytest.param(None, r'pip install -e "\.\[plot\]"', id="no-matplotlib"),
    ],
)
def test_mistakes_raise_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: Any, message: str
) -> None:
    if arguments is None:
        monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises((ValueError, MissingExtraError), match=message):
        figures.draw_figures(tmp_path / "out", **(arguments or {}))
    assert not (tmp_path / "out").exists()
