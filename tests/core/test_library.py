"""The library of the core: it is loaded, or one clear error says why not."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support import c_core

from maplines_can import __version__
from maplines_can.core import PATH

ROOT = Path(__file__).parents[2]
#: A library of another version.
STALE = """
#include <stddef.h>
#include <stdint.h>
const char *maplines_core_version(void) { return "0.0.1"; }
uint32_t maplines_core_declarations(void) { return 0; }
const char *maplines_core_compiler(void) { return "any"; }
size_t maplines_core_size(size_t i) { return i; }
"""
#: What is there in place of the library (C, bytes or nothing), and what the error says.
UNUSABLE = {
    "missing": (None, f"the library of the core, {PATH.name}, is missing; "),
    "stale": (STALE, "the library of the core is another build, 0.0.1; "),
    "another": ("int other;", "the library of the core cannot be loaded: "),
    "no-library": (b"text", "the library of the core cannot be loaded: "),
}


def maplines(*arguments: str, folder: Path = ROOT) -> tuple[int, str, str]:
    """Run a command with the package of a folder; return its status, output and errors."""
    command = [sys.executable, "-m", "maplines_can", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of the package, without its library."""
    folder = tmp_path_factory.mktemp("package")
    skipped = shutil.ignore_patterns(PATH.name, "__pycache__")
    shutil.copytree(ROOT / "maplines_can", folder / "maplines_can", ignore=skipped)
    return folder


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no cc")
@pytest.mark.parametrize("kind", UNUSABLE)
def test_a_library_that_cannot_be_used_is_one_error(package: Path, kind: str) -> None:
    """One line with the reason and the cure, and the status is 1: nothing else computes."""
    content, reason = UNUSABLE[kind]
    path = package / "maplines_can" / "core" / PATH.name
    path.unlink(missing_ok=True)
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        command = ["cc", "-shared", "-fPIC", "-xc", "-", "-o", str(path)]
        subprocess.run(command, input=content, text=True, check=True)

    status, said, errors = maplines("demo", folder=package)

    assert (status, said) == (1, "")
    assert errors.startswith(f"maplines: error: {reason}")
    assert errors.endswith("; install the package again, which builds it\n")
    assert errors.count("\n") == 1


def test_the_version_names_the_compiler() -> None:
    status, said, errors = maplines("--version")

    assert (status, errors) == (0, "")
    assert re.fullmatch(rf"maplines {re.escape(__version__)}\b.*\d+\.\d+.*\n", said)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the symbols of ELF")
def test_the_library_runs_with_any_mathematical_library() -> None:
    """It needs no function that differs between libraries, or whose name has a new version."""
    assert c_core.library_functions(PATH) <= c_core.EXACT
