"""The figures of the paper's evaluation, before and after the wire (Map Line Interface, IV).

Each figure has the structure of the paper's section IV-A. Lines are drawn as the
car sees them, in the frame of the mean pose; arrows are the poses on the map.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import MissingExtraError
from ...gaussian import Gaussian
from ...line import Slot, Status, lateral, lateral_jacobian
from ...polyline import to_ego
from ...propagation import MonteCarlo, Refit, SigmaPoints
from ...scenarios import SCENARIOS, Scenario
from ...wire import Codec
from ..metrics import LATERAL_X
from . import panels
from .panels import Layer, LineStyle, View

__all__ = ["FIGURES", "SLOT", "Case", "FigurePlan", "case_of", "draw_case", "draw_figures"]

Array = NDArray[np.float64]

#: The line of all figures: the right boundary of the car's lane, as in the paper's figure 2.
SLOT = Slot.EGO_RIGHT
#: How many samples are drawn as arrows and lines, and as dots: more would only blacken the page.
LINES, DOTS = 200, 3000
#: Fewer samples show no distribution.
LEAST_SAMPLES = 100
#: Widths and heights [in]; where the two columns begin.
WIDTH, PANEL, HEAD, FOOT = 10.6, 4.6, 1.72, 0.72
COLUMNS = (0.55, 5.7)
DPI = 150
TITLE: dict[str, Any] = {"fontsize": 13, "fontweight": "bold"}
#: What would differ between two runs, switched off.
METADATA: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}
#: Okabe and Ito's blue and vermillion, as the paper's blue and red; solid and dashed besides.
MONTE_CARLO_STYLE: tuple[str, str, LineStyle] = ("Monte Carlo", "#0072B2", "solid")
SIGMA_POINTS_STYLE: tuple[str, str, LineStyle] = ("sigma points", "#D55E00", (0, (4, 1.5)))


@dataclass(frozen=True)
class FigurePlan:
    """A figure of the paper: its number there, its scene, and what to see."""

    number: int
    scenario: str
    reading: str
    variances_only: bool = False

    def name(self, *, wire: bool = False) -> str:
        """Name of its file, without the suffix."""
        variances = "-variances-only" if self.variances_only else ""
        return f"figure-{self.number:02d}-{self.scenario}{variances}{'-wire' if wire else ''}"


#: Figure 6, the close-up of 5 and 7, has a structure of its own.
FIGURES = (
    FigurePlan(
        5,
        "highway",
        "The drawn lines fill the band of the true ones. But c0 has a hard lower end, since "
        "turning the car either way raises it:\nhalf of each ellipse with c0 is empty.",
    ),
    FigurePlan(
        7,
        "highway-correlated",
        "Correlating e_x with e_y (see the car's ellipse) changes hardly a thing: only y_off and "
        "c0 correlate a little more\nthan in figure 5.",
    ),
    FigurePlan(
        8,
        "highway-10deg",
        "Twice the heading sigma: a band twice as wide, and c1 gets a lower end beside that of "
        "c0, with which it correlates more.\nThe sigma points' Gaussian is so thin in one "
        "direction that it leaves out most of the samples in 4-D.",
    ),
    FigurePlan(
        9,
        "highway",
        "Without correlations the ellipse of beta and c1 swells far beyond the thin curve of the "
        "samples: false positives.\nIn 4-D Monte Carlo leaves out a few samples more than in "
        "figure 5; the band of the lines is the same.",
        variances_only=True,
    ),
    FigurePlan(
        10,
        "street-turn",
        "Large correlations among beta, c0 and c1, whose marginals begin to bend. The Gaussians "
        "still hold the samples,\nand draw a few lines below the band where none is true.",
    ),
    FigurePlan(
        11,
        "street-turn-10deg",
        "One Gaussian fails: marginals with two arms, and lines drawn below the band where none "
        "is true. The sigma points miss\nhow c1 turns back, and leave out three samples in ten "
        "in beta and c1.",
    ),
)
AFTER_THE_WIRE = (
    "What a receiver gets: colours are decoded, fine black dots were sent. "
    "Each drawn line has its pair before the wire."
)


@dataclass(frozen=True, eq=False)
class Case:
    """A scene's line: its true distribution and the two Gaussians that stand for it."""

    scenario: Scenario
    refit: Refit
    poses: Array  #: (n, 3) Monte Carlo draws, in the frame of the mean pose
    lines: Array  #: (n, 4) their lines: the true distribution
    ill_posed: int  #: draws left out, from which no cubic y(x) follows the points
    monte_carlo: Gaussian
    sigma_poses: Array  #: (7, 3) in the frame of the mean pose
    sigma_lines: Array  #: (7, 4)
    sigma_points: Gaussian


