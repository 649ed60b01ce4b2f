"""Bounds of signals, and what they need together, at their edges."""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from scene_layouts import layout_of, pose_layout_of

from maplines_can.values.errors import LayoutError
from maplines_can.values.line import Slot
from maplines_can.wire.layout.record_layout import RecordLayout
from maplines_can.wire.layout.record_signals import (
    COMPLETE_RECORD,
    CONDITIONAL_RECORD,
    POSE_RECORD,
    SCENE_LINE,
    SCENE_RECORD,
    SLOT,
    SLOT_BOUNDS,
    Bounds,
    Signal,
    of_slot,
)
from maplines_can.wire.layout.signal import all_raw

LINE = layout_of("maplines.dbc").signals
CONDITIONAL = layout_of("maplines-pose.dbc").signals
POSE = pose_layout_of("maplines.dbc").signals
SCENE = layout_of("maplines-scene.dbc")
assert SCENE.scene
#: Names of the signals of lines in a whole scene.
OF_LINES = re.compile(rf"(EgoLeft|EgoRight|Line[34])({'|'.join((*SCENE_LINE, SLOT))})")
#: Signals and bounds of the records of lines, of conditional ones, of the pose error, of whole
#: scenes, and of a line in one.
RECORDS = {
    "line": (LINE, COMPLETE_RECORD),
    "conditional": (CONDITIONAL, CONDITIONAL_RECORD),
    "pose": (POSE, {**POSE_RECORD, **{k: v for slot in Slot for k, v in of_slot(slot).items()}}),
    "scene": (SCENE.scene.signals, SCENE_RECORD),
    "line of a scene": (SCENE.signals, {**SCENE_LINE, SLOT: SLOT_BOUNDS}),
}


class Frame(RecordLayout):
    """Record without pages."""

    @property
    def record_bytes(self) -> int:
        """Length of the frame."""
        return 64


def check(record: str, signals: Mapping[str, Signal]) -> None:
    """Check the signals of a record."""
    kind = Frame if record.endswith("scene") else RecordLayout
    kind(signals=signals, source="my.dbc").check(RECORDS[record][1])


def refusal(record: str, name: str, **change: Any) -> str:
    """The message with which a record is refused if a signal is changed; empty if it is not.

    The range is that of all bits.
    """
    signals, _ = RECORDS[record]
    signal = replace(signals[name], **change)
    if "raw_min" not in change and "raw_max" not in change:
        low, high = all_raw(signal.length, signal.signed)
        signal = replace(signal, raw_min=low, raw_max=high)
    try:
        check(record, {**signals, name: signal})
    except LayoutError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("record", RECORDS)
def test_the_projects_signals_are_within_their_bounds(record: str) -> None:
    """And each signal is needed; those of a slot only with the slot. All have bounds."""
    signals, bounds = RECORDS[record]
    check(record, signals)
    beside = re.compile(rf"(Page|TransferId)\d|(Pivot|Ratio)\w+|Inflation|{OF_LINES.pattern}")
    assert not [name for name in signals.keys() - bounds.keys() if not beside.fullmatch(name)]
    for name in signals.keys() & bounds.keys() - {n for slot in Slot for n in of_slot(slot)}:
        others = {other: signal for other, signal in signals.items() if other != name}
        with pytest.raises(LayoutError, match=f"there is no signal '{name}'"):
            check(record, others)


