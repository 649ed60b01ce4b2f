"""The figures of the paper's evaluation, before and after the wire (Map Line Interface, IV).

Each figure has the structure of the paper's section IV-A. Lines are drawn as the car sees them,
in the frame of the mean pose; arrows are poses on the map.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...pictures.figure import save_figure
from ...propagation import MonteCarlo, Refit, SigmaPoints
from ...simulation.scenarios import SCENARIOS, Scenario
from ...values.coding_loss import LATERAL_X
from ...values.errors import missing_extra
from ...values.gaussian import Gaussian
from ...values.line import Slot, lateral, lateral_jacobian
from ...values.polyline import to_ego
from ...wire import Codec
from ..representations import Approximation, through_the_wire
from ..roads import paper_refit
from .paper_panels import (
    TRUE,
    Layer,
    LineStyle,
    PanelView,
    draw_correlation,
    draw_legend,
    draw_lines,
    draw_map,
    draw_marginals,
    draw_mean,
    draw_poses,
    place_inset,
)

Array = NDArray[np.float64]

#: The line of all figures: the right boundary of the car's lane, as in the paper's figure 2.
SLOT = Slot.EGO_RIGHT
#: Samples drawn as arrows and lines; more would hide each other.
LINES = 200


@dataclass(frozen=True, eq=False)
class Case:
    """A scenario's line: its true distribution and two Gaussian approximations."""

    scenario: Scenario
    refit: Refit
    poses: Array  #: (n, 3) Monte Carlo draws, in the frame of the mean pose
    lines: Array  #: (n, 4) their lines: the true distribution
    ill_posed: int  #: draws left out, from which no cubic y(x) follows the points
    monte_carlo: Gaussian
    sigma_poses: Array  #: (7, 3) in the frame of the mean pose
    sigma_lines: Array  #: (7, 4)
    sigma_points: Gaussian

    @property
    def shown(self) -> tuple[tuple[Array, Array, str], ...]:
        """Drawn poses, their lines and their name: sigma points, then samples."""
        return (
            (self.sigma_poses, self.sigma_lines, "sigma points"),
            (self.poses[:LINES], self.lines[:LINES], "Monte Carlo samples"),
        )


def case_of(scenario: Scenario, samples: int, seed: int) -> Case:
    """Return the distribution of a scenario's line ``SLOT``, by sampling and by sigma points."""
    ego, refit = scenario.ego, paper_refit(scenario, SLOT)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the figure prints the number of draws left out
        draws = MonteCarlo(samples, seed).samples(refit, ego)
    transform = SigmaPoints()
    sigma_poses = transform.rule(ego).points(ego)

    def in_ego_frame(poses: Array) -> Array:
        return np.column_stack([to_ego(poses[:, :2], ego.mean), poses[:, 2] - ego.mean[2]])

    return Case(
        scenario=scenario,
        refit=refit,
        poses=in_ego_frame(draws.inputs),
        lines=draws.values,
        ill_posed=draws.ill_posed,
        monte_carlo=Gaussian(draws.values.mean(axis=0), np.cov(draws.values.T, bias=True)),
        sigma_poses=in_ego_frame(sigma_poses),
        sigma_lines=refit(sigma_poses),
        sigma_points=transform(refit, ego),
    )


def view_of(case: Case) -> PanelView:
    """Return the view of a case's map panels."""
    low, high = (float(x) for x in case.refit.x_range)
    points = case.refit.points[0]
    bottom, top = points[:, 1].min(), points[:, 1].max()
    # Space for the lines around the points, in a shape that suits a page and any heading.
    tall = max(0.64 * (high - low), 1.5 * (top - bottom))
    wide = max(1.06 * (high - low), tall / 0.78)
    x, y = (low + high) / 2, 0.57 * bottom + 0.43 * top  # false lines run below a left turn
    true = lateral(case.lines[:20_000, None], np.linspace(low, high, 60))
    return PanelView(
        ego=Gaussian(np.zeros(3), case.scenario.ego.cov),
        line=case.refit(case.scenario.ego.mean),
        points=points,
        x_range=(low, high),
        band=np.quantile(true, [0.005, 0.995], axis=0),
        limits=(x - wide / 2, x + wide / 2, y - tall / 2, y + tall / 2),
        arrow=0.04 * (high - low),
        fan=0.16 * (high - low),
    )


