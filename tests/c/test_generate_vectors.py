"""The command ``maplines generate vectors``."""

import json
from pathlib import Path
from typing import Any

import pytest

from maplines_can.cli import main


def generate(*words: str | Path) -> int:
    return main(["generate", "vectors", *map(str, words)])


def test_the_files_are_the_same_each_time(tmp_path: Path, capsys: Any) -> None:
    for folder in ("a", "b"):
        assert generate("--dbc", "maplines-pose.dbc", "--out", tmp_path / folder, "--json") == 0
    first, second = ({p.name: p.read_bytes() for p in (tmp_path / d).iterdir()} for d in "ab")
    assert first == second
    assert set(first) == {
        "maplines_pose.json", "maplines_pose.txt", "vectors.schema.json", "run_vectors.c",
        "aes_cmac.h",
    }  # fmt: skip
    printed = json.loads(capsys.readouterr().out.partition("}\n{")[0] + "}")
    assert printed["cases"] > 100
    assert printed["dbc"]["name"] == "maplines-pose.dbc"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        pytest.param(["--dbc", "maplines-float16.dbc"], "'Float16' is none of", id="study"),
        pytest.param(["--name", "a b"], "C identifier", id="name"),
    ],
)
def test_what_cannot_be_generated_is_refused(
    tmp_path: Path, capsys: Any, words: list[str], message: str
) -> None:
    assert generate(*words, "--out", tmp_path / "out") == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
