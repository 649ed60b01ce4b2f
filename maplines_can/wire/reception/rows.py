"""Rows of the core: received lines and scenes as dtypes, and the lines and scenes of them.

What is decoded is finite, and its covariances are positive definite for any bits. An object has the
attributes that its constructor sets, in this order, so that it is pickled alike. Its arrays are
read-only: they are over bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from struct import Struct
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...core import ffi
from ...core.memory import dtype_of
from ...values.gaussian import Gaussian
from ...values.line import LEFT_OUT, Kind, MapLine, Slot, Status
from ...values.mixture import GaussianMixture
from ...values.scene import MapError, PoseError, Scene
from .views import ReceivedScene

T = TypeVar("T")

#: A received line, a component of a mixture, and a scene; ``c/core/core.h`` says what they have.
LINE_ROW = dtype_of("maplines_line_row_t", cov=(4, 4))
COMPONENT_ROW = dtype_of("maplines_component_row_t", cov=(4, 4))
SCENE_ROW = dtype_of("maplines_scene_row_t")
LINE_BYTES, COMPONENT_BYTES = LINE_ROW.itemsize, COMPONENT_ROW.itemsize
_SLOTS, _KINDS, _STATUSES = tuple(Slot), tuple(Kind), tuple(Status)
#: Members of a row that are no arrays, from its time on: see `LINE_ROW`.
_read_line = Struct("=q3d160x8x4B").unpack_from
_AFTER_FRAME = 8
_LINE_MEAN, _COMPONENT_MEAN, _MEAN_BYTES = 40, 16, 32
_FLOAT, _ndarray = np.dtype(float), np.ndarray
_new, _set = object.__new__, object.__setattr__


def line_of(row: bytes, begin: int, components: Callable[[], bytes] = bytes) -> MapLine:
    """Return the line of a row.

    Args:
        row: bytes of a `LINE_ROW`.
        begin: of the row in these bytes.
        components: returns the rows of the components of a mixture, as `COMPONENT_ROW`.
    """
    t_ns, x_min, x_max, age, slot, kind, status, count = _read_line(row, begin + _AFTER_FRAME)
    line = _new(MapLine)
    _set(
        line,
        "__dict__",
        {
            "slot": _SLOTS[slot],
            "gaussian": _gaussian(row, begin + _LINE_MEAN),
            "kind": _KINDS[kind],
            "x_min": x_min,
            "x_max": x_max,
            "age": age,
            "status": _STATUSES[status],
            "t_ns": t_ns,
            "mixture": None if count <= 1 else _mixture(components()),
        },
    )
    return line


def scene_of(seen: Any, lines: tuple[MapLine, ...]) -> ReceivedScene:
    """Return a scene.

    Args:
        seen: a ``maplines_seen_scene_t``.
        lines: of the scene.
    """
    n, known = len(lines), seen.scene
    pose_error = {"cov": _doubles(seen.pose_cov, 3, 3), "correlation_time": known.correlation_time}
    scene = Scene.trusted(
        lines,
        _doubles(seen.cov, 4 * n, 4 * n),
        _made(PoseError, pose_error),
        _doubles(known.fit_range, n, 2),
        MapError(0.0, known.offset_sigma, known.heading_sigma),
        {
            slot: reason
            for slot, i in zip(_SLOTS, known.left_out, strict=True)
            if (reason := LEFT_OUT[i])
        },
        _doubles(known.quartic, n),
        _doubles(seen.specific, n, 4, 4) if n else None,
    )
    return ReceivedScene(scene, known.counter, known.t_ns, known.age)


def _gaussian(row: bytes, begin: int) -> Gaussian:
    """Return the Gaussian of a mean and a covariance that follow each other in a row."""
    gaussian = _new(Gaussian)
    mean = _ndarray(4, _FLOAT, row, begin)
    cov = _ndarray((4, 4), _FLOAT, row, begin + _MEAN_BYTES)
    _set(gaussian, "__dict__", {"mean": mean, "cov": cov})
    return gaussian


def _mixture(rows: bytes) -> GaussianMixture:
    weights = np.frombuffer(rows, COMPONENT_ROW)["weight"].copy()
    weights.flags.writeable = False
    begins = range(_COMPONENT_MEAN, len(rows), COMPONENT_BYTES)
    components = tuple(_gaussian(rows, begin) for begin in begins)
    return _made(GaussianMixture, {"weights": weights, "components": components})


def _made(kind: type[T], attributes: dict[str, Any]) -> T:
    made = _new(kind)
    _set(made, "__dict__", attributes)
    return made


def _doubles(values: Any, *shape: int) -> NDArray[np.float64]:
    """Return an array of the first values of an array of C."""
    size = _FLOAT.itemsize * math.prod(shape)
    return _ndarray(shape, _FLOAT, ffi.buffer(values, size)[:])
