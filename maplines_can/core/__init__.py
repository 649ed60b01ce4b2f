"""The core in C as a shared library: ``lib`` has its functions, and ``ffi`` their types.

``declarations.py`` is what cffi makes of ``c/core/core.h``. Nothing at run time compares the two
but what is done here, once: version, checksum of the declarations, and sizes of structures.
Arguments of functions are as their callers have checked them. A call lets other threads run: an
object with a state has a ``Lock``, which it holds around its calls.

It may import ``values.errors`` only.
"""

from __future__ import annotations

import os
from pathlib import Path
from threading import Lock
from typing import Any

from .. import __version__
from ..values.errors import CoreError
from .declarations import CHECKSUM, ffi

__all__ = ["PATH", "Lock", "compiler", "ffi", "lib"]

PATH = Path(__file__).with_name(f"maplines.{'dll' if os.name == 'nt' else 'so'}")
#: Structures that are made here, in the order of ``maplines_core_size``.
_STRUCTURES = ("dbc", "receiver", "settings", "block", "rows", "log", "prepared", "given_scene")
_CURE = "install the package again, which builds it"


def _load() -> tuple[Any, str]:
    """Return the functions of the library, and what built it."""
    if not PATH.exists():
        raise CoreError(f"the library of the core, {PATH.name}, is missing; {_CURE}")
    try:
        lib = ffi.dlopen(str(PATH))
        found = ffi.string(lib.maplines_core_version()).decode(), lib.maplines_core_declarations()
        sizes = [lib.maplines_core_size(i) for i in range(len(_STRUCTURES))]
        compiler = ffi.string(lib.maplines_core_compiler()).decode()
    except (OSError, ffi.error) as error:
        raise CoreError(f"the library of the core cannot be loaded: {error}; {_CURE}") from error
    expected = [ffi.sizeof(f"maplines_{name}_t") for name in _STRUCTURES]
    if (found, sizes) != ((__version__, CHECKSUM), expected):
        raise CoreError(f"the library of the core is another build, {found[0]}; {_CURE}")
    return lib, compiler


#: The functions of the library.
lib: Any
#: The compiler that built it.
compiler: str
lib, compiler = _load()
