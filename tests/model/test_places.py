"""Places of lines in whole scenes: examples, and what holds for any lines."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can import Slot
from maplines_can.model.lines import Curve
from maplines_can.model.matrices import Vector
from maplines_can.model.places import NEARER, Candidate, Places, Slots, chosen

LEFT, RIGHT, NEXT_LEFT, NEXT_RIGHT, CENTRE, EDGE_LEFT, EDGE_RIGHT, ROUTE = Slot
SCENE: Slots = (LEFT, RIGHT, None, None)
SCENE2: Slots = (EDGE_LEFT, EDGE_RIGHT, None, None)
BOTH = (SCENE, SCENE2)
#: Fixed slots that a DBC may have: those of the project, and of its authenticated messages.
FORMS = (
    BOTH, (SCENE,), (SCENE[:3], SCENE2[:3]), (SCENE[:3],), ((None, None),), ((None,), (None,)),
    ((LEFT, RIGHT),), ((None,) * 8,), ((CENTRE, None), (None, None, ROUTE)),
)  # fmt: skip


def line(slot: Slot, y: float, *, is_left_out: bool = False) -> Candidate:
    return Candidate(slot, Curve(Vector([y, 0.0, 0.0, 0.0]), -10.0, 50.0), is_left_out)


def places_of(messages: Any, *cycles: list[Candidate]) -> Places:
    """Return the places of the last of some cycles."""
    last = Places()
    for lines in cycles:
        last = chosen(messages, lines, last)
    return last


def scenes() -> Any:
    """Lines of some slots at distances that differ by more or less than the hysteresis."""
    lines = st.builds(
        line, st.sampled_from(Slot), st.integers(-24, 24).map(lambda n: n / 4),
        is_left_out=st.sampled_from([False, False, True]),
    )  # fmt: skip
    return st.lists(lines, max_size=8, unique_by=lambda one: one.slot)


FORM, CYCLES = st.sampled_from(FORMS), st.lists(scenes(), min_size=1, max_size=4)


@given(FORM, CYCLES)
def test_each_line_has_one_place_or_all_are_taken(
    messages: tuple[Slots, ...], cycles: list[list[Candidate]]
) -> None:
    """A fixed place is of its slot only; Scene2 is sent from the first cycle that needs it."""
    last = Places()
    for lines in cycles:
        before, last = last, chosen(messages, lines, last)
        slots, scene2 = {one.slot for one in lines}, last.scene2
        fixed = [own for message in messages[: 1 + (scene2 is not None)] for own in message]
        found = [*last.scene, *(scene2 or ())]
        taken = [slot for slot in found if slot is not None]
        free = [place for own, place in zip(fixed, found, strict=True) if own is None]
        without = slots - {*taken}
        assert sorted(taken) == sorted({*taken} & slots)
        pairs = zip(fixed, found, strict=True)
        assert all(a in (None, b) or (b is None and a not in slots) for a, b in pairs)
        assert not without or None not in free
        assert before.scene2 is None or scene2 is not None
        assert not without or scene2 is not None or len(messages) == 1


@given(FORM, CYCLES)
def test_the_same_lines_keep_their_places(
    messages: tuple[Slots, ...], cycles: list[list[Candidate]]
) -> None:
    """Also in another order."""
    last = places_of(messages, *cycles)

    assert chosen(messages, cycles[-1][::-1], last) == last


@given(FORM, CYCLES, st.data())
def test_moves_within_the_hysteresis_change_nothing(
    messages: tuple[Slots, ...], cycles: list[list[Candidate]], data: Any
) -> None:
    """Each line moves by less than half of it."""
    last = places_of(messages, *cycles)
    moves = st.sampled_from([-NEARER / 2.1, 0.0, NEARER / 2.1])
    moved = [
        line(one.slot, one.curve.mean[0] + data.draw(moves), is_left_out=one.is_left_out)
        for one in cycles[-1]
    ]

    assert chosen(messages, moved, last) == last


def test_the_nearest_lines_are_in_scene() -> None:
    """All eight: Scene2 is needed, and the centre comes last, since it follows from the others."""
    ys = dict(zip(Slot, (1.8, -1.8, 5.3, -5.2, 0.1, 9.0, -9.0, -1.0), strict=True))
    lines = [line(slot, y) for slot, y in ys.items()]

    assert places_of(BOTH, lines) == Places(
        (LEFT, RIGHT, ROUTE, NEXT_RIGHT), (EDGE_LEFT, EDGE_RIGHT, NEXT_LEFT, CENTRE)
    )
    assert places_of([SCENE], lines) == Places((LEFT, RIGHT, ROUTE, NEXT_RIGHT))


@pytest.mark.parametrize(("y", "slot"), [(2.9, ROUTE), (2.1, ROUTE), (1.9, NEXT_RIGHT)])
def test_another_line_has_to_be_nearer_by_more_than_the_hysteresis(y: float, slot: Slot) -> None:
    messages = [SCENE[:3]]
    before, after = ([line(ROUTE, 3.0), line(NEXT_RIGHT, -d)] for d in (4.0, y))

    assert places_of(messages, before, after).scene[2] == slot


def test_a_line_that_is_left_out_yields_to_those_that_go() -> None:
    """It has a place, which says why, if one is free."""
    out, centre = line(ROUTE, 1.0, is_left_out=True), line(CENTRE, 0.0)

    assert places_of([SCENE[:3]], [out], [out, centre]).scene == (None, None, CENTRE)
    assert places_of([SCENE], [out], [out, centre]).scene == (None, None, ROUTE, CENTRE)


def test_the_distance_is_that_of_the_point_of_the_range_that_is_nearest_to_the_car() -> None:
    """The route begins 20 m ahead, where it has come near: 6 - 0.2 x."""
    ahead = Candidate(ROUTE, Curve(Vector([6.0, -0.2, 0.0, 0.0]), 20.0, 50.0))

    assert places_of([SCENE[:3]], [ahead, line(NEXT_RIGHT, -2.5)]).scene[2] == ROUTE
