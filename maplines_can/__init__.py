"""Lines of a digital map on a CAN bus, with their uncertainty.

>>> import numpy as np, maplines_can as ml
>>> points = [[x, 1.75 + x**2 / 4000] for x in range(-30, 100, 2)]
>>> road = ml.Polyline(points, ml.Kind.DASHED)
>>> ego = ml.Gaussian([0, 0, 0], np.diag([0.3, 0.1, 0.01]) ** 2)
>>> (line,) = ml.map_lines({ml.Slot.EGO_LEFT: road}, ego)
>>> line.gaussian.mean.round(3)[0]  # Gaussian over (y_off, beta, c0, c1)
np.float64(1.75)
>>> frames = ml.Codec.from_dbc().encoder().encode(line)  # 4 frames of classic CAN
>>> decoder = ml.Codec.from_dbc().decoder()
>>> *_, (received,) = [decoder.feed(frame.can_id, frame.data, t_ns=0) for frame in frames]
>>> received.slot.name, bool(abs(received.y(80.0) - line.y(80.0)) < 0.005)
('EGO_LEFT', True)

The core: a pose and a line of the map become a Gaussian (``map_lines``), frames (``Codec``), and a
Gaussian again. ``bus`` sends and receives the frames. All else uses the core: ``maps``,
``localisation``, ``simulation``, ``consumers`` and ``testing`` have names of their own.

A name is imported from its module when it is first used, so that a program loads only what it
needs. ``__init__.pyi`` lists the names.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

__version__ = "0.1.0"


def attach_stub(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package, from its ``__init__.pyi``.

    So the stub is the only list of names, for type checkers and for this function, which imports a
    name when it is first used (PEP 562). It does what lazy_loader does, without the dependency.
    Subpackages, ``from . import maps as maps``, are attributes but not in ``__all__``.
    """
    module = sys.modules[package]
    stub = ast.parse(module.__loader__.get_data(f"{module.__path__[0]}/__init__.pyi"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    packages = {alias.name for node in imports if not node.module for alias in node.names}
    source = {
        alias.name: "." * node.level + (node.module or alias.name)
        for node in imports
        for alias in node.names
    }
    names = vars(module)

    def get(name: str) -> Any:
        if name not in source:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = import_module(source[name], package)
        names[name] = found if name in packages else getattr(found, name)
        return names[name]  # found without this function the next time

    return get, lambda: sorted({*names, *source}), sorted(source.keys() - packages)


__getattr__, __dir__, __all__ = attach_stub(__name__)
