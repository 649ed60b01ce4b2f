#!/usr/bin/env python3
"""Build the extension module maplines_can._native, and the core as a shared library beside it.

`pip install` runs this; it needs a C compiler and nothing else. Without one, the package is
installed without the extension module and computes in Python alone, and `maplines --version` says
so. The environment variable MAPLINES_NATIVE decides otherwise: 0 builds nothing, and with 1 a
missing compiler is an error. CFLAGS and LDFLAGS are added, such as those of sanitizers.

    python tools/build_native.py       build it again in the checkout, after changes of C
"""

from __future__ import annotations

import os
import re
import shutil
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parents[1]
C = ROOT / "c"
#: The core as a shared library, which has no part of Python in it.
LIBRARY = "_native_core.dll" if os.name == "nt" else "_native_core.so"
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
        paths: list[Path] = []
        try:
            if wanted != "0":
                self._folder = tempfile.mkdtemp()
                paths = build(Path(self._folder))
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
            put_into_checkout(paths)
            return
        for path in paths:
            build_data["force_include"][str(path)] = f"maplines_can/{path.name}"
        if paths:
            build_data["pure_python"] = False
            build_data["tag"] = wheel_tag()

    def finalize(self, *_: Any) -> None:
        """Remove the folder of the build."""
        shutil.rmtree(self._folder, ignore_errors=True)

    _folder = ""


def build(folder: Path) -> list[Path]:
    """Build both in the package of a folder; return their paths.

    Raises:
        Exception: there is no compiler, or it fails.
    """
    from setuptools import Distribution, Extension
    from setuptools.command.build_ext import build_ext

    macros = [(f"MAPLINES_MAX_{name}", str(limit)) for name, limit in LIMITS.items()]
    folders = [C / name for name in ("src", "propagation", "core", "python")]
    include = [str(path) for path in (C / "include", *folders)]
    src, propagation, arrays, binding = (sorted(place.glob("*.c")) for place in folders)
    libraries = [] if os.name == "nt" else ["m"]

    class Build(build_ext):  # type: ignore[misc]
        def build_extensions(self) -> None:
            options = OPTIONS if self.compiler.compiler_type != "msvc" else []
            objects = self.compiler.compile(
                [joined(src, folder), *map(str, propagation + arrays)],
                output_dir=self.build_temp,
                macros=macros,
                include_dirs=include,
                extra_postargs=options,
            )
            self.compiler.link_shared_object(
                objects, str(library), libraries=libraries, export_symbols=functions()
            )
            extension.extra_compile_args, extension.extra_objects = options, objects
            super().build_extensions()

    limited = not sysconfig.get_config_var("Py_GIL_DISABLED")
    own = [("Py_LIMITED_API", f"0x{OLDEST[0]:02x}{OLDEST[1]:02x}0000")] if limited else []
    extension = Extension(
        "maplines_can._native",
        list(map(str, binding)),
        include_dirs=include,
        define_macros=macros + own,
        libraries=libraries,
        py_limited_api=limited,
    )
    command = Build(Distribution({"name": "maplines_can", "ext_modules": [extension]}))
    command.force = True  # options may have changed
    library = folder / "maplines_can" / LIBRARY
    library.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as objects:
        command.build_lib, command.build_temp = str(folder), objects
        command.ensure_finalized()
        command.run()
    return [Path(command.get_ext_fullpath(extension.name)), library]


def functions() -> list[str]:
    """Return the names of the functions that the library exports."""
    return re.findall(r"^[a-z].*\b(maplines_\w+)\(", (C / "core" / "core.h").read_text(), re.M)


def joined(sources: list[Path], folder: Path) -> str:
    """Return a file that includes all sources: compilers inline functions of one in another."""
    path = folder / "core.c"
    path.write_text("".join(f'#include "{source.name}"\n' for source in sources))
    return str(path)


def put_into_checkout(paths: list[Path]) -> None:
    """Copy what was built into the package of the checkout; nothing removes earlier builds."""
    package = ROOT / "maplines_can"
    if not paths:
        for old in package.glob("_native*"):
            old.unlink()
    for path in paths:
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
