"""Lines with their bands of 1, 2 and 3 sigma as ``foxglove.SceneUpdate``, for 3D views.

The fields are those of https://docs.foxglove.dev/docs/sdk/schemas/scene-update, of which the
primitives that are not used here are empty arrays.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ...values.line import Slot
from ...wire.layout.record_signals import slot_title
from ..line_tables import Table
from ..plots.log_panels import COLOURS
from .line_points import has_sigma, is_shown, points_of

#: Frame of the points: that of the car, x forward, y to the left.
FRAME = "base_link"
NAME = "foxglove.SceneUpdate"
#: Points of a line: one each 8 m of 80 m.
POINTS = 11
#: Primitives of an entity that are not used.
_UNUSED = ("metadata", "arrows", "cubes", "spheres", "cylinders", "texts", "models")
#: Opacity of each band; that of 3 sigma is the lowest of three layers.
_OPACITY = 0.2

_SLOTS = [(slot_title(slot), COLOURS[slot]) for slot in Slot]
#: Triangles between two polylines whose points alternate.
_TRIANGLES = [k + corner for k in range(0, 2 * POINTS - 2, 2) for corner in (0, 1, 2, 1, 3, 2)]


def scene_updates(lines: Table, lifetime_ns: int) -> Iterator[bytes]:
    """Yield a message in JSON for each line: its entity, or the deletion of an older one.

    The ID of an entity is the name of the slot. A line that must not be used is deleted.

    Args:
        lines: the rows.
        lifetime_ns: time after which an entity disappears [ns].
    """
    x, y, sigma = points_of(lines, POINTS)
    offsets = np.array([0, -1, 1, -2, 2, -3, 3])
    # 1 mm is enough to draw.
    ys = np.round(y[:, None] + offsets[:, None] * sigma[:, None], 3).tolist()
    rows = zip(
        lines.columns["t_ns"].clip(0).tolist(), lines.columns["slot"].tolist(),
        is_shown(lines).tolist(), has_sigma(lines).tolist(), np.round(x, 3).tolist(), ys,
        strict=True,
    )  # fmt: skip
    for t_ns, slot, is_drawn, has_bands, along, across in rows:
        title, colour = _SLOTS[slot]
        update: dict[str, Any] = {"deletions": [], "entities": []}
        if is_drawn:
            bands = 3 * has_bands
            shape = _shape(along, across[: 1 + 2 * bands], colour)
            about = {"timestamp": _time(t_ns), "frame_id": FRAME, "id": title}
            about |= {"lifetime": _time(lifetime_ns), "frame_locked": True}
            update["entities"].append(about | dict.fromkeys(_UNUSED, ()) | shape)
        else:
            update["deletions"].append({"timestamp": _time(t_ns), "type": 0, "id": title})
        yield json.dumps(update, separators=(",", ":")).encode()


def _shape(x: Sequence[float], ys: Sequence[Sequence[float]], colour: str) -> dict[str, Any]:
    """Return the primitives of a line.

    Args:
        x: of its points [m].
        ys: of the mean, and of the lower and the upper end of each band [m].
        colour: such as "#0072B2".
    """
    mean, *ends = ys
    lines = [
        {
            "type": 0,
            "pose": _pose(0.0),
            "thickness": 2,
            "scale_invariant": True,
            "points": _points(x, mean),
            "color": _colour(colour, 1),
            "colors": (),
            "indices": (),
        }
    ]
    bands = [
        {
            "pose": _pose(-0.01 * number),  # below the line, so that it is seen from above
            "points": [
                end for both in zip(_points(x, low), _points(x, high), strict=True) for end in both
            ],
            "color": _colour(colour, _OPACITY),
            "colors": (),
            "indices": _TRIANGLES,
        }
        for number, (low, high) in enumerate(zip(ends[::2], ends[1::2], strict=True), 1)
    ]
    return {"lines": lines, "triangles": bands}


def _points(x: Sequence[float], y: Sequence[float]) -> list[dict[str, float]]:
    return [{"x": along, "y": across, "z": 0} for along, across in zip(x, y, strict=True)]


def _pose(z: float) -> dict[str, Any]:
    return {"position": {"x": 0, "y": 0, "z": z}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}


def _colour(text: str, opacity: float) -> dict[str, float]:
    red, green, blue = (round(one / 255, 3) for one in bytes.fromhex(text[1:]))
    return {"r": red, "g": green, "b": blue, "a": opacity}


def _time(t_ns: int) -> dict[str, int]:
    sec, nsec = divmod(t_ns, 10**9)
    return {"sec": sec, "nsec": nsec}


def schema() -> dict[str, Any]:
    """Return the JSON schema of the messages, with the fields that they use."""
    time = _object(sec="integer", nsec="integer")
    point = _object(x="number", y="number", z="number")
    pose = _object(
        position=point, orientation=_object(x="number", y="number", z="number", w="number")
    )
    colour = _object(r="number", g="number", b="number", a="number")
    shared: dict[str, Any] = {"pose": pose, "points": _array(point), "color": colour}
    shared |= {"colors": _array(colour), "indices": _array({"type": "integer"})}
    line = _object(type="integer", thickness="number", scale_invariant="boolean", **shared)
    entity = _object(
        timestamp=time, frame_id="string", id="string", lifetime=time, frame_locked="boolean",
        lines=_array(line), triangles=_array(_object(**shared)),
        **dict.fromkeys(_UNUSED, _array({"type": "object"})),
    )  # fmt: skip
    deletion = _object(timestamp=time, type="integer", id="string")
    return {"title": NAME} | _object(deletions=_array(deletion), entities=_array(entity))


def _object(**properties: Any) -> dict[str, Any]:
    """Return the schema of an object; a text is the type of a property."""
    types = {
        name: {"type": kind} if isinstance(kind, str) else kind for name, kind in properties.items()
    }
    return {"type": "object", "properties": types, "required": [*types]}


def _array(items: Any) -> dict[str, Any]:
    return {"type": "array", "items": items}
