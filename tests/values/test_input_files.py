"""Values of files from anywhere: nested deeper than any parser or message can follow."""

import gzip
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from maplines_can.cli import main
from maplines_can.logs.signal_log import read_table
from maplines_can.restbus.config import Config
from maplines_can.study.sweep.plan import StudyDirectory
from maplines_can.values.errors import DriveFileError, RestbusError, StudyError
from maplines_can.values.input_files import MAX_NESTING, json_of, toml_of

DEEP = "must be nested at most 32 deep"

#: By name: a text with values, or a key, nested so deep.
TOML: dict[str, Callable[[int], str]] = {
    "arrays": lambda n: f"a = {'[' * n}{']' * n}\n",
    "inline-tables": lambda n: f"a = {'{b = ' * n}1{'}' * n}\n",
    "key": lambda n: f"{'a.' * n}a = 1\n",
    "quoted-key": lambda n: " . ".join(['"a"'] * (n + 1)) + " = 1\n",
    "key-in-a-table": lambda n: "x = {'y' = 1, " + ".".join(["a"] * (n + 1)) + " = 1}\n",
    "header": lambda n: f"\n[{'a.' * n}a]\n",
    "header-of-an-array": lambda n: f"[[ {'a .' * n} a ]]\n",
}
#: Deeper than the limit, and than Python's own parsers follow; of values, which raise there, more.
DEPTHS = (MAX_NESTING + 1, sys.getrecursionlimit() + 1)
VALUE_DEPTHS = (*DEPTHS, 20_000)


@pytest.mark.parametrize(
    ("name", "depth"),
    [*product(TOML, DEPTHS), ("arrays", VALUE_DEPTHS[-1]), ("inline-tables", VALUE_DEPTHS[-1])],
)
def test_deep_toml_is_refused_in_one_line(name: str, depth: int, tmp_path: Path) -> None:
    """By all that reads TOML of a user."""
    text, path = TOML[name](depth), tmp_path / "deep.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"^deep\.toml: values {DEEP}$"):
        toml_of(text, "deep.toml", ValueError)
    with pytest.raises(DriveFileError, match=DEEP):
        read_table(path)
    with pytest.raises(RestbusError, match=DEEP):
        Config.load(path)


@pytest.mark.parametrize("name", TOML)
def test_what_is_nested_less_is_read(name: str) -> None:
    """Some more than half of the limit, whichever way it is counted."""
    assert toml_of(TOML[name](MAX_NESTING // 2 + 2), "car.toml", ValueError)


def test_many_dots_in_a_text_are_no_key() -> None:
    """In a value, and in lines of one."""
    text = f"a = '{'b.' * 100}'\nb = '''\n  c,{'d ' * 50}'''\n"
    assert toml_of(text, "car.toml", ValueError)["a"] == "b." * 100


@pytest.mark.parametrize("depth", VALUE_DEPTHS)
@pytest.mark.parametrize(("start", "end"), [("[", "]"), ('{"a":', "}")])
def test_deep_json_is_refused(start: str, end: str, depth: int, tmp_path: Path) -> None:
    """Of the manifest of a study, and of a result."""
    text = start * depth + "1" + end * depth
    with pytest.raises(ValueError, match=rf"^log\.json: values {DEEP}$"):
        json_of(text, "log.json", ValueError)
    (tmp_path / "study").mkdir()
    (tmp_path / "study/study.json").write_text(text)
    with pytest.raises(StudyError, match=DEEP):
        StudyDirectory(tmp_path / "study", {"a": 1})
    directory = StudyDirectory(tmp_path / "other", {"a": 1})
    (tmp_path / "other/chunks/x.json.gz").write_bytes(gzip.compress(text.encode()))
    with pytest.raises(StudyError, match=f"{DEEP}.*delete it"):
        directory.result("x")
    assert json_of("[" * MAX_NESTING + "]" * MAX_NESTING, "log.json", ValueError)


@pytest.mark.parametrize("text", ["{", "", "[1,]", "x"])
def test_what_is_no_json_is_refused(text: str) -> None:
    """With its name."""
    with pytest.raises(ValueError, match=r"^log\.json: is not valid JSON: "):
        json_of(text, "log.json", ValueError)


def test_the_restbus_ends_with_one_line(tmp_path: Path, capsys: Any) -> None:
    """And status 1."""
    path = tmp_path / "deep.toml"
    path.write_text(TOML["arrays"](5000))
    assert main(["restbus", str(path), "--virtual-time", "--seconds", "1"]) == 1
    assert capsys.readouterr().err == f"maplines: error: {path}: values {DEEP}\n"
