"""The command ``maplines study run``: output, help, wrong usage."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.fixtures import Patch

from maplines_can.cli import main


@pytest.fixture
def command(monkeypatch: Patch) -> Any:
    """Run the command; return its status and the calls of its progress bar."""
    seen: list[Any] = []

    @contextlib.contextmanager
    def bar(_unit: str) -> Iterator[Any]:
        yield lambda done, total: seen.append((done, total))

    monkeypatch.setattr("maplines_can.cli.study.progress_bar", bar)

    def run(*arguments: Any) -> Any:
        seen.clear()
        return main(["study", "run", *map(str, arguments)]), seen

    return run


SMALL = ("--code", "Cholesky", "--finer", "-1", "0", "--set", "road", "--n", "2e2", "--jobs", 1)


def test_the_command_prints_the_summary(
    command: Any, tmp_path: Path, capsys: Any, monkeypatch: Patch
) -> None:
    """As text or as JSON; the second run has nothing left to do."""
    pytest.importorskip("pyarrow")
    sizes = {"fields_n": 0, "limit_n": 0, "scenes_n": 0}
    monkeypatch.setattr("maplines_can.cli.study.DEFAULTS", sizes)
    status, seen = command("--out", tmp_path / "out", *SMALL)
    text = capsys.readouterr().out

    assert status == 0
    assert seen == [(0, 200), (200, 200)]
    assert "road: 200 Gaussians" in text
    assert "over its theory" in text
    status, seen = command("--out", tmp_path / "out", *SMALL, "--json")
    rows = json.loads(capsys.readouterr().out)["summary"]
    assert status == 0
    assert seen == [(200, 200)]
    assert [(row["code"], row["finer_bits"]) for row in rows] == [("Cholesky", -1), ("Cholesky", 0)]


def test_the_help_explains_sets_files_and_tables(command: Any, capsys: Any) -> None:
    """It also says how to resume and how to use a cluster."""
    with pytest.raises(SystemExit):
        command("--help")
    text = capsys.readouterr().out

    for word in ("paper", "road", "cov_00", "Parquet", "dask scheduler", "goes on"):
        assert word in text


@pytest.mark.parametrize(
    "arguments", [("--n", "0"), ("--n", "1.5"), ("--finer", "99"), ("--code", "Morse")]
)
def test_wrong_usage_is_refused(command: Any, arguments: Any, tmp_path: Path, capsys: Any) -> None:
    """argparse ends with status 2 and names the option."""
    with pytest.raises(SystemExit, match="2"):
        command("--out", tmp_path / "out", *arguments)
    assert arguments[0] in capsys.readouterr().err
