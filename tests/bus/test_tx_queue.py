"""Lines are encoded together, a little ahead; counters have no gap."""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.dbcs import default_codec
from support.fake_bus import (
    map_line,
)
from support.fake_codec import FakeCodec

from maplines_can import Codec, Gaussian, Polyline, map_scene
from maplines_can.bus.tx_queue import AHEAD, ALLOWANCE, Published, PublishedScene, Transfer, TxQueue
from maplines_can.values.line import Slot
from maplines_can.values.mixture import GaussianMixture
from maplines_can.wire import POSE, Frame, default_dbc_path


@settings(max_examples=30)
@given(st.lists(st.sampled_from([0.2, 0.9, 1.1, 2.7]), min_size=1, max_size=30), st.integers(1, 3))
def test_counters_have_no_gap_whatever_deadlines_are_skipped(steps: Any, drop_every: int) -> None:
    """Lines that were encoded ahead and not sent do not count as lost."""
    codec, period, now = default_codec(), 0.05, 100.0  # the queue counts by itself
    tx_queue = TxQueue(codec, period, fd=True, count=None, max_age=1.0)
    decoder = codec.decoder(cycle_ms=1e3 * period)
    for number, step in enumerate(steps):
        tx_queue.put([map_line(slot) for slot in (Slot.EGO_LEFT, Slot.ROUTE)], now)
        if number % drop_every == 0:
            tx_queue.drop(Slot.ROUTE)
        now += step * period
        while (transfer := tx_queue.take(now)) is not None:
            for frame in transfer.frames:
                decoder.feed(frame.can_id, frame.data, round(1e9 * now))
    assert decoder.lost == 0
    assert not any(decoder.counts.values())


T0 = 1000.0
#: A power of two, so that all times are exact; the slots are T / 8 apart [s].
T = 2.0**-4
LEFT, RIGHT, ROUTE = Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.ROUTE


@dataclass(frozen=True)
class FakeScene:
    """A prepared scene with nothing but its slots and the age of each line."""

    sent_slots: tuple[Slot, ...]
    ages: tuple[float, ...] = (0.0,)

    @property
    def owners(self) -> tuple[Any, ...]:
        return (POSE, *self.sent_slots)

    @property
    def scene(self) -> Any:
        return SimpleNamespace(lines=[SimpleNamespace(age=age) for age in self.ages])

    def without(self, slot: Slot) -> "FakeScene":
        return replace(self, sent_slots=tuple(s for s in self.sent_slots if s != slot))


class SceneCodec(FakeCodec):
    """Codec that records the owners of each call; a frame has the counter as ID and the age."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[Any] = []

    def encode_lines(self, lines: Any, *, fd: bool = False, counters: Any = None) -> Any:  # noqa: ARG002
        self.calls.append({line.slot for line in lines})
        return [self._frames(counters[line.slot], line.age) for line in lines]

    def prepare_scene(self, prepared: Any, *, fd: bool) -> Any:  # noqa: ARG002
        return prepared

    def encode_scene(self, prepared: Any, *, age: Any, fd: bool, counters: Any) -> Any:  # noqa: ARG002
        owners = (POSE, *prepared.sent_slots)
        self.calls.append(set(owners))
        return {owner: self._frames(counters.get(owner, 0), age[owner]) for owner in owners}

    @staticmethod
    def _frames(counter: int, age: float) -> list[Frame]:
        return [Frame(counter, struct.pack("d", age))]


def queue_of(
    codec: Any = None, period: float = T, count: int | None = None, max_age: float = 0.2
) -> TxQueue:
    codec = codec or SceneCodec()
    return TxQueue(codec, period, fd=False, count=count, max_age=max_age)


def put(tx_queue: TxQueue, what: Any, now: float) -> None:
    """Publish a scene of these slots, or lines of these slots, a number of periods after T0."""
    kind, *slots = what
    if kind == "scene":
        tx_queue.put_scene(FakeScene(tuple(slots)), T0 + now * T)  # type: ignore[arg-type]
    else:
        tx_queue.put([map_line(slot) for slot in slots], T0 + now * T)


def taken(tx_queue: TxQueue, start: float, end: float) -> list[Transfer]:
    """Return the transfers from ``start`` until before ``end`` [periods after T0], never late."""
    now, transfers = T0 + start * T, list[Transfer]()
    while (step := tx_queue.wait(now)) is not None and now + step < T0 + end * T:
        now += step
        if (transfer := tx_queue.take(now)) is not None:
            transfers.append(transfer)
    return transfers


def owners(transfers: Sequence[Transfer]) -> list[Any]:
    return [transfer.owner for transfer in transfers]


def age_of(transfer: Transfer) -> float:
    """Return the age that is sent [s]."""
    (frame,) = transfer.frames
    return float(struct.unpack("d", frame.data)[0])


def counters(transfers: Sequence[Transfer], owner: Any) -> list[int]:
    return [transfer.frames[0].can_id for transfer in transfers if transfer.owner == owner]


def test_lines_are_encoded_together_with_the_ages_at_their_deadlines() -> None:
    """One call a period; each age refers to the line's own deadline and the lateness allowed."""
    tx_queue = queue_of(codec := SceneCodec(), max_age=1.0)
    tx_queue.put([map_line(slot, age=0.125) for slot in Slot], T0)
    transfers = taken(tx_queue, 0, 1)

    assert codec.calls == [{*Slot}]
    assert [transfer.deadline for transfer in transfers] == [T0 + slot * T / 8 for slot in Slot]
    assert [age_of(transfer) for transfer in transfers] == pytest.approx(
        [0.125 + slot * T / 8 + ALLOWANCE for slot in Slot]
    )


