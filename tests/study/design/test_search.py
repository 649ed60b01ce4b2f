"""Designs of message layouts: their figures, their DBCs, and sending them over a bus."""

import contextlib
import json
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest

from maplines_can.cli import main
from maplines_can.study import adversarial, paper, road
from maplines_can.study.design.planner import Targets, allocated
from maplines_can.study.design.search import design, figures_of
from maplines_can.study.design.sensitivity import (
    RatioSpread,
    Width,
    blurs,
    conservative,
    inflation_width,
    rows_of,
)
from maplines_can.study.sets import Gaussians
from maplines_can.values.line import Status
from maplines_can.wire import Codec, Layout

N = 1000
FRAMES = (3, 4)
MEAN = ("YOff", "Beta", "C0", "C1")


@pytest.fixture(scope="module")
def roads() -> Any:
    return {"road": road(N, seed=3)}


@pytest.fixture(scope="module")
def others() -> Any:
    return {"road": road(N, seed=4)}


@pytest.fixture(scope="module")
def designs(roads: Any, others: Any) -> Any:
    return {n: design(roads, Targets(frames=n), held_out=others) for n in FRAMES}


@pytest.fixture(scope="module")
def folder(designs: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = tmp_path_factory.mktemp("designs")
    for n, made in designs.items():
        made.write(path / f"frames{n}.dbc", "maplines design and so on")
    return path


def a_design(sets: Any, seed_lines: int = 400, **targets: Any) -> Any:
    """Return a design from few lines."""
    few = {name: Gaussians(s.mean[:seed_lines], s.cov[:seed_lines]) for name, s in sets.items()}
    return design(few, Targets(**targets))


# ---- the designs --------------------------------------------------------------------


def test_three_frames_lose_little_on_the_road(designs: Any) -> None:
    """Three frames hold the covariance at a divergence of 0.02, and all other signals."""
    figures = designs[3].measured["road"]
    assert figures.kl_mean <= 0.02
    assert figures.kl_p99 <= 0.05
    assert figures.kl_untouched_median <= 0.02
    assert figures.saturated <= 0.01
    assert figures.out_of_range == 0


@pytest.mark.parametrize("frames", FRAMES)
def test_each_design_fills_its_frames(designs: Any, folder: Any, frames: Any) -> None:
    """cantools loads the DBC, which has the right pages and all signals of the record."""
    database = cantools.database.load_file(folder / f"frames{frames}.dbc")
    message = database.get_message_by_name("EgoLeft")  # type: ignore[union-attr]
    pages = {i for signal in message.signals for i in signal.multiplexer_ids or ()}
    assert pages == set(range(frames))
    assert designs[frames].frames == frames
    assert designs[frames].spare_bits <= 2
    assert database.get_message_by_name("EgoLeftFd").length >= 8 * frames  # type: ignore[union-attr]
    kept = {"Crc": 16, "Counter": 8, "Status": 3, "Kind": 3, "ComponentWeight": 5, "Age": 5}
    for name, bits in kept.items():
        assert message.get_signal_by_name(name).length == bits
    for signal in message.signals:
        assert signal.comment


@pytest.mark.parametrize("frames", FRAMES)
def test_no_design_is_overconfident(folder: Any, frames: Any) -> None:
    """On the set of the design, on another set, and on adversarial covariances."""
    codec = Codec.from_dbc(folder / f"frames{frames}.dbc")
    for make in (paper, road, adversarial):
        figures = figures_of(codec, make(800, 9))
        assert figures.not_definite == figures.overconfident == 0


@pytest.mark.parametrize("frames", FRAMES)
def test_measured_figures_match_the_prediction(designs: Any, frames: Any) -> None:
    """Mean and 99 % quantile of unseen lines within 25 %, saturation within nine lines."""
    predicted, measured = designs[frames].predicted, designs[frames].measured["road"]
    assert measured.kl_mean == pytest.approx(predicted.kl_mean, rel=0.25)
    assert measured.kl_p99 == pytest.approx(predicted.kl_p99, rel=0.2)
    assert measured.saturated <= predicted.saturated + 9 / N
    assert 0.5 * predicted.lateral_error <= measured.lateral_error
    assert measured.lateral_error <= 1.15 * predicted.lateral_error  # a slope has a longer lever


def test_a_signal_of_zero_means_zero(folder: Any) -> None:
    """Ranges are asymmetric, but uncorrelated states stay exactly uncorrelated."""
    codec = Codec.from_dbc(folder / "frames3.dbc")
    ratios = [field for name, field in codec.layout.signals.items() if name.startswith("Ratio")]
    assert len(ratios) == 6
    assert all(field.physical(field.raw(0.0)) == 0 for field in ratios)
    cov = np.diag([0.04, 1e-4, 1e-6, 1e-9])[None]
    alone = codec.batch.decode(codec.batch.encode(np.zeros((1, 4)), cov, status=Status.DIAGONAL))
    assert np.array_equal(alone.cov[0], np.diag(alone.cov[0].diagonal()))


# ---- targets -----------------------------------------------------------------


def test_max_kl_is_met_with_few_bits(roads: Any, others: Any, designs: Any) -> None:
    """2e-3 fits into four frames, and leaves bits unused."""
    few, unseen = (Gaussians(*(part[:500] for part in s["road"])) for s in (roads, others))
    made = design({"road": few}, Targets(frames=4, max_kl=2e-3), held_out={"road": unseen})
    assert made.measured["road"].kl_mean <= 1.2 * 2e-3
    assert made.frames == 4
    # Each factor of 4 in the divergence is one bit in each of 14 fields.
    ratio = made.measured["road"].kl_mean / designs[4].measured["road"].kl_mean
    assert made.spare_bits == pytest.approx(7 * np.log2(ratio), abs=8)


def test_ranges_are_kept(roads: Any) -> None:
    """Ranges of the mean are exact, those of the standard deviations are included."""
    narrow = {"y_off": 7.0, "beta": 0.3, "c0": 0.07, "c1": 0.025}
    made = a_design(roads, frames=4, ranges=narrow, sigmas={"y_off": 20.0, "c1": 0.05})
    signals = {spec.name: spec for page in made.writer.pages for spec in page}
    for name, end in zip(MEAN, narrow.values(), strict=True):
        low, high = signals[name].range
        assert low == pytest.approx(-end)
        assert high == pytest.approx(end - signals[name].factor)
    assert 2.0 ** signals["PivotYOff"].range[1] >= 20 * 0.999
    assert 2.0 ** signals["PivotC1"].range[1] >= 0.05 * 0.999
    codec = Codec(Layout.from_text(made.writer.dbc()))
    batch = codec.batch.decode(codec.batch.encode([[6.99, -0.3, 0.07, 0.025]]))
    assert batch.mean[0] == pytest.approx([6.99, -0.3, 0.07, 0.025], abs=5e-3)


def test_the_mean_is_kept(roads: Any) -> None:
    """The mean has the widths and factors of the project's own DBC."""
    own = Codec.from_dbc().layout
    layout = Layout.from_text(a_design(roads, frames=5, keep_mean=True).writer.dbc())
    for name in MEAN:
        assert (layout[name].length, layout[name].factor) == (own[name].length, own[name].factor)


def test_a_design_is_reproducible(roads: Any) -> None:
    """The same lines and targets give the same DBC; the progress ends at the total."""
    seen: list[float] = []
    few = {"road": Gaussians(*(part[:400] for part in roads["road"]))}
    targets = Targets(frames=4, max_lateral=0.002)
    made = design(few, targets)
    again = design(few, targets, progress=lambda done, total: seen.append(done / total))
    assert again.writer.dbc() == made.writer.dbc()
    assert again.as_dict() == made.as_dict()
    assert seen == sorted(seen)
    assert seen[-1] == 1
    assert made.predicted.lateral_error <= 0.002
    assert made.measured["road"].lateral_error <= 1.15 * 0.002


@pytest.mark.parametrize(
    ("targets", "words"),
    [
        pytest.param({}, "frames or max_kl must be given", id="nothing"),
        pytest.param({"frames": 9}, "frames must be from 1 to 8", id="nine-frames"),
        pytest.param({"frames": 2}, "2 leave 68 bits .* need", id="two-frames"),
        pytest.param({"max_kl": 0.0}, "max_kl must be positive", id="zero"),
        pytest.param(
            {"frames": 3, "max_kl": 1e-3},
            "cannot be reached in 3 frames, which reach 0.0",
            id="both",
        ),
        pytest.param({"frames": 4, "ranges": {"y": 3}}, "ranges must be .* got y=3", id="state"),
        pytest.param({"frames": 4, "sigmas": {"beta": -1}}, "sigmas must be", id="sigma"),
        pytest.param(
            {"frames": 4, "ranges": {"y_off": 1.0}},
            "y_off of .* beyond 1.* choose y_off of ranges above it",
            id="narrow",
        ),
        pytest.param({"frames": 4, "sigmas": {"c0": 1e-6}}, "c0 of .* beyond 1e-06", id="small"),
        pytest.param(
            {"frames": 4, "keep_mean": True, "ranges": {"c0": 1}}, "keep_mean", id="keep-and-range"
        ),
    ],
)
def test_impossible_targets_raise(roads: Any, targets: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        a_design(roads, **targets)


def test_too_few_lines_raise(roads: Any) -> None:
    with pytest.raises(ValueError, match=r"100 lines or more.*but road has 75 for one of them"):
        a_design(roads, seed_lines=150, frames=4)


# ---- the sensitivities -------------------------------------------------------------------


def test_rows_are_those_of_the_cholesky_factor(roads: Any) -> None:
    """In any order, compared with numpy."""
    cov, order = roads["road"].cov[:50], (2, 0, 3, 1)
    pivots, ratios = rows_of(cov, np.zeros(4), order)
    scale = np.sqrt(np.einsum("nii->ni", cov))[:, order]
    ordered = cov[:, order][:, :, order] / scale[:, :, None] / scale[:, None, :]
    L = np.linalg.cholesky(ordered) * scale[:, :, None]
    assert pivots == pytest.approx(np.log2(np.einsum("nii->ni", L)), abs=1e-6)
    assert ratios == pytest.approx(L / np.einsum("nii->ni", L)[:, :, None], rel=1e-4, abs=1e-6)


def test_the_loss_of_rounding_is_a_constant_of_the_steps(codec: Any, others: Any) -> None:
    """With continuous inflation 2 to 2.7 times the theory; with its steps, the measured loss."""
    rows = [MEAN[i] for i in codec.covariance.factor.order]
    pairs = [(row, column) for i, row in enumerate(rows) for column in rows[:i]]
    pivots = np.array([codec.layout[f"Pivot{row}"].factor for row in rows])
    ratios = np.array([codec.layout[f"Ratio{row}{column}"].factor for row, column in pairs])
    theory = ((pivots * np.log(2)) ** 2).sum() / 12 + (ratios**2).sum() / 24
    fine = conservative(pivots, ratios, inflation_width(16, pivots, ratios)).mean()
    assert 2 * theory < fine < 2.7 * theory

    field = codec.layout["Inflation"]
    own = conservative(pivots, ratios, Width(field.length, field.factor, 0.0)).mean()
    assert figures_of(codec, others["road"]).kl_mean == pytest.approx(own, rel=0.05)


def test_the_loss_beyond_an_end_is_that_of_the_lifted_pivot() -> None:
    """ln g + (g^-2 - 1) / 2 for the values beyond, by hand."""
    values = np.array([-3.0, -1.0, 0.0, 0.5, 8.0])
    spread = RatioSpread(values, np.full(5, 0.2))
    width = spread.width(4, 0.25, 0.5, price=0.0)  # -2 to 1.75; unseen lines: -6 and 16

    def lift(value: Any, end: Any) -> Any:
        return np.log(value / end) + ((end / value) ** 2 - 1) / 2

    seen = 0.2 * (lift(3.0, 2.125) + lift(8.0, 1.875))
    unseen = 0.2 * (lift(6.0, 2.125) + lift(16.0, 1.875))
    assert width.beyond == pytest.approx(0.8)
    assert width.beyond_loss == pytest.approx(seen + unseen)
    assert width.unseen_loss == pytest.approx(unseen)


def test_the_blur_of_a_fine_grid_is_its_first_order(roads: Any) -> None:
    """Sum of D_i^2 (S^-1)_ii / 24."""
    cov = roads["road"].cov[:20]
    steps = 1e-2 * np.sqrt(1 / np.einsum("nii->ni", np.linalg.inv(cov)).max(axis=0))
    first = (steps**2 / 24 * np.einsum("nii->ni", np.linalg.inv(cov))).sum(axis=1)
    assert blurs(cov, steps**2 / 12) == pytest.approx(first, rel=1e-3)


def test_bits_go_where_they_reduce_the_loss_most() -> None:
    """Two fields of the same kind and different ranges get the same step."""
    spreads = {"wide": 100.0, "narrow": 6.25}
    rng = np.random.default_rng(0)
    tables = {
        name: RatioSpread(rng.uniform(-end, end, 2000), np.full(2000, 1 / 2000)).widths(0.0)
        for name, end in spreads.items()
    }
    chosen = allocated(tables, 20)
    assert chosen["wide"].bits == chosen["narrow"].bits + 4  # type: ignore[index]
    assert chosen["wide"].factor / chosen["narrow"].factor == pytest.approx(1, rel=0.5)  # type: ignore[index]
    assert allocated(tables, 5) is None


# ---- the command -----------------------------------------------------------------------


def test_the_command_writes_the_dbc_and_its_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "mine.dbc"
    words = ["--frames", "4", "--set", "road", "--n", "300", "--range", "y_off=16,beta=0.4"]
    assert main(["design", *words, "--out", str(out), "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["frames"] == 4
    assert output["targets"]["ranges"] == {"y_off": 16, "beta": 0.4}
    assert output["measured"]["road"]["overconfident"] == 0
    assert Codec.from_dbc(out).layout["YOff"].physical_range[0] == -16
    page = out.with_suffix(".md").read_text()
    assert "maplines design --frames 4 --set road --range y_off=16,beta=0.4" in page
    assert str(tmp_path) not in page
    assert "| `PivotC1` |" in page
    assert "KL, mean" in page


def test_the_command_reads_a_user_s_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], roads: Any
) -> None:
    own = str(tmp_path / "own.npz")
    np.savez(own, mean=roads["road"].mean[:300], cov=roads["road"].cov[:300])
    assert main(["design", "--frames", "3", "--set", own, "--out", f"{own}.dbc"]) == 0
    output = capsys.readouterr().out
    assert "measured: own.npz" in output
    assert "3 classic frames" in output


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--range", "y_off"], "must be numbers of y_off"),
        (["--range", "x=3"], "must be numbers of y_off"),
        (["--frames", "four"], "must be a whole number from 1 to 8"),
        (["--out", "wire.md"], "ends in .dbc"),
        (["--out", "nowhere/wire.dbc"], "in a folder that exists"),
    ],
)
def test_wrong_options_are_refused(
    capsys: pytest.CaptureFixture[str], words: Any, reason: str
) -> None:
    with contextlib.suppress(SystemExit):
        assert main(["design", "--frames", "4", *words]) == 1
    assert reason in capsys.readouterr().err
