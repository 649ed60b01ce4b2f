"""The receiver of the model: its rules by example, and the core beside it on hostile streams."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest
from random_dbc import SCENE_SEED, random_dbc
from scene_layouts import layout_of
from support.c_layouts import unusual_layouts

from maplines_can import Kind, Slot, Status
from maplines_can.model import (
    decoder,
    e2e,
    epochs,
    levels,
    lines,
    mixtures,
    reassembly,
    scenes,
    secoc,
    senders,
    sequence,
    settings,
    whole_scenes,
)
from maplines_can.model.records import written
from maplines_can.testing.back_to_back import START_US, Pair, compare, profiles_of
from maplines_can.testing.hostile_streams import (
    PROFILES,
    SECURED_PROFILES,
    FrameStep,
    Question,
    Stream,
    traffics_of,
)
from maplines_can.wire import POSE, SHIPPED, Layout, Owner
from maplines_can.wire.layout.scene_layout import SceneLayout

MS = 1_000_000
CYCLE = 50 * MS
COMPLETE, SECURED, CONDITIONAL = "maplines.dbc", "maplines-secoc.dbc", "maplines-pose.dbc"
WHOLE = "maplines-scene.dbc"
SLOT = Slot.EGO_LEFT


# ---- streams ------------------------------------------------------------------------------------


def check_streams(layout: Layout, seed: int, frames: int, step: int = 1) -> None:
    """Compare streams of each profile, or of every so-many-th one."""
    traffics = traffics_of(layout, seed)
    for i, profile in enumerate(profiles_of(layout)[::step]):
        result = compare(traffics, profile, frames, 100 * seed + i)
        assert result.difference is None, str(result.difference)
        assert result.frames == frames


@pytest.mark.parametrize("dbc", sorted({*SHIPPED, WHOLE}))
def test_core_and_model_are_equal_on_hostile_streams(dbc: str) -> None:
    """Every decoded double, reason, counter and state, after each frame."""
    check_streams(layout_of(dbc), seed=1, frames=40 if dbc == WHOLE else 150)


@pytest.mark.parametrize("name", sorted(unusual_layouts()))
def test_they_are_equal_with_unusual_dbcs(name: str) -> None:
    """Without a pose error, with some messages or slots only, with short counters."""
    check_streams(unusual_layouts()[name], seed=2, frames=60, step=3)


@pytest.mark.parametrize(
    ("seed", "frames"), [(0, 60), (1, 60), (2, 60), (SCENE_SEED, 20), (504, 10)]
)
def test_they_are_equal_with_random_dbcs(seed: int, frames: int) -> None:
    """Other places, byte orders, lengths and factors."""
    check_streams(Layout.from_text(random_dbc(seed)), seed=3, frames=frames, step=3)


def of_name(name: str) -> Any:
    return next(one for one in (*PROFILES, *SECURED_PROFILES) if one.name == name)


def met_by(pair: Pair, step: Any, states: dict[Any, str]) -> Iterator[str]:
    """Yield what a step has met: kinds of answers, changes of states, gaps, wraps of counters."""
    if isinstance(step, Question):
        if step.kind in ("latest", "scene"):
            yield f"{step.kind} {pair.answer.state}"
            yield from (f"{step.kind} usable" for _ in range(pair.answer.is_usable))
            yield from (f"{step.kind} two senders" for _ in range(pair.answer.may_be_two))
            yield from (f"{step.kind} stale" for _ in range(pair.answer.is_stale))
            yield from (f"left out: {why}" for why in (pair.answer.left_out,) if why)
    elif isinstance(pair.answer, str):
        yield pair.answer
    else:
        for line in pair.answer:
            yield f"Status.{line.status.name}"
            yield "mixture" if line.components else "line"
            yield "too old" if math.isinf(line.age) else "age"
        yield from ("lines of a pose error" for _ in range(len(pair.answer) > 1))
    for owner, check in pair.model.checks.items():
        last, state = check.last, check.state
        if state != states.get(owner, "NODATA"):
            yield f"{states.get(owner, 'NODATA')} to {state}"
        states[owner] = state
        before = states.get(("last", owner))
        if last is not None and before is not None and last != int(before):
            yield "wrapped" if last < int(before) and check.ahead is not None else "counted"
            yield from ("break" for _ in range(check.ahead is None))
        states["last", owner] = str(last) if last is not None else "0"


#: Streams with the numbers of their frames, and how often is asked.
STREAMS = [
    (COMPLETE, "faults", 1300, 0.05),
    (COMPLETE, "hostile", 900, 0.05),
    (COMPLETE, "two senders, same counters", 600, 0.05),
    (COMPLETE, "restarts", 600, 0.05),
    (COMPLETE, "narrow windows", 400, 0.05),
    (COMPLETE, "clock of another unit", 1900, 0.05),
    (CONDITIONAL, "faults", 600, 0.05),
    (CONDITIONAL, "any content", 600, 0.05),
    (SECURED, "authenticated, faults", 600, 0.05),
    (SECURED, "authenticated, without a key", 60, 0.05),
    (SECURED, "not authenticated", 60, 0.05),
    (WHOLE, "faults", 400, 0.5),
    (WHOLE, "any content", 900, 0.5),
]
REACHED = {
    *("FOREIGN", "LENGTH", "PAGE", "DUPLICATE", "REPLACED", "STALE", "INCOMPLETE", "TIMEOUT"),
    *("MIXED", "CRC", "CONTENT", "POSE", "UNAUTHENTICATED", "KEY", "MAC", "REPLAY", "AGE"),
    "SPACING",
    *e2e.STATUSES,
    *("NODATA to INIT", "INIT to VALID", "INIT to INVALID", "VALID to INVALID"),
    *("INVALID to VALID", "wrapped", "counted", "break", "lost"),
    *(f"Status.{status.name}" for status in Status),
    *("line", "mixture", "age", "too old", "lines of a pose error"),
    *("latest INIT", "latest VALID", "latest INVALID", "latest NODATA", "latest usable"),
    *("latest two senders", "latest stale", "scene VALID", "scene usable", "scene stale"),
    *("scene two senders", "two senders are confirmed"),
    *(f"left out: {why}" for why in whole_scenes.REASONS),
}


def test_the_streams_of_a_seed_reach_every_rule() -> None:
    """Each reason, status, change of state and kind of answer, more than once."""
    met = Counter[str]()
    for dbc, name, frames, ask in STREAMS:
        pair = Pair(layout_of(dbc), replace(of_name(name), ask=ask))
        sign = pair.sign if pair.profile.is_signed else None
        stream = Stream(traffics_of(layout_of(dbc), 1), pair.profile, 7, sign, START_US)
        states: dict[Any, str] = {}
        for step in stream.steps():
            assert not [*pair.differences(step)]
            met.update(met_by(pair, step, states))
            if pair.model.frames >= frames:
                break
        met.update(pair.model.counts)
        for check in pair.model.checks.values():
            met.update(check.statuses)
            met.update({"lost": check.lost, "two senders are confirmed": check.senders.are_two})
    assert {name: met[name] for name in REACHED if met[name] < 2} == {}


# ---- a fault of a rule is found -----------------------------------------------------------------

FAULTS = [
    pytest.param(e2e, "OKS", ("OK",), COMPLETE, "faults", id="lost-records-are-no-OK"),
    pytest.param(sequence, "GRACE_CYCLES", 1.6, COMPLETE, "faults", id="deadline"),
    pytest.param(sequence, "RESTART_RECORDS", 4, COMPLETE, "restarts", id="restart"),
    pytest.param(sequence, "FASTEST", 5, COMPLETE, "very fast sender", id="pace"),
    pytest.param(sequence, "MEAN_LINES", 7, COMPLETE, "fast sender", id="mean-pace"),
    pytest.param(senders, "CONFLICTS", 9, COMPLETE, "two senders", id="conflicts"),
    pytest.param(senders, "DUPLICATES", 30, COMPLETE, "most twice", id="duplicates"),
    pytest.param(senders, "SUSPECT_CYCLES", 9, COMPLETE, "two senders", id="suspicion"),
    pytest.param(mixtures, "WEIGHT_TOLERANCE", 1.0, COMPLETE, "CAN FD", id="weights"),
    pytest.param(
        mixtures, "SEVERITY", mixtures.SEVERITY[::-1], COMPLETE, "clean", id="worst-component"
    ),
    pytest.param(epochs, "KEEP_CYCLES", 4.0, CONDITIONAL, "late", id="epochs-are-kept"),
    pytest.param(epochs, "WINDOW", (0.4, 3.0), CONDITIONAL, "late", id="window"),
    pytest.param(epochs, "MIXTURE_WINDOW", (0.5, 0.5), COMPLETE, "late", id="mixture-window"),
    pytest.param(scenes, "ROUNDING", 2.0**-43, CONDITIONAL, "clean", id="rounding"),
    pytest.param(scenes, "RESOLUTION", 2.0**-8, CONDITIONAL, "clean", id="resolution"),
    pytest.param(scenes, "STEPS", 20, CONDITIONAL, "clean", id="valid-range"),
    pytest.param(lines, "ROOTS", 0.99 * lines.ROOTS, CONDITIONAL, "clean", id="roots"),
    pytest.param(lines, "MARGIN", 2.9, CONDITIONAL, "clean", id="margin"),
    pytest.param(levels, "GOLDEN_RATIO", 1.618, CONDITIONAL, "clean", id="phase"),
    pytest.param(levels, "SHAPE_OCTAVES", 10.3, CONDITIONAL, "clean", id="shape"),
    pytest.param(decoder, "CLOCK_JITTER_NS", 2 * MS, COMPLETE, "clock", id="clock-jitter"),
    pytest.param(settings, "GRACE_CYCLES", 1.4, COMPLETE, "many faults", id="time-out"),
    pytest.param(whole_scenes, "REASONS", whole_scenes.REASONS[:3], WHOLE, "clean", id="kinds"),
    pytest.param(
        whole_scenes, "shared", lambda _: ["SceneCounter"], WHOLE, "clean", id="poses-of-one-scene"
    ),
    pytest.param(whole_scenes, "joint_bits", lambda *_: 0, WHOLE, "clean", id="joint-bits"),
    pytest.param(secoc, "MAX_FRESHNESS", 0, SECURED, "authenticated", id="freshness"),
    pytest.param(
        reassembly.Reassembly, "_ahead", lambda *_: 0, COMPLETE, "many faults", id="newer-counter"
    ),
    pytest.param(
        reassembly.Reassembly, "_needed", lambda *_: 4, CONDITIONAL, "clean", id="short-record"
    ),
]


@pytest.mark.parametrize(("module", "name", "faulty", "dbc", "profile"), FAULTS)
def test_a_fault_of_a_rule_is_found(
    monkeypatch: pytest.MonkeyPatch, module: Any, name: str, faulty: Any, dbc: str, profile: str
) -> None:
    """One rule of the model is another one: a stream tells it from the core."""
    traffics = traffics_of(layout_of(dbc), 1)
    monkeypatch.setattr(module, name, faulty)
    found = (compare(traffics, of_name(profile), 2500, seed).difference for seed in range(3))
    difference = next((one for one in found if one is not None), None)
    assert difference is not None
    assert difference.core != difference.model
    assert dbc in str(difference)


# ---- rules by example: the core agrees in each step ---------------------------------------------


class Sender:
    """Records of any owner, by their counters, to core and model."""

    def __init__(self, dbc: str, profile: str = "clean") -> None:
        self.layout = layout_of(dbc)
        self.pair = Pair(self.layout, of_name(profile))

    def record(self, counter: int, owner: Owner = SLOT, **raw: int) -> bytes:
        """Return a record with a straight line, or a pose error of small levels."""
        layout = self.layout.record_of(owner)
        assert not isinstance(layout, SceneLayout)
        values = {name: 0 for name in layout.signals if owner == POSE} | {"XMin": 1, "XMax": 20}
        of_complete = {"Status": 1, "Age": 3, "ComponentWeight": 31}
        values |= {"HasCovariance": 0} if self.layout.is_conditional else of_complete
        known = {name: n for name, n in values.items() if name in layout.signals}
        data_id = self.layout.messages_of[owner].data_id
        return written(layout, known | {"Counter": counter} | raw, data_id)

    def pages(self, record: bytes, owner: Owner = SLOT) -> list[tuple[int, bytes]]:
        can_id = self.layout.messages_of[owner].can_id
        assert can_id is not None
        return [(can_id, record[i : i + 8]) for i in range(0, len(record), 8)]

    def feed(self, frames: list[tuple[int, bytes]], t_ns: int = 0) -> list[Any]:
        """Return the answers to frames, 0.25 ms apart: reasons, or lines."""
        answers = []
        for i, (can_id, data) in enumerate(frames):
            step = FrameStep(can_id, data, False, t_ns + i * MS // 4, self.pair.now_us)
            assert not [*self.pair.differences(step)]
            answers.append(self.pair.answer)
        return answers

    def send(self, counter: int, t_ns: int, owner: Owner = SLOT, **raw: int) -> Any:
        """Return the answer to the last frame of a record."""
        return self.feed(self.pages(self.record(counter, owner, **raw), owner), t_ns)[-1]

    def latest(self, t_ns: int, slot: Slot = SLOT) -> Any:
        """Return the view of a slot."""
        assert not [*self.pair.differences(Question("latest", slot, t_ns))]
        return self.pair.answer


@pytest.fixture
def sender() -> Sender:
    """A sender of complete records."""
    return Sender(COMPLETE)


@pytest.mark.parametrize("bit", [0, 20, 63, 70, 127, 200])
def test_a_damaged_bit_is_found(sender: Sender, bit: int) -> None:
    """By the checksum, the page number or the transfer ID."""
    data = bytearray(sender.record(5))
    data[bit // 8] ^= 1 << bit % 8
    answers = sender.feed(sender.pages(bytes(data)))
    assert all(isinstance(answer, str) for answer in answers)
    assert not sender.pair.model.lines


#: Pages that come at a time [ms], by the counter of their record; what is answered, with a letter
#: for each: pending, line, duplicate, CRC; and what is counted in the end.
ALL = (0, 1, 2, 3)
STORIES: dict[str, tuple[list[tuple[int, Sequence[int], float]], str, dict[str, int]]] = {
    "pages in any order": ([(5, (3, 1, 0, 2), 0)], "pppl", {}),
    "a lost page loses its line only": (
        [(5, (0, 1, 3), 0), (6, ALL, 50), (7, ALL, 100)], "pppppplpppl", {"TIMEOUT": 3}
    ),
    "each page twice": ([(5, (0, 0, 1, 1, 2, 2, 3, 3), 0)], "pdpdpdld", {"DUPLICATE": 4}),
    "a transfer twice": ([(5, ALL, 0), (5, ALL, 1)], "pppldddd", {"DUPLICATE": 4}),
    "a transfer again, long after": ([(5, ALL, 0), (5, ALL, 1e7)], "ppplpppd", {"DUPLICATE": 4}),
    "as late as a page may be": ([(5, (0, 1, 2), 0), (5, (3,), 75)], "pppl", {}),
    "a page that is later": ([(5, (0, 1, 2), 0), (5, (3,), 75.1)], "pppp", {"TIMEOUT": 3}),
    "a clock that is set back": ([(5, (0, 1), 1e6), (6, ALL, 0)], "pppppl", {"TIMEOUT": 2}),
    "16 records later the ID is the same": ([(5, (0, 1), 0), (21, (2, 3), 1)], "pppc", {"CRC": 4}),
    "a newer counter replaces a transfer": (
        [(5, (0, 1, 2), 0), (21, ALL, 1)], "ppppppl", {"REPLACED": 3}
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", STORIES)
def test_what_becomes_of_each_frame(sender: Sender, name: str) -> None:
    steps, expected, counts = STORIES[name]
    answers = list[Any]()
    for counter, numbers, t_ms in steps:
        pages = sender.pages(sender.record(counter, PivotBeta=counter))
        answers += sender.feed([pages[i] for i in numbers], round(t_ms * MS))
    letters = [answer[0].lower() if isinstance(answer, str) else "l" for answer in answers]
    assert "".join(letters) == expected
    assert +sender.pair.model.counts == counts


def test_a_record_in_one_can_fd_frame(sender: Sender) -> None:
    """It may be padded, is delivered once, and has all bytes."""
    own, record = sender.layout.messages[SLOT], sender.record(5)
    assert own.fd_can_id is not None
    frames = [(own.fd_can_id, data) for data in (record + bytes(16), record, record[:24])]
    (line,), *others = sender.feed(frames)
    assert (line.slot, others) == (SLOT, ["DUPLICATE", "LENGTH"])


def test_a_sender_that_restarts_is_told_from_late_records(sender: Sender) -> None:
    """Two of its records are dropped, then it is known: one counter has another content."""
    for k in range(3):
        sender.send(k, k * CYCLE)
    for k in range(40, 43):
        sender.send(k, (k - 37) * CYCLE)  # dropped: too far ahead
    answers = [sender.send(k, (6 + k) * CYCLE, Kind=1) for k in range(3)]
    assert [one if isinstance(one, str) else "line" for one in answers] == ["STALE"] * 3
    assert sender.send(3, 9 * CYCLE, Kind=1)[0].kind is Kind.SOLID


def test_a_mixture_has_all_of_its_components(sender: Sender) -> None:
    """They have consecutive counters and the same range; the sum of the weights is 1."""
    parts: list[Any] = [
        {"ComponentIndex": i, "ComponentCount": 2, "ComponentWeight": w, "YOff": y}
        for i, (w, y) in enumerate(((7, -512), (7, 512), (15, 0)))
    ]
    first, second, (line,) = (sender.send(8 + i, i * MS, **raw) for i, raw in enumerate(parts))
    assert (first, second) == ("PENDING", "PENDING")
    assert [component.weight for component in line.components] == [0.25, 0.25, 0.5]
    assert line.mean[0] == 0.0
    assert line.cov[0][0] > 0.125
    assert sender.send(11, CYCLE, **parts[0]) == "PENDING"
    assert sender.send(14, 2 * CYCLE, **parts[0]) == "PENDING"
    assert +sender.pair.model.counts == {"INCOMPLETE": 4}


def test_a_conditional_line_waits_for_its_pose_error() -> None:
    """It has the low bits of its counter, and comes at about the same time."""
    sender = Sender(CONDITIONAL)
    assert sender.send(13, 0) == "PENDING"
    assert sender.pair.model.pending == 2  # a record without a covariance has two pages
    (line,) = sender.send(0, 4 * MS, POSE, EgoLeftCounter=5)
    assert line.t_ns == 0
    assert sender.send(14, CYCLE) == "PENDING"
    assert sender.send(1, CYCLE + 4 * MS, POSE, EgoLeftCounter=7) == "PENDING"
    sender.latest(CYCLE)
    assert not [*sender.pair.differences(Question("expire", SLOT, 10 * CYCLE))]
    assert +sender.pair.model.counts == {"POSE": 2}


def test_an_old_line_is_stale_and_a_clock_that_was_set_back_has_no_ages(sender: Sender) -> None:
    """Three cycles without a newer line; before the reception, no age is known."""
    sender.send(0, 0)
    views = [sender.latest(t_ns) for t_ns in (150 * MS, 150 * MS + 1, -MS, -MS - 1)]
    assert [view.is_stale for view in views] == [False, True, False, True]
    assert [view.age for view in views] == [0.174, pytest.approx(0.174), 0.024, math.inf]
