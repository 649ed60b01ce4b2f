"""Each kind of fault does what it says, at its rate, and is counted."""

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from answers import one
from hypothesis import given, settings
from hypothesis import strategies as st
from support.dbcs import default_codec
from support.fault_streams import MIX, bits_apart, content, number_of, numbered, run

from maplines_can.study import road
from maplines_can.testing import FaultInjector, FaultKind, Faults, Interval, ScriptedFault
from maplines_can.testing.scripted_fault import LENGTHS
from maplines_can.values.line import MapLine, Slot
from maplines_can.wire import Frame


def check_sums(injector: Any) -> None:
    done = injector.counts
    came = injector.frames + done[FaultKind.DUPLICATED] + done[FaultKind.FLOODED]
    assert came == injector.passed + done[FaultKind.LOST] + injector.held


def flipped(before: Any, after: Any) -> Any:
    return len(after.data) == 8 and 1 <= bits_apart(before.data, after.data) <= 3


def truncated(before: Any, after: Any) -> Any:
    return len(after.data) < 8 and before.data.startswith(after.data)


def wrong_id(before: Any, after: Any) -> Any:
    return (before.can_id ^ after.can_id).bit_count() == 1 and before.data == after.data


def garbage(before: Any, after: Any) -> Any:
    return len(after.data) == 8 and before.data != after.data


@pytest.mark.parametrize(
    ("field", "kind", "holds"),
    [
        pytest.param("flip", FaultKind.FLIPPED, flipped, id="flip"),
        pytest.param("truncate", FaultKind.TRUNCATED, truncated, id="truncate"),
        pytest.param("wrong_dlc", FaultKind.WRONG_DLC, truncated, id="wrong-dlc-of-full-frames"),
        pytest.param("wrong_id", FaultKind.WRONG_ID, wrong_id, id="wrong-id"),
        pytest.param("garbage", FaultKind.GARBAGE, garbage, id="garbage"),
    ],
)
def test_damage_at_rate_1_changes_every_frame(field: str, kind: Any, holds: Any) -> None:
    """Each frame is damaged in the same way, keeps its place, and is counted."""
    injector = FaultInjector[Any](Faults(**{field: 1.0}))  # type: ignore[arg-type]
    frames = numbered(500)
    out = run(injector, frames)
    assert len(out) == 500
    assert all(holds(*pair) for pair in zip(frames, out, strict=True))
    assert injector.counts == {kind: 500}


def test_a_wrong_length_is_a_length_of_can_fd() -> None:
    """A frame that is cut short or padded can still be sent."""
    for field in ("truncate", "wrong_dlc"):
        frames = [Frame(0x348, bytes([255] * 32), True) for _ in range(500)]
        out = run(FaultInjector(Faults(**{field: 1.0})), frames)  # type: ignore[arg-type]
        lengths = {len(frame.data) for frame in out}
        longest = 24 if field == "truncate" else 64
        assert lengths == {n for n in LENGTHS if n <= longest and n != 32}
        assert all(frame.data == (b"\xff" * 32)[:n].ljust(n, b"\0") for frame in out
                   for n in [len(frame.data)])  # fmt: skip


def test_a_fault_without_effect_is_not_counted() -> None:
    injector = FaultInjector[Any](Faults(flip=0.4, truncate=0.3, garbage=0.3))
    frames = [Frame(1, b"")] * 50
    assert run(injector, frames) == frames
    assert injector.counts == {}


def test_29_bit_ids_stay_29_bit_ids() -> None:
    frames = [Frame(0x18FF3400, b"data", False, True)] * 300
    out = run(FaultInjector(Faults(wrong_id=1.0)), frames)
    assert all(frame.is_extended and frame.can_id <= 0x1FFFFFFF for frame in out)
    assert len({frame.can_id for frame in out}) == 29


