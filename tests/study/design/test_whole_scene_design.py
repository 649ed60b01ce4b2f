"""Design of records of whole scenes: bits are exchanged within the frame, for a smaller loss."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can.cli import main
from maplines_can.generation.dbc.record_spec import WHOLE_SCENES
from maplines_can.maps.tour import town_path
from maplines_can.study.design import scene_frames as module
from maplines_can.study.design.scene_frames import (
    FOUND,
    FRAME_BYTES,
    SHIPPED,
    TODAY,
    design_whole_scenes,
    fields_of,
    resized,
    scene_of,
    todays,
    writer_of,
)
from maplines_can.study.scenes.map_scenes import DrawnScene
from maplines_can.study.scenes.random_scenes import random_scene
from maplines_can.wire import Layout

FIELDS = fields_of(WHOLE_SCENES)


def scenes(n: int, seed: int) -> list[DrawnScene]:
    rng = np.random.default_rng(seed)
    return [DrawnScene("roads", "", "", random_scene(4, rng).scene) for _ in range(n)]


def test_the_fields_are_those_of_pose_error_mean_and_levels() -> None:
    """With them, the DBC is the shipped one."""
    assert {"PivotHeading", "RatioHeadingAcross", "MapOffset", "C1", "OwnShape"} <= FIELDS.keys()
    assert not {"Crc", "Age", "XMin", "Kind", "OwnTilt", "SceneCounter"} & FIELDS.keys()
    assert writer_of(FIELDS, 4).dbc() == WHOLE_SCENES.dbc()
    assert todays()["YOff"].bits == FIELDS["YOff"].bits - 1


def test_a_frame_of_fewer_or_more_lines_is_filled() -> None:
    """Of three with more bits each, and two of them authenticated; of five with fewer."""
    for lines, secured in ((3, 2), (5, 3)):
        found = design_whole_scenes(scenes(1, 1), scenes(1, 2), lines=lines, rounds=0)
        scene = scene_of(found.writer)
        layout = Layout.from_text(found.writer.dbc())
        assert layout.scene is not None
        assert (layout.scene.places, layout.scene.secured_places) == (lines, secured)
        assert scene.record_bytes(lines) <= FRAME_BYTES < scene.record_bytes(lines) + lines
        more = sum(found.fields[name].bits - spec.bits for name, spec in FIELDS.items())
        assert more < 0 if lines > 4 else more > 0


def test_the_search_finds_what_was_made_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pivot, of whose bits a ratio has some, gets finer steps again; the frame is as full."""
    worse = FIELDS | {
        "RatioAcrossAlong": resized(FIELDS["RatioAcrossAlong"], 3),
        "PivotAcross": resized(FIELDS["PivotAcross"], -3),
    }
    start = writer_of(worse, 4)
    monkeypatch.setattr(module, "WHOLE_SCENES", start)
    names = ("RatioAcrossAlong", "PivotAcross")
    monkeypatch.setattr(module, "fields_of", lambda _writer: {name: worse[name] for name in names})
    done: list[Any] = []

    found = design_whole_scenes(
        scenes(6, 1), scenes(4, 2), rounds=2, progress=lambda *at: done.append(at)
    )

    assert found.fields["PivotAcross"].factor < worse["PivotAcross"].factor
    assert (
        sum(spec.bits for spec in found.fields.values())
        == worse["PivotAcross"].bits + worse["RatioAcrossAlong"].bits
    )
    assert found.losses["other scenes"][FOUND] < found.losses["other scenes"][SHIPPED]
    assert done[-1] == (1.0, 1.0)
    assert all(0 < before < after for (before, _), (after, _) in pairwise(done))


def test_fields_of_any_steps_are_of_the_same_range() -> None:
    """But for the ends of levels, which move by a share of their octaves."""
    coarse = resized(FIELDS["C1"], -2)
    assert (coarse.bits, coarse.factor) == (FIELDS["C1"].bits - 2, 4 * FIELDS["C1"].factor)
    assert "found by maplines design" in coarse.why
    level = FIELDS["OwnLateral"]
    moved = module._moved_ends(level, 0.1, 0.0)
    octaves = level.factor * 2**level.bits
    assert moved.offset == pytest.approx(level.offset + 0.1 * octaves, abs=0.01)
    assert moved.range[1] == pytest.approx(level.range[1], abs=0.1)
    with pytest.raises(ValueError, match="no messages of whole scenes"):
        scene_of(replace(WHOLE_SCENES, scene=None))


def test_the_command_says_what_each_bit_is_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a round it keeps the fields of maplines-scene.dbc; as text or JSON."""
    monkeypatch.chdir(tmp_path)
    every = module.fields_of
    names = ("YOff", "OwnPoints")
    monkeypatch.setattr(module, "fields_of", lambda writer: {k: every(writer)[k] for k in names})
    command = ["design", "--whole-scenes", "--map", str(town_path()), "--n", "10", "--rounds", "0"]
    assert main([*command, "--out", "same.dbc"]) == 0
    text = capsys.readouterr().out
    for part in ("left out", "wider", TODAY, SHIPPED, "loss with a bit less", "town.xodr"):
        assert part in text
    assert (tmp_path / "same.dbc").read_text() == WHOLE_SCENES.dbc()
    page = (tmp_path / "same.md").read_text()
    assert "maplines design --whole-scenes --rounds 0 --map town.xodr --n 10 --seed 0" in page
    assert "| `*OwnShape` |" in page
    assert main([*command, "--json", "--force", "--out", "same.dbc"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert {name: field["bits"] for name, field in result["fields"].items()} == {
        name: FIELDS[name].bits for name in names
    }
    assert result["a_bit_less"]["OwnPoints"] > 0
    assert result["figures"]["other scenes"][FOUND]["random roads"]["left_out"] == {}


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (["--whole-scenes", "--frames", "3"], "must not be given with"),
        (["--whole-scenes", "--scenes"], "must not be given with"),
        (["--rounds", "1", "--max-kl", "1"], "need --whole-scenes"),
        (["--whole-scenes", "--map", "none.xodr"], "none.xodr"),
        (["--scenes", "--frames", "3"], "--scenes must not be given with"),
        (["--scenes", "--keep-mean"], "--scenes must not be given with"),
    ],
)
def test_options_of_other_records_are_refused(
    options: list[str], match: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["design", *options]) != 0
    assert match in capsys.readouterr().err