@pytest.mark.parametrize("offset", [1 / 16, 7 / 16, 13 / 16])
def test_a_producer_of_the_same_period_is_never_behind(offset: float) -> None:
    """Whenever it publishes: one call a period, and no value is older than a period."""
    tx_queue = queue_of(codec := SceneCodec())
    put(tx_queue, ("lines", *Slot), 0)
    taken(tx_queue, 0, offset)
    for k in range(10):
        codec.calls.clear()
        put(tx_queue, ("lines", *Slot), k + offset)
        transfers = taken(tx_queue, k + offset, k + 1 + offset)
        assert len(transfers) == 8
        assert max(map(age_of, transfers)) < T + ALLOWANCE
        assert k == 0 or codec.calls == [{*Slot}]


def test_repetitions_are_encoded_half_a_period_ahead_at_most() -> None:
    """A line that is exactly half a period away is not included."""
    tx_queue = queue_of(codec := SceneCodec())
    put(tx_queue, ("lines", *Slot), 0)
    taken(tx_queue, 0, 3)

    assert [*map(len, codec.calls)] == [8, 4, 4, 4, 4]


@pytest.mark.parametrize("period", [1.0, 3.0, 60.0])
def test_a_slow_sender_encodes_a_tenth_of_a_second_ahead_at_most(period: float) -> None:
    """A new value is sent at the next deadline, although the period is long."""
    tx_queue = queue_of(codec := SceneCodec(), period, max_age=100.0)
    put(tx_queue, ("lines", *Slot), 0)
    then = (period * 5 / 8 - AHEAD - 0.01) / T
    before = taken(tx_queue, 0, then)
    put(tx_queue, ("lines", *Slot), then)
    after = taken(tx_queue, then, period * 0.99 / T)

    assert (len(before), len(after)) == (5, 3)
    for transfers, at in ((before, 0.0), (after, then * T)):
        ages = [transfer.latest - T0 - at for transfer in transfers]
        assert [*map(age_of, transfers)] == pytest.approx(ages)
    assert max(map(len, codec.calls)) <= 1 + AHEAD / (period / 8)


def test_a_line_encoded_before_a_retract_is_not_sent_after_it() -> None:
    tx_queue = queue_of(codec := SceneCodec())
    put(tx_queue, ("lines", *Slot), 0)
    assert owners(taken(tx_queue, 0, 1 / 16)) == [LEFT]
    assert codec.calls == [{*Slot}]
    tx_queue.drop(ROUTE)
    assert len(taken(tx_queue, 1 / 16, 0.7)) == 5
    put(tx_queue, ("lines", ROUTE), 0.7)
    _, route = taken(tx_queue, 0.7, 1)
    assert age_of(route) == pytest.approx(route.latest - T0 - 0.7 * T)


@pytest.mark.parametrize("kind", ["scene", "lines"])
def test_what_is_published_again_has_no_more_deadlines(kind: str) -> None:
    """The count is of the slot, not of its value; nor is a deadline lost that has passed."""
    tx_queue = queue_of(count=3)
    transfers = []
    for k in range(6):
        put(tx_queue, (kind, LEFT, ROUTE), k + 15 / 16)  # just after the deadline of the route
        transfers += taken(tx_queue, k + 15 / 16, k + 31 / 16)
    first = [POSE] if kind == "scene" else []
    assert sorted(map(str, owners(transfers))) == sorted(map(str, [*first, LEFT, ROUTE] * 3))
    assert tx_queue.over
    assert {transfer.skipped for transfer in transfers} == {0}