def test_rates_are_kept() -> None:
    """Each within five standard deviations of the binomial distribution."""
    faults = Faults.parse(f"{MIX},garbage=0.03,late=0.2,delay=1")
    injector, n = FaultInjector[Any](faults), 50_000
    run(injector, numbered(n))
    kept = n - injector.counts[FaultKind.LOST]
    copies = kept + injector.counts[FaultKind.DUPLICATED]
    in_order = copies - injector.counts[FaultKind.REORDERED]
    for kind, rate, of in (
        (FaultKind.LOST, 0.1, n),
        (FaultKind.DUPLICATED, 0.05, kept),
        (FaultKind.REORDERED, 0.05, copies),
        (FaultKind.FLIPPED, 0.005, copies),
        (FaultKind.TRUNCATED, 0.005, copies),
        (FaultKind.WRONG_DLC, 0.005, copies),
        (FaultKind.WRONG_ID, 0.005, copies),
        (FaultKind.GARBAGE, 0.03, copies),
        (FaultKind.DELAYED, 0.2, in_order),
    ):
        sigma = math.sqrt(of * rate * (1 - rate))
        assert injector.counts[kind] == pytest.approx(of * rate, abs=5 * sigma), kind


def test_the_seed_decides() -> None:
    """The same seed gives the same frames; another seed or another stream gives others."""

    def outcome(seed: Any, stream: str = "") -> Any:
        return run(FaultInjector(Faults.parse(f"{MIX},seed={seed}"), stream=stream), numbered(500))

    assert outcome(1) == outcome(1)
    assert outcome(1) != outcome(2)
    assert outcome(1, "send") != outcome(1, "receive")


@given(st.integers(1, 9), st.integers(0, 2**32))
def test_no_frame_is_held_back_by_more_than_depth(depth: int, seed: int) -> None:
    """None is passed on after a frame that was sent more than ``depth`` later."""
    injector = FaultInjector[Any](Faults(reorder=0.4, depth=depth, seed=seed))
    newest = 0
    for frame in run(injector, numbered(60)):
        assert newest - number_of(frame) <= depth
        newest = max(newest, number_of(frame))


RATES = st.sampled_from([0.0, 0.01, 0.1, 0.5])

FAULTS = st.builds(
    Faults,
    loss=RATES, duplicate=RATES, reorder=RATES, depth=st.integers(1, 12),
    late=RATES, delay=st.sampled_from([0.0, 0.001]), jitter=st.sampled_from([0.0, 0.005]),
    flip=st.sampled_from([0, 0.1]), truncate=st.sampled_from([0, 0.1]),
    wrong_dlc=st.sampled_from([0, 0.1]), wrong_id=st.sampled_from([0, 0.1]),
    garbage=st.sampled_from([0, 0.1]), flood=st.sampled_from([0.0, 500.0]),
    flood_ids=st.sampled_from([(0,), tuple(range(0x33F, 0x351))]), seed=st.integers(0, 2**32),
)  # fmt: skip


@given(FAULTS)
def test_every_frame_is_accounted_for(faults: Any) -> None:
    """Taken, duplicated and flooded frames are lost, held back or passed on, at any time."""
    injector = FaultInjector[Any](faults)
    passed = 0
    for i, frame in enumerate(numbered(100)):
        passed += len(injector.apply(frame, i * 1e-3))
        passed += len(injector.due(i * 1e-3 + 5e-4))
        check_sums(injector)
    passed += len(injector.flush())
    check_sums(injector)
    assert injector.held == 0
    assert passed == injector.passed
    assert injector.as_dict()["passed"] == injector.passed


def test_a_delayed_frame_is_passed_on_when_it_is_due() -> None:
    injector = FaultInjector[Any](Faults(delay=0.02))
    (a, b) = numbered(2)
    assert injector.apply(a, 1.0) == []
    assert injector.next_due == pytest.approx(1.02)
    assert injector.due(1.019) == []
    assert injector.apply(b, 1.021) == [a]
    assert injector.due(2.0) == [b]
    assert injector.next_due == math.inf