@pytest.mark.parametrize(
    ("record", "name", "change", "words"),
    [
        # numbers that are sent unchanged
        ("line", "Crc", {"length": 15}, "16 bits"),
        ("line", "Crc", {"big_endian": True, "start": 7}, "Intel"),
        ("line", "Crc", {"start": 1}, "a multiple of 8"),
        ("line", "Kind", {"is_float": True}, "an integer type"),
        ("line", "Kind", {"raw_max": 6}, "the range [min|max] of all its bits"),
        ("line", "Kind", {"raw_min": 1}, "the range [min|max] of all its bits"),
        ("line", "Kind", {"length": 2}, "3 to 53 bits; since it has eight values"),
        ("line", "Kind", {"signed": True}, "an unsigned type"),
        ("line", "Counter", {"length": 3}, "4 to 53 bits"),
        ("line", "Counter", {"length": 4}, ""),
        ("line", "ComponentIndex", {"factor": 2.0}, "factor 1 and offset 0; write (1,0)"),
        ("line", "ComponentCount", {"offset": 0.0}, "factor 1 and offset 1; write (1,1)"),
        # quantities
        ("line", "YOff", {"length": 53, "factor": 2.0**-47}, "overlap"),
        ("line", "YOff", {"length": 54}, "1 to 53 bits"),
        ("line", "C1", {"factor": 1e-30}, ""),
        ("line", "C1", {"factor": 9.9e-31}, "a positive factor of 1e-30 or more"),
        ("line", "C1", {"factor": -(2.0**-30)}, "a positive factor"),
        ("line", "C1", {"factor": float("nan")}, "a positive factor"),
        ("line", "C1", {"factor": float("inf")}, "values from -1e+30 to 1e+30"),
        ("line", "YOff", {"offset": 1e30}, ""),
        ("line", "YOff", {"offset": -1.01e30}, "values from -1e+30 to 1e+30"),
        ("line", "YOff", {"unit": ""}, ""),
        ("line", "YOff", {"unit": "cm"}, 'the unit "m", or none'),
        ("line", "YOff", {"signed": False, "offset": -32.0}, ""),
        ("line", "Age", {"offset": -1.0}, "values from 0"),
        ("line", "Age", {"length": 2}, ""),
        ("line", "Age", {"length": 1}, "2 to 53 bits"),
        ("conditional", "XMin", {"offset": -32.5}, "factor 1 and a whole offset"),
        ("conditional", "XMax", {"factor": 2.0}, "factor 1 and a whole offset"),
        # exponents of 2
        ("pose", "MapOffset", {"signed": True}, "unsigned"),
        ("pose", "MapOffset", {"length": 17}, "1 to 16 bits"),
        ("pose", "MapOffset", {"offset": -200.0}, ""),
        ("pose", "MapOffset", {"offset": -201.0}, "values from -200 to 200"),
        ("conditional", "OwnShape", {"offset": -10.0}, ""),
        ("conditional", "OwnShape", {"offset": -10.01}, "values from -10 to 10"),
        ("conditional", "OwnShape", {"offset": 3.63}, "values from -10 to 10"),
        ("conditional", "OwnShape", {"unit": ""}, 'the unit "octave"'),
        # signals of slots
        ("pose", "RouteOwnShape", {"unit": "octave"}, 'the unit "1"'),
        ("pose", "RouteOwnShape", {"offset": 0.0}, "values from 0.000976562"),
        ("pose", "RouteOwnShape", {"factor": 0.01}, "for all slots"),
        ("pose", "EgoLeftQuartic", {"offset": 0.01}, "for all slots"),
        ("pose", "RouteCounter", {"length": 2}, "3 to 53 bits"),
        # finer parts of the mean
        ("conditional", "YOffFine", {"signed": False}, ""),
        ("conditional", "BetaFine", {"factor": 2.0**-15}, "one step of Beta"),
        ("conditional", "YOffFine", {"offset": 100.0}, "and offset 0"),
        ("conditional", "C1Fine", {"length": 36, "factor": 2.0**-56}, "overlap"),
        ("conditional", "C1Fine", {"length": 37, "factor": 2.0**-57}, "at most 53 bits together"),
        # several signals together
        ("line", "Page0", {"length": 1}, "number all pages"),
        ("line", "Page2", {"length": 1}, "the same bits"),
        ("line", "Page1", {"start": 190}, "the same bits"),
        ("line", "TransferId3", {"length": 3}, "the same bits"),
        ("line", "TransferId1", {"start": 63}, "the same bits"),
        ("line", "TransferId1", {"start": 125}, "the same bits"),
        ("line", "ComponentCount", {"length": 2}, ""),
        ("line", "ComponentCount", {"length": 4}, "a bit more than ComponentCount"),
        ("line", "ComponentIndex", {"length": 2}, "as ComponentCount"),
        ("line", "ComponentWeight", {"offset": 0.0}, "factor and offset 2^-n"),
        ("line", "ComponentWeight", {"length": 3, "factor": 0.125, "offset": 0.125}, ""),
        ("line", "ComponentWeight", {"length": 2, "factor": 0.25, "offset": 0.25}, "at least as"),
        ("line", "XMax", {"length": 1, "factor": 4.0, "offset": -24.0}, "no valid range"),
        ("line", "XMax", {"length": 1, "factor": 4.0, "offset": -23.0}, ""),
        # whole scenes
        ("scene", "SceneCounter", {"length": 2}, "3 to 53 bits"),
        ("scene", "SceneCounter", {"signed": True}, "an unsigned type"),
        ("scene", "SceneCounter", {"length": 9}, "at most as many bits as Counter"),
        ("scene", "Age", {"unit": "s"}, 'the unit "ms"'),
        ("scene", "Counter", {"length": 3}, "4 to 53 bits"),
        ("line of a scene", "Kind", {"length": 3}, "4 to 53 bits; since it has thirteen values"),
        ("line of a scene", "OwnTilt", {"length": 1}, "2 bits"),
        ("line of a scene", "OwnTilt", {"offset": 1.0}, "factor 1 and offset 0; write (1,0)"),
        ("line of a scene", "OwnLateral", {"length": 1}, ""),
        ("line of a scene", "OwnShape", {"unit": "1"}, 'the unit "octave"'),
        ("line of a scene", "XMin", {"factor": 0.5}, "factor 1 and a whole offset"),
        ("line of a scene", "XMax", {"length": 1, "offset": -33.0}, "no valid range"),
        ("line of a scene", "XMax", {"length": 1, "offset": -32.0}, ""),
        ("line of a scene", SLOT, {"length": 2}, "3 bits"),
        # places
        ("scene", "Line4Slot", {"start": 510}, "must lie in the record of 64 bytes"),
        ("scene", "Line4Slot", {"start": 507}, "overlap"),
        ("line", "Inflation", {"start": 254}, "must lie in"),
        ("line", "Inflation", {"start": 248}, "overlap"),
    ],
)
def test_a_signal_at_the_edge(record: str, name: str, change: dict[str, Any], words: str) -> None:
    """Accepted at the edge, and refused with the reason one beyond it."""
    found = refusal(record, name, **change)
    assert words in found
    assert bool(words) is bool(found)


