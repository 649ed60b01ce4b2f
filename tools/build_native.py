#!/usr/bin/env python3
"""Build the extension module maplines_can._native.

`pip install` runs this; it needs a C compiler and nothing else. Without one, the package is
installed without the extension module and computes in Python alone, and `maplines --version` says
so. The environment variable MAPLINES_NATIVE decides otherwise: 0 builds nothing, and with 1 a
missing compiler is an error. CFLAGS and LDFLAGS are added, such as those of sanitizers.

    python tools/build_native.py       build it again in the checkout, after changes of C
"""

from __future__ import annotations

import os
import shutil
import sys
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
#: Options of compilers that take those of GCC.
OPTIONS = ["-std=c99", "-O3", "-fvisibility=hidden", "-ffp-contract=off", "-g0", "-Wall", "-Wextra"]


class NativeHook(BuildHookInterface[Any]):
    """Adds the extension module to a wheel, or builds it in the checkout of an editable install."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the module; without it, the wheel is one for any platform."""
        wanted = os.environ.get("MAPLINES_NATIVE", "")
        if wanted == "0":
            remove()
            return
        try:
            path = build(ROOT if version == "editable" else self._folder())
        except Exception as error:
            if wanted == "1":
                raise
            remove()
            self.app.display_warning(
                f"maplines_can is installed without its extension module, and computes in Python "
                f"alone: {error}"
            )
            return
        build_data["pure_python"] = False
        build_data["tag"] = wheel_tag()
        if version != "editable":
            build_data["force_include"][str(path)] = f"maplines_can/{path.name}"

    def finalize(self, *_: Any) -> None:
        """Remove the folder of the build."""
        shutil.rmtree(self._built, ignore_errors=True)

    _built = ""

    def _folder(self) -> Path:
        self._built = tempfile.mkdtemp()
        return Path(self._built)


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
    extension = Extension(
        "maplines_can._native",
        [str(path) for sources in folders for path in sorted(sources.glob("*.c"))],
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


def remove() -> None:
    """Remove the module of an earlier build from the checkout."""
    for path in (ROOT / "maplines_can").glob("_native*"):
        path.unlink()


def wheel_tag() -> str:
    """Return the tag of a wheel with the extension module."""
    from packaging.tags import sys_tags

    tag = next(tag for tag in sys_tags() if "many" not in tag.platform)
    if sysconfig.get_config_var("Py_GIL_DISABLED"):
        return str(tag)
    return f"cp{OLDEST[0]}{OLDEST[1]}-abi3-{tag.platform}"


if __name__ == "__main__":
    print(build(ROOT))
    sys.exit()