def test_jitter_reorders_frames() -> None:
    injector = FaultInjector[Any](Faults(delay=0.1, jitter=0.05, seed=3))
    out = run(injector, numbered(200), step=0.001)
    late = [number_of(frame) for frame in out]
    assert sorted(late) == list(range(200))
    assert late != sorted(late)


def test_a_flood_has_its_rate_and_its_ids() -> None:
    """250 frames a second for two seconds."""
    injector = FaultInjector[Any](Faults(flood=250.0, flood_ids=(0, 0x340, 0x18FF0000)))
    injector.due(10.0)
    out = [frame for i in range(1, 201) for frame in injector.due(10.0 + i / 100)]
    assert len(out) == pytest.approx(500, abs=1)
    assert {(f.can_id, f.is_extended) for f in out} == {
        (0, False),
        (0x340, False),
        (0x18FF0000, True),
    }
    assert injector.counts == {FaultKind.FLOODED: len(out)}


def test_a_flood_does_not_make_up_for_an_hour() -> None:
    injector = FaultInjector[Any](Faults(flood=1000.0))
    injector.due(0.0)
    (*batches, last) = iter(lambda: injector.due(3600.0), [])
    assert {len(batch) for batch in batches} == {32}
    assert 32 * len(batches) + len(last) == pytest.approx(1000, abs=1)
    assert injector.left_out == pytest.approx(3599 * 1000, abs=1)
    assert injector.next_due > 3600.0


def test_a_flood_of_a_tiny_rate_never_starts() -> None:
    injector = FaultInjector[Any](Faults(flood=5e-324))
    assert injector.due(0.0) == injector.due(3600.0) == []


def test_ids_of_a_flood_are_drawn_from_ranges_and_single_ids_alike() -> None:
    """A range may have any length: it is not expanded."""

    def ids(flood_ids: Any) -> Any:
        injector = FaultInjector[Any](Faults(flood=1000.0, flood_ids=flood_ids))
        injector.due(0.0)
        return [f.can_id for i in range(1, 501) for f in injector.due(i / 100)]

    some = ids((7, *range(0x340, 0x348), 9))
    assert some == ids((7, range(0x340, 0x348), 9))
    assert set(some) == {7, *range(0x340, 0x348), 9}
    assert set(ids(range(5))) == set(range(5))
    assert max(ids((0, range(0x20000000)))) > 0x10000000
    assert Faults.parse("flood=1,flood_ids=0-0x1fffffff").flood_ids == (range(0x20000000),)


@pytest.mark.parametrize(
    ("script", "numbers"),
    [
        pytest.param("loss 3", [1, 2, 4, 5, 6], id="loss"),
        pytest.param("loss 2-4", [1, 5, 6], id="range"),
        pytest.param("dup 2", [1, 2, 2, 3, 4, 5, 6], id="duplicate"),
        pytest.param("reorder 2 2", [1, 3, 4, 2, 5, 6], id="reorder"),
        pytest.param("reorder 6 2", [1, 2, 3, 4, 5, 6], id="reorder-the-last"),
        pytest.param("dup 2\nreorder 2 3", [1, 2, 3, 4, 5, 2, 6], id="late-duplicate"),
        pytest.param("delay 2 0.02", [1, 3, 2, 4, 5, 6], id="delay"),
        pytest.param("loss 1\nloss 6\ndup 4", [2, 3, 4, 4, 5], id="several"),
        pytest.param("loss 9", [1, 2, 3, 4, 5, 6], id="never"),
    ],
)
def test_a_script_names_faults_of_single_frames(script: str, numbers: Any) -> None:
    """Frames are counted from 1 and are 10 ms apart."""
    faults = Faults(script=[ScriptedFault.parse(line) for line in script.splitlines()])  # type: ignore[arg-type]
    out = run(FaultInjector(faults), numbered(7)[1:], step=0.01)
    assert [number_of(frame) for frame in out] == numbers


