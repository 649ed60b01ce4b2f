"""Test vectors: what is in them, that the C core passes, and that the runner can fail."""

import hashlib
import json
import re
import shutil
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from random_dbc import SCENE_SEED, random_dbc
from scene_layouts import layout_of
from support import c_core

from maplines_can import Status
from maplines_can.cli import main
from maplines_can.generation.c_tables import identifier_of
from maplines_can.generation.vector_files import vectors_from
from maplines_can.generation.vectors import SCHEMA
from maplines_can.wire import E2EState, ProfileStatus, Reason
from maplines_can.wire.layout.message_layout import Layout

pytest.importorskip("cryptography")

ROOT = Path(__file__).parents[2]
FOLDER = c_core.C / "tests" / "vectors"
SHIPPED = ("maplines.dbc", "maplines-pose.dbc", "maplines-secoc.dbc", "maplines-scene.dbc")


def text_of(dbc: str) -> str:
    """The vectors of a DBC in the repository."""
    return (FOLDER / f"{identifier_of(dbc)}.txt").read_text()


@cache
def content(dbc: str) -> Any:
    return json.loads((FOLDER / f"{identifier_of(dbc)}.json").read_text())


def steps(dbc: str) -> list[Any]:
    return [step for case in content(dbc)["cases"] for step in case["steps"]]


