"""The description of the messages of whole scenes: each signal, and why."""

from __future__ import annotations

from dataclasses import replace

from ...values.line import Kind, Slot
from ...wire.layout.pose_layout import SCENE, SCENE2
from ...wire.layout.scene_layout import NoLine
from ...wire.layout.signals import SLOT
from .covariance_spec import pivot_signal, ratio_signal
from .dbc_writer import DbcWriter, SceneSpec, SignalSpec
from .pose_spec import (
    AGE,
    CORRELATION_TIME,
    CRC,
    FIT_RANGE,
    INFLATION,
    KIND,
    MAP_LEVELS,
    MEAN,
    OWN,
    level_signal,
)

# The numbers of a signal stand on one line, its texts below.
# fmt: off

_HEAD = (
    replace(CRC, about=CRC.about.replace("the slot's E2EDataId", "the E2EDataId of the message")),
    SignalSpec(
        name="Counter", bits=8,
        about="Counts the records of the message (AUTOSAR E2E profile 5).",
        why="profile 5 asks for 8 bits; 256 records are 12.8 s at 20 Hz"),
    pivot_signal("Along", (), 9, 0.0254, -8, "4 mm to 31 m in steps of 1.8 %"),
    pivot_signal("Across", ("Along",), 9, 0.0254, -8, "4 mm to 31 m in steps of 1.8 %"),
    pivot_signal(
        "Heading", ("Along", "Across"), 9, 0.0235, -13, "1.2e-4 to 0.5 rad in steps of 1.6 %"),
    ratio_signal("Across", "Along", 8, 1 / 64, why="a correlation of 0.89"),
    ratio_signal("Heading", "Along", 8, 1 / 64, why="a correlation of 0.89"),
    ratio_signal("Heading", "Across", 9, 1 / 64, why="a correlation of 0.97: drift across a lane"),
    AGE, CORRELATION_TIME, MAP_LEVELS[0],
    replace(
        MAP_LEVELS[1],
        why="0.015 to 0.2 deg in steps of 9 %: no level of a line has the shape of a rotation"),
)
#: More bits of each signal of the mean than in a record of a line alone, and why.
_MEAN = (
    (1, "half a step is 2 mm; +-32 m holds four lanes to either side"),
    (1, "half a step is 2.4 mm at 80 m; +-28.6 deg"),
    (1, "half a step is 6 mm at 80 m, less YOff and Beta; +-0.25 1/m is a radius of 4 m, as the "
        "inner line of a corner has"),
    (0, "half a step is 4 cm at 80 m, for most of which the others make up; +-0.0625 1/m^2 turns "
        "into the tightest corner within 4 m"),
)
_LINE = (
    replace(
        KIND, bits=4, choices={one.value: one.name for one in (*Kind, *NoLine)},
        about="Kind of line on the road, or why there is no line: NONE, or the reason for which "
              "the line of this slot is left out; all other signals of the line then mean nothing, "
              "but for its slot if it is left out.",
        why="thirteen values"),
    *(replace(spec.finer(bits), why=why) for spec, (bits, why) in zip(MEAN, _MEAN, strict=True)),
    *FIT_RANGE,
    level_signal("OwnLateral", 5, 0.3, -8.4, "3.6 mm to 1.9 m in steps of 23 %"),
    SignalSpec(
        name="OwnTilt", bits=2,
        about="Tilt t of OwnLateral along the line: its standard deviation is |1 + t w| times that "
              "of OwnLateral, with w from -1 at XMin to 1 at XMax: t = 0, 1, -1, 6 for 0 to 3.",
        why="four values: the same all along, from 0 to twice as much, back, and mainly a turn"),
    level_signal("OwnPoints", 7, 0.07, -8.2, "3.6 mm to 1.6 m in steps of 5 %"),
    replace(
        OWN[2], factor=0.0271,
        why="1/32 to 3.8 half lengths, with a phase and a shape near any; levels of 1 mm to 1.1 m "
            "in steps of 2.8 %"),
)
_TAILS = (
    replace(INFLATION, factor=0.0062, why="steps of 0.4 % of the variance, up to 3 %"),
    SignalSpec(
        name="SceneCounter", bits=3,
        about="Low three bits of the counter of the Scene that is sent in this cycle.",
        why="tells apart the scenes of eight cycles"),
)
#: Messages of whole scenes.
SCENES = SceneSpec(
    head=_HEAD,
    line=_LINE,
    tails=_TAILS,
    slot=SignalSpec(
        name=SLOT, bits=3, choices={slot.value: slot.name for slot in Slot},
        about="Slot of the line, also of one that is left out.", why="eight slots"),
    fixed={
        SCENE2: (Slot.EDGE_LEFT, Slot.EDGE_RIGHT),
        SCENE: (Slot.EGO_LEFT, Slot.EGO_RIGHT),
    },
)
#: The writer of ``dbc/maplines-scene.dbc``.
WHOLE_SCENES = DbcWriter(
    covariance_code="Scene", slots=(), scene=SCENES, first_secured_can_id=0x37A, freshness_bytes=4)
# fmt: on
