"""A line goes from one thread to another by the buffer of c/examples/isr, whole and at once."""

import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from scene_layouts import layout_of
from support import c_core

HARNESS = c_core.C / "tests" / "isr_harness.c"
READER = HARNESS.with_name("isr_reader.c")
BUFFER = c_core.C / "examples" / "isr" / "line_buffer.h"
THREADS = ("-std=c11", "-pthread")
SANITIZER = ("-O1", "-g", "-fsanitize=thread")


def run(
    main: Path, flags: tuple[str, ...] = c_core.FLAGS, reader: Path = READER
) -> subprocess.CompletedProcess[str]:
    layouts = [layout_of("maplines.dbc")]
    program = c_core.program(
        [main, reader], layouts, [c_core.NAME], flags=flags, main_flags=THREADS
    )
    return subprocess.run([str(program)], capture_output=True, text=True, check=False)


@pytest.fixture
def has_sanitizer(tmp_path: Path) -> None:
    """Skip where the thread sanitizer does not work."""
    if c_core.OWN_FLAGS or c_core.EMULATOR:
        pytest.skip("another compiler or processor is tested")
    (tmp_path / "empty.c").write_text("int main(void) { return 0; }")
    command = [c_core.CC, *SANITIZER, "empty.c", "-o", "empty"]
    if subprocess.run(command, cwd=tmp_path, check=False).returncode:
        pytest.skip("no thread sanitizer")
    if subprocess.run(["./empty"], cwd=tmp_path, check=False).returncode:
        pytest.skip("the thread sanitizer does not run here")


def check(done: Any) -> None:
    assert (done.returncode, done.stderr) == (0, "")
    seen, usable = map(int, done.stdout.split())
    assert 30 <= seen <= 3000  # the writer has waited for the reader 30 times
    assert usable >= seen - 10  # of the first ones, the E2E state is INIT


def test_no_line_is_torn_and_the_newest_is_seen() -> None:
    """3000 lines, of which each says its number three times."""
    check(run(HARNESS))


@pytest.mark.usefixtures("has_sanitizer")
def test_the_thread_sanitizer_finds_no_race() -> None:
    check(run(HARNESS, SANITIZER))


@pytest.mark.usefixtures("has_sanitizer")
def test_the_thread_sanitizer_finds_a_weaker_order(tmp_path: Path) -> None:
    """With a relaxed exchange, nothing orders the bytes of a line: so the test above can fail."""
    main, buffer = tmp_path / "tests" / HARNESS.name, tmp_path / "examples" / "isr" / BUFFER.name
    for path in (main, buffer):
        path.parent.mkdir(parents=True)
    for path in (READER, READER.with_suffix(".h")):
        shutil.copy(path, main.parent)
    buffer.write_text(BUFFER.read_text().replace("memory_order_acq_rel", "memory_order_relaxed"))
    main.write_text(f"{HARNESS.read_text()}/* with a relaxed exchange */\n")
    done = run(main, SANITIZER, main.with_name(READER.name))
    assert done.returncode != 0
    assert "data race" in done.stderr


@pytest.mark.parametrize(("cc", "standard"), [("g++", "c++17"), ("clang++", "c++20")])
def test_the_reader_may_be_in_another_language(cc: str, standard: str, tmp_path: Path) -> None:
    """A reader in C++ gets the lines of a writer in C."""
    if c_core.OWN_FLAGS or c_core.EMULATOR:
        pytest.skip("another compiler or processor is tested")
    if not shutil.which(cc):
        pytest.skip(f"there is no {cc}")
    flags = [*c_core.WARNINGS, "-Wold-style-cast", f"-std={standard}", "-O1", "-pthread"]
    flags += [f"-D{macro}={value}" for macro, value in c_core.LIMITS.macros.items()]
    reader = tmp_path / "reader.o"
    command = [cc, "-x", "c++", *flags, f"-I{c_core.C / 'include'}", "-c", str(READER)]
    subprocess.run([*command, "-o", str(reader)], check=True)
    check(run(HARNESS, reader=reader))


def test_a_compiler_without_atomics_is_told() -> None:
    command = [c_core.CC, "-std=c99", "-fsyntax-only", f"-I{c_core.C / 'include'}", str(BUFFER)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "line_buffer.h needs C11 with atomics, or C++11" in done.stderr
