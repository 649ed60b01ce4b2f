"""Epochs: a line joins the pose error of its cycle, or none."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can.values.line import Slot
from maplines_can.wire import E2EConfig, ProfileStatus, Reason, SequenceCheck
from maplines_can.wire.reception.scenes import MAX_EPOCHS, EpochAssembler
from maplines_can.wire.records.raw_format import absent_counter

CYCLE = 1_000_000  # [ns]
SLOTS = (Slot.EGO_LEFT, Slot.ROUTE)


class Sent(NamedTuple):
    """A record of a cycle: of the pose error (slot None), or of a line."""

    cycle: int
    slot: Slot | None
    counter: int
    components: int
    stated: dict[Slot, int]


@dataclass(frozen=True)
class Fate:
    """What happens to a record."""

    lost: bool
    delay: float  #: [cycles]
    copies: int


def sent(
    plan: Sequence[Sequence[int]], first: int, restart: int | None, silence: int
) -> Iterator[tuple[Sent, float]]:
    """Yield the records of cycles and their times [cycles].

    ``plan`` has the number of components for each cycle and slot; 0 for no line.
    """
    following, last = dict.fromkeys(SLOTS, first), dict.fromkeys(SLOTS, first - 1)
    pose, start = first + 3, 0
    for cycle, components in enumerate(plan):
        if cycle == restart:
            following, last, pose = dict.fromkeys(SLOTS, 0), dict.fromkeys(SLOTS, -1), 0
            start = silence
        lines, stated = [], {}
        for slot, k in zip(SLOTS, components, strict=True):
            counters = range(following[slot], following[slot] + k)
            stated[slot] = following[slot] % 8
            if k != 1:
                stated[slot] = absent_counter(last[slot], following[slot] + k, 3)
            lines += [(Sent(cycle, slot, c % 256, k, {}), c) for c in counters]
            following[slot] += k
            last[slot] = following[slot] - 1 if k == 1 else last[slot]
        t = float(cycle + start)
        yield Sent(cycle, None, pose % 256, 1, stated), t
        pose += 1
        for i, (line, _) in enumerate(lines):
            yield line, t + 0.05 + 0.85 * i / len(lines)


class Receiver:
    """Sequence checks and the assembler, as a decoder has them."""

    def __init__(self, *, has_mixtures: bool, cycle_ns: int = CYCLE) -> None:
        self.checks = {
            slot: SequenceCheck(E2EConfig(), 256, 1, cycle_ns) for slot in (None, *SLOTS)
        }
        self.epochs: EpochAssembler[int, int] = EpochAssembler(
            dict.fromkeys(SLOTS, 3), cycle_ns, has_mixtures=has_mixtures
        )
        self.joined: list[tuple[int, int, Slot]] = []
        self.last_pose: int | None = None

    def feed(self, record: Sent, t_ns: int) -> None:
        """Receive a record."""
        check = self.checks[record.slot]
        if check.received(record.counter, hash(record[:3]), t_ns, record.components) is not None:
            return
        is_break = check.status is ProfileStatus.WRONGSEQUENCE
        if record.slot is None:
            ahead = 1 if self.last_pose is None else (record.counter - self.last_pose) % 256
            self.last_pose = record.counter
            stated = record.stated
            for joined in self.epochs.add_pose(
                record.cycle, stated, t_ns, ahead=None if is_break else ahead
            ):
                self.joined.append((joined.epoch.pose, joined.line, joined.slot))
            return
        if record.components != 1:
            return
        found = self.epochs.add_line(
            record.cycle, record.slot, record.counter, t_ns, frames=2, is_break=is_break
        )
        if found is not None:
            self.joined.append((found.epoch.pose, found.line, found.slot))


def receive(
    records: Sequence[tuple[Sent, float]], fates: Sequence[Fate], *, has_mixtures: bool
) -> Receiver:
    """Send records over a bus with faults, and check the memory of the assembler."""
    arrivals = [
        (t + fate.delay + 0.01 * copy, i, record)
        for i, ((record, t), fate) in enumerate(zip(records, fates, strict=True))
        if not fate.lost
        for copy in range(fate.copies)
    ]
    receiver = Receiver(has_mixtures=has_mixtures)
    for t, _, record in sorted(arrivals):
        receiver.feed(record, int(t * CYCLE))
        assert len(receiver.epochs.epochs) <= MAX_EPOCHS
        assert receiver.epochs.pending <= 2 * len(SLOTS)
    return receiver


def fates(n: int, most_delay: float) -> st.SearchStrategy[list[Fate]]:
    """Strategy of what happens to n records: mostly nothing, or a burst of losses."""
    fate = st.one_of(
        st.just(Fate(lost=False, delay=0.0, copies=1)),
        st.just(Fate(lost=True, delay=0.0, copies=1)),
        st.builds(
            Fate,
            lost=st.just(value=False),
            delay=st.floats(0, most_delay, exclude_max=True),
            copies=st.integers(1, 2),
        ),
    )
    return st.lists(fate, min_size=n, max_size=n)


@settings(max_examples=300, deadline=None)
@given(st.data(), st.booleans())
def test_no_line_joins_another_pose(data: st.DataObject, has_mixtures: bool) -> None:
    """Lost, late, duplicated and swapped records, slots that come and go, a restart, a wrap."""
    most = 8 if has_mixtures else 1
    cycles = st.tuples(st.integers(0, most), st.integers(0, most))
    plan = data.draw(st.lists(cycles, min_size=1, max_size=24))
    first = data.draw(st.integers(0, 255))
    restart = data.draw(st.none() | st.integers(0, len(plan)))
    records = list(sent(plan, first, restart, silence=7))
    delay = 0.5 if has_mixtures else 2.0
    of_records = data.draw(fates(len(records), delay))
    receiver = receive(records, of_records, has_mixtures=has_mixtures)
    wrong = [(pose, line, slot) for pose, line, slot in receiver.joined if pose != line]
    assert not wrong
    assert len(receiver.joined) == len(set(receiver.joined))


@pytest.mark.parametrize(("has_mixtures", "delay"), [(False, 2.0), (True, 0.5)])
def test_no_line_joins_another_pose_on_a_bad_bus(has_mixtures: bool, delay: float) -> None:
    """Half of the records are lost, a third are late; slots come and go at random."""
    rng = np.random.default_rng(14)
    joined = 0
    for _ in range(60):
        present = rng.random((60, 2)) < 0.6
        of_lines = [1, 1, 1, 1, 2, 3, 4, 7, 8] if has_mixtures else [1]
        components = rng.choice(of_lines, (60, 2))
        plan = (present * components).tolist()
        records = list(sent(plan, int(rng.integers(256)), None, 0))
        of_records = [
            Fate(
                lost=bool(rng.random() < 0.5),
                delay=float(rng.uniform(0, delay)) if rng.random() < 1 / 3 else 0.0,
                copies=1,
            )
            for _ in records
        ]
        receiver = receive(records, of_records, has_mixtures=has_mixtures)
        assert not [pair for pair in receiver.joined if pair[0] != pair[1]]
        joined += len(receiver.joined)
    assert joined > 300


@pytest.mark.parametrize("first", [0, 200, 255])
@pytest.mark.parametrize("has_mixtures", [False, True])
def test_without_faults_each_line_joins(first: int, has_mixtures: bool) -> None:
    """Over two rounds of the counter, with a slot that comes and goes, and mixtures."""
    plan = [(1, (1, 0, 1, 1, 5 * has_mixtures)[i % 5]) for i in range(600)]
    records = list(sent(plan, first, None, 0))
    good = [Fate(lost=False, delay=0.0, copies=1)] * len(records)
    receiver = receive(records, good, has_mixtures=has_mixtures)
    single = [(r.cycle, r.cycle, r.slot) for r, _ in records if r.slot and r.components == 1]
    left = [(r.cycle, r.cycle, r.slot) for r, _ in records if r.slot is Slot.EGO_LEFT]
    assert sorted(receiver.joined) == sorted({*single, *left})
    assert receiver.epochs.latest is not None
    assert receiver.epochs.latest.pose == 598  # 599 lacks a slot that it has


def test_a_lost_pose_costs_the_lines_of_its_cycle_only() -> None:
    """They are dropped and counted when the next line of the slot comes, or after three cycles."""
    records = list(sent([(1, 1)] * 10, 0, None, 0))
    lost = [Fate(lost=r.slot is None and r.cycle == 4, delay=0.0, copies=1) for r, _ in records]
    receiver = receive(records, lost, has_mixtures=False)
    assert {line for _, line, _ in receiver.joined} == set(range(10)) - {4}
    assert receiver.epochs.counts == {Reason.POSE: 4}


def test_a_line_may_come_before_its_pose() -> None:
    """By up to a cycle; two epochs at once."""
    for late, joins in ((0.9, True), (1.2, False)):
        records = list(sent([(1, 0)] * 3, 5, None, 0))
        of_records = [
            Fate(lost=False, delay=late if r.slot is None and r.cycle == 2 else 0.0, copies=1)
            for r, _ in records
        ]
        receiver = receive(records, of_records, has_mixtures=False)
        assert ((2, 2, Slot.EGO_LEFT) in receiver.joined) is joins


def test_a_line_waits_three_cycles() -> None:
    """Then it is dropped with a reason."""
    epochs: EpochAssembler[str, str] = EpochAssembler({Slot.ROUTE: 3}, 100, has_mixtures=False)
    assert epochs.add_line("line", Slot.ROUTE, 9, 1000, frames=2) is None
    epochs.expire(1300)
    assert (epochs.pending, epochs.counts) == (2, {})
    epochs.expire(1301)
    assert (epochs.pending, epochs.counts) == (0, {Reason.POSE: 2})


def test_the_window_shrinks_with_the_cycle_of_a_fast_sender() -> None:
    """At a tenth of the cycle of the DBC, eight records pass within the window of the DBC."""
    epochs: EpochAssembler[int, int] = EpochAssembler({Slot.ROUTE: 3}, 1000, has_mixtures=False)
    for i in range(6):
        epochs.add_pose(i, {Slot.ROUTE: i}, 100 * i)
    # The pose errors 6 to 13 and the line 5 are lost; line 13 has the same low bits.
    assert epochs.add_line(13, Slot.ROUTE, 13, 1310) is None
    assert epochs.add_line(4, Slot.ROUTE, 4, 680) is not None


def test_after_a_sequence_break_nothing_joins_what_came_before() -> None:
    """Of the pose errors, or of the slot."""
    for of_pose in (True, False):
        epochs: EpochAssembler[str, str] = EpochAssembler({Slot.ROUTE: 3}, 100, has_mixtures=False)
        epochs.add_pose("before", {Slot.ROUTE: 0}, 1000)
        if of_pose:
            epochs.add_pose("after", {Slot.ROUTE: 5}, 1010, ahead=None)
        assert epochs.add_line("after", Slot.ROUTE, 0, 1020, is_break=not of_pose) is None
        assert epochs.latest is None


def test_a_line_that_fits_two_pose_errors_joins_none() -> None:
    """Nor does a second line of a slot."""
    epochs: EpochAssembler[str, str] = EpochAssembler({Slot.ROUTE: 3}, 100, has_mixtures=False)
    epochs.add_pose("first", {Slot.ROUTE: 2}, 1000)
    assert epochs.add_line("one", Slot.ROUTE, 2, 1010) is not None
    assert epochs.add_line("two", Slot.ROUTE, 10, 1020) is None
    epochs.add_pose("second", {Slot.ROUTE: 7}, 1100)
    epochs.add_pose("third", {Slot.ROUTE: 7}, 1200)
    assert epochs.add_line("three", Slot.ROUTE, 15, 1210) is None


def assembler(*, has_mixtures: bool = False) -> EpochAssembler[str, str]:
    """Return an assembler for pose errors every 100 ns."""
    return EpochAssembler({Slot.ROUTE: 3, Slot.CENTRE: 3}, 100, has_mixtures=has_mixtures)


@pytest.mark.parametrize("beyond", [0, 1])
@pytest.mark.parametrize(("has_mixtures", "late_ns"), [(False, 300), (True, 150)])
def test_the_window_of_a_line(has_mixtures: bool, late_ns: int, beyond: int) -> None:
    """From one cycle before its pose error to three after it; half of that with mixtures."""
    epochs = assembler(has_mixtures=has_mixtures)
    assert epochs.add_pose("pose", {Slot.ROUTE: 1}, 1000) == []
    joined = epochs.add_line("late", Slot.ROUTE, 9, 1000 + late_ns + beyond)
    assert (joined is None) is bool(beyond)
    epochs = assembler(has_mixtures=has_mixtures)
    assert epochs.add_line("early", Slot.ROUTE, 9, 1000 - late_ns // 3 - beyond) is None
    assert len(epochs.add_pose("pose", {Slot.ROUTE: 1}, 1000)) == 1 - beyond


@pytest.mark.parametrize("t_ns", [1501, 499])
def test_old_pose_errors_are_forgotten(t_ns: int) -> None:
    """After five cycles, in either direction of the clock."""
    epochs = assembler()
    epochs.add_pose("pose", {}, 1000)
    epochs.expire(1500)
    epochs.expire(500)
    assert len(epochs.epochs) == 1
    epochs.expire(t_ns)
    assert not epochs.epochs


@pytest.mark.parametrize("t_ns", [1301, 699])
def test_a_line_does_not_wait_for_long_while_others_come(t_ns: int) -> None:
    """It is dropped with the next line or pose error after three cycles, or on another clock."""
    for adds_pose in (True, False):
        epochs = assembler()
        assert epochs.add_line("line", Slot.ROUTE, 9, 1000, frames=2) is None
        if adds_pose:
            epochs.add_pose("pose", {}, t_ns)
        else:
            epochs.add_line("other", Slot.CENTRE, 9, t_ns)
        assert (epochs.pending, epochs.counts) == (0, {Reason.POSE: 2})


def test_eight_pose_errors_are_kept() -> None:
    """However fast they come: one for each value of the three bits that they state for a slot."""
    epochs = assembler()
    for i in range(20):
        epochs.add_pose(f"{i}", {}, 1000 + i)
    assert [epoch.pose for epoch in epochs.epochs] == [f"{i}" for i in range(12, 20)]


@pytest.mark.parametrize(("fast", "window_ns"), [(2, 300), (3, 60)])
def test_the_window_follows_most_of_the_last_five_intervals(fast: int, window_ns: int) -> None:
    """Two short intervals are jitter, three are a sender that is five times faster."""
    for late_ns in (window_ns, window_ns + 1):
        epochs = assembler()
        for t_ns in [*range(0, 600, 100), *range(520, 521 + 20 * (fast - 1), 20)]:
            epochs.add_pose("pose", {Slot.ROUTE: 1} if t_ns == 500 else {}, t_ns)
        joined = epochs.add_line("line", Slot.ROUTE, 1, 500 + late_ns)
        assert (joined is not None) is (late_ns == window_ns)


@pytest.mark.parametrize(("late_ns", "joins"), [(30, True), (31, False)])
def test_lost_pose_errors_do_not_make_a_sender_slower(late_ns: int, joins: bool) -> None:
    """The interval between two pose errors is divided by the difference of their counters."""
    epochs = assembler()
    epochs.add_pose("before", {}, 1000)
    epochs.add_pose("pose", {Slot.ROUTE: 1}, 1030, ahead=3)
    assert (epochs.add_line("line", Slot.ROUTE, 1, 1030 + late_ns) is not None) is joins


def test_a_time_stamp_may_be_before_the_last_one() -> None:
    """The window is never negative."""
    epochs = assembler()
    epochs.add_pose("before", {}, 1000)
    epochs.add_pose("pose", {Slot.ROUTE: 1}, 980)
    assert epochs.add_line("line", Slot.ROUTE, 1, 985) is not None


def test_a_restarted_sender_has_the_window_of_the_dbc() -> None:
    """That of the sender before it is forgotten, and so are the lines that waited."""
    epochs = assembler()
    for i in range(6):
        epochs.add_pose("before", {}, 1000 + 10 * i)
    assert epochs.add_line("waiting", Slot.ROUTE, 1, 1060, frames=2) is None
    assert epochs.add_pose("after", {Slot.ROUTE: 1, Slot.CENTRE: 1}, 1060, ahead=None) == []
    assert (epochs.pending, epochs.counts) == (0, {Reason.POSE: 2})
    assert epochs.add_line("line", Slot.CENTRE, 1, 1360) is not None


@pytest.mark.parametrize(("pose_ns", "joins"), [(999, False), (1000, True)])
def test_after_a_sequence_break_a_line_waits_for_a_later_pose(pose_ns: int, joins: bool) -> None:
    """Whose first frame was not received before that of the line."""
    epochs = assembler()
    assert epochs.add_line("line", Slot.ROUTE, 1, 1000, is_break=True) is None
    assert bool(epochs.add_pose("pose", {Slot.ROUTE: 1}, pose_ns)) is joins


def test_a_slot_that_pose_errors_do_not_state() -> None:
    """Its lines belong to none, whatever the pose error says."""
    epochs = assembler()
    epochs.add_pose("pose", {Slot.EGO_LEFT: 1}, 1000)
    assert epochs.add_line("line", Slot.EGO_LEFT, 1, 1000) is None


def test_the_latest_epoch_is_that_of_the_newest_pose_error() -> None:
    """Lines for the cycle before do not change that; of equal times, the last one is newer."""
    epochs = assembler()
    for pose, counter, t_ns in (("first", 1, 1000), ("second", 2, 1100), ("third", 3, 1100)):
        epochs.add_pose(pose, {Slot.ROUTE: counter, Slot.CENTRE: counter}, t_ns)
    for counter, slot, latest in (
        (2, Slot.ROUTE, "second"),
        (1, Slot.ROUTE, "second"),
        (3, Slot.ROUTE, "third"),
        (1, Slot.CENTRE, "third"),
    ):
        assert epochs.add_line("line", slot, counter, 1110) is not None
        assert epochs.latest is not None
        assert epochs.latest.pose == latest


def test_the_latest_epoch_after_the_clock_was_set_back() -> None:
    """It is that of the new time."""
    epochs = assembler()
    for pose, t_ns in (("before", 10**9), ("after", 0)):
        epochs.add_pose(pose, {Slot.ROUTE: 1}, t_ns)
        epochs.add_line("line", Slot.ROUTE, 1, t_ns)
        assert epochs.latest is not None
        assert epochs.latest.pose == pose
