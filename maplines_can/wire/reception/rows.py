"""Rows of received lines and scenes: the structures that the core fills, as dtypes."""

from __future__ import annotations

import numpy as np

from ...values.line import Slot

#: A line. ``frame`` is the place in the log of the frame that has completed it. ``counter`` is that
#: of its last record, and ``ahead`` by how much it is ahead of the record before; 0 after a
#: sequence break. ``state`` is the E2E state after it, of the slot or, if this is VALID and the
#: line is conditional on the pose error, of that; ``e2e_status`` is that of the last check.
LINE_ROW = np.dtype(
    [
        ("frame", "i8"),
        ("t_ns", "i8"),
        *((name, "f8") for name in ("x_min", "x_max", "age")),
        ("mean", "f8", 4),
        ("cov", "f8", (4, 4)),
        ("counter", "u4"),
        ("ahead", "u4"),
        *((name, "u1") for name in ("slot", "kind", "status", "components")),
        *((name, "u1") for name in ("state", "e2e_status")),
        ("two_senders", "?"),
        ("usable", "?"),
    ]
)
#: A component of the mixture of a line, by its place among the lines of the block.
COMPONENT_ROW = np.dtype(
    [("line", "i8"), ("weight", "f8"), ("mean", "f8", 4), ("cov", "f8", (4, 4))]
)
_N = len(Slot)
#: A scene of ``count`` lines: the first ones of ``slots``, ``x_min``, ``x_max``, ``mean``, and of
#: the rows and columns of ``cov``. ``frame`` is the place of the last frame that has changed it.
SCENE_ROW = np.dtype(
    [
        ("frame", "i8"),
        ("t_ns", "i8"),
        ("age", "f8"),
        ("correlation_time", "f8"),
        ("counter", "u4"),
        ("count", "u1"),
        ("state", "u1"),
        ("two_senders", "?"),
        ("usable", "?"),
        ("slots", "u1", _N),
        *((name, "f8", _N) for name in ("x_min", "x_max")),
        ("mean", "f8", (_N, 4)),
        ("cov", "f8", (4 * _N, 4 * _N)),
    ]
)