def case_of(scenario: Scenario, samples: int, seed: int) -> Case:
    """The distribution of the line ``SLOT`` of a scene, by sampling and by sigma points."""
    polyline = next(line.polyline for line in scenario.lines if line.slot == SLOT)
    ego = scenario.ego
    refit = Refit(polyline, ego.mean, scenario.window)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # draws left out are counted, and the figure says so
        draws = MonteCarlo(samples, seed).samples(refit, ego)
    transform = SigmaPoints()
    sigma_poses = transform.points(ego)
    return Case(
        scenario=scenario,
        refit=refit,
        poses=_in_ego_frame(draws.inputs, ego.mean),
        lines=draws.values,
        ill_posed=draws.ill_posed,
        monte_carlo=Gaussian(draws.values.mean(axis=0), np.cov(draws.values.T, bias=True)),
        sigma_poses=_in_ego_frame(sigma_poses, ego.mean),
        sigma_lines=refit(sigma_poses),
        sigma_points=transform(refit, ego),
    )


def draw_figures(
    out: Path,
    *,
    seed: int = 0,
    samples: int = 100_000,
    formats: Sequence[str] = ("png", "svg"),
    codec: Codec | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[Path]:
    """Draw figures 5 to 11 of the paper, and each scene once more after the wire.

    The same arguments give the same files, byte for byte, with the same
    versions of numpy and matplotlib. The background is white and not
    transparent, so that the dark text is read on a dark screen too.

    Args:
        out: folder, made where it is missing.
        seed: of all draws.
        samples: Monte Carlo draws a scene; 200 of them are drawn as lines and 3000 as dots.
        formats: of png, svg and pdf.
        codec: of the wire; by default the project's own.
        progress: called after each file with the number done and the number of all.

    Returns:
        The files, in the order of the figures.

    Raises:
        MissingExtraError: matplotlib is not installed.
        OSError: a file cannot be written.
        ValueError: an unknown format, or fewer than 100 samples.
    """
    try:
        import matplotlib as mpl
    except ImportError as error:
        raise MissingExtraError(
            'figures need matplotlib: pip install "maplines_can[plot]"'
        ) from error
    if not samples >= LEAST_SAMPLES:
        raise ValueError(f"samples must be {LEAST_SAMPLES} or more, got {samples!r}")
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
        mpl.rcdefaults()  # whatever the reader's own settings are
        mpl.rcParams.update({"svg.hashsalt": "maplines", "axes.linewidth": 0.7, "font.size": 9})
        for name, figure in _figures(cases, seed, codec):
            for suffix in formats:
                paths.append(out / f"{name}.{suffix}")
                figure.savefig(paths[-1], dpi=DPI, metadata=METADATA[suffix])
                if progress is not None:
                    progress(len(paths), (2 * len(FIGURES) + 1) * len(formats))
    return paths


def _figures(cases: Mapping[str, Case], seed: int, codec: Codec) -> Iterator[tuple[str, Any]]:
    """All figures by name, drawn one at a time."""
    for plan in FIGURES:
        case = cases[plan.scenario]
        yield plan.name(), draw_case(case, plan, seed)
        yield plan.name(wire=True), draw_case(case, plan, seed, codec)
        if plan.number == 5:
            close_up = [cases["highway"], cases["highway-correlated"]]
            yield "figure-06-close-up", draw_close_up(close_up)


def draw_case(case: Case, plan: FigurePlan, seed: int = 0, codec: Codec | None = None) -> Any:
    """One figure of the paper's structure.

    Args:
        case: the scene.
        plan: which figure.
        seed: of the lines drawn from the Gaussians.
        codec: draw the Gaussians as they come out of its decoder; None: as they are sent.

    Returns:
        A ``matplotlib.figure.Figure``.
    """
    from matplotlib.figure import Figure

    layers, view = _layers(case, plan, codec), _view(case)
    left, right, bottom, top = view.limits
    panel = PANEL * (top - bottom) / (right - left)
    row = panel + 0.62
    below = HEAD + 2 * row + 0.1
    height = below + PANEL + FOOT
    figure = Figure(figsize=(WIDTH, height), facecolor="white")

    def place(x: float, y: float, wide: float, tall: float) -> Any:
        """Axes at so many inches from the left and from the top."""
        return figure.add_axes((x / WIDTH, 1 - (y + tall) / height, wide / WIDTH, tall / height))

    maps = [[place(x, HEAD + i * row, PANEL, panel) for x in COLUMNS] for i in range(2)]
    _draw_maps(maps, case, view, layers, seed)
    matrix = place(COLUMNS[0] - 0.1, below, PANEL - 0.1, PANEL - 0.1)
    panels.draw_correlation(matrix, layers[1], *_compared(case, plan, layers))
    cell, step = 0.98, 1.17
    grid = [
        [place(COLUMNS[1] + 0.1 + j * step, below + i * step, cell, cell) for j in range(4)]
        for i in range(4)
    ]
    limits = panels.draw_marginals(np.array(grid), case.lines, DOTS, layers)
    figure.text(
        COLUMNS[1] / WIDTH,
        1 - (below - 0.2) / height,
        "marginals, 99 % regions, share of true samples outside",
        fontsize=9.5,
    )
    _draw_head(figure, height, case, plan, view, layers)
    _draw_foot(figure, height, case, limits)
    return figure


def draw_close_up(cases: Sequence[Case]) -> Any:
    """Figure 6: the car in the middle of other figures, sigma points left, samples right."""
    from matplotlib.figure import Figure

    width, side, head = 10.2, 4.55, 1.3
    height = head + len(cases) * (side + 0.5) + 0.2
    figure = Figure(figsize=(width, height), facecolor="white")
    for i, case in enumerate(cases):
        view = _close_up(_view(case))
        for j, (poses, lines, name) in enumerate(_shown(case)):
            x, y = 0.55 + j * (side + 0.45), head + (i + 1) * (side + 0.5) - 0.5
            ax = figure.add_axes((x / width, 1 - y / height, side / width, side / height))
            panels.draw_map(ax, view, f"{case.scenario.name}: {len(poses)} {name}")
            panels.draw_lines(ax, lines, view.x_range, panels.TRUE, 0.8, 0.35 if j else 0.9)
            panels.draw_poses(ax, poses, *((0.6, 0.6, 0.004) if j else (0.9, 1, 0.006)))
            if j == 0:
                ax.set_ylabel("y, to the left [m]", fontsize=8)
            if case is cases[-1]:
                ax.set_xlabel("x, ahead [m]", fontsize=8)
    x, heading = COLUMNS[0] / width, np.degrees(cases[0].scenario.ego.sigma[2])
    figure.text(x, 1 - 0.32 / height, "Figure 6: close-up of figures 5 and 7", **TITLE)
    figure.text(
        x,
        1 - 0.62 / height,
        f"The same heading (sigma {heading:g} deg); below, e_x and e_y are correlated by 0.8. "
        f"n = {len(cases[0].lines):,} samples, line {SLOT.name}.",
        fontsize=10,
    )
    panels.draw_legend(figure, [], (x, 1 - 0.74 / height))
    return figure


def _layers(case: Case, plan: FigurePlan, codec: Codec | None) -> list[Layer]:
    """The two Gaussians as this figure shows them."""
    layers = []
    for sent, (name, colour, style) in (
        (case.monte_carlo, MONTE_CARLO_STYLE),
        (case.sigma_points, SIGMA_POINTS_STYLE),
    ):
        if plan.variances_only:
            sent = Gaussian(sent.mean, np.diag(sent.cov.diagonal()))
        if codec is None:
            layers.append(Layer(name, sent, colour, style))
        else:
            status = Status.DIAGONAL if plan.variances_only else Status.FULL
            decoded = _through_the_wire(sent, case.refit.x_range, codec, status)
            layers.append(Layer(name, decoded, colour, style, before=sent))
    return layers


def _through_the_wire(gaussian: Gaussian, x_range: Array, codec: Codec, status: Status) -> Gaussian:
    payload = codec.encode_batch(
        gaussian.mean[None],
        gaussian.cov[None],
        slot=SLOT,
        x_min=x_range[0],
        x_max=x_range[1],
        status=status,
    )
    batch = codec.decode_batch(payload, slot=SLOT)
    if not batch.accepted[0] or batch.status[0] == Status.OUT_OF_RANGE:
        raise ValueError(f"the line {gaussian} does not fit the messages of {codec.layout.source}")
    return Gaussian(batch.mean[0], batch.cov[0])


def _view(case: Case) -> View:
    low, high = (float(x) for x in case.refit.x_range)
    points = case.refit.points[0]
    bottom, top = points[:, 1].min(), points[:, 1].max()
    # Room for the lines beside the points, at a shape that suits a page; the same for any heading.
    tall = max(0.64 * (high - low), 1.5 * (top - bottom))
    wide = max(1.06 * (high - low), tall / 0.78)
    x, y = (low + high) / 2, 0.57 * bottom + 0.43 * top  # false lines run below a left turn
    true = lateral(case.lines[:20_000, None], np.linspace(low, high, 60))
    return View(
        ego=Gaussian(np.zeros(3), case.scenario.ego.cov),
        line=case.refit(case.scenario.ego.mean),
        points=points,
        x_range=(low, high),
        band=np.quantile(true, [0.005, 0.995], axis=0),
        limits=(x - wide / 2, x + wide / 2, y - tall / 2, y + tall / 2),
        arrow=0.04 * (high - low),
        fan=0.16 * (high - low),
    )


def _close_up(view: View) -> View:
    return replace(view, band=np.empty((0, 60)), limits=(-2.6, 2.6, -2.6, 2.6), arrow=0.6, fan=2.3)


def _in_ego_frame(poses: Array, mean: Array) -> Array:
    return np.column_stack([to_ego(poses[:, :2], mean), poses[:, 2] - mean[2]])


def _shown(case: Case) -> tuple[tuple[Array, Array, str], ...]:
    """Poses, lines and name: the sigma points, and those samples that are drawn."""
    return (
        (case.sigma_poses, case.sigma_lines, "sigma points"),
        (case.poses[:LINES], case.lines[:LINES], "Monte Carlo samples"),
    )


def _draw_maps(maps: Any, case: Case, view: View, layers: Sequence[Layer], seed: int) -> None:
    close_up = _close_up(view)
    for row, (poses, lines, name) in zip(maps, reversed(_shown(case)), strict=True):
        few = poses is case.sigma_poses
        panels.draw_map(row[0], view, f"{len(poses)} {name}: poses and their lines")
        panels.draw_lines(
            row[0], lines, view.x_range, panels.TRUE, *((1, 0.9) if few else (0.6, 0.35))
        )
        panels.draw_poses(row[0], poses, view.arrow, *((1, 0.006) if few else (0.35, 0.003)))
        inset = panels.place_inset(row[0], view)
        panels.draw_map(inset, close_up)
        panels.draw_poses(inset, poses, *((0.9, 1, 0.014) if few else (0.6, 0.5, 0.008)))
        inset.spines[:].set(visible=True, color="0.6")
        row[0].set_ylabel("y, to the left [m]", fontsize=8)
    for row, layer in zip(maps, layers, strict=True):
        after = "" if layer.before is None else ", decoded"
        title = f"{LINES} lines drawn from the Gaussian of {layer.name}{after}"
        panels.draw_map(row[1], view, title)
        # The same random numbers in all figures: lines before and after the wire are pairs.
        drawn = layer.gaussian.sample(LINES, np.random.default_rng([seed, 2]))
        panels.draw_lines(row[1], drawn, view.x_range, layer.colour, 0.6, 0.35)
        panels.draw_mean(row[1], layer, view.x_range)
    for ax in maps[1]:
        ax.set_xlabel("x, ahead [m]", fontsize=8, labelpad=1)


def _compared(
    case: Case, plan: FigurePlan, layers: Sequence[Layer]
) -> tuple[tuple[str, Gaussian], str]:
    """What the correlations of the sigma points are compared with, and the panel's title."""
    before = layers[1].before
    if before is not None:
        return ("sent", before), "correlations, sigma points, decoded (sent: before the wire)"
    if plan.variances_only:
        return ("was", case.sigma_points), "correlations, sigma points, set to zero"
    return ("MC", case.monte_carlo), "correlations, sigma points (MC: Monte Carlo)"


def _draw_head(
    figure: Any, height: float, case: Case, plan: FigurePlan, view: View, layers: Sequence[Layer]
) -> None:
    heading = np.degrees(case.scenario.ego.sigma[2])
    what = ", variances only" if plan.variances_only else ""
    wire = layers[0].before is not None
    where = ", after the wire" if wire else ""
    x = COLUMNS[0] / WIDTH
    title = f"Figure {plan.number}: {case.scenario.name}{what}{where}"
    figure.text(x, 1 - 0.32 / height, title, **TITLE)
    figure.text(
        1 - 0.3 / WIDTH,
        1 - 0.32 / height,
        f"heading sigma {heading:g} deg, n = {len(case.lines) + case.ill_posed:,} samples, "
        f"line {SLOT.name}",
        fontsize=9,
        ha="right",
    )
    reading = f"{AFTER_THE_WIRE}\n{_cost(layers, view)}" if wire else plan.reading
    figure.text(x, 1 - 0.45 / height, reading, fontsize=10, va="top", linespacing=1.35)
    panels.draw_legend(figure, layers, (x, 1 - 0.98 / height))


def _draw_foot(figure: Any, height: float, case: Case, limits: Array) -> None:
    beyond = ((case.lines < limits[:, 0]) | (case.lines > limits[:, 1])).any(axis=1).mean()
    note = f"{100 * beyond:.2f} % of the samples lie beyond the axes of the marginals"
    if case.ill_posed:
        note += f"; draws left out, since no cubic y(x) follows the points: {case.ill_posed}"
    figure.text(COLUMNS[0] / WIDTH, 0.16 / height, f"{note}.", fontsize=8, color="0.25")


def _cost(layers: Sequence[Layer], view: View) -> str:
    """How much wider the lateral band is after the wire, at the places of the study."""
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
    return f"Sigma of l(x) at {places} m against the sent one: {'; '.join(parts)}."
