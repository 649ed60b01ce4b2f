"""An altered pose error or conditional record gives a right result or a refusal.

``tools/altered_dbc.py`` prints the table of all alterations; cantools is the witness.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import altered_dbc
import cantools
import pytest
from dbc_alterations import conditional_original, of_field_in, pose_original
from dbc_witness import WrongResultError
from pose_witness import check_conditional, check_pose

from maplines_can.study.dbc.record_spec import dbc_writer_for
from maplines_can.values.errors import LayoutError
from maplines_can.values.line import Slot
from maplines_can.wire import Layout
from maplines_can.wire.layout.signals import CONDITIONAL_SIGNALS

POSE, LINES = pose_original(), conditional_original()
#: Records in a row: loading the DBC takes the time.
RECORDS = 2


@pytest.mark.parametrize("field", altered_dbc.scene_fields())
def test_an_altered_signal_gives_a_right_result_or_a_refusal(field: str) -> None:
    """Each alteration of each signal; a refusal names the signal or its message."""
    outcomes = [
        altered_dbc.outcome(alteration, RECORDS) for alteration in altered_dbc.alterations_of(field)
    ]
    wrong = [(o.alteration.name, o.text) for o in outcomes if o.result == "wrong"]
    assert not wrong
    assert {o.result for o in outcomes} == {"right", "refused"}


def test_the_command_knows_the_fields_of_both_records() -> None:
    """With the name of their message, since some have the names of others."""
    fields = altered_dbc.scene_fields()

    assert {"Pose.PivotAlong", "Pose.EgoRightCounter", "Pose.EgoLeftOwnPoints"} <= set(fields)
    assert {"Conditional.HasCovariance", "Conditional.XMin", "Conditional.Page"} <= set(fields)
    assert len(fields) == len(set(fields)) > 50


@pytest.mark.parametrize(("text", "check"), [(POSE, check_pose), (LINES, check_conditional)])
def test_the_originals_are_right(text: str, check: Callable[[Layout, Any, int], None]) -> None:
    """Without an alteration."""
    check(Layout.from_text(text), cantools.database.load_string(text, "dbc"), RECORDS)


@pytest.mark.parametrize(
    ("text", "check", "message", "field"),
    [(POSE, check_pose, "Pose(Fd)?", "MapOffset"), (LINES, check_conditional, r"Ego\w+", "C1")],
)
def test_the_witness_sees_another_factor(
    text: str, check: Callable[[Layout, Any, int], None], message: str, field: str
) -> None:
    """The DBC that cantools reads differs from that of the codec."""
    other = next(a for a in of_field_in(text, field, message) if a.name == "factor x 2")
    database = cantools.database.load_string(other.text, "dbc")
    with pytest.raises(WrongResultError, match=field):
        check(Layout.from_text(text), database, RECORDS)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('BA_ "MapLinePose" BO_ 860 1;', 'BA_ "MapLinePose" BO_ 860 2;', "MapLinePose must be"),
        ('BA_ "E2EDataId" BO_ 860 19804;', 'BA_ "E2EDataId" BO_ 860 7;', "pose error: its messag"),
        (
            'BA_ "MapLinePose" BO_ 860 1;',
            'BA_ "MapLinePose" BO_ 860 1;\nBA_ "MapLineSlot" BO_ 860 3;',
            "MapLineSlot and MapLinePose",
        ),
        ("BO_ 861 PoseFd: 48", "BO_ 861 PoseFd: 32", "PoseFd"),
    ],
)
def test_a_wrong_message_of_the_pose_error_is_refused(old: str, new: str, words: str) -> None:
    """The refusal says what is wrong."""
    assert old in POSE
    with pytest.raises(LayoutError, match=words):
        Layout.from_text(POSE.replace(old, new))


def test_the_pose_error_has_its_own_ids() -> None:
    """A frame of it could otherwise be delivered as one of a line."""
    layout = Layout.from_text(POSE)
    assert layout.pose is not None
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"can_id": 0x341}, "the same CAN ID, 833"),
        ({"data_id": layout.messages[Slot.EGO_LEFT].data_id}, "the same E2EDataId"),
    )
    for change, words in cases:
        messages = replace(layout.pose.messages, **change)
        with pytest.raises(LayoutError, match=words):
            replace(layout, pose=replace(layout.pose, messages=messages))


def test_a_conditional_record_needs_the_pose_error() -> None:
    """Without the attribute, its message is one of others."""
    text = LINES.replace('BA_ "MapLinePose"', 'BA_ "GenMsgStartDelayTime"')
    text = text.replace('"MapLinePose"', '"GenMsgStartDelayTime"')
    with pytest.raises(LayoutError, match="need a message of the pose error"):
        Layout.from_text(text)


def test_a_pose_error_without_a_slot_is_refused() -> None:
    """Each slot of the DBC needs its counter, and complete lines their levels."""
    for name in ("EgoRightCounter", "EgoRightOwnPoints"):
        with pytest.raises(LayoutError, match=f"there is no signal '{name}'"):
            Layout.from_text(POSE.replace(f" {name} ", f" {name}X "))


def test_a_dbc_without_a_pose_error_is_as_before() -> None:
    """Its layout has none, and nothing is conditional."""
    for code in ("Float16", "MeanOnly"):
        layout = Layout.from_dbc(dbc_writer_for(code).database())
        assert layout.pose is None
        assert layout.short_pages == layout.pages
    assert set(CONDITIONAL_SIGNALS) - set(Layout.from_text(LINES).signals) == set()
