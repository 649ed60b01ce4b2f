#!/usr/bin/env python3
"""Build the extension module maplines_can._native.

`pip install` runs this; it needs a C compiler and nothing else. Without one, the package is
installed without the extension module and computes in Python alone, and `maplines --version` says
so. The environment variable MAPLINES_NATIVE decides otherwise: 0 builds nothing, and with 1 a
missing compiler is an error. CFLAGS and LDFLAGS are added, such as those of sanitizers.

    python tools/build_native.py       build it again in the checkout, after changes of C
"""

from __future__ import annotations

import itertools
import os
import shutil
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parents[1]
C = ROOT / "c"
#: The limited API of this version of Python: one wheel serves all later ones, too.
OLDEST = (3, 11)
#: Structures have the size of the largest DBC that has C.
LIMITS = {"PAGES": 16, "TRANSFER_IDS": 256, "COMPONENTS": 64}
#: Options of compilers that take those of GCC. Without errno, a square root is one instruction.
OPTIONS = [
    "-std=c99",
    "-O3",
    "-fvisibility=hidden",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-g0",
    "-Wall",
    "-Wextra",
]


class NativeHook(BuildHookInterface[Any]):
    """Adds the extension module to a wheel, or builds it in the checkout of an editable install."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the module; without it, the wheel is one for any platform."""
        wanted = os.environ.get("MAPLINES_NATIVE", "")
        path = None
        try:
            if wanted != "0":
                self._folder = tempfile.mkdtemp()
                path = build(Path(self._folder))
        except Exception as error:
            compiler = os.environ.get("CC") or sysconfig.get_config_var("CC") or "of C"
            cause = (
                f"the compiler {compiler!r} is not there or fails, or the headers of Python are "
                f"missing ({type(error).__name__}); pip install --verbose has its messages"
            )
            if wanted == "1":
                raise RuntimeError(f"MAPLINES_NATIVE=1, but {cause}") from error
            self.app.display_warning(
                f"maplines_can is installed without its extension module, and computes in Python "
                f"alone: {cause}"
            )
        if version == "editable":
            put_into_checkout(path)
        elif path is not None:
            build_data["force_include"][str(path)] = f"maplines_can/{path.name}"
        if path is not None:
            build_data["pure_python"] = False
            build_data["tag"] = wheel_tag()

    def finalize(self, *_: Any) -> None:
        """Remove the folder of the build."""
        shutil.rmtree(self._folder, ignore_errors=True)

    _folder = ""


def build(folder: Path) -> Path:
    """Build the extension module in the package of a folder; return its path.

    Raises:
        Exception: there is no compiler, or it fails.
    """
    from setuptools import Distribution, Extension
    from setuptools.command.build_ext import build_ext

    class Build(build_ext):  # type: ignore[misc]
        def build_extensions(self) -> None:
            if self.compiler.compiler_type != "msvc":
                for extension in self.extensions:
                    extension.extra_compile_args = OPTIONS
            super().build_extensions()

    limited = not sysconfig.get_config_var("Py_GIL_DISABLED")
    macros = [(f"MAPLINES_MAX_{name}", str(limit)) for name, limit in LIMITS.items()]
    if limited:
        macros.append(("Py_LIMITED_API", f"0x{OLDEST[0]:02x}{OLDEST[1]:02x}0000"))
    folders = [C / name for name in ("src", "propagation", "python")]
    core, *others = ([str(path) for path in sorted(place.glob("*.c"))] for place in folders)
    extension = Extension(
        "maplines_can._native",
        [joined(core, folder), *itertools.chain(*others)],
        include_dirs=[str(path) for path in (C / "include", *folders)],
        define_macros=macros,
        libraries=[] if os.name == "nt" else ["m"],
        py_limited_api=limited,
    )
    command = Build(Distribution({"name": "maplines_can", "ext_modules": [extension]}))
    command.force = True  # options may have changed
    with tempfile.TemporaryDirectory() as objects:
        command.build_lib, command.build_temp = str(folder), objects
        command.ensure_finalized()
        command.run()
    return Path(command.get_ext_fullpath(extension.name))


def joined(sources: list[str], folder: Path) -> str:
    """Return a file that includes all sources: compilers inline functions of one in another."""
    path = folder / "core.c"
    path.write_text("".join(f'#include "{Path(source).name}"\n' for source in sources))
    return str(path)


def put_into_checkout(path: Path | None) -> None:
    """Copy a module into the package of the checkout; None removes those of earlier builds."""
    package = ROOT / "maplines_can"
    if path is None:
        for old in package.glob("_native*"):
            old.unlink()
        return
    copy = Path(tempfile.mkdtemp(dir=package, prefix="_native")) / path.name
    shutil.copy(path, copy)
    copy.replace(package / path.name)  # in one step: other processes may load it now
    copy.parent.rmdir()


def wheel_tag() -> str:
    """Return the tag of a wheel with the extension module."""
    from packaging.tags import sys_tags

    tag = next(tag for tag in sys_tags() if "many" not in tag.platform)
    if sysconfig.get_config_var("Py_GIL_DISABLED"):
        return str(tag)
    return f"cp{OLDEST[0]}{OLDEST[1]}-abi3-{tag.platform}"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        put_into_checkout(build(Path(place)))