@pytest.mark.parametrize(
    ("line", "holds"),
    [
        pytest.param("flip 1 12", lambda f: bits_apart(f.data, bytes(8)) == 12, id="flip"),
        pytest.param("flip 1", lambda f: 1 <= bits_apart(f.data, bytes(8)) <= 3, id="flip-some"),
        pytest.param("flip 1 512", lambda f: f.data == b"\xff" * 8, id="flip-all"),
        pytest.param("truncate 1 4", lambda f: f.data == bytes(4), id="truncate"),
        pytest.param("wrong_dlc 1 5", lambda f: f.data == bytes(5), id="wrong-dlc"),
        pytest.param("wrong_id 1 0x123", lambda f: f.can_id == 0x123, id="wrong-id"),
        pytest.param("wrong_id 1 0x800", lambda f: f.is_extended, id="extended-id"),
        pytest.param("garbage 1", lambda f: f.data != bytes(8), id="garbage"),
    ],
)
def test_a_script_damages_a_frame_by_its_value(line: str, holds: Any) -> None:
    (frame,) = run(
        FaultInjector(Faults(script=[ScriptedFault.parse(line)])),  # type: ignore[arg-type]
        [Frame(0x340, bytes(8))],
    )
    assert holds(frame)


def test_rates_apply_to_the_frames_that_the_script_does_not_name() -> None:
    faults = Faults(loss=1.0, script=[ScriptedFault.parse("dup 2")])  # type: ignore[arg-type]
    assert [number_of(f) for f in run(FaultInjector(faults), numbered(9))] == [1, 1]


