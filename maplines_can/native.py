"""The path of this process: the extension module in C, or Python alone.

The package computes the same with both: the wire bit for bit, lines of the map within 1e-12 of
their standard deviations. In C it takes a fraction of the time. The environment variable
``MAPLINES_NATIVE`` forces a path: 0 is Python alone, and 1 is C, which is an error without the
extension module.

>>> is_active == (core is not None)
True
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

from .core import load
from .values.errors import NativeError

#: Environment variable that forces a path.
VARIABLE = "MAPLINES_NATIVE"


def _choose() -> tuple[Any, Any, str]:
    """Return the extension module and the shared library, or None, and why."""
    wanted = os.environ.get(VARIABLE, "")
    if wanted == "0":
        return None, None, f"{VARIABLE}=0"
    if wanted not in ("", "1"):
        raise NativeError(
            f"{VARIABLE} must be 0 for Python alone, 1 for C, or not set, got {wanted!r}"
        )
    version = import_module(__package__).__version__
    try:
        found = import_module("._native", __package__)
        functions = load(version)
    except ImportError as error:
        why = f"the extension module cannot be loaded: {error}"
        if isinstance(error, ModuleNotFoundError) and error.name == f"{__package__}._native":
            why = "no extension module; an install with a C compiler builds it"
    else:
        if found.version == version:
            return found, functions, f"built with {found.compiler}"
        why = f"the extension module is that of version {found.version}; install the package again"
    if wanted == "1":
        raise NativeError(f"{VARIABLE}=1, but there is no C path: {why}")
    return None, None, why


#: The extension module, and the functions of the shared library; None for Python alone.
core: Any
lib: Any
#: Why this path runs.
reason: str
core, lib, reason = _choose()
#: Whether the extension module runs.
is_active = core is not None


def description() -> str:
    """Return the path and the reason, as ``maplines --version`` prints them."""
    return f"{'C' if is_active else 'Python alone'} ({reason})"