def test_the_files_of_the_repository_are_up_to_date() -> None:
    check = [sys.executable, str(ROOT / "tools" / "make_vectors.py"), "--check"]
    done = subprocess.run(check, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


# ---- what is in them --------------------------------------------------------------------------


@pytest.mark.parametrize("dbc", SHIPPED)
def test_the_json_conforms_to_its_schema(dbc: str) -> None:
    schema = json.loads((FOLDER / SCHEMA).read_text())
    validator = pytest.importorskip("jsonschema").Draft202012Validator(schema)
    validator.validate(content(dbc))
    changes: list[dict[str, Any]] = [
        {"sha256": "0"}, {"cases": [{}]}, {"more": 1}, {"places": ["a"]},
    ]  # fmt: skip
    for change in changes:
        assert not validator.is_valid(content(dbc) | change)


def test_every_reason_status_and_state_occurs() -> None:
    """Of the DBCs together; those that one of them can have, in it."""
    seen = {dbc: Counter[str]() for dbc in SHIPPED}
    for dbc in SHIPPED:
        for step in steps(dbc):
            seen[dbc].update([step["reason"]] if "reason" in step else [])
            seen[dbc].update(step.get("counts", {}).keys())
            seen[dbc].update(f"{name} {step[name]}" for name in ("state", "status") if name in step)
            seen[dbc].update(f"line {line['status']}" for line in step.get("lines", ()))
    everywhere = {f"state {state.name}" for state in E2EState}
    everywhere |= {f"status {status.name}" for status in ProfileStatus} | {"status NONE"}
    secoc = {"UNAUTHENTICATED", "KEY", "MAC", "REPLAY", "AGE"}
    # SPACING is off in the default settings, which the receivers of vectors have.
    common = {reason.name for reason in Reason} - secoc - {"POSE", "SPACING"}
    of_pages = {"PAGE", "REPLACED", "INCOMPLETE", "TIMEOUT", "MIXED"}
    for dbc in SHIPPED:
        none = of_pages if layout_of(dbc).scene else set()
        assert seen[dbc].keys() >= everywhere | common - none
    assert seen["maplines-secoc.dbc"].keys() >= secoc
    assert "POSE" in seen["maplines-pose.dbc"]
    assert seen["maplines.dbc"].keys() >= {f"line {status.name}" for status in Status}


@pytest.mark.parametrize("dbc", SHIPPED)
def test_there_are_usable_lines_and_scenes(dbc: str) -> None:
    for kind in ("view", "scene"):
        usable = Counter(step["is_usable"] for step in steps(dbc) if step["step"] == kind)
        assert usable[True] >= 3
        assert usable[False] >= 3
    assert any(step.get("two_senders") for step in steps(dbc))
    assert {len(step["slots"]) for step in steps(dbc) if step["step"] == "scene"} >= {0, 1, 2, 3}


@pytest.mark.parametrize("dbc", SHIPPED)
def test_the_hashes_are_those_of_the_dbc_and_of_the_cases(dbc: str) -> None:
    text = text_of(dbc)
    body = text.split("\n", 4)[4]
    assert content(dbc)["sha256"] == hashlib.sha256(body.encode()).hexdigest()
    file = (ROOT / "dbc" / dbc).read_bytes()
    assert content(dbc)["dbc"] == {"name": dbc, "sha256": hashlib.sha256(file).hexdigest()}
    assert [line.split()[-1] for line in text.splitlines()[2:4]] == [
        content(dbc)["dbc"]["sha256"], content(dbc)["sha256"],
    ]  # fmt: skip


# ---- what passes and what fails ---------------------------------------------------------------


def changed(folder: Path, pattern: str, replacement: str) -> Path:
    """Vectors of maplines.dbc with one change."""
    text, found = re.subn(pattern, replacement, text_of("maplines.dbc"), count=1)
    assert found
    path = folder / "vectors.txt"
    path.write_text(text)
    return path


def runner(layout: Layout, **options: Any) -> Path:
    return c_core.program([c_core.C / "tests" / "run_vectors.c"], [layout], ["harness"], **options)


@pytest.mark.parametrize(
    "flags",
    [pytest.param(("-O2",), id="double"), pytest.param(("-O2", "-DMAPLINES_FLOAT"), id="float")],
)
@pytest.mark.parametrize("dbc", SHIPPED)
def test_the_c_core_passes(tmp_path: Path, dbc: str, flags: tuple[str, ...]) -> None:
    path = tmp_path / "vectors.txt"
    path.write_text(text_of(dbc))
    program = runner(layout_of(dbc), flags=flags)
    done = subprocess.run([program, path], capture_output=True, text=True, check=False)
    n = text_of(dbc).count("\ncase ")
    assert done.stdout == f"{n} cases of {dbc}: {n} passed, 0 failed\n"
    assert done.returncode == 0


@pytest.mark.parametrize("seed", [*range(3), SCENE_SEED])
def test_the_c_core_passes_those_of_any_dbc(tmp_path: Path, seed: int) -> None:
    """Also without classic messages, or with other widths and places of all signals."""
    path = tmp_path / "random.dbc"
    path.write_text(random_dbc(seed))
    layout, found = Layout.from_dbc(path), tmp_path / "vectors.txt"
    found.write_text(vectors_from(layout).text)
    assert found.read_text().count("\ncase ") > 80
    done = subprocess.run([runner(layout), found], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("pattern", "replacement"),
    [
        pytest.param(r"(?m)^(mean) \S+", r"\1 0x1.8p+4", id="mean"),
        pytest.param(r"(?m)^(cov) \S+", r"\1 0x1p+0", id="covariance"),
        pytest.param(r"(?m)^(y) \S+", r"\1 0x1p+0", id="y"),
        pytest.param(r"(?m)^(sigma) \S+", r"\1 0x1p+0", id="sigma"),
        pytest.param(r"(?m)^(joint) \S+", r"\1 0x1p-30", id="joint"),
        pytest.param(r"(?m)^(frame .*) CRC$", r"\1 CONTENT", id="reason"),
        pytest.param(r"(?m)^(frame .*) COMPLETE EGO_LEFT$", r"\1 COMPLETE ROUTE", id="slot"),
        pytest.param(r"(?m)^(view \S+ \S+) VALID", r"\1 INIT", id="state"),
        pytest.param(r"(?m)^(view \S+ \S+ \S+) OK", r"\1 ERROR", id="status"),
        pytest.param(r"(?m)^(view .*) 1$", r"\1 0", id="usable"),
        pytest.param(r"(?m)^(view (?:\S+ ){4})0x\S+", r"\g<1>inf", id="age"),
        pytest.param(r"(?m)^(stats (?:\S+ ){4})\d+", r"\g<1>99", id="ok"),
        pytest.param(r"(?m)^(counts .*)CRC=\d+", r"\1CRC=99", id="count"),
        pytest.param(r"(?m)^(line \S+ )SOLID", r"\1KERB", id="kind"),
        pytest.param(r"(?m)^(frame .*) COMPLETE EGO_LEFT$", r"\1 COMPLETE", id="no-slot"),
        pytest.param(r"(?m)^counts .*$", "anything", id="unknown-step"),
    ],
)
def test_the_runner_fails_if_a_value_is_another_one(
    tmp_path: Path, pattern: str, replacement: str
) -> None:
    path, program = changed(tmp_path, pattern, replacement), runner(layout_of("maplines.dbc"))
    done = subprocess.run([program, path], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout.endswith(" 1 failed\n")
    name = done.stdout.split(":")[0]
    assert subprocess.run([program, path, name], stdout=-1, check=False).returncode == 1
    assert subprocess.run([program, path, "foreign"], stdout=-1, check=False).returncode == (
        name == "foreign"
    )


@pytest.mark.parametrize(
    ("pattern", "replacement"),
    [
        pytest.param(r"(?s)\ncase [^\n]+\n(?!.*\ncase ).*", "\n", id="last case"),
        pytest.param(r"(?s)\ncase .*?(?=\ncase )", "", id="first case"),
        pytest.param(r"end \d+\n$", "", id="end"),
        pytest.param(r"\d\n$", "", id="last character"),
    ],
)
def test_the_runner_fails_if_the_file_is_cut(
    tmp_path: Path, pattern: str, replacement: str
) -> None:
    command = [runner(layout_of("maplines.dbc")), changed(tmp_path, pattern, replacement)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert " 0 failed\n" in done.stdout
    assert "is not whole" in done.stdout


def test_the_generated_files_are_enough_to_run_them(tmp_path: Path) -> None:
    """As the help of the command says."""
    dbc = tmp_path / "own.dbc"
    dbc.write_bytes((ROOT / "dbc" / "maplines-secoc.dbc").read_bytes())
    for what in ("c", "vectors"):
        assert main(["generate", what, "--dbc", str(dbc), "--out", str(tmp_path)]) == 0
    compiler = ["cc", "-std=c99", "-ffp-contract=off"]
    sources = ["run_vectors.c", "maplines.c", "own_dbc.c"]
    subprocess.run([*compiler, *sources, "-lm", "-o", "run_vectors"], check=True, cwd=tmp_path)
    subprocess.run([tmp_path / "run_vectors", "own.txt"], check=True, cwd=tmp_path)


@pytest.mark.skipif(not shutil.which("cmake"), reason="there is no cmake")
def test_cmake_builds_the_sources_and_ctest_runs_the_vectors(tmp_path: Path) -> None:
    """Of one DBC, to be fast."""
    build = str(tmp_path / "build")
    options = [f"-DPython3_EXECUTABLE={sys.executable}", "-DCMAKE_BUILD_TYPE=Debug"]
    for command in (
        ["cmake", "-S", str(c_core.C), "-B", build, *options],
        ["cmake", "--build", build, "--target", "run_vectors_maplines"],
        ["ctest", "--test-dir", build, "--tests-regex", "^vectors_of_maplines$"],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
