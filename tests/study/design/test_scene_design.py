"""Design of conditional records: fewer bits for more divergence, and always valid joints."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can.cli import main
from maplines_can.generation.dbc.record_spec import CONDITIONAL
from maplines_can.study.design import conditional as module
from maplines_can.study.design.conditional import design_scenes, fields, figures_of, writer_of
from maplines_can.wire import Layout

SHIPPED = {name: spec.bits for name, spec in fields().items()}
FEW = ("PivotAcross", "C1")


@pytest.fixture
def few_fields(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search two fields only: each figure takes the time of loading a DBC."""
    every = fields()
    monkeypatch.setattr(module, "fields", lambda: {name: every[name] for name in FEW})


def test_the_fields_are_those_of_pose_error_mean_and_levels() -> None:
    """Their widths are those of maplines-pose.dbc, whose text comes out unchanged."""
    assert {"PivotHeading", "RatioHeadingAcross", "C1", "YOff", "YOffFine"} <= SHIPPED.keys()
    assert not {"Crc", "Counter", "XMin", "Age"} & SHIPPED.keys()
    assert writer_of(SHIPPED).dbc() == CONDITIONAL.dbc()


def test_fewer_bits_cover_the_same_range() -> None:
    """The DBC is valid, and its steps are wider."""
    writer = writer_of(SHIPPED | {"C1": SHIPPED["C1"] - 2, "PivotAcross": 7})
    layout, old = Layout.from_text(writer.dbc()), Layout.from_text(CONDITIONAL.dbc())

    assert layout["C1"].factor == 4 * old["C1"].factor
    assert layout["C1"].reach[0] == old["C1"].reach[0]
    assert layout["C1Fine"].factor == pytest.approx(4 * old["C1Fine"].factor)
    assert layout.pose is not None
    assert layout.pose["PivotAcross"].length == 7
    assert layout.short_pages == old.short_pages
    assert "2 bits less" in writer.table()


def test_joints_are_valid_with_few_bits() -> None:
    """The divergence grows; no joint covariance is overconfident or indefinite."""
    scenes = module.random_scenes(3, 2)
    shipped = figures_of(SHIPPED, scenes)
    coarse = figures_of(SHIPPED | {name: SHIPPED[name] - 4 for name in FEW}, scenes)

    assert shipped.kl_mean < 0.02 < coarse.kl_mean
    fine = 13 * module.LINES
    mean_bits = [figures.mean_bits - fine * figures.all_entries for figures in (shipped, coarse)]
    assert mean_bits[1] == pytest.approx(mean_bits[0] - 4 * module.LINES)
    for figures in (shipped, coarse):
        assert figures.overconfident == figures.indefinite == 0


@pytest.mark.usefixtures("few_fields")
def test_the_widths_are_reduced_as_far_as_the_divergence_allows() -> None:
    """The next bit would exceed it, or save nothing."""
    done: list[Any] = []
    scenes = module.random_scenes(3, 1)
    shipped = figures_of({name: SHIPPED[name] for name in FEW}, scenes)
    most = 1.3 * shipped.kl_mean
    found = design_scenes(most, n=3, seed=1, progress=lambda *at: done.append(at))
    reached = figures_of(found.bits, scenes)

    assert reached.kl_mean <= most
    assert all(found.bits[name] <= SHIPPED[name] for name in FEW)
    assert sum(found.bits.values()) < sum(SHIPPED[name] for name in FEW)
    for cost in found.a_bit_less.values():
        assert reached.kl_mean + cost.kl > most or cost.bits >= 0
    assert done[-1][0] == done[-1][1]


@pytest.mark.usefixtures("few_fields")
def test_a_divergence_beyond_the_frames_is_refused() -> None:
    with pytest.raises(ValueError, match="the frames of a line hold no more bits"):
        design_scenes(1e-6, n=1)


@pytest.mark.usefixtures("few_fields")
def test_the_command_explains_the_widths_of_the_shipped_dbc(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a divergence it keeps them, and says what a bit less costs; as text or JSON."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "LINES", 2)
    assert main(["design", "--scenes", "--n", "10", "--out", "same.dbc"]) == 0
    text = capsys.readouterr().out
    assert "0 overconfident, 0 not definite" in text
    assert "with a bit less" in text
    assert (tmp_path / "same.dbc").read_text() == CONDITIONAL.dbc()
    page = (tmp_path / "same.md").read_text()
    assert "maplines design --scenes --n 10 --seed 0 --out same.dbc" in page
    assert "| `HasCovariance` |" in page
    assert main(["design", "--scenes", "--n", "10", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["bits"] == {name: SHIPPED[name] for name in FEW}
    assert np.isfinite([cost["kl"] for cost in result["a_bit_less"].values()]).all()
