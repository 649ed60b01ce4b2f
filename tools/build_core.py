#!/usr/bin/env python3
"""Build the C core as a shared library, which maplines_can.core loads.

`pip install` runs this. It needs a C compiler: that of CC, or cc, gcc, clang or cl. Where there is
none, pip fetches the package ziglang, which has one (100 MB, so this takes minutes). CFLAGS and
LDFLAGS are added, such as those of sanitizers.

    python tools/build_core.py       build it again in the checkout, after changes of C
"""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parents[1]
C = ROOT / "c"
FOLDERS = [C / name for name in ("src", "propagation", "core", "logs")]
DECLARATIONS = ROOT / "maplines_can" / "core" / "declarations.py"
#: The library in the package.
LIBRARY = f"core/maplines.{'dll' if os.name == 'nt' else 'so'}"
#: Structures have the size of the largest DBC that has C. There is one build, so names are plain.
#: Python checks what its callers give, and raises: no assertion ends the process.
MACROS = (
    "-DMAPLINES_MAX_PAGES=16",
    "-DMAPLINES_MAX_TRANSFER_IDS=256",
    "-DMAPLINES_MAX_COMPONENTS=64",
    "-DMAPLINES_NAME(name)=maplines_##name",
    "-DMAPLINES_ASSERT(condition)=((void)0)",
)
#: Options of compilers that take those of GCC. A fused multiplication would give other bits.
#: Without errno, a square root is one instruction.
OPTIONS = shlex.split(
    "-std=c99 -O3 -fPIC -shared -fvisibility=hidden -ffp-contract=off -fno-math-errno "
    "-fno-semantic-interposition -g0 -Wall -Wextra"
)
#: Those of Microsoft C, which leaves out no operation and fuses none with /fp:precise.
CL_OPTIONS = ["/nologo", "/LD", "/O2", "/fp:precise"]
#: Compilers that are looked for, besides that of CC.
COMPILERS = ("cc", "gcc", "clang", "cl")
#: What ziglang calls platforms and machines. Without a target it compiles for the CPU at hand.
PLATFORMS = {"linux": "linux-gnu.2.17", "darwin": "macos.11.0", "win32": "windows-gnu"}
MACHINES = {"x86_64": "x86_64", "amd64": "x86_64", "aarch64": "aarch64", "arm64": "aarch64"}


class BuildError(Exception):
    """There is no compiler, or it fails."""


class CoreHook(BuildHookInterface[Any]):
    """Adds the library to a wheel, or builds it in the checkout of an editable install."""

    def dependencies(self) -> list[str]:
        """Return what pip installs for the build: a compiler where there is none."""
        return ["ziglang>=0.13"] if not own_compiler() and target() else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the library into the checkout, or into a wheel of this platform."""
        place = ROOT / "maplines_can" / LIBRARY
        if version != "editable":
            self._folder = tempfile.mkdtemp()
            place = Path(self._folder) / place.name
        try:
            build(place)
        except BuildError as error:
            self.app.abort(f"maplines_can: {error}")
        if version != "editable":
            build_data["force_include"][str(place)] = f"maplines_can/{LIBRARY}"
            build_data["pure_python"] = False
            build_data["tag"] = wheel_tag()

    def finalize(self, *_: Any) -> None:
        """Remove the folder of the build."""
        shutil.rmtree(self._folder, ignore_errors=True)

    _folder = ""


def own_compiler() -> list[str]:
    """Return the command of the compiler of this machine; an empty one if there is none."""
    if "CC" in os.environ:
        return shlex.split(os.environ["CC"], posix=os.name != "nt")
    return next(([name] for name in COMPILERS if shutil.which(name)), [])


def target() -> str | None:
    """Return the target of ziglang for this Python; None if there is none."""
    system, machine = PLATFORMS.get(sys.platform), MACHINES.get(platform.machine().lower())
    if "musl" in str(sysconfig.get_config_var("SOABI")):
        system = "linux-musl"
    return f"{machine}-{system}" if system and machine else None


def compiler() -> list[str]:
    """Return the command of a compiler.

    Raises:
        BuildError: there is none.
    """
    if own := own_compiler():
        return own
    if (known := target()) and importlib.util.find_spec("ziglang"):
        # Its sanitizer is on unless told otherwise.
        options = ["-target", known, "-fno-sanitize=undefined"]
        return [sys.executable, "-m", "ziglang", "cc", *options]
    raise BuildError(
        f"there is no C compiler ({', '.join(COMPILERS)} or CC), and the package ziglang "
        f"{'is not installed' if known else f'has none for {sysconfig.get_platform()}'}; install "
        "one (on Debian: apt-get install gcc)"
    )


def build(path: Path) -> None:
    """Build the library, which appears in one step: other processes may load the old one now.

    Raises:
        BuildError: there is no compiler, or it fails.
    """
    src, *others = FOLDERS
    with tempfile.TemporaryDirectory() as folder:
        # One file of all sources of an ECU: compilers inline functions of one in another.
        joined, made = Path(folder) / "joined.c", Path(folder) / path.name
        # What maplines.h declares is exported, too, as core.h includes it.
        names = ["core.h", *(one.name for one in sorted(src.glob("*.c")))]
        joined.write_text("".join(f'#include "{name}"\n' for name in names))
        sources = [joined, *(one for place in others for one in sorted(place.glob("*.c")))]
        macros = [*MACROS, f"-DMAPLINES_DECLARATIONS={checksum()}"]
        include = [f"-I{place}" for place in (C / "include", *FOLDERS)]
        command, flags = compiler(), shlex.split(os.environ.get("CFLAGS", ""))
        is_microsoft = Path(command[0]).stem.lower() == "cl"
        command += CL_OPTIONS if is_microsoft else OPTIONS
        command += [*flags, *macros, *include, *map(str, sources)]
        command += [f"/Fe{made}", "/link"] if is_microsoft else ["-o", str(made)]
        command += shlex.split(os.environ.get("LDFLAGS", ""))
        command += [f"/EXPORT:{name}" for name in functions()] if is_microsoft else ["-lm"]
        try:
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        except OSError as error:
            raise BuildError(f"the compiler {command[0]!r} cannot be run: {error}") from error
        if done.returncode:
            raise BuildError(f"the compiler {command[0]!r} fails:\n{done.stdout}{done.stderr}")
        print(done.stderr, end="", file=sys.stderr)  # warnings
        copy = path.with_suffix(f".{os.getpid()}")
        shutil.copy(made, copy)
        copy.replace(path)


def functions() -> list[str]:
    """Return the names of the functions that the library exports."""
    return re.findall(r"\\x23(maplines_\w+)", DECLARATIONS.read_text())


def checksum() -> str:
    """Return the checksum of the declarations, by which a library of others is found."""
    return DECLARATIONS.read_text().split()[-1]


def wheel_tag() -> str:
    """Return the tag of a wheel of this platform, for any Python."""
    from packaging.tags import platform_tags

    return f"py3-none-{next(tag for tag in platform_tags() if 'many' not in tag)}"


if __name__ == "__main__":
    try:
        build(ROOT / "maplines_can" / LIBRARY)
    except BuildError as problem:
        sys.exit(f"build_core.py: {problem}")
