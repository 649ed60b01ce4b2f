"""Compilers that make the binaries of an FMU: that of this machine, and MinGW for Windows."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

#: Names of a C compiler for this machine, and for Windows.
COMPILERS = (("cc", "gcc", "clang"), ("x86_64-w64-mingw32-gcc",))
#: Endings of a shared library.
ENDINGS = {"linux": ".so", "windows": ".dll", "darwin": ".dylib"}
OPTIONS = ["-std=c99", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-DNDEBUG", "-shared",
           "-DFMI3_OVERRIDE_FUNCTION_PREFIX"]  # fmt: skip
#: Options of a system: no time stamp and no library of the compiler in a DLL.
MORE = {
    "linux": ["-fPIC", "-s"],
    "windows": ["-s", "-static-libgcc", "-Wl,--no-insert-timestamp"],
    "darwin": ["-fPIC"],
}


def binaries(
    identifier: str, sources: Mapping[str, str], compiled: Iterable[str]
) -> dict[str, bytes]:
    """Return the shared libraries that the compilers of this machine make, by platform and name.

    Raises:
        OSError: a compiler fails; the message has what it says.
    """
    found: dict[str, bytes] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, text in sources.items():
            (Path(folder) / name).write_text(text, encoding="utf-8", newline="\n")
        for names in COMPILERS:
            compiler = next(filter(None, map(shutil.which, names)), None)
            platform = None if compiler is None else platform_of(compiler)
            if compiler is None or platform is None:
                continue
            ending = ENDINGS[platform.partition("-")[2]]
            name = f"{platform}/{identifier}{ending}"
            found[name] = library(compiler, name, Path(folder), compiled)
    return found


def platform_of(compiler: str) -> str | None:
    """Return the name in FMI of what a compiler compiles for; None if it has none.

    The target of a compiler is such as x86_64-linux-gnu, x86_64-w64-mingw32, arm64-apple-darwin23.
    """
    machine, _, system = _run([compiler, "-dumpmachine"]).strip().partition("-")
    machine = {"arm64": "aarch64", "i686": "x86", "i386": "x86"}.get(machine, machine)
    for part, name in (("linux", "linux"), ("mingw", "windows"), ("darwin", "darwin")):
        if part in system:
            return f"{machine}-{name}"
    return None


def library(compiler: str, name: str, folder: Path, sources: Iterable[str]) -> bytes:
    """Compile a shared library of this name, by platform and file, in the folder of its sources."""
    platform, _, file = name.partition("/")
    more = MORE[platform.partition("-")[2]]
    _run([compiler, *OPTIONS, *more, *sources, "-lm", "-o", file], folder)
    return (folder / file).read_bytes()


def _run(command: list[str], folder: Path | None = None) -> str:
    """Return what a compiler prints."""
    done = subprocess.run(  # noqa: S603 - a compiler that is installed here, and our own sources
        command,
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env=os.environ | {"LC_ALL": "C"},
    )
    if done.returncode:
        raise OSError(f"{command[0]} fails: {done.stderr[-500:]}")
    return done.stdout