def close_up(view: PanelView) -> PanelView:
    """Return the view of the vicinity of the car."""
    return replace(view, band=np.empty((0, 60)), limits=(-2.6, 2.6, -2.6, 2.6), arrow=0.6, fan=2.3)


# ---- figures ------------------------------------------------------------------------------------

#: Samples drawn as dots; more would hide each other.
DOTS = 3000
#: Fewer samples show no distribution.
MIN_SAMPLES = 100
#: Widths and heights [in]; left ends of the two columns.
WIDTH, PANEL, HEAD, FOOT = 10.6, 4.6, 1.72, 0.72
COLUMNS = (0.55, 5.7)
DPI = 150
TITLE: dict[str, Any] = {"fontsize": 13, "fontweight": "bold"}
#: Metadata that would differ between two runs, switched off.
METADATA: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}
#: Okabe and Ito's blue and vermillion, as the paper's blue and red; also solid and dashed.
MONTE_CARLO_STYLE: tuple[str, str, LineStyle] = ("Monte Carlo", "#0072B2", "solid")
SIGMA_POINTS_STYLE: tuple[str, str, LineStyle] = ("sigma points", "#D55E00", (0, (4, 1.5)))


@dataclass(frozen=True)
class FigurePlan:
    """A figure of the paper: its number there, its scenario, and what it shows."""

    number: int
    scenario: str
    reading: str
    variances_only: bool = False

    def name(self, *, wire: bool = False) -> str:
        """Return the name of its file, without the suffix."""
        variances = "-variances-only" if self.variances_only else ""
        return f"figure-{self.number:02d}-{self.scenario}{variances}{'-wire' if wire else ''}"


#: Figure 6, the close-up of 5 and 7, has a structure of its own.
FIGURES = (
    FigurePlan(
        5,
        "highway",
        "The drawn lines fill the band of the true ones. But c0 has a hard lower limit, since "
        "turning the car either way raises it:\nhalf of each ellipse with c0 is empty.",
    ),
    FigurePlan(
        7,
        "highway-correlated",
        "Correlating e_x with e_y (see the car's ellipse) changes almost nothing: only y_off and "
        "c0 are slightly more correlated\nthan in figure 5.",
    ),
    FigurePlan(
        8,
        "highway-10deg",
        "Twice the heading sigma: the band is twice as wide, and c1 gets a lower limit like c0, "
        "with which it is more correlated.\nThe sigma points' Gaussian is so thin in one "
        "direction that most of the samples are outside it in 4-D.",
    ),
    FigurePlan(
        9,
        "highway",
        "Without correlations the ellipse of beta and c1 extends far beyond the thin curve of the "
        "samples: false positives.\nIn 4-D slightly more samples are outside the Monte Carlo "
        "Gaussian than in figure 5; the band of the lines is the same.",
        variances_only=True,
    ),
    FigurePlan(
        10,
        "street-turn",
        "Large correlations among beta, c0 and c1, whose marginals begin to curve. The Gaussians "
        "still hold the samples,\nand draw a few lines below the band, where no true line is.",
    ),
    FigurePlan(
        11,
        "street-turn-10deg",
        "One Gaussian fails: beta and c1 lie on a hooked curve, so most of their ellipse is empty, "
        "and lines are drawn below the\nband, where no true line is. The sigma points see less of "
        "the correlation of beta and c1.",
    ),
)
CLOSE_UP = "figure-06-close-up"
AFTER_THE_WIRE = (
    "Gaussians as received: colours are decoded, fine black dots were sent. "
    "The drawn lines use the same random numbers as before the wire."
)


#: File formats of the figures.
FORMATS = ("png", "svg")


