"""Lines with their bands of 1, 2 and 3 sigma as ``foxglove.SceneUpdate``, for 3D views.

The fields are those of https://docs.foxglove.dev/docs/sdk/schemas/scene-update, of which the
primitives that are not used here are empty arrays.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from itertools import chain
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
    ys = np.round(y[:, None] + offsets[:, None] * sigma[:, None], 3)
    is_drawn = is_shown(lines) & np.isfinite(ys).all(axis=(1, 2))
    texts = [[_texts(slot, bands, lifetime_ns) for bands in (0, 3)] for slot in Slot]
    rows = zip(
        lines.columns["t_ns"].clip(0).tolist(), lines.columns["slot"].tolist(),
        is_drawn.tolist(), has_sigma(lines).tolist(), np.round(x, 3).tolist(), ys.tolist(),
        strict=True,
    )  # fmt: skip
    for t_ns, slot, drawn, has_bands, along, across in rows:
        entity, deletion = texts[slot][has_bands]
        time = json.dumps(_time(t_ns))
        if not drawn:
            yield (deletion % time).encode()
            continue
        heads = [f'{{"x":{x},"y":' for x in along]
        mean, *ends = (
            [f'{head}{y},"z":0}}' for head, y in zip(heads, ys, strict=True)] for ys in across
        )
        bands = zip(ends[::2], ends[1::2], strict=True) if has_bands else ()
        points = [mean, *([*chain(*zip(*band, strict=True))] for band in bands)]
        yield (entity % (time, *map(",".join, points))).encode()


@cache
def _texts(slot: Slot, bands: int, lifetime_ns: int) -> tuple[str, str]:
    """Return the messages with the entity of a slot, and with its deletion.

    They have %s for the time, and for the points of the mean and of each band: a message in full
    from objects takes four times as long.
    """
    colour = COLOURS[slot]
    drawn: dict[str, Any] = {"points": ["%s"], "colors": (), "indices": ()}
    mean = {"type": 0, "pose": _pose(0.0), "thickness": 2, "scale_invariant": True}
    below = [  # the mean, so that it is seen from above
        {"pose": _pose(-0.01 * number), "color": _colour(colour, _OPACITY)}
        | drawn
        | {"indices": _TRIANGLES}
        for number in range(1, bands + 1)
    ]
    about = {"timestamp": "%s", "id": slot_title(slot)}
    entity = about | {"frame_id": FRAME, "lifetime": _time(lifetime_ns), "frame_locked": True}
    entity |= dict.fromkeys(_UNUSED, ())
    entity |= {"lines": [mean | {"color": _colour(colour, 1)} | drawn], "triangles": below}
    deletion = about | {"type": 0}
    updates = ({"deletions": [], "entities": [entity]}, {"deletions": [deletion], "entities": []})
    first, second = (json.dumps(one, separators=(",", ":")) for one in updates)
    return first.replace('"%s"', "%s"), second.replace('"%s"', "%s")


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
