"""Facts that were: all of them, or the last ones, whatever their number."""

import json
import threading
import zlib
from typing import Any

import pytest

from maplines_can.desk.history import PART, FactHistory


def facts(k: Any) -> Any:
    """Return facts whose counter changes at every tenth."""
    return {"t": k / 20, "slots": {}, "messages": {}, "counts": {"CRC": k // 10}}


def unpacked(history: Any, part: Any) -> Any:
    packed = history.part(part)
    return None if packed is None else json.loads(zlib.decompress(packed))


@pytest.mark.parametrize("count", [0, 1, PART - 1, PART, PART + 1, 5 * PART + 7])
@pytest.mark.parametrize("max_facts", [None, 1, 2 * PART])
def test_what_is_kept(count: int, max_facts: int | None) -> None:
    """Parts are in the order of their numbers, and at least the last facts are there."""
    history = FactHistory(max_facts)
    assert all(history.add(facts(k)) for k in range(count))
    kept = history.contents()
    first = kept["first"]
    parts = [unpacked(history, first + k) for k in range(len(kept["starts"]))]
    times = [one["t"] for part in parts for one in part]

    assert kept["count"] == count
    assert times == [k / 20 for k in range(first * PART, count)]
    assert kept["starts"] == [part[0]["t"] for part in parts]
    assert len(times) >= min(count, max_facts or count)
    assert len(times) <= count if max_facts is None else max_facts + 2 * PART
    assert unpacked(history, first - 1) is unpacked(history, first + len(parts)) is None
    _, found = history.changes(0)
    expected = [k for k in range(first * PART, count) if k and k % 10 == 0]
    assert [number for number, _, _ in found] == expected
    assert [one["changes"] for part in parts for one in part if one["changes"]] == [
        texts for _, _, texts in found
    ]


def test_changes_are_asked_for_once() -> None:
    """The number that comes with changes leads to those after them."""
    history, got, following = FactHistory(), [], 0
    for k in range(95):
        history.add(facts(k))
        if k % 7 == 0:
            following, found = history.changes(following)
            got += [number for number, _, _ in found]
    assert got == [10, 20, 30, 40, 50, 60, 70, 80, 90]


def test_packed_bytes_are_limited() -> None:
    """Nothing is added beyond the limit."""
    history = FactHistory(max_bytes=1)
    assert [history.add(facts(k)) for k in range(PART + 2)] == [True] * PART + [False] * 2
    assert history.contents()["count"] == PART


def test_the_newest_facts_wake_who_waits() -> None:
    """The newest ones come, not each of them; after the end nobody waits."""
    history = FactHistory()
    history.add(facts(0))
    history.add(facts(1))
    newest = history.after(-1, 0.0)
    assert newest is not None
    assert newest.number == 1
    assert json.loads(newest.text)["t"] == 0.05
    assert history.after(1, 0.01) is None
    threading.Timer(0.05, history.add, [facts(2)]).start()
    assert history.after(1, 10.0).number == 2  # type: ignore[union-attr]
    threading.Timer(0.05, history.end).start()
    assert history.after(2, 10.0) is None


def test_frames_of_others_are_counted_together() -> None:
    """Facts stay small on a bus with hundreds of other messages."""
    messages = {hex(k): {"owner": None if k else "EGO_LEFT", "frames": k} for k in range(300)}
    traffic = {"load": 0.5, "beyond": 7, "messages": messages}
    history = FactHistory()
    history.add(facts(0) | {"traffic": traffic})
    (only,) = unpacked(history, 0)

    assert only["traffic"]["others"] == {"ids": 299, "frames": sum(range(300)) + 7}
    assert list(only["traffic"]["messages"]) == ["0x0"]


def test_a_message_that_stays_away_is_told_once() -> None:
    """Each cycle without it counts, but its state says so; what is lost or wrong is told."""
    own = {"lost": 0, "repeated": 0, "wrong_sequence": 0, "errors": 0, "two_senders": False}
    counters = [("VALID", 0, 0), ("VALID", 1, 0), ("INVALID", 2, 0), ("INVALID", 3, 0)]
    counters += [("INVALID", 4, 1), ("VALID", 5, 1)]
    history = FactHistory()
    for k, (state, missing, lost) in enumerate(counters):
        message = own | {"state": state, "no_new_data": missing, "lost": lost}
        history.add(facts(0) | {"t": k, "messages": {"EGO_LEFT": message}})
    assert [texts for _, _, texts in history.changes(0)[1]] == [
        ["ego left: NODATA -> VALID"],
        ["ego left: 1 missing in their cycle"],
        ["ego left: VALID -> INVALID", "ego left: 1 missing in their cycle"],
        ["ego left: 1 lost"],
        ["ego left: INVALID -> VALID"],
    ]
