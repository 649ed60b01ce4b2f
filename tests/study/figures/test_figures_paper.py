"""The figures of the paper: their data, their text, and reproducible files."""

import re
import sys
import xml.etree.ElementTree as ET
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
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import lateral

SAMPLES = 1500
PLANS = {plan.number: plan for plan in figures.FIGURES}
BLUE, VERMILLION = "#0072b2", "#d55e00"


@pytest.fixture(scope="module")
def codec() -> Any:
    return Codec.from_dbc()


@pytest.fixture(scope="module")
def case_of() -> Any:
    """Return a function for cases, each computed once."""
    known: dict[str, Any] = {}

    def case(plan: Any) -> Any:
        if plan.scenario not in known:
            known[plan.scenario] = figures.case_of(scenario(plan.scenario), SAMPLES, seed=0)
        return known[plan.scenario]

    return case


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw only two figures and the close-up, at a low resolution."""
    monkeypatch.setattr(figures, "FIGURES", (PLANS[5], PLANS[7]))
    monkeypatch.setattr(figures, "DPI", 40)


def parts(figure: Any) -> Any:
    """Return map panels, correlations and the grid of marginals, in the order of the page."""
    axes = figure.axes
    assert len(axes) == 4 + 1 + 16
    return axes[:4], axes[4], np.array(axes[5:]).reshape(4, 4)


def texts(ax: Any) -> Any:
    return [text.get_text() for text in ax.texts]


def signed(r: Any) -> Any:
    return f"{r:+.3f}" if abs(r) >= 0.0005 else "0"


def of_type(ax: Any, name: Any) -> Any:
    return [artist for artist in ax.get_children() if type(artist).__name__ == name]


def test_all_figures_are_planned() -> None:
    """The paper has six figures of one structure; one of them sends variances only."""
    assert [(plan.number, plan.scenario, plan.variances_only) for plan in figures.FIGURES] == [
        (5, "highway", False),
        (7, "highway-correlated", False),
        (8, "highway-10deg", False),
        (9, "highway", True),
        (10, "street-turn", False),
        (11, "street-turn-10deg", False),
    ]
    names = {plan.name(wire=wire) for plan in figures.FIGURES for wire in (False, True)}
    assert len(names) == 12
    assert all(plan.reading and plan.reading.count("\n") <= 1 for plan in figures.FIGURES)


def test_files_in_both_formats(few: None, tmp_path: Path) -> None:
    """Files are in order, and progress is reported for each one."""
    seen, out = [], tmp_path / "new" / "folder"
    paths = figures.draw_figures(out, samples=300, progress=lambda *n: seen.append(n))
    assert [
        f"{name}.{suffix}"
        for name in (
            "figure-05-highway",
            "figure-05-highway-wire",
            "figure-06-close-up",
            "figure-07-highway-correlated",
            "figure-07-highway-correlated-wire",
        )
        for suffix in ("png", "svg")
    ] == [path.name for path in paths]
    assert sorted(out.iterdir()) == sorted(paths)
    assert seen == [(i, 10) for i in range(1, 11)]
    for path in paths:
        if path.suffix == ".png":
            pixels = imread(path)
            assert pixels[0, 0].tolist() == [1, 1, 1, 1]  # opaque white, on any screen
            assert pixels[..., :3].min() < 0.1
        else:
            assert path.stat().st_size < 1_000_000
            assert ET.parse(path).getroot().tag.endswith("svg")  # noqa: S314, our own file


def test_files_do_not_depend_on_the_user_s_settings(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Files depend on the seed, but not on the time or on matplotlibrc."""
    monkeypatch.setattr(figures, "FIGURES", (PLANS[10],))
    monkeypatch.setattr(figures, "DPI", 30)

    def draw(folder: Any, **settings: Any) -> Any:
        paths = figures.draw_figures(tmp_path / folder, samples=300, **settings)
        return [path.read_bytes() for path in paths]

    first = draw("first")
    with mpl.rc_context({"font.size": 20, "svg.hashsalt": "other", "axes.facecolor": "red"}):
        assert first == draw("second")
        assert mpl.rcParams["font.size"] == 20  # the settings are restored
    assert first[1::2] != draw("third", seed=1, formats=("svg",))


