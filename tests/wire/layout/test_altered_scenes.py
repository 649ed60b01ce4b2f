"""A DBC with a misspelt signal is refused when it is loaded, or its scenes arrive."""

from dataclasses import replace

import pytest
from scene_alterations import FORMS, alterations_in, check_scenes, original, scenes_outcome

from maplines_can.study.dbc.pose_spec import CONDITIONAL, POSE_WITH_LEVELS
from maplines_can.study.dbc.record_spec import DEFAULT
from maplines_can.values.errors import LayoutError
from maplines_can.values.line import Slot
from maplines_can.wire import Codec, Layout

#: Slots with messages; the pose error has the signals of all eight.
SLOTS = [(Slot.EGO_LEFT, Slot.EGO_RIGHT), (Slot.CENTRE, Slot.ROUTE)]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("slots", SLOTS)
def test_a_misspelt_or_missing_signal_is_refused_or_not_needed(
    form: str, slots: tuple[Slot, ...]
) -> None:
    """Any signal of any message, in one frame format and in both."""
    database = original(form, slots)
    check_scenes(Codec(Layout.from_dbc(database)))
    tried = [*alterations_in(database)]
    found = [scenes_outcome(database, alteration) for alteration in tried]
    results = zip(tried, found, strict=True)
    assert [result for result in results if result[1] not in {"refused", "right"}] == []
    assert found.count("refused") > 0.9 * len(tried) > 300


@pytest.mark.parametrize("name", ["EdgeRightOwnPoints", "EdgeRightCounter", "RouteFitAhead"])
def test_a_pose_error_has_all_signals_of_a_slot_or_none(name: str) -> None:
    """Also of a slot without messages; the refusal names the signal that is missing."""
    text = replace(DEFAULT, slots=SLOTS[0]).dbc()
    with pytest.raises(LayoutError, match=f"there is no signal '{name}'"):
        Layout.from_text(text.replace(f" {name} ", f" {name}s "))


def test_a_pose_error_may_leave_out_slots_without_messages() -> None:
    """All signals of a slot, in all frame formats: then scenes of the others arrive."""
    titles = ("NextLeft", "NextRight", "Centre", "EdgeLeft", "EdgeRight", "Route")
    pages = tuple(
        tuple(spec for spec in page if not spec.name.startswith(titles))
        for page in POSE_WITH_LEVELS.pages
    )
    pose = replace(POSE_WITH_LEVELS, pages=pages)
    check_scenes(Codec(Layout.from_text(replace(DEFAULT, slots=SLOTS[0], pose=pose).dbc())))


def test_levels_beside_conditional_records_are_refused() -> None:
    """Their records have them; those of the pose error would be filled in by nobody."""
    text = replace(CONDITIONAL, slots=SLOTS[0], pose=POSE_WITH_LEVELS).dbc()
    with pytest.raises(LayoutError, match=r"signal EgoLeftFitAhead is .*; remove it here"):
        Layout.from_text(text)
