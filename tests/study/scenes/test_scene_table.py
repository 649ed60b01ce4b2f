"""The tables of codes on scenes: of a study, and of maps."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.study_helpers import small, tables

from maplines_can.cli import main
from maplines_can.study.scenes.carriers import AT_SCENE_BITS, WITH_POSE, scene_figures, scenes_text
from maplines_can.study.scenes.map_scenes import ROADS
from maplines_can.study.scenes.random_scenes import box
from maplines_can.study.scenes.sigma_ratios import ALL, Ratios, ratios_text
from maplines_can.study.sweep import plan
from maplines_can.study.sweep.run import run_study
from maplines_can.study.sweep.summary import SCHEMAS, summary_text

#: Information of three scenes of two lines.
F = np.tile(np.eye(10) * 1e6, (3, 1, 1))


def scene(kl: float = 1e-3, **changes: Any) -> Any:
    """Return the figures of one scene."""
    row = {"frames": 6, "mean_bits": 126, "joint_bits": 101, "left_out": 0, "all_entries": 1}
    row |= {"not_positive_definite": False, "overconfident": False}
    return (
        row
        | {"kl_joint": 3 * kl, "kl_lines": [kl, kl], "far": [1.01, 1.03]}
        | {"width": 1.02, "centre": 1.01}
        | changes
    )


def test_bits_over_the_limit_are_at_the_divergence_of_the_joint() -> None:
    """Of records of single lines, at the sum of those of the lines."""
    rows = [scene(), scene(2e-3), scene(3e-3)]
    joint = scene_figures("PoseConditional", 2, rows, F)
    apart = scene_figures("Cholesky", 2, rows, F)

    assert (joint["limit_kl"], apart["limit_kl"]) == (pytest.approx(6e-3), pytest.approx(4e-3))
    assert joint["limit_dimension"] == len(box(2))
    assert joint["over_bits"] == pytest.approx(101 - joint["limit_bits"])
    assert apart["limit_bits"] - joint["limit_bits"] == pytest.approx(5 * np.log2(1.5))
    assert (joint["has_joint"], apart["has_joint"]) == (True, False)
    assert (joint["all_entries"], joint["kl_line_mean"]) == (0.5, pytest.approx(2e-3))
    assert (joint["far_p50"], joint["far_p99"]) == (pytest.approx(1.02), pytest.approx(1.03))


@pytest.mark.parametrize(
    "bad",
    [
        pytest.param(scene(1e7), id="divergence-too-large"),
        pytest.param(scene(not_positive_definite=True, kl_joint=np.inf), id="indefinite"),
    ],
)
def test_there_is_no_limit_at_low_rates_or_for_a_part_of_the_scenes(bad: Any) -> None:
    """Its columns are missing, and their cells are empty."""
    row = scene_figures("Linear", 2, [scene(), bad], F) | {"lines": 2, "code": "Linear"}

    assert "limit_bits" not in row
    assert "  -  " in scenes_text([row])


def test_a_scene_without_a_line_has_no_figures() -> None:
    """None of its lines fits the message."""
    empty = {"frames": 2, "mean_bits": 0, "joint_bits": 63, "left_out": 2, "all_entries": 0}
    row = scene_figures("PoseConditional", 2, [empty], F)

    assert row["kl_line_mean"] is row["overconfident"] is row["width_p99"] is None
    assert row["left_out"] == 1


def test_a_study_compares_codes_on_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In chunks, with those that send the pose error, and single lines in as many bits."""
    pytest.importorskip("pyarrow")
    monkeypatch.setattr(plan, "SCENES_IN_A_CHUNK", 2)
    monkeypatch.setattr(plan, "SCENE_LINES", (2, 3))
    study = small(n=50, codes=("Cholesky",), scenes_n=3)
    progress: list[Any] = []
    result = tables(run_study(study, tmp_path, jobs=1, progress=lambda *at: progress.append(at)))
    rows = {(row["lines"], row["code"]): row for row in result["scenes"]}

    codes = ("Cholesky", AT_SCENE_BITS, *WITH_POSE)
    assert list(rows) == [(lines, code) for lines in (2, 3) for code in codes]
    for row in rows.values():
        assert row["scenes"] == 3
        assert row.keys() == SCHEMAS["scenes"].keys()
    assert rows[2, "Cholesky"]["overconfident"] == 1
    assert rows[2, "PoseConditional"]["overconfident"] == 0
    assert rows[3, "PoseConditional"]["over_bits"] < rows[3, "Cholesky"]["over_bits"]
    one, five = rows[3, "Scene, FD"], rows[3, "PoseConditional, FD"]
    assert (one["frames"], five["frames"]) == (1, 4)
    assert one["kl_joint_mean"] < rows[3, AT_SCENE_BITS]["kl_line_mean"]
    assert one["overconfident"] == one["all_entries"] == one["left_out"] == 0
    assert progress[-1] == (50 + 3 * 2 + 3 * 3,) * 2
    of_scenes = summary_text(result["summary"], result["terms"], result["scenes"])
    assert "3 scenes of 2 lines" in of_scenes


# ---- maps ---------------------------------------------------------------------------------------


def test_each_kind_of_records_is_measured_on_each_map(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """On the town without a map; all entries are closer than levels in one frame."""
    assert main(["study", "maps", "--n", "6", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert list(figures) == list(WITH_POSE)
    assert main(["study", "maps", "--n", "1", "--seed", "1"]) == 0
    assert {"town.xodr", "  Scene, FD"} <= {
        line.split("   ")[0] for line in capsys.readouterr().out.splitlines()
    }
    for of_maps in figures.values():
        assert list(of_maps) == ["town.xodr", ROADS, ALL]
        lines = [of_maps[name]["lines"] for name in of_maps]
        assert lines[0] + lines[1] == lines[2] > 20
    whole, apart = (figures[f"{name}, FD"][ALL] for name in ("Scene", "PoseConditional"))
    assert 1 < apart["width at 20 m"][0] < whole["width at 20 m"][0]
    assert 1 < whole["y at 0 m"][0] < apart["y at 0 m"][0]


def test_the_table_has_the_reasons_of_lines_that_are_left_out() -> None:
    ratios = Ratios(lines=200, wider=3)
    ratios.left_out.update({"RANGE": 3, "MEAN": 1})
    ratios.ratios["y", 0.0] = [1.01, 1.02, 1.03]
    shown = ratios_text({"Scene, FD": {"a.xodr": ratios}})
    assert "2 % (3 RANGE, 1 MEAN)" in shown
    assert "1.5 %" in shown
    assert "1.02 1.03" in shown
