"""Each process runs C or Python alone, as it was told, and says which and why."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import c_core
import pytest

from maplines_can import __version__, native
from maplines_can.core import PATH

ROOT = Path(__file__).parents[2]
#: A library of another version.
STALE = """
#include <stddef.h>
const char *maplines_core_version(void) { return "0.0.1"; }
const char *maplines_core_compiler(void) { return "any"; }
size_t maplines_core_size(void) { return 1; }
"""
#: What is there in place of the library (C, bytes or nothing), and how the reason begins.
UNUSABLE = {
    "missing": (None, "no library of the core; an install with a C compiler builds it"),
    "stale": (STALE, "the library of the core is of version 0.0.1; install the package again"),
    "another": ("int other;", "the library of the core cannot be loaded: "),
    "no-library": (b"text", "the library of the core cannot be loaded: "),
}


def maplines(*arguments: str, native: str | None, folder: Path = ROOT) -> tuple[int, str, str]:
    """Run a command with the package of a folder; return its status, output and errors."""
    environment = {k: v for k, v in os.environ.items() if k != "MAPLINES_NATIVE"}
    if native is not None:
        environment["MAPLINES_NATIVE"] = native
    done = subprocess.run(
        [sys.executable, "-m", "maplines_can", *arguments],
        capture_output=True, text=True, check=False, cwd=folder, env=environment,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of the package, without its library."""
    folder = tmp_path_factory.mktemp("package")
    skipped = shutil.ignore_patterns(PATH.name, "__pycache__")
    shutil.copytree(ROOT / "maplines_can", folder / "maplines_can", ignore=skipped)
    return folder


@pytest.fixture(params=UNUSABLE)
def unusable(package: Path, request: pytest.FixtureRequest) -> tuple[Path, str]:
    """The copy with a library that cannot be used, and how the reason begins."""
    content, reason = UNUSABLE[request.param]
    path = package / "maplines_can" / "core" / PATH.name
    path.unlink(missing_ok=True)
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        command = ["cc", "-shared", "-fPIC", "-xc", "-", "-o", str(path)]
        subprocess.run(command, input=content, text=True, check=True)
    return package, reason


def test_python_alone_computes_if_the_library_cannot_be_used(unusable: tuple[Path, str]) -> None:
    """The version names the reason."""
    folder, reason = unusable

    status, said, errors = maplines("--version", native=None, folder=folder)

    assert (status, errors) == (0, "")
    assert said.startswith(f"maplines {__version__}, computes in Python alone ({reason}")


def test_c_cannot_be_forced_if_the_library_cannot_be_used(unusable: tuple[Path, str]) -> None:
    """The error is one line with the reason, and the status is 1."""
    folder, reason = unusable

    status, said, errors = maplines("--version", native="1", folder=folder)

    assert (status, said) == (1, "")
    text = f"maplines: error: MAPLINES_NATIVE=1, but there is no C path: {reason}"
    assert errors.startswith(text)
    assert errors.count("\n") == 1


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the memory map of Linux")
def test_python_alone_can_be_forced() -> None:
    """The library is not even loaded."""
    expected = f"maplines {__version__}, computes in Python alone (MAPLINES_NATIVE=0)\n"
    assert maplines("--version", native="0") == (0, expected, "")

    code = "import maplines_can.wire.codec; print(open('/proc/self/maps').read())"
    environment = os.environ | {"MAPLINES_NATIVE": "0"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment)
    assert (done.returncode, PATH.name.encode() in done.stdout) == (0, False)


@pytest.mark.skipif(not native.is_active, reason="Python alone runs here")
@pytest.mark.parametrize("wanted", [None, "", "1"])
def test_c_computes_where_it_can(wanted: str | None) -> None:
    """The version names the compiler."""
    status, said, errors = maplines("--version", native=wanted)

    assert (status, errors) == (0, "")
    built = r"computes in C \(built with .*\b\d+\.\d+.*\)\n"
    assert re.fullmatch(rf"maplines {re.escape(__version__)}, {built}", said)


@pytest.mark.parametrize("command", [["--version"], ["demo"]])
def test_another_path_is_an_error(command: list[str]) -> None:
    """The error names the value and the valid ones, of each command."""
    text = "MAPLINES_NATIVE must be 0 for Python alone, 1 for C, or not set, got '2'"
    assert maplines(*command, native="2") == (1, "", f"maplines: error: {text}\n")


@pytest.mark.skipif(not native.is_active, reason="Python alone runs here")
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the symbols of ELF")
def test_the_library_runs_with_any_mathematical_library() -> None:
    """It needs no function that differs between libraries, or whose name has a new version."""
    assert c_core.library_functions(PATH) <= c_core.EXACT


def test_help_needs_no_path() -> None:
    """A wrong path does not hide the help."""
    assert maplines("--help", native="2")[0] == 0


def test_this_process_says_what_it_runs() -> None:
    """The attributes of the module agree."""
    wanted = os.environ.get(native.VARIABLE)
    assert native.is_active is (native.lib is not None)
    assert wanted not in ("0", "1") or native.is_active is (wanted == "1")
    path = "C" if native.is_active else "Python alone"
    assert native.description() == f"{path} ({native.reason})"
