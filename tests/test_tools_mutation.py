"""tools/mutation.py on a tiny package, and the mutants that it makes."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from mutants import mutants
from mutation import AREAS

ROOT = Path(__file__).parents[1]

SOURCE = "LEAST = 3\n\ndef limited(x: int) -> int:\n    return max(x, LEAST)\n"
TEST = """
from tiny.limits import limited

def test_inside():
    assert [limited(x) for x in (4, 5)] == [4, 5]
"""


@pytest.mark.parametrize(
    ("source", "texts"),
    [
        ("a < b", {"(a <= b)", "(a >= b)"}),
        ("a == b", {"(a != b)"}),
        ("0 < a <= 9", {"(0 <= a <= 9)", "(0 >= a <= 9)", "(0 < a < 9)", "(0 < a > 9)",
                        "(1)", "(10)", "(8)"}),
        ("a and b", {"(a or b)", "(a)", "(b)"}),
        ("a & ~b", {"(a | ~b)", "(a)", "(~b)", "(b)"}),
        ("not a", {"(a)"}),
        ("a - b", {"(a + b)"}),
        ("x = abs(a)", {"(a)"}),
        ("x = np.abs(a)", {"(a)"}),
        ("x = min(a, b)", {"(max(a, b))"}),
        ("x = (a > b).any()", {"((a > b).all)", "(a >= b)", "(a <= b)"}),
        ("if a: pass", {"(True)", "(False)"}),
        ("while a: pass", {"(False)"}),
        ("[a for a in b if c]", {"(True)", "(False)"}),
        ("a.b = c", {"pass"}),
        ("a = b", set()),
        ("a += b", {"a -= b", "pass"}),
        ("def f(a=2): return a", {"(3)", "(1)", "return None"}),
        ("def f(a: list[1] = None) -> 3: 'text'; return None", set()),
        ("raise ValueError(1)", {"pass"}),
        ("x = 0.5, 'text', None, True", {"(5.0)", "(0.05)", "(False)"}),
        ("class A:\n    def __repr__(self): return 1 + 2", set()),
        ("f'{a + 1}'", set()),
    ],
)  # fmt: skip
def test_mutants_of_one_place(source: str, texts: set[str]) -> None:
    """Each can be compiled, and texts, annotations and messages are left alone."""
    found = mutants(source.encode())
    for mutant in found:
        compile(mutant.apply(source.encode()), "mutant", "exec")
    assert {mutant.mutated for mutant in found} == texts


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A package of one function, whose tests leave its lower limit open."""
    for name, text in {
        "tiny/__init__.py": "",
        "tiny/limits.py": SOURCE,
        "tests/test_it.py": TEST,
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def run(tree: Path, *options: str) -> tuple[int, dict[str, Any]]:
    command = [sys.executable, str(ROOT / "tools" / "mutation.py"), "--json", "--root", str(tree)]
    command += ["--sources", "tiny", "--tests", "tests", "--sample", "0", *options]
    environment = {**os.environ, "PYTHONPATH": ""}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    return done.returncode, json.loads(done.stdout) if done.stdout else {"error": done.stderr}


@pytest.mark.skipif(sys.platform == "win32", reason="mutation.py needs Linux or macOS")
def test_the_survivors_are_what_the_tests_leave_open(tree: Path) -> None:
    """No test has a lower x, so another limit goes unnoticed; a listed reason is printed."""
    pytest.importorskip("coverage")
    survivors = tree / "survivors.toml"
    survivors.write_text(
        "[[survivor]]\nfile = 'tiny/limits.py'\nfunction = ''\noriginal = '3'\n"
        "mutated = '(4)'\nreason = 'nobody cares'\n"
    )
    status, result = run(tree, "--survivors", str(survivors), "--least", "0.99")
    assert status == 1, result
    assert result["survived"] == len(result["survivors"]) == 2
    assert result["of these not listed"] == 1
    texts = sorted(f"{place} {reason}" for place, reason in result["survivors"].items())
    assert "3 -> (2)" in texts[0]
    assert "3 -> (4)" in texts[1]
    assert "nobody cares" in texts[1]
    assert result["killed"] == result["mutants"] - 2 == 2
    assert (tree / "tiny" / "limits.py").read_text() == SOURCE


def test_the_areas_have_all_of_their_packages() -> None:
    """Each area has files that exist; packages whose folders are named are in one of them."""
    for name, area in AREAS.items():
        for path in (*area.sources, *area.tests):
            assert (ROOT / path).exists(), name
    sources = {path for area in AREAS.values() for path in area.sources}
    for package in ("bus", "consumers", "localisation", "maps", "propagation", "values", "wire"):
        assert f"maplines_can/{package}" in sources