@cache
def sent_lines(n: int = 120, fd: bool = False) -> Any:
    """Frames of n lines of three slots in turn, and the numbers of the lines by their content."""
    codec = default_codec()
    means, covs = road(n, seed=3)
    slots = np.arange(n) % 3
    payloads = codec.batch.encode(means, covs, slot=slots, counter=np.arange(n) // 3)
    frames = [
        codec.encoder().frames(p, Slot(int(s)), fd=fd) for p, s in zip(payloads, slots, strict=True)
    ]
    known = {
        content(codec.batch.decode_one(p.tobytes(), Slot(s))): i  # type: ignore[arg-type]
        for i, (p, s) in enumerate(zip(payloads, slots, strict=True))
    }
    assert len(known) == n
    return frames, known


@settings(max_examples=150, deadline=None)
@given(FAULTS, st.booleans())
def test_whatever_the_faults_lines_are_sent_ones_and_delivered_once(faults: Any, fd: bool) -> None:
    """Bit for bit; and every frame is accounted for, by the injector and by the decoder."""
    frames, known = sent_lines(fd=fd)
    codec = default_codec()
    injector, decoder, delivered = FaultInjector[Any](faults), codec.decoder(), list[Any]()

    def receive(out: Any, now: Any) -> None:
        for frame in out:
            answer = one(
                decoder.feed(
                    frame.can_id, frame.data, round(now * 1e9), is_extended=frame.is_extended
                )
            )
            if isinstance(answer, MapLine):
                delivered.append(content(answer))

    now = 0.0
    for transfer in frames:
        for frame in transfer:
            now += 0.5e-3
            receive(injector.apply(frame, now), now)
    receive(injector.flush(), now)
    assert set(delivered) <= set(known)
    assert len(delivered) == len(set(delivered)) == decoder.lines
    assert decoder.frames == injector.passed
    assert decoder.frames == decoder.line_frames + sum(decoder.counts.values()) + decoder.pending


TIMES = st.floats(0, 20) | st.integers(0, 20).map(float)
INTERVALS = st.lists(
    st.tuples(TIMES, TIMES | st.just(math.inf)).filter(lambda t: t[0] < t[1]),
    min_size=1,
    max_size=4,
)


@given(intervals=INTERVALS, times=st.lists(TIMES, min_size=1), start=st.floats(-1e3, 1e3))
def test_a_frame_is_lost_in_an_interval_and_only_there(
    intervals: list[Any], times: list[float], start: float
) -> None:
    """Whatever the intervals, which may overlap, from `start` on."""
    injector = FaultInjector[Any](Faults(loss=1.0, schedule=[("loss", *i) for i in intervals]))  # type: ignore[arg-type]
    injector.start(start)
    for elapsed in sorted(times):
        now = start + elapsed
        lost = any(begin <= now - start < end for begin, end in intervals)
        assert bool(injector.apply(Frame(1, b""), now)) != lost


@given(intervals=INTERVALS, calls=st.lists(st.floats(0.01, 0.9), min_size=1, max_size=30))
def test_a_flood_flows_in_its_intervals_and_only_there(
    intervals: list[Any], calls: list[float]
) -> None:
    """10 frames a second, however often it is called; the time of each is `next_due`."""
    faults = Faults(flood=10.0, schedule=[("flood", *i) for i in intervals])  # type: ignore[arg-type]
    injector, now, due = FaultInjector[Any](faults), 0.0, []
    injector.start(now)
    for wait in calls:
        now += wait
        while injector.next_due <= now:
            due.append(injector.next_due)
            assert len(injector.due(injector.next_due)) == 1
    assert all(any(b < t < e for b, e in intervals) for t in due)
    expected = sum(
        math.ceil(10 * (min(end, now) - begin) - 1 - 1e-9)
        for begin, end in faults.intervals("flood")
        if begin < now
    )
    assert len(due) == pytest.approx(max(expected, 0), abs=len(intervals))
    assert injector.left_out == 0
    assert injector.counts[FaultKind.FLOODED] == len(due)


def test_a_flood_that_nobody_asked_for_is_left_out_in_its_intervals_only() -> None:
    """10 frames a second from 1 s to 2 s and from 5 s on, asked for at 7 s."""
    injector = FaultInjector[Any](Faults.parse("flood=10@1-2+5-"))
    injector.start(0.0)
    made = injector.due(7.0)
    assert len(made) + injector.left_out == pytest.approx(9 + 20, abs=1)
    assert len(made) == pytest.approx(10, abs=1)


def test_the_injection_starts_with_the_first_frame() -> None:
    injector = FaultInjector[Any](Faults.parse("loss=1@1-2"))
    passed = [bool(injector.apply(Frame(1, b""), 1e6 + 0.25 * k)) for k in range(12)]
    assert passed == [not 4 <= k < 8 for k in range(12)]


def test_new_faults_begin_anew_and_the_counters_go_on() -> None:
    """Seed, intervals and the frames of the script; frames that are held back remain so."""
    script = (ScriptedFault(FaultKind.LOST, 2, 2),)
    faults = Faults(delay=900.0, schedule=(Interval("delay", 0.0, 1.0),), script=script)
    injector = FaultInjector[Any](faults)
    for _ in range(2):
        begin = injector.frames
        assert [bool(injector.apply(Frame(k, b""), 10.0 * begin)) for k in range(2)] == [False] * 2
        assert injector.apply(Frame(9, b""), 10.0 * begin + 1.0)
        injector.faults = faults
    assert (injector.frames, injector.held) == (6, 2)
    assert injector.counts == {FaultKind.LOST: 2, FaultKind.DELAYED: 2}
    injector.faults = Faults()
    assert [frame.can_id for frame in injector.apply(Frame(5, b""), 1e3)] == [0, 0, 5]
    same = [FaultInjector[Any](Faults.parse("loss=0.5,seed=4")) for _ in range(2)]
    same[1].apply(Frame(1, b""))
    same[1].faults = same[1].faults
    answers = [[bool(one.apply(Frame(1, b""))) for _ in range(50)] for one in same]
    assert answers[0] == answers[1]
