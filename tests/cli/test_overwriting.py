"""Commands that write files replace none that exists, unless --force is given."""

import argparse
import shlex
from pathlib import Path
from typing import Any

import pytest

from maplines_can.cli import COMMANDS, GROUPS, _parser, main

#: What a person wrote.
OWN = b"my own work\n"
#: Options with which a command writes files.
WRITING = {"--log", "--output", "--out", "--plot", "--record", "--truth"}
#: Commands that write, with the file that is there.
CASES = [
    ("demo --seconds 0.1 --plot own.png", "own.png"),
    ("drive --as-fast-as-possible --seconds 0.1 --record own.blf", "own.blf"),
    ("drive --as-fast-as-possible --seconds 0.1 --record new.log", "new.truth.parquet"),
    ("drive --as-fast-as-possible --seconds 0.1 --record new.log", "new.truth.csv"),
    ("drive --as-fast-as-possible --seconds 0.1 --truth own.csv", "own.csv"),
    ("decode log.blf -o own.csv", "own.scenes.csv"),
    ("map town.xodr --plot own.png", "own.png"),
    ("accuracy truth.csv log.blf --plot own.png", "own.png"),
    ("design --frames 4 --n 100 --set road --out own.dbc", "own.dbc"),
    ("design --frames 4 --n 100 --set road --out own.dbc", "own.md"),
    ("generate c", "CMakeLists.txt"),
    ("generate vectors", "maplines.json"),
    ("figures --samples 1000 --out figures", "figures/figure-06-close-up.svg"),
    ("study report sweep --out own.html", "own.html"),
]


@pytest.mark.parametrize(("command", "name"), CASES)
def test_a_file_that_exists_is_not_replaced(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    command: str,
    name: str,
) -> None:
    """The command ends before it writes anything, and its one line says what to do."""
    monkeypatch.chdir(tmp_path)
    Path(name).parent.mkdir(exist_ok=True)
    Path(name).write_bytes(OWN)
    assert main(shlex.split(command)) == 1
    assert capsys.readouterr().err == (
        f"maplines: error: {name} exists already; use another name, or --force to replace the "
        "file\n"
    )
    assert Path(name).read_bytes() == OWN
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [tmp_path / name]


@pytest.mark.parametrize(("command", "name"), [CASES[1], CASES[4], CASES[6]])
def test_force_replaces_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: Any, name: Any
) -> None:
    """It is the output of the command then."""
    if name.endswith(".png"):
        pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(OWN)
    assert main([*shlex.split(command), "--force"]) == 0
    assert OWN not in Path(name).read_bytes()


@pytest.mark.parametrize("truth", ["new.truth.csv", "other.csv"])
def test_force_leaves_nothing_of_what_is_replaced(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, truth: str
) -> None:
    """A table or truth beside it would be taken for that of the new file."""
    monkeypatch.chdir(tmp_path)
    old = ["new.truth.csv", "new.truth.parquet", "table.rejects.mf4", "table.scenes.csv"]
    for name in old:
        Path(name).write_bytes(OWN)
    drive = ["drive", "--as-fast-as-possible", "--seconds", "0.1", "--record", "new.log"]
    assert main([*drive, "--truth", truth, "--force"]) == 0
    assert main(["decode", "new.log", "-o", "table.csv", "--force"]) == 0
    kept = {truth, "new.log", "table.csv", "table.rejects.csv", "table.rejects.mf4"}
    assert {path.name for path in tmp_path.iterdir()} == kept


def test_what_is_read_is_not_removed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A drive along the truth of a log that is replaced."""
    monkeypatch.chdir(tmp_path)
    fast = ["drive", "--as-fast-as-possible", "--seconds", "0.5", "--record", "new.log"]
    assert main([*fast, "--truth", "new.truth.csv"]) == 0
    again = [*fast, "--truth", "other.csv", "--drive", "new.truth.csv", "--force"]
    assert main(again) == 1
    assert "--record new.log would overwrite what is read" in capsys.readouterr().err
    assert Path("new.truth.csv").is_file()


@pytest.mark.parametrize(
    "words",
    [[name] for name in COMMANDS if name not in ("consume", "generate")]
    + [["generate", "c"], ["generate", "vectors"]]
    + [[group, name] for group, (table, _) in GROUPS.items() for name in table],
)
def test_each_command_that_writes_has_force(words: list[str]) -> None:
    """Of those with such an option, only the study has none: its folder is never replaced.

    ``replay`` has one for what it sends.
    """
    parser: Any = _parser(words)
    for word in words:
        choices = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
        parser = choices.choices[word]
    options = parser._option_string_actions.keys()
    writes = bool(WRITING & options) and words != ["study", "run"]
    assert ("--force" in options) is (writes or words == ["replay"])
