"""Records of the last counter cycle."""

from typing import Any

import pytest

from maplines_can.wire.reception.history import RecordHistory

MODULUS = 16


@pytest.fixture
def history() -> Any:
    """Counters 0, 1, 2 and 4 were new; 3 is a gap."""
    history = RecordHistory(MODULUS)
    for counter, ahead in ((0, 1), (1, 1), (2, 1), (4, 2)):
        history.add_new(counter, 100 + counter, ahead)
    return history


@pytest.mark.parametrize(
    ("counter", "content", "behind", "duplicate", "other"),
    [
        pytest.param(4, 104, 0, True, False, id="the-last-one"),
        pytest.param(2, 102, 2, True, False, id="an-older-one"),
        pytest.param(2, 999, 2, False, True, id="another-content"),
        pytest.param(3, 103, 1, False, False, id="a-gap"),
        pytest.param(2, 102, 2 + MODULUS, False, False, id="a-round-before"),
    ],
)
def test_a_record_is_known_by_counter_position_and_content(
    history: Any, counter: int, content: int, behind: Any, duplicate: bool, other: bool
) -> None:
    """All three must agree for a duplicate."""
    assert history.is_duplicate(counter, content, behind) is duplicate
    assert history.has_other(counter, content, behind) is other


def test_a_duplicate_is_marked_once(history: Any) -> None:
    """And only if the record was new when it came."""
    assert [history.mark_duplicated(2, 2) for _ in range(2)] == [True, False]
    history.add_late(3, 103, 1)
    assert history.is_duplicate(3, 103, 1)
    assert not history.mark_duplicated(3, 1)


def test_a_late_record_takes_no_position_of_another(history: Any) -> None:
    """What was accepted stays known."""
    history.add_late(2, 999, 2)
    assert history.is_duplicate(2, 102, 2)


@pytest.mark.parametrize(("counter", "behind", "fills"), [(3, 1, True), (5, 15, False)])
def test_a_gap_is_filled_by_the_record_after_a_new_one(
    history: Any, counter: int, behind: int, fills: bool
) -> None:
    """A record that was overtaken follows one that was new."""
    assert history.fills_gap(counter, behind) is fills


def test_positions_continue_beyond_the_wrap_around() -> None:
    """A record of the round before is not one of this round."""
    history = RecordHistory(MODULUS)
    for counter in range(20):
        history.add_new(counter % MODULUS, counter, 1)
    assert history.is_duplicate(3, 19, 0)
    assert not history.is_duplicate(3, 3, 0)
    assert history.is_duplicate(4, 4, 15)