def test_a_case_has_the_results_of_the_transforms(case_of: Any) -> None:
    """A case has the results of MonteCarlo and SigmaPoints for the line EGO_RIGHT."""
    case, example = case_of(PLANS[10]), scenario("street-turn")
    refit = Refit(example.lines[figures.SLOT], example.ego.mean, example.window, **PAPER)
    draws = MonteCarlo(SAMPLES, 0).samples(refit, example.ego)
    np.testing.assert_array_equal(draws.values, case.lines)
    np.testing.assert_allclose(draws.inputs, case.poses, atol=1e-12)
    expected = MonteCarlo(SAMPLES, 0)(refit, example.ego)
    np.testing.assert_allclose(expected.cov, case.monte_carlo.cov, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(SigmaPoints()(refit, example.ego).cov, case.sigma_points.cov)
    assert case.sigma_poses.shape == (7, 3)
    assert case.sigma_lines.shape == (7, 4)


@pytest.mark.parametrize("wire", [False, True])
def test_content_of_the_map_panels(case_of: Any, codec: Any, wire: bool) -> None:
    """200 samples and 7 sigma points as arrows and lines, and 200 lines of each Gaussian."""
    plan = PLANS[11]
    figure = figures.draw_case(case_of(plan), plan, codec=codec if wire else None)
    maps, _, _ = parts(figure)
    samples, monte_carlo, sigma, sigma_gaussian = maps
    for ax, lines, arrows in (
        (samples, 200, [2, 1, 200]),  # the fan's edges, its middle, the poses
        (sigma, 7, [2, 1, 7]),
        (monte_carlo, 200, [2, 1]),
        (sigma_gaussian, 200, [2, 1]),
    ):
        (drawn,) = of_type(ax, "PathCollection")
        assert len(drawn.get_paths()) == lines
        assert [quiver.N for quiver in of_type(ax, "Quiver")] == arrows
        assert ax.get_xlim() == samples.get_xlim()  # no outlier changes the scale
        assert ax.get_ylim() == samples.get_ylim()
    assert samples.get_ylim()[1] - samples.get_ylim()[0] < 50
    colours = [to_hex(of_type(ax, "PathCollection")[0].get_edgecolor()) for ax in maps]
    assert [colours[1], colours[3]] == [BLUE, VERMILLION]
    assert wire == ("decoded" in monte_carlo.get_title(loc="left"))


def test_arrows_are_at_the_poses_and_point_along_them(case_of: Any) -> None:
    """The tail is at the position, the angle is the heading."""
    case = case_of(PLANS[5])
    maps, _, _ = parts(figures.draw_case(case, PLANS[5]))
    quiver = of_type(maps[0], "Quiver")[-1]
    np.testing.assert_allclose(quiver.XY, case.poses[:200, :2])
    np.testing.assert_allclose(np.arctan2(quiver.V, quiver.U), case.poses[:200, 2], atol=1e-12)


def test_a_drawn_line_is_exactly_the_cubic(case_of: Any) -> None:
    """The Bezier curve of a line lies on l(x) everywhere."""
    case = case_of(PLANS[11])
    maps, _, _ = parts(figures.draw_case(case, PLANS[11]))
    (drawn,) = of_type(maps[0], "PathCollection")
    t = np.linspace(0, 1, 50)[:, None]
    weights = np.hstack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    for path, line in zip(drawn.get_paths(), case.lines, strict=False):
        x, y = (weights @ path.vertices).T
        np.testing.assert_allclose(lateral(line, x), y, atol=1e-9 * np.abs(y).max())


def test_car_and_mean_pose_are_in_each_map_panel(case_of: Any) -> None:
    """The ellipse has the radius of 99 %, the fan the angle of 99 %, the mean's line is dotted."""
    case = case_of(PLANS[7])
    maps, _, _ = parts(figures.draw_case(case, PLANS[7]))
    ego = case.scenario.ego
    for ax in maps:
        ellipse = next(
            line.get_xydata() for line in ax.lines if len(line.get_xdata()) == 120
        )  # only the ellipse has as many points
        distances = ego.marginal([0, 1]).mahalanobis(ellipse)
        np.testing.assert_allclose(distances, np.sqrt(-2 * np.log(0.01)))
        fan = of_type(ax, "Quiver")[0]
        assert abs(np.arctan2(fan.V, fan.U)) == pytest.approx(2.5758 * ego.sigma[2])
        dotted = [line for line in ax.lines if line.get_linewidth() == 1.8]
        assert len(dotted) == 1
        x, y = dotted[0].get_data()
        np.testing.assert_allclose(lateral(case.refit(ego.mean), x), y)
        assert dotted[0].get_linestyle() == "--"  # matplotlib's name for any custom pattern
        assert to_hex(dotted[0].get_color()) == "#000000"


def test_the_band_holds_99_percent_of_the_true_lines(case_of: Any) -> None:
    """Its edges are quantiles at each x."""
    case = case_of(PLANS[10])
    maps, _, _ = parts(figures.draw_case(case, PLANS[10]))
    low, high = (line for line in maps[1].lines if line.get_linewidth() == 0.9)
    for x, bottom, top in zip(low.get_xdata(), low.get_ydata(), high.get_ydata(), strict=True):
        y = lateral(case.lines, x)
        assert np.mean((bottom <= y) & (y <= top)) == pytest.approx(0.99, abs=2 / SAMPLES)


@pytest.mark.parametrize("number", [5, 11])
def test_correlations_are_those_of_the_sigma_points(case_of: Any, number: int) -> None:
    """Number, colour and area of each square, with Monte Carlo's numbers below."""
    case = case_of(PLANS[number])
    _, matrix, _ = parts(figures.draw_case(case, PLANS[number]))
    written = texts(matrix)
    R, R_monte_carlo = case.sigma_points.correlation, case.monte_carlo.correlation
    squares = {}
    for square in matrix.patches:
        if square.get_linewidth() == 0:
            x, y = square.get_center()
            squares[round(y), round(x)] = square
    for i, j in combinations(range(4), 2):
        for pair in ((i, j), (j, i)):
            r = R[pair]
            square = squares[pair]
            assert square.get_width() * square.get_height() == pytest.approx(0.96**2 * abs(r))
            red, _, blue, _ = square.get_facecolor()
            assert abs(r) < 0.01 or (red > blue) == (r > 0)
        assert written.count(signed(R[i, j])) >= 2
        assert written.count(f"MC {signed(R_monte_carlo[i, j])}") >= 2
    assert f"{case.sigma_points.sigma[0]:.3g} m" in written
    assert f"{np.degrees(case.sigma_points.sigma[1]):.3g} deg" in written


def test_figure_9_sends_variances_and_no_covariances(case_of: Any, codec: Any) -> None:
    """All correlations are zero, also when decoded; the panel shows the original ones."""
    plan = PLANS[9]
    case = case_of(plan)
    for layers in (figures.layers_of(case, plan, None), figures.layers_of(case, plan, codec)):
        for layer in layers:
            np.testing.assert_allclose(layer.gaussian.correlation, np.eye(4), atol=1e-12)
    _, matrix, _ = parts(figures.draw_case(case, plan))
    assert texts(matrix).count("0") == 12
    assert texts(matrix).count(f"was {case.sigma_points.correlation[1, 3]:+.3f}") == 2


@pytest.mark.parametrize("number", PLANS)
def test_after_the_wire_the_layers_are_decoded(case_of: Any, codec: Any, number: Any) -> None:
    """Each layer covers the sent Gaussian, and keeps it for comparison."""
    plan = PLANS[number]
    case = case_of(plan)
    for layer, sent in zip(
        figures.layers_of(case, plan, codec), figures.layers_of(case, plan, None), strict=True
    ):
        np.testing.assert_array_equal(sent.gaussian.cov, layer.before.cov)  # type: ignore[union-attr]
        decoded, S = layer.gaussian, sent.gaussian.cov
        assert not np.array_equal(decoded.cov, S)
        d = decoded.mean - sent.gaussian.mean
        scale = np.outer(decoded.sigma, decoded.sigma)
        assert np.linalg.eigvalsh((decoded.cov - S - np.outer(d, d)) / scale)[0] >= -1e-9
        np.testing.assert_allclose(decoded.sigma, sent.gaussian.sigma, rtol=0.15)


def test_marginals(case_of: Any) -> None:
    """Dots, both ellipses of 99 %, histograms of all samples, and the shares outside."""
    plan = PLANS[10]
    case = case_of(plan)
    _, _, grid = parts(figures.draw_case(case, plan))
    for i, j in np.ndindex(4, 4):
        ax = grid[i, j]
        gaussians = {BLUE: case.monte_carlo, VERMILLION: case.sigma_points}
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
        assert dots.shape == (SAMPLES, 2)
        np.testing.assert_allclose(dots, (case.lines * panels.UNITS)[:, [j, i]])
        for colour, gaussian in gaussians.items():
            pair = gaussian.marginal([j, i])
            distances = pair.mahalanobis(curves[colour] / panels.UNITS[[j, i]])
            np.testing.assert_allclose(distances, np.sqrt(-2 * np.log(0.01)))
        if i < j:
            assert [
                f"{100 * (1 - g.marginal([i, j]).coverage(case.lines[:, [i, j]])):.1f} %"
                for g in gaussians.values()
            ] == texts(ax)
    assert [
        *(
            f"{100 * (1 - gaussian.coverage(case.lines)):.1f} %"
            for gaussian in (case.monte_carlo, case.sigma_points)
        ),
        "4-D:",
    ] == texts(grid[0, 0])
    assert all(ax.lines[0].get_rasterized() for ax in grid[np.triu_indices(4, 1)])


@pytest.mark.parametrize("wire", [False, True])
def test_the_head_describes_the_figure(case_of: Any, codec: Any, wire: bool) -> None:
    """Scenario, heading sigma, samples, line and reading; after the wire, the cost."""
    plan = PLANS[11]
    figure = figures.draw_case(case_of(plan), plan, codec=codec if wire else None)
    head = " ".join(text.get_text() for text in figure.texts)
    assert "Figure 11: street-turn-10deg" in head
    assert f"heading sigma 10 deg, n = {SAMPLES:,} samples, line EGO_RIGHT" in head
    if wire:
        assert "after the wire" in head
        costs = [float(cost) for cost in re.findall(r"[+-]\d+\.\d", head)]
        assert len(costs) == 4
        assert all(0 <= cost < 10 for cost in costs)  # wider, never narrower
    else:
        assert plan.reading in head
        assert "wire" not in head


def test_the_readings_are_true(case_of: Any) -> None:
    """The statements above the figures hold on these samples."""

    def outside(case: Any, gaussian: Any, pair: Any) -> Any:
        return 1 - gaussian.marginal(pair).coverage(case.lines[:, pair])

    beta, c0, c1 = 1, 2, 3
    highway, wider = case_of(PLANS[5]), case_of(PLANS[8])
    # Chords of 2 m deviate from the curve by up to 0.25 mm (0.075 mm rms about their mean), and
    # 64 nodes over 100 m determine c0 to 2.8e-4 1/m^2 times that.
    assert highway.refit(highway.scenario.ego.mean)[c0] == pytest.approx(5e-4, abs=1e-7)
    assert highway.lines[:, c0].min() > 4.97e-4  # the hard lower limit
    assert highway.monte_carlo.mean[c0] - 3 * highway.monte_carlo.sigma[c0] < 4.9e-4
    correlated = case_of(PLANS[7])
    change = abs(correlated.sigma_points.correlation - highway.sigma_points.correlation)
    assert change.max() == pytest.approx(change[0, c0])
    assert change.max() < 0.05
    assert abs(wider.sigma_points.correlation[c0, c1]) > abs(
        highway.sigma_points.correlation[c0, c1]
    )
    assert 1 - wider.sigma_points.coverage(wider.lines) > 0.5
    sent = highway.monte_carlo
    variances = Gaussian(sent.mean, np.diag(sent.cov.diagonal()))
    areas = [np.linalg.det(gaussian.marginal([beta, c1]).cov) for gaussian in (variances, sent)]
    assert np.sqrt(areas[0] / areas[1]) > 3
    assert variances.coverage(highway.lines) < sent.coverage(highway.lines)
    turn, wide_turn = case_of(PLANS[10]), case_of(PLANS[11])
    assert (np.abs(turn.sigma_points.correlation[1:, 1:]) > 0.6).all()
    assert outside(turn, turn.monte_carlo, [c0, c1]) < 0.04
    heading, rate = wide_turn.lines[:, [beta, c1]].T
    curve = np.polynomial.Polynomial.fit(heading, rate, 8)
    seen, true = (g.correlation[beta, c1] for g in (wide_turn.sigma_points, wide_turn.monte_carlo))
    in_ellipse = wide_turn.monte_carlo.sigma[c1] * np.sqrt(1 - true**2)  # of c1, at a given beta
    assert np.median(np.abs(rate - curve(heading))) < 0.2 * in_ellipse
    assert seen < true - 0.05


def test_close_up(case_of: Any) -> None:
    """Sigma points left, samples right, the plain car above the correlated one."""
    figure = figures.draw_close_up([case_of(PLANS[5]), case_of(PLANS[7])])
    assert [ax.get_title(loc="left") for ax in figure.axes] == [
        "highway: 7 sigma points",
        "highway: 200 Monte Carlo samples",
        "highway-correlated: 7 sigma points",
        "highway-correlated: 200 Monte Carlo samples",
    ]
    assert [of_type(ax, "Quiver")[-1].N for ax in figure.axes] == [7, 200, 7, 200]
    assert all(ax.get_xlim() == (-2.6, 2.6) == ax.get_ylim() for ax in figure.axes)


def test_without_matplotlib_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The error is raised before anything is written."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r'pip install "\.\[plot\]"'):
        figures.draw_figures(tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        pytest.param({"formats": ("png", "bmp")}, r"png, svg, pdf, got \['bmp'\]", id="format"),
        pytest.param({"samples": 99}, "100 or more, got 99", id="samples"),
    ],
)
def test_invalid_arguments_raise_before_drawing(
    tmp_path: Path, arguments: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        figures.draw_figures(tmp_path / "out", **arguments)
    assert not (tmp_path / "out").exists()
