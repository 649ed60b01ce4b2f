"""Records of the last counter cycle."""

from typing import Any

import pytest

from maplines_can.wire.reception.history import HISTORY, RecordHistory

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


def test_of_a_long_counter_only_the_last_records_are_known() -> None:
    """Memory is constant, and an older record is neither a duplicate nor another one."""
    history = RecordHistory(2**20)
    for counter in range(5000):
        history.add_new(counter, counter, 1)
    oldest = HISTORY - 1
    assert history.is_duplicate(4999 - oldest, 4999 - oldest, oldest)
    assert not history.is_duplicate(4999 - HISTORY, 4999 - HISTORY, HISTORY)
    assert not history.has_other(4999 - HISTORY, -1, HISTORY)
    history.add_late(4999 - HISTORY, -1, HISTORY)
    assert history.is_duplicate(4999, 4999, 0), "an older record takes no place of a newer one"


@pytest.mark.parametrize("ahead", [3, HISTORY, 2**20])
def test_what_a_new_record_has_skipped_is_forgotten(ahead: int) -> None:
    """Low bits that were those of an earlier record are not mistaken for that."""
    history = RecordHistory(2**20)
    for counter in range(HISTORY):
        history.add_new(counter, counter, 1)
    newest = (HISTORY - 1 + ahead) % 2**20
    history.add_new(newest, -1, ahead)
    for behind in range(1, min(ahead, HISTORY)):
        assert not history.has_other((newest - behind) % 2**20, -1, behind)
    assert history.is_duplicate(HISTORY - 1, HISTORY - 1, ahead) is (ahead < HISTORY)
