"""Design of records of whole scenes: the fields that tell most of a scene in one frame.

The frame has 64 bytes, or 51 of a record that is authenticated, and the bits of all lines are
alike. So bits are exchanged: one field has one less, another one of the same line or of the pose
error one more. The ranges of levels move, too, and steps of the pose error and of the mean double
or halve over more or less of a range. Of all changes that lower the loss, the best is taken, until
there is none.

The loss is what decoded standard deviations of y, width and centre are above the computed ones, in
units of the targets, see ``excess``; each map counts as much. It is measured: scenes of the maps,
and of random roads, go through the DBC and the codec. The decoded joint covariance is definite and
covers the computed one with any widths.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ...wire.layout.signals import PARAMETER_SIGNALS
from ..dbc.dbc_writer import DbcWriter, SceneSpec, SignalSpec
from ..dbc.pose_spec import CONDITIONAL, POSE
from ..dbc.scene_spec import WHOLE_SCENES

#: Least bits of a field.
MIN_BITS = 2
#: Share of its octaves by which an end of a range of levels moves.
END = 1 / 16
#: Least relative improvement; smaller ones are noise of the scenes.
MIN_GAIN = 2e-3
#: Fields, by name.
Fields = Mapping[str, SignalSpec]


def fields_of(writer: DbcWriter) -> dict[str, SignalSpec]:
    """Return the fields that are designed: of the pose error, and of a line."""
    scene = scene_of(writer)
    specs = (*scene.head, *scene.line, *scene.tails)
    return {spec.name: spec for spec in specs if _is_designed(spec.name)}


def _is_designed(name: str) -> bool:
    starts = ("Pivot", "Ratio", "Inflation", "Map", "Own", *PARAMETER_SIGNALS)
    return name.startswith(starts)


def writer_of(fields: Fields) -> DbcWriter:
    """Return the writer of the DBC with other fields."""
    scene = scene_of(WHOLE_SCENES)

    def changed(specs: tuple[SignalSpec, ...]) -> tuple[SignalSpec, ...]:
        designed = (fields.get(spec.name, spec) for spec in specs)
        return tuple(spec for spec in designed if spec.bits)

    parts = {name: changed(getattr(scene, name)) for name in ("head", "line", "tails")}
    return replace(WHOLE_SCENES, scene=replace(scene, **parts))


def scene_of(writer: DbcWriter) -> SceneSpec:
    """Return the messages of whole scenes of a DBC."""
    if writer.scene is None:
        raise ValueError("the DBC has no messages of whole scenes")
    return writer.scene


def todays() -> dict[str, SignalSpec]:
    """Return the fields with the widths of maplines-pose.dbc, which has no tilt."""
    pages = (*CONDITIONAL.pages[: -CONDITIONAL.optional_pages], *POSE.pages)
    known = {spec.name: spec for page in pages for spec in page}
    fields = fields_of(WHOLE_SCENES)
    return {name: known.get(name, replace(spec, bits=0)) for name, spec in fields.items()}
