"""tools/evidence_scenes.py on a small map; it finds lost lines and overconfident scenes."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import evidence_scenes as tool
import numpy as np
import pytest
from drive_files import town

from maplines_can import Codec, LeftOut
from maplines_can.wire import PreparedScene
from maplines_can.wire.covariance.scene_code import SceneCode

QUICK = ["-n", "14", "--pose", "production", "--error", "5 cm"]


def rows_of(capsys: Any, *arguments: str, status: int = 0) -> Any:
    assert tool.main([*QUICK, "--json", *arguments]) == status
    return json.loads(capsys.readouterr().out)


def test_a_map_and_random_roads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The counts add up; nothing is overconfident; the errors are those of the pose."""
    (tmp_path / "README.md").write_text("A map.")
    town(tmp_path)
    result = rows_of(capsys, str(tmp_path))
    assert result["missed"] == []
    assert [*result["rows"]] == [f"{name}, production, 5 cm" for name in ("map.xodr", tool.RANDOM)]
    for row in result["rows"].values():
        counts = row["counts"]
        unsent = sum(n for key, n in counts.items() if key.startswith("not sent"))
        assert counts["given"] == counts["levels"] + counts.get("all entries", 0) + unsent
        assert counts["given"] >= 2 * 14 - sum(
            n for key, n in counts.items() if key.startswith("not given")
        )
        assert counts["overconfident"] == counts["not received"] == 0
        assert 0.5 < row["frames"]["mean"] <= row["frames"]["max"] <= 1
        assert 1 <= row["width"]["50 %"] < 1.1
        assert 0 < row["KL"]["50 %"] < 0.1
        for of in ("scenes", "records"):
            assert 0.3 < row[f"error of {of}"]["95 %"] < 0.7  # sigma across 0.2 m, and 0.2 deg


def test_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert tool.main(QUICK) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("random roads, production, 5 cm ") for line in lines) == 1
    assert lines[-1] == "All bounds are met."


def test_lost_lines_are_found(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first line of each scene is not sent."""
    prepare = Codec.prepare_scene

    def without_first(codec: Any, scene: Any, **settings: Any) -> PreparedScene:
        prepared = prepare(codec, scene, **settings)
        first = {0: LeftOut.MEAN} if prepared.sent_slots else {}
        encoded = replace(prepared.encoded, left_out=prepared.encoded.left_out | first)
        return replace(prepared, encoded=encoded, sent_slots=prepared.sent_slots[1:])

    monkeypatch.setattr(Codec, "prepare_scene", without_first)
    result = rows_of(capsys, status=1)
    assert any("of the lines with 10 m ahead are lost" in text for text in result["missed"])


def test_overconfident_scenes_are_found(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    decode = SceneCode.decode

    def small(self: Any, *arguments: Any) -> Any:
        decoded = decode(self, *arguments)
        return decoded._replace(cov=0.5 * decoded.cov)

    monkeypatch.setattr(SceneCode, "decode", small)
    result = rows_of(capsys, status=1)
    assert any("scenes are overconfident" in text for text in result["missed"])


def test_a_file_that_is_no_map_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.xodr"
    path.write_text("<OpenDRIVE>")
    for name, text in ((path, "is no map with lanes"), (tmp_path / "b", "there is no such file")):
        with pytest.raises(SystemExit):
            tool.main([*QUICK, str(name)])
        assert text in capsys.readouterr().err


def test_eigenvalues_are_those_of_the_whitened_covariance() -> None:
    rng = np.random.default_rng(1)
    A, B = (X @ X.T + np.eye(5) for X in rng.normal(size=(2, 5, 5)))
    expected = np.sort(np.linalg.eigvals(np.linalg.solve(A, B)).real)
    assert tool.whitened(np.linalg.cholesky(A), B) == pytest.approx(expected)
