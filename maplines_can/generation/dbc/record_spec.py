"""The records and the Pose message, from which the DBCs are written: each signal, and why."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from ...values.line import Kind, Slot, Status
from ...wire.layout.pose_layout import SCENE, SCENE2
from ...wire.layout.record_signals import SLOT, slot_title
from ...wire.layout.scene_layout import NoLine
from .cholesky_signals import CHOLESKY, pivot_signal, ratio_signal
from .dbc_writer import DbcWriter, PoseSpec, SceneSpec, SignalSpec

# The numbers of a signal stand on one line, its texts below.
# fmt: off

# ---- signals of the Pose message and of lines -------------------------------------------

CRC = SignalSpec(
    name="Crc", bits=16,
    about="CRC-16/CCITT-FALSE over all other bytes of the record, then the slot's E2EDataId, "
          "low byte first (AUTOSAR E2E profile 5).",
    why="profile 5 asks for 16 bits, and for this place at the head of the record")
KIND = SignalSpec(
    name="Kind", bits=3, choices={kind.value: kind.name for kind in Kind},
    about="Kind of line on the road.", why="eight values")
AGE = SignalSpec(
    name="Age", bits=5, factor=8, unit="ms", choices={31: "TOO_OLD"},
    about="Time from the pose to the transmission, rounded up. The greatest raw value means "
          "too old, or unknown: the sender no longer vouches for the line; do not use it.",
    why="a step is 24 cm of travel at 30 m/s, along the line where it matters least")

# ---- the Pose message -----------------------------------------------------------------

_CRC = replace(CRC, about=CRC.about.replace("the slot's E2EDataId", "the E2EDataId of Pose"))
_COUNTER = SignalSpec(
    name="Counter", bits=8,
    about="Counts the records of the pose error (AUTOSAR E2E profile 5). Its low two bits are the "
          "transfer number, which the other pages repeat.",
    why="profile 5 asks for 8 bits; 256 records are 12.8 s at 20 Hz")
_PIVOTS = (
    pivot_signal("Along", (), 9, 0.04, -12, "from 2^-12 m to 347 m in steps of 2.8 %"),
    pivot_signal("Across", ("Along",), 9, 0.04, -12, "from 2^-12 m to 347 m in steps of 2.8 %"),
    pivot_signal(
        "Heading", ("Along", "Across"), 9, 0.034, -18,
        "from 2^-18 rad to 0.65 rad in steps of 2.4 %"),
)
CORRELATION_TIME = SignalSpec(
    name="CorrelationTime", bits=4, factor=0.5, offset=-2, unit="octave", choices={0: "UNKNOWN"},
    about="log2 of the time [s] after which the pose error has lost its correlation to 1/e, "
          "rounded up. The raw value 0 means unknown, or longer than the greatest value: take the "
          "errors of all cycles as the same.",
    why="0.35 to 45 s in steps of 41 %; a smoothed pose keeps its error for seconds")
_RATIOS = (
    ratio_signal("Across", "Along", 7, 1 / 32, why="a correlation of 0.89"),
    ratio_signal("Heading", "Along", 7, 1 / 32, why="a correlation of 0.89"),
    ratio_signal("Heading", "Across", 8, 1 / 32, why="a correlation of 0.97: drift across a lane"),
)
INFLATION = SignalSpec(
    name="Inflation", bits=3, factor=0.0124, unit="octave",
    about="log2 of the factor on the whole covariance that makes up for rounding: the decoded "
          "covariance is 2^Inflation L L^T.",
    why="steps of 0.9 % of the variance, up to 6.2 %, as in a record with a covariance")
MAP_LEVELS = (
    SignalSpec(
        name="MapOffset", bits=6, factor=0.125, offset=-8, unit="octave", choices={0: "NONE"},
        about="log2 of the standard deviation [m] of the offset of each line on the map, in any "
              "direction, independent from line to line. The raw value 0 means none.",
        why="4 mm to 0.9 m in steps of 9 %: no level of a line has the shape of a shift along it"),
    SignalSpec(
        name="MapHeading", bits=5, factor=0.125, offset=-12, unit="octave", choices={0: "NONE"},
        about="log2 of the standard deviation [rad] of the heading of each line on the map, "
              "independent from line to line. The raw value 0 means none.",
        why="0.015 to 0.2 deg in steps of 9 %: no level of a line has the shape of a rotation, and "
            "with coarser steps most lines would need all entries"),
)


def _counter_of(slot: Slot) -> SignalSpec:
    return SignalSpec(
        name=f"{slot_title(slot)}Counter", bits=3,
        about=f"Low three bits of the counter of the {slot_title(slot)} record that belongs to "
              "this pose. If none does: those of the next counter plus 4, which no record in the "
              "last or next cycles has.",
        why="tells apart the records of eight cycles; receivers look three cycles back and ahead")


def level_signal(name: str, bits: int, factor: float, offset: float, why: str) -> SignalSpec:
    """Return the signal of a level of what a line has of its own: OwnLateral or OwnPoints.

    Args:
        name: of the signal.
        bits: width.
        factor: step [octave].
        offset: low end of the range [octave]; the raw value 0 means none.
        why: reason for range and steps.
    """
    return SignalSpec(
        name=name, bits=bits, factor=factor, offset=offset, unit="octave", choices={0: "NONE"},
        about=f"log2 of the standard deviation [m] of {_LEVELS[name]} The raw value 0 means none.",
        why=why)


_LEVELS = {
    "OwnLateral":
        "the lateral position that the line has of its own: it does not come from the pose error.",
    "OwnPoints": "the points of the line, each by itself, in any direction.",
}


#: The line-specific covariance of a line, and how it differs from its cubic.
OWN = (
    level_signal("OwnLateral", 6, 0.12, -9.5, "1.4 mm to 25 cm in steps of 9 %"),
    level_signal(
        "OwnPoints", 5, 0.24, -9.5,
        "1.4 mm to 25 cm in steps of 18 %; with OwnShape they are finer"),
    SignalSpec(
        name="OwnShape", bits=8, factor=0.025, offset=-5, unit="octave",
        about="With OwnPoints: log2 of the distance of these points along the line, in halves of "
              "its length over the fit range. By the fraction of the raw value times the golden "
              "ratio, 1.618..., the first point is ahead of the range's start, in such distances. "
              "By its remainder modulo 6, the shape of the line is more uncertain. Without "
              "OwnPoints, the raw value / 25 - 10 is log2 of the level [m] of an uncertain shape "
              "alone; 0 means none.",
        why="1/32 to 2.6 half lengths, with a phase and a shape near any; levels of 1 mm to 1.1 m "
            "in steps of 2.8 %"),
    SignalSpec(
        name="Quartic", bits=3, factor=2**-5, unit="m", signed=True,
        about="Coefficient of the Chebyshev polynomial T_4 over the fit range that the cubic "
              "leaves of the line. It serves to see the line from another pose.",
        why="a cubic leaves at most 10 cm of its line"),
)
#: OwnShape of the Pose message: complete records cannot send all entries of what a line has of
#: its own, so points that are far apart need finer steps.
_SHAPE = replace(
    OWN[2], factor=2**-7, offset=2**-5, unit="1",
    about=OWN[2].about.replace("log2 of the distance", "distance"),
    why="1/32 to 2 half lengths; finer for points that are far apart, since the places of a few "
        "points matter most")
#: How far the fit range exceeds the stated range, which is the valid range.
_FIT = (
    SignalSpec(
        name="FitBehind", bits=3, unit="m",
        about="Distance by which the range to which the cubic was fitted begins before XMin.",
        why="XMin is rounded to 4 m, and leaves room for the error of the pose"),
    SignalSpec(
        name="FitAhead", bits=4, unit="m",
        about="Distance by which the range to which the cubic was fitted ends beyond XMax.",
        why="XMax is rounded to 4 m, and leaves room for the error of the pose"),
)
_POSE_PAGES = (
    (_CRC, _COUNTER, *_PIVOTS, AGE, MAP_LEVELS[1]),
    (*_RATIOS, INFLATION, MAP_LEVELS[0], CORRELATION_TIME, *map(_counter_of, Slot)),
)


def _own_page(slots: Iterable[Slot]) -> tuple[SignalSpec, ...]:
    """Return what slots have of their own, whose records have no room for it."""
    return tuple(
        replace(spec, name=slot_title(slot) + spec.name)
        for slot in slots
        for spec in (*OWN[:2], _SHAPE, OWN[3], *_FIT)
    )


#: Message of the pose error beside records that are conditional on it.
POSE = PoseSpec(_POSE_PAGES)
#: The same beside complete records; it has what the lines have of their own, too.
POSE_WITH_LEVELS = PoseSpec(
    (*_POSE_PAGES, *(_own_page(list(Slot)[i : i + 2]) for i in range(0, len(Slot), 2)))
)

# ---- records that are conditional on the pose -------------------------------------------

_LINE_COUNTER = SignalSpec(
    name="Counter", bits=8,
    about="Counts the records of the slot (AUTOSAR E2E profile 5). Its low two bits are the "
          "transfer number, its low three bits those that the Pose message states.",
    why="profile 5 asks for 8 bits; 256 lines are 12.8 s at 20 Hz")
MEAN = (
    SignalSpec(
        name="YOff", bits=13, factor=2**-7, unit="m", signed=True,
        about="Lateral offset of the line at x = 0, positive to the left.",
        why="half a step is 4 mm; +-32 m holds four lanes to either side"),
    SignalSpec(
        name="Beta", bits=13, factor=2**-13, unit="rad", signed=True,
        about="Heading of the line relative to the car, positive to the left; tan(Beta) is the "
              "slope.",
        why="half a step is 5 mm at 80 m; +-28.6 deg"),
    SignalSpec(
        name="C0", bits=16, factor=2**-17, unit="1/m", signed=True,
        about="Curvature at x = 0: the second derivative of y(x), positive to the left.",
        why="half a step is 1.2 cm at 80 m, less YOff and Beta; +-0.25 1/m is a radius of 4 m, as "
            "the inner line of a corner has"),
    SignalSpec(
        name="C1", bits=17, factor=2**-20, unit="1/m^2", signed=True,
        about="Curvature rate: the third derivative of y(x).",
        why="half a step is 4 cm at 80 m, for most of which the others make up; +-0.0625 1/m^2 "
            "turns into the tightest corner within 4 m"),
)
_HAS_COVARIANCE = SignalSpec(
    name="HasCovariance", bits=1,
    about="1 if the record has the pages with the covariance of what the line has of its own, and "
          "with finer steps of its mean. 0 if it ends before them, and OwnLateral, OwnPoints and "
          "OwnShape hold the covariance; the checksum then covers the pages before.",
    why="two values")
FIT_RANGE = (
    SignalSpec(
        name="XMin", bits=6, offset=-32, unit="m",
        about="Start of the range to which the cubic was fitted, exact. It is wider than the range "
              "where the line is valid, which follows from the pose error.",
        why="-32 to 31 m; the pose error acts on the line over this range, to 1 m"),
    SignalSpec(
        name="XMax", bits=7, unit="m",
        about="End of the range to which the cubic was fitted, exact.",
        why="0 to 127 m; the pose error acts on the line over this range, to 1 m"),
)


def _fine(spec: SignalSpec, bits: int) -> SignalSpec:
    return SignalSpec(
        name=f"{spec.name}Fine", bits=bits, factor=spec.factor / 2**bits, unit=spec.unit,
        signed=True,
        about=f"What to add to {spec.name} if HasCovariance is 1.",
        why=f"1/{2**bits} of a step of {spec.name}: the errors of all means are covered jointly, "
            "and a line with little of its own would become much too uncertain")


_FINE = tuple(map(_fine, MEAN, (3, 3, 3, 4)))
#: The writer of ``dbc/maplines-pose.dbc``.
CONDITIONAL = DbcWriter(
    pages=(
        (CRC, _LINE_COUNTER, *MEAN[:2], KIND, _HAS_COVARIANCE, OWN[2]),
        (*MEAN[2:], *FIT_RANGE, *OWN[:2], OWN[3]),
        (*CHOLESKY[:5], *_FINE),
        CHOLESKY[5:],
    ),
    first_can_id=0x360,
    first_fd_can_id=0x368,
    first_secured_can_id=0x370,
    first_data_id=0x4D60,
    first_secured_data_id=0x4D70,
    covariance_code="PoseConditional",
    transfer_id_bits=2,
    optional_pages=2,
    pose=POSE,
)
# fmt: on


# fmt: off
_PROTECTION = (
    CRC,
    SignalSpec(
        name="Counter", bits=8,
        about="Counts the records of the slot (AUTOSAR E2E profile 5). Its low four bits are the "
              "transfer number, which the other pages repeat.",
        why="profile 5 asks for 8 bits; 256 lines are 12.8 s at 20 Hz"),
)
_MEAN = (
    SignalSpec(
        name="YOff", bits=16, factor=2**-10, unit="m", signed=True,
        about="Lateral offset of the line at x = 0, positive to the left.",
        why="half a step is 0.5 mm; +-32 m holds four lanes to either side"),
    SignalSpec(
        name="Beta", bits=16, factor=2**-16, unit="rad", signed=True,
        about="Heading of the line relative to the car, positive to the left; tan(Beta) is the "
              "slope.",
        why="half a step is 0.6 mm at 80 m; +-28.6 deg"),
    SignalSpec(
        name="C0", bits=19, factor=2**-21, unit="1/m", signed=True,
        about="Curvature at x = 0: the second derivative of y(x), positive to the left.",
        why="half a step is 0.8 mm at 80 m; +-0.125 1/m is a radius of 8 m"),
    SignalSpec(
        name="C1", bits=26, factor=2**-30, unit="1/m^2", signed=True,
        about="Curvature rate: the third derivative of y(x).",
        why="a step is an eighth of the sigma of c1 given beta with a good pose, since coarser "
            "steps blur their correlation; a turn of radius 15 m needs 0.02 of the 0.031"),
)
_STATUS = SignalSpec(
    name="Status", bits=3, choices={status.value: status.name for status in Status},
    about="Validity of the covariance.", why="six values; 6 and 7 are refused")
_EXTENT = (
    SignalSpec(
        name="XMin", bits=3, factor=4, offset=-20, unit="m",
        about="Start of the range where the cubic is valid, rounded up: never too wide.",
        why="-20 to 8 m: from behind the car to where a line begins beside it"),
    SignalSpec(
        name="XMax", bits=5, factor=4, unit="m",
        about="End of the range where the cubic is valid, rounded down: never too wide.",
        why="0 to 124 m; in a roundabout a cubic holds for 15 m, of which steps of 8 m would "
            "leave a point"),
    AGE,
)
_COMPONENT = (
    SignalSpec(
        name="ComponentIndex", bits=3,
        about="Component of a Gaussian mixture, from 0.", why="8 components"),
    SignalSpec(
        name="ComponentCount", bits=3, offset=1,
        about="Number of components of the line; 1 is a plain Gaussian.", why="8 components"),
    SignalSpec(
        name="ComponentWeight", bits=5, factor=2**-5, offset=2**-5,
        about="Weight of the component.", why="steps of 1/32; no component has weight 0"),
)
# fmt: on
#: The signals of a record other than its covariance.
SERVICE = (*_PROTECTION, *_MEAN, _STATUS, KIND, *_EXTENT, *_COMPONENT)

#: The writer of ``dbc/maplines.dbc``.
DEFAULT = DbcWriter(
    pages=(
        (*_PROTECTION, _MEAN[0], _MEAN[1], _STATUS, KIND),
        (_MEAN[2], _MEAN[3], *_EXTENT),
        (*CHOLESKY[:5], *_COMPONENT),
        CHOLESKY[5:],
    ),
    pose=POSE_WITH_LEVELS,
)
#: The writer of ``dbc/maplines-secoc.dbc``: the same, with an authenticated message for each slot.
SECURED = replace(DEFAULT, first_secured_can_id=0x350)


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
_MORE_OF_MEAN = (
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
    *(
        replace(spec.finer(bits), why=why)
        for spec, (bits, why) in zip(MEAN, _MORE_OF_MEAN, strict=True)
    ),
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