def figure_paths(out: Path, formats: Sequence[str] = FORMATS) -> list[Path]:
    """Return the files that ``draw_figures`` writes into a folder, in another order."""
    names = [plan.name(wire=wire) for plan in FIGURES for wire in (False, True)]
    return [out / f"{name}.{suffix}" for name in (*names, CLOSE_UP) for suffix in formats]


def draw_figures(
    out: Path,
    *,
    seed: int = 0,
    samples: int = 100_000,
    formats: Sequence[str] = FORMATS,
    codec: Codec | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[Path]:
    """Draw figures 5 to 11 of the paper, each before and after the wire (6 only before).

    The same arguments give the same files, byte for byte, with the same versions of numpy and
    matplotlib. The background is opaque, so that the figures are legible in dark viewers too.

    Args:
        out: folder, which is created if it does not exist.
        seed: of all draws.
        samples: Monte Carlo draws per scenario; 200 of them are drawn as lines and 3000 as dots.
        formats: of png, svg and pdf.
        codec: of the wire; by default the project's own.
        progress: called after each file with the number of files done and the number of all files.

    Returns:
        The files, in the order of the figures.

    Raises:
        MissingExtraError: matplotlib is not installed.
        OSError: a file cannot be written.
        ValueError: a format is not supported, or fewer than 100 samples.
    """
    try:
        import matplotlib as mpl
    except ImportError as error:
        raise missing_extra("figures need matplotlib", "plot") from error
    if not samples >= MIN_SAMPLES:
        raise ValueError(f"samples must be {MIN_SAMPLES} or more, got {samples!r}")
    unknown = set(formats) - set(METADATA)
    if unknown:
        raise ValueError(f"formats must be of {', '.join(METADATA)}, got {sorted(unknown)}")
    codec = codec or Codec.from_dbc()
    cases = {
        name: case_of(SCENARIOS[name], samples, seed)
        for name in dict.fromkeys(plan.scenario for plan in FIGURES)
    }
    out.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    with mpl.rc_context():
        mpl.rcdefaults()  # do not depend on the user's settings
        mpl.rcParams.update({"svg.hashsalt": "maplines", "axes.linewidth": 0.7, "font.size": 9})
        for name, figure in _figures(cases, seed, codec):
            for suffix in formats:
                paths.append(out / f"{name}.{suffix}")
                save_figure(figure, paths[-1], DPI, metadata=METADATA[suffix])
                if progress is not None:
                    progress(len(paths), len(figure_paths(out, formats)))
    return paths


def _figures(cases: Mapping[str, Case], seed: int, codec: Codec) -> Iterator[tuple[str, Any]]:
    """Draw all figures, one at a time."""
    for plan in FIGURES:
        case = cases[plan.scenario]
        yield plan.name(), draw_case(case, plan, seed)
        yield plan.name(wire=True), draw_case(case, plan, seed, codec)
        if plan.number == 5:
            close_up = [cases["highway"], cases["highway-correlated"]]
            yield CLOSE_UP, draw_close_up(close_up)


def draw_case(case: Case, plan: FigurePlan, seed: int = 0, codec: Codec | None = None) -> Any:
    """Draw one figure of the paper's structure.

    Args:
        case: the scenario.
        plan: the figure.
        seed: of the lines drawn from the Gaussians.
        codec: encodes and decodes the Gaussians; None: as they are sent.

    Returns:
        A ``matplotlib.figure.Figure``.
    """
    from matplotlib.figure import Figure

    layers, view = layers_of(case, plan, codec), view_of(case)
    left, right, bottom, top = view.limits
    panel = PANEL * (top - bottom) / (right - left)
    row = panel + 0.62
    below = HEAD + 2 * row + 0.1
    height = below + PANEL + FOOT
    figure = Figure(figsize=(WIDTH, height), facecolor="white")

    def place(x: float, y: float, wide: float, tall: float) -> Any:
        """Return axes; all arguments are in inches, from the left and from the top."""
        return figure.add_axes((x / WIDTH, 1 - (y + tall) / height, wide / WIDTH, tall / height))

    def write(x: float, y: float, text: str, **style: Any) -> None:
        figure.text(x / WIDTH, 1 - y / height, text, **style)

    maps = [[place(x, HEAD + i * row, PANEL, panel) for x in COLUMNS] for i in range(2)]
    _draw_maps(maps, case, view, layers, seed)
    matrix = place(COLUMNS[0] - 0.1, below, PANEL - 0.1, PANEL - 0.1)
    draw_correlation(matrix, layers[1], *_compared(case, plan, layers))
    cell, step = 0.98, 1.17
    grid = [
        [place(COLUMNS[1] + 0.1 + j * step, below + i * step, cell, cell) for j in range(4)]
        for i in range(4)
    ]
    limits = draw_marginals(np.array(grid), case.lines, DOTS, layers)
    heading = np.degrees(case.scenario.ego.sigma[2])
    what = ", variances only" if plan.variances_only else ""
    where = ", after the wire" if codec else ""
    reading = f"{AFTER_THE_WIRE}\n{_cost(layers, view)}" if codec else plan.reading
    beyond = ((case.lines < limits[:, 0]) | (case.lines > limits[:, 1])).any(axis=1).mean()
    note = f"{100 * beyond:.2f} % of the samples are outside the axes of the marginals"
    if case.ill_posed:
        note += f"; draws left out, since no cubic y(x) follows the points: {case.ill_posed}"
    write(COLUMNS[0], 0.32, f"Figure {plan.number}: {case.scenario.name}{what}{where}", **TITLE)
    write(
        WIDTH - 0.3,
        0.32,
        f"heading sigma {heading:g} deg, n = {len(case.lines) + case.ill_posed:,} samples, "
        f"line {SLOT.name}",
        fontsize=9,
        ha="right",
    )
    write(COLUMNS[0], 0.45, reading, fontsize=10, va="top", linespacing=1.35)
    draw_legend(figure, layers, (COLUMNS[0] / WIDTH, 1 - 0.98 / height))
    caption = "marginals, 99 % regions, share of true samples outside"
    write(COLUMNS[1], below - 0.2, caption, fontsize=9.5)
    write(COLUMNS[0], height - 0.16, f"{note}.", fontsize=8, color="0.25")
    return figure


def draw_close_up(cases: Sequence[Case]) -> Any:
    """Draw figure 6, the vicinity of the car: sigma points left, samples right."""
    from matplotlib.figure import Figure

    width, side, head = 10.2, 4.55, 1.3
    height = head + len(cases) * (side + 0.5) + 0.2
    figure = Figure(figsize=(width, height), facecolor="white")
    for i, case in enumerate(cases):
        view = close_up(view_of(case))
        for j, (poses, lines, name) in enumerate(case.shown):
            x, y = 0.55 + j * (side + 0.45), head + (i + 1) * (side + 0.5) - 0.5
            ax = figure.add_axes((x / width, 1 - y / height, side / width, side / height))
            draw_map(ax, view, f"{case.scenario.name}: {len(poses)} {name}")
            draw_lines(ax, lines, view.x_range, TRUE, 0.8, 0.35 if j else 0.9)
            draw_poses(ax, poses, *((0.6, 0.6, 0.004) if j else (0.9, 1, 0.006)))
            if j == 0:
                ax.set_ylabel("y, to the left [m]", fontsize=8)
            if case is cases[-1]:
                ax.set_xlabel("x, ahead [m]", fontsize=8)
    x, heading = COLUMNS[0] / width, np.degrees(cases[0].scenario.ego.sigma[2])
    figure.text(x, 1 - 0.32 / height, "Figure 6: close-up of figures 5 and 7", **TITLE)
    note = (
        f"The same heading (sigma {heading:g} deg); below, e_x and e_y are correlated by 0.8. "
        f"n = {len(cases[0].lines):,} samples, line {SLOT.name}."
    )
    figure.text(x, 1 - 0.62 / height, note, fontsize=10)
    draw_legend(figure, [], (x, 1 - 0.74 / height))
    return figure


def layers_of(case: Case, plan: FigurePlan, codec: Codec | None) -> list[Layer]:
    """Return the two Gaussians that a figure shows."""
    layers = []
    for sent, style in (
        (case.monte_carlo, MONTE_CARLO_STYLE),
        (case.sigma_points, SIGMA_POINTS_STYLE),
    ):
        if plan.variances_only:
            sent = Gaussian(sent.mean, np.diag(sent.cov.diagonal()))
        layer = Layer(style[0], sent, *style[1:])
        if codec is not None:
            approximation, x_range = Approximation.gaussian(sent.mean, sent.cov), case.refit.x_range
            diagonal = plan.variances_only
            decoded = through_the_wire(approximation, codec, SLOT, x_range, diagonal=diagonal)
            assert decoded.covs is not None  # noqa: S101  # a Gaussian was sent
            layer = replace(
                layer, gaussian=Gaussian(decoded.means[0], decoded.covs[0]), before=sent
            )
        layers.append(layer)
    return layers


def _draw_maps(maps: Any, case: Case, view: PanelView, layers: Sequence[Layer], seed: int) -> None:
    near = close_up(view)
    for (ax, _), (poses, lines, name) in zip(maps, reversed(case.shown), strict=True):
        few = poses is case.sigma_poses
        draw_map(ax, view, f"{len(poses)} {name}: poses and their lines")
        line_style = (1, 0.9) if few else (0.6, 0.35)
        draw_lines(ax, lines, view.x_range, TRUE, *line_style)
        draw_poses(ax, poses, view.arrow, *((1, 0.006) if few else (0.35, 0.003)))
        inset = place_inset(ax, view)
        draw_map(inset, near)
        draw_poses(inset, poses, *((0.9, 1, 0.014) if few else (0.6, 0.5, 0.008)))
        inset.spines[:].set(visible=True, color="0.6")
        ax.set_ylabel("y, to the left [m]", fontsize=8)
    for (_, ax), layer in zip(maps, layers, strict=True):
        after = "" if layer.before is None else ", decoded"
        draw_map(ax, view, f"{LINES} lines drawn from the Gaussian of {layer.name}{after}")
        # All figures use the same random numbers, so that lines correspond before and after.
        drawn = layer.gaussian.sample(LINES, np.random.default_rng([seed, 2]))
        draw_lines(ax, drawn, view.x_range, layer.colour, 0.6, 0.35)
        draw_mean(ax, layer, view.x_range)
    for ax in maps[1]:
        ax.set_xlabel("x, ahead [m]", fontsize=8, labelpad=1)


def _compared(
    case: Case, plan: FigurePlan, layers: Sequence[Layer]
) -> tuple[tuple[str, Gaussian], str]:
    """Return name and Gaussian to compare the correlations with, and the panel's title."""
    before = layers[1].before
    if before is not None:
        return ("sent", before), "correlations, sigma points, decoded (sent: before the wire)"
    if plan.variances_only:
        return ("was", case.sigma_points), "correlations, sigma points, set to zero"
    return ("MC", case.monte_carlo), "correlations, sigma points (MC: Monte Carlo)"


def _cost(layers: Sequence[Layer], view: PanelView) -> str:
    """Return the increase in width of the lateral band by the wire, in words."""
    x = np.array([x for x in LATERAL_X if x <= view.x_range[1]])
    parts = []
    for layer in layers:
        before = layer.before or layer.gaussian
        sigma_after, sigma_before = (
            np.sqrt(np.einsum("xi,ij,xj->x", J, gaussian.cov, J))
            for gaussian in (layer.gaussian, before)
            for J in (lateral_jacobian(gaussian.mean, x),)
        )
        wider = ", ".join(f"{w:+.1f}" for w in 100 * (sigma_after / sigma_before - 1))
        parts.append(f"{layer.name} {wider} %")
    places = ", ".join(f"{place:g}" for place in x)
    return f"Sigma of l(x) at {places} m relative to the sent one: {'; '.join(parts)}."