def test_a_refusal_has_name_value_need_and_cure() -> None:
    """With the signal in the notation of a DBC."""
    with pytest.raises(LayoutError) as error:
        Bounds(units=("m", "")).check(replace(LINE["YOff"], unit="cm"), "my.dbc")
    assert str(error.value) == (
        'my.dbc: signal YOff is 24|16@1- (0.0009765625,0) [-32|31.9990234375] "cm", but it needs '
        'the unit "m", or none; convert factor and offset to it'
    )


@pytest.mark.parametrize(("bits", "accepted"), [(2, False), (3, True), (4, True)])
def test_a_counter_of_a_slot_is_no_longer_than_that_of_its_records(
    bits: int, accepted: bool
) -> None:
    """Its low bits are what the pose error states; here it has 3."""
    pose = pose_layout_of("maplines-pose.dbc")
    counters = {Slot.ROUTE: replace(LINE["Counter"], length=bits)}
    if accepted:
        pose.check_slots(counters, levels=False)
    else:
        with pytest.raises(LayoutError, match=r"RouteCounter .* at most 2 bits"):
            pose.check_slots(counters, levels=False)
    with pytest.raises(LayoutError, match="EgoLeftOwnLateral"):
        pose.check_slots(counters, levels=True)


def test_a_record_of_the_pose_error_without_one_of_its_pages_is_refused() -> None:
    """Pages 0 and 2 are not a record; neither is one without pages."""
    pose = pose_layout_of("maplines-pose.dbc")
    later = {"Page1": "Page2", "TransferId1": "TransferId2"}
    signals = {later.get(name, name): signal for name, signal in pose.signals.items()}
    with pytest.raises(LayoutError, match=r"numbered 0, 1, ..., got \[0, 2\]"):
        replace(pose, signals=signals)
    with pytest.raises(LayoutError, match=r"numbered 0, 1, ..., got \[\]"):
        replace(pose, signals={n: s for n, s in signals.items() if not n.startswith("Page")})
