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

ROOT = Path(__file__).parents[2]
#: Fake extension modules, and why each is not used; None is no module at all.
UNUSABLE = {
    "missing": (None, "no extension module; an install with a C compiler builds it"),
    "stale": (
        "version = '0.0.1'",
        "the extension module is that of version 0.0.1; install the package again",
    ),
    "broken": (
        "raise ImportError('libm.so.6: wrong version')",
        "the extension module cannot be loaded: libm.so.6: wrong version",
    ),
    "lacking": (
        "import no_such_library",
        "the extension module cannot be loaded: No module named 'no_such_library'",
    ),
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
    """A folder with a copy of the package, without its extension module."""
    folder = tmp_path_factory.mktemp("package")
    skipped = shutil.ignore_patterns("_native*", "__pycache__")
    shutil.copytree(ROOT / "maplines_can", folder / "maplines_can", ignore=skipped)
    return folder


@pytest.fixture(params=UNUSABLE)
def unusable(package: Path, request: pytest.FixtureRequest) -> tuple[Path, str]:
    """The copy with a module that cannot be used, and the reason."""
    source, reason = UNUSABLE[request.param]
    path = package / "maplines_can" / "_native.py"
    path.unlink(missing_ok=True)
    if source is not None:
        path.write_text(source)
    return package, reason


def test_python_alone_computes_if_the_module_cannot_be_used(unusable: tuple[Path, str]) -> None:
    """The version names the reason."""
    folder, reason = unusable

    said = maplines("--version", native=None, folder=folder)

    expected = f"maplines {__version__}, computes in Python alone ({reason})\n"
    assert said == (0, expected, "")


def test_c_cannot_be_forced_if_the_module_cannot_be_used(unusable: tuple[Path, str]) -> None:
    """The error is one line with the reason, and the status is 1."""
    folder, reason = unusable

    said = maplines("--version", native="1", folder=folder)

    expected = f"maplines: error: MAPLINES_NATIVE=1, but there is no C path: {reason}\n"
    assert said == (1, "", expected)


def test_python_alone_can_be_forced() -> None:
    """The extension module is not even loaded."""
    expected = f"maplines {__version__}, computes in Python alone (MAPLINES_NATIVE=0)\n"
    assert maplines("--version", native="0") == (0, expected, "")

    code = "import sys, maplines_can.wire.codec; print('maplines_can._native' in sys.modules)"
    environment = os.environ | {"MAPLINES_NATIVE": "0"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment)
    assert done.stdout.strip() == b"False"


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
def test_the_module_runs_with_any_mathematical_library() -> None:
    """It needs no function that differs between libraries, or whose name has a new version."""
    assert c_core.library_functions(Path(native.core.__file__)) <= c_core.EXACT


def test_help_needs_no_path() -> None:
    """A wrong path does not hide the help."""
    assert maplines("--help", native="2")[0] == 0


def test_this_process_says_what_it_runs() -> None:
    """The attributes of the module agree."""
    wanted = os.environ.get(native.VARIABLE)
    assert native.is_active is (native.core is not None)
    assert wanted not in ("0", "1") or native.is_active is (wanted == "1")
    path = "C" if native.is_active else "Python alone"
    assert native.description() == f"{path} ({native.reason})"