@pytest.mark.parametrize("kind", ["scene", "lines"])
def test_a_transfer_that_is_renewed_says_whether_it_has_expired(kind: str) -> None:
    """The new age counts from the publishing to twice the lateness; the counter is the same."""
    tx_queue = queue_of(max_age=0.2)
    put(tx_queue, (kind, LEFT), 0)
    transfers = taken(tx_queue, 0, 2)
    for transfer in transfers[len(transfers) // 2 :]:
        for late, expired in ((0.0625, False), (0.125, True)):
            now = transfer.deadline + late
            renewed = tx_queue.renew(transfer, now)
            assert renewed.latest == now + late
            assert age_of(renewed) == (math.inf if expired else renewed.latest - T0)
            assert renewed.frames[0].can_id == 1
            assert (transfer.expired, renewed.expired) == (False, expired)


def test_a_line_due_a_period_after_its_publishing_is_not_encoded_ahead() -> None:
    """A newer value is expected until then."""
    tx_queue = queue_of(codec := SceneCodec())
    put(tx_queue, ("lines", *Slot), 0)
    assert len(taken(tx_queue, 0, 1)) == 8
    for slot in Slot:  # each is published just after its deadline
        now = 1 + slot / 8
        assert len(taken(tx_queue, now, now + 1 / 16)) == 1
        put(tx_queue, ("lines", slot), now)
    codec.calls.clear()
    assert len(taken(tx_queue, 2, 2 + 1 / 16)) == 1
    assert codec.calls == [{LEFT}]


def test_a_mixture_uses_a_counter_for_each_of_its_components() -> None:
    line = map_line(LEFT)
    three = GaussianMixture([0.25, 0.25, 0.5], [line.gaussian] * 3)
    tx_queue = queue_of()
    tx_queue.put([replace(line, mixture=three), map_line(ROUTE)], T0)
    transfers = taken(tx_queue, 0, 3)
    assert counters(transfers, LEFT) == [0, 3, 6]
    assert counters(transfers, ROUTE) == [0, 1, 2]


def test_a_deadline_that_was_skipped_is_encoded_again() -> None:
    """A line that was encoded for it would be too young at the deadline that is met."""
    tx_queue = queue_of(codec := SceneCodec())
    put(tx_queue, ("lines", LEFT, ROUTE), 0)
    assert owners(taken(tx_queue, 0, 0.5)) == [LEFT]
    assert codec.calls == [{LEFT, ROUTE}]
    late = {}
    while (transfer := tx_queue.take(T0 + 2 * T)) is not None:
        late[transfer.owner] = transfer
    assert {owner: t.deadline - T0 for owner, t in late.items()} == {LEFT: 2 * T, ROUTE: 1.875 * T}
    assert {owner: t.skipped for owner, t in late.items()} == {LEFT: 1, ROUTE: 1}
    assert age_of(late[ROUTE]) == pytest.approx(1.875 * T + 0.004)


def test_a_line_that_missed_its_deadlines_is_sent_if_its_pose_error_was() -> None:
    """Even the next deadline is over. On a busy machine, the last lines would never be sent."""
    tx_queue = queue_of(count=2)
    put(tx_queue, ("scene", LEFT, ROUTE), 0)
    assert owners(taken(tx_queue, 0, 0.5)) == [POSE, LEFT]
    now = T0 + 1.9375 * T
    late = tx_queue.take(now)
    assert late is not None
    assert (late.owner, late.deadline, late.skipped) == (ROUTE, T0 + 0.875 * T, 1)
    assert counters([late], ROUTE) == [0]
    assert age_of(tx_queue.renew(late, now)) == pytest.approx(now - T0 + now - late.deadline)
    assert owners(taken(tx_queue, 1.9375, 3)) == [POSE, LEFT]
    assert tx_queue.over


@pytest.mark.parametrize(("period", "calls"), [(0.8, 2), (0.5, 2), (0.0625, 1)])
def test_lines_of_a_scene_are_encoded_a_tenth_of_a_second_ahead_at_most(
    period: float, calls: int
) -> None:
    """A line that is due later gets its frames when it is due, with the same counter and age.

    With a period of 0.8 s, the first line is due after a tenth of a second exactly.
    """
    tx_queue = queue_of(codec := SceneCodec(), period, max_age=1.0)
    tx_queue.put_scene(FakeScene((Slot.EGO_RIGHT, ROUTE)), T0)  # type: ignore[arg-type]
    transfers = taken(tx_queue, 0, period / T)
    assert owners(transfers) == [POSE, RIGHT, ROUTE]
    assert len(codec.calls) == calls
    for transfer in transfers:
        assert transfer.frames[0].can_id == 0
        assert age_of(transfer) == pytest.approx(transfer.latest - T0)


def test_no_lines_in_place_of_a_scene_end_its_pose_error() -> None:
    """A sender without a pose publishes no lines: nothing of the scene before is sent on."""
    codec = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
    road = Polyline([[-50.0, 1.7], [150.0, 1.7]])
    ego = Gaussian(np.zeros(3), np.diag([0.1, 0.1, 0.001]) ** 2)
    scene = map_scene({Slot.EGO_LEFT: road}, ego, correlation_time=3.0)
    queue = TxQueue(codec, 0.05, fd=False, count=None, max_age=0.2)
    queue.put_scene(codec.encoder().prepare_scene(scene), 0.0)
    assert queue.take(0.01) is not None
    queue.put([], 0.02)
    assert queue.wait(0.02) is None
    assert queue.take(1.0) is None


@pytest.mark.parametrize(
    ("age", "expected"), [(-1.0, 0.0), (0.25, 0.375), (0.375, 0.5), (0.376, math.inf)]
)
def test_an_age_is_stated_up_to_the_greatest_one(age: float, expected: float) -> None:
    """0.125 s after publishing, with 0.5 s as the greatest; it is never less than 0."""
    scene = PublishedScene(FakeScene((LEFT,)), age, at=T0)  # type: ignore[arg-type]
    line = Published(map_line(), age, at=T0)
    assert scene.age_at(T0 + 0.125, 0.5) == line.with_age(T0 + 0.125, 0.5).age == expected
