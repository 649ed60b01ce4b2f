"""tools/evidence_joint.py against closed forms, and it finds joints that are wrong."""

import json
from typing import Any

import evidence_joint as tool
import joint_figures
import numpy as np
import pytest
from exact import covers, is_positive_definite
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import covariances

from maplines_can import MapError
from maplines_can.wire.covariance.scene_code import SceneCode


def run(capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, Any]:
    """Exit status and result of the tool with few scenes."""
    status = tool.main(["-n", "8", "--shape", "motorway", "--exact", "2", "--json", *options])
    return status, json.loads(capsys.readouterr().out)


def test_scenes_are_definite_and_covered(
    capsys: pytest.CaptureFixture[str],
) -> None:
    _, result = run(capsys, "--shape", "rural")
    for carrier in joint_figures.CARRIERS:
        row = result[carrier]
        assert row["checked"] >= 7  # of complete records, no line may be in the scene
        assert row["checked exactly"] == 2
        for what in ("indefinite", "overconfident"):
            assert row[what] == row[f"{what}, exactly"] == 0
        assert 1 <= row["groups"]["all"]["centre"][2] <= 1.1
        assert row["groups"]["all"]["z of centre"]["rms"] == pytest.approx(1.0, abs=0.25)
        assert row["groups"]["all"]["z of width"]["rms"] <= 1.1


def test_processes_give_the_same_figures(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tool, "CHUNK", 3)
    results = [run(capsys, "--jobs", jobs)[1] for jobs in ("1", "2")]
    for result in results:
        for carrier in joint_figures.CARRIERS:
            del result[carrier]["median"]
    assert results[0] == results[1]


def test_the_table_has_all_groups(capsys: pytest.CaptureFixture[str]) -> None:
    tool.main(["-n", "8", "--shape", "motorway", "--exact", "0"])
    lines = capsys.readouterr().out.splitlines()
    for group in ("all", "production, map error", "poor, no error"):
        assert sum(line.startswith(group) for line in lines) == 2


def test_overconfident_joints_are_found(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three quarters of the decoded covariance, in floating point and exactly."""
    decode = SceneCode.decode

    def small(self: Any, *arguments: Any) -> Any:
        decoded = decode(self, *arguments)
        return decoded._replace(cov=0.75 * decoded.cov)

    monkeypatch.setattr(SceneCode, "decode", small)
    status, result = run(capsys)
    assert status == 1
    assert "MISSED  conditional: 8 are overconfident" in result["missed"]
    assert "MISSED  complete: 2 are overconfident, exactly" in result["missed"]


def test_indefinite_joints_are_found(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    decode = SceneCode.decode

    def indefinite(self: Any, *arguments: Any) -> Any:
        decoded = decode(self, *arguments)
        cov = decoded.cov.copy()
        cov[0, 4] = cov[4, 0] = 10 * cov[0, 0]
        return decoded._replace(cov=cov)

    monkeypatch.setattr(SceneCode, "decode", indefinite)
    status, result = run(capsys)
    assert status == 1
    for carrier in joint_figures.CARRIERS:
        assert result[carrier]["indefinite"] == result[carrier]["checked"] >= 7


def test_wide_joints_are_found(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    decode = SceneCode.decode

    def wide(self: Any, *arguments: Any) -> Any:
        decoded = decode(self, *arguments)
        return decoded._replace(cov=2 * decoded.cov)

    monkeypatch.setattr(SceneCode, "decode", wide)
    _, result = run(capsys)
    assert result["conditional"]["groups"]["all"]["centre"][1] == pytest.approx(2**0.5, rel=0.02)
    missed = "\n".join(result["missed"])
    for words in ("ratio of the centre", "lateral ratio at 80 m", "KL with a map error"):
        assert words in missed


def test_the_lines_move_as_the_map_error_says() -> None:
    points = np.column_stack([np.linspace(0, 50, 26), np.full(26, 2.0)])
    error = MapError(point_sigma=0.05, offset_sigma=0.1)
    true = tool.moved(points, error, 20_000, np.random.default_rng(1)) - points
    assert true[..., 1].var(axis=0) == pytest.approx(np.full(26, 0.05**2 + 0.1**2), rel=0.06)
    assert np.diff(true[..., 1], axis=1).var() == pytest.approx(2 * 0.05**2, rel=0.03)
    assert tool.moved(points, None, 5, np.random.default_rng(1)) is points


def test_the_load_of_a_classic_frame() -> None:
    """135 bits at most, 32 frames 50 times a second, at 500 kbit/s."""
    assert joint_figures.bus_load(32, 50) == pytest.approx(32 * 50 * 135 / 500_000)
    assert joint_figures.bus_load(None, 50) is None


@given(covariances(4, (0.0, 1e-15, 1e-9, 1.0)))
def test_exact_definiteness_agrees_with_the_eigenvalues(cov: np.ndarray[Any, Any]) -> None:
    """Where they are not near 0; and a matrix covers itself plus anything definite only."""
    scale = np.sqrt(np.where(cov.diagonal() > 0, cov.diagonal(), 1.0))
    least = np.linalg.eigvalsh(cov / scale / scale[:, None])[0]
    if abs(least) > 1e-12:
        assert is_positive_definite(cov.tolist()) == (least > 0)
    zero = np.zeros(4)
    assert not covers(cov, zero, cov, zero)
    more = cov + np.diag(scale**2)
    assert covers(more, zero, cov, zero)
    assert not covers(more, zero, cov, 2 * scale * [1, 0, 0, 0])


@pytest.mark.parametrize(
    ("matrix", "definite"),
    [
        ([[1.0, 1.0], [1.0, 1.0 + 2**-52]], True),
        ([[1.0, 1.0], [1.0, 1.0]], False),
        ([[1e-300, 0.0], [0.0, 1e300]], True),
        ([[0.0]], False),
        ([[2, -1, 0], [-1, 2, -1], [0, -1, 2]], True),
        ([[2, -1, -1], [-1, 2, -1], [-1, -1, 2]], False),
        ([[1, 2], [2, 1]], False),
    ],
)
def test_exact_definiteness(matrix: Any, definite: bool) -> None:
    assert is_positive_definite(matrix) is definite


@settings(max_examples=20)
@given(st.integers(0, 55))
def test_scenes_are_reproducible_and_of_all_kinds(number: int) -> None:
    what = tool.Settings(("motorway", "city"), 1, 1, 0, 0, 0)
    first, second = (tool.drawn(number, what) for _ in range(2))
    assert np.array_equal(first.scene.cov, second.scene.cov)
    assert len(first.case.lines) == 2 + number // 8 % 7
    assert ("poor" in first.group) == (number // 2 % 2 == 1)
    assert ("map error" in first.group) == (first.scene.map_error is not None)
