"""The path of this process: the core in C, or Python alone.

The package computes the same with both: the wire bit for bit, lines of the map within 1e-12 of
their standard deviations. In C it takes a fraction of the time. The environment variable
``MAPLINES_NATIVE`` forces a path: 0 is Python alone, and 1 is C, which is an error without the
library of the core.

>>> is_active == (lib is not None)
True
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

from .core import CoreError, load
from .values.errors import NativeError

#: Environment variable that forces a path.
VARIABLE = "MAPLINES_NATIVE"


def _choose() -> tuple[Any, str]:
    """Return the functions of the library, or None, and why."""
    wanted = os.environ.get(VARIABLE, "")
    if wanted == "0":
        return None, f"{VARIABLE}=0"
    if wanted not in ("", "1"):
        raise NativeError(
            f"{VARIABLE} must be 0 for Python alone, 1 for C, or not set, got {wanted!r}"
        )
    try:
        return load(import_module(__package__).__version__)
    except CoreError as error:
        if wanted == "1":
            raise NativeError(f"{VARIABLE}=1, but there is no C path: {error}") from error
        return None, str(error)


#: The functions of the library; None for Python alone.
lib: Any
#: Why this path runs.
reason: str
lib, reason = _choose()
#: Whether the core computes.
is_active = lib is not None


def description() -> str:
    """Return the path and the reason, as ``maplines --version`` prints them."""
    return f"{'C' if is_active else 'Python alone'} ({reason})"
