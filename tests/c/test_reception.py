"""Reception in C, frame for frame as in Python: lines, reasons, counters, states and views."""

import random
import struct
from collections import Counter
from dataclasses import fields, replace
from typing import Any

import c_core
import numpy as np
import pytest
from c_layouts import unusual_layouts
from c_receivers import FRAME, MAX_TIME, PROBLEM, REASONS, SCENE, Receivers
from c_streams import KEY, PROFILES, SECURED_PROFILES, Stream, Traffic, traffic_of
from dbcs import changed_record
from random_dbc import LIMIT_SEED, random_dbc
from scene_layouts import layout_of
from scene_streams import road_scene

from maplines_can import Gaussian, GaussianMixture, MapLine
from maplines_can.values.line import Slot, Status
from maplines_can.wire import POSE, E2EConfig, E2EState, Layout, ProfileStatus, Reason

SHIPPED = ("maplines.dbc", "maplines-pose.dbc", "maplines-secoc.dbc")
FRAMES = 600
HOUR = 3_600_000_000_000  # [ns]
ALL = [*PROFILES, *SECURED_PROFILES]
MET: dict[str, Counter[str]] = {}


def profiles_of(dbc: str) -> list[Any]:
    return ALL if layout_of(dbc).secured is not None else [*PROFILES]


@pytest.mark.parametrize(
    ("dbc", "profile"),
    [pytest.param(dbc, p, id=f"{dbc}-{p.name}") for dbc in SHIPPED for p in profiles_of(dbc)],
)
def test_a_stream_is_received_as_in_python(dbc: str, profile: Any) -> None:
    """Clean traffic, faults, hostile bytes, clock faults, two senders, restarts, duplicates."""
    receivers = Stream(traffic_of(dbc), profile, seed=ALL.index(profile)).run(FRAMES)
    assert receivers.check(c_core.harness("reception", receivers.layout)) >= FRAMES
    MET.setdefault(dbc, Counter()).update(receivers.met)


def test_the_streams_meet_all_there_is() -> None:
    """Every reason, status, state and view: otherwise the streams show too little."""
    met = sum((streams_of(dbc) for dbc in SHIPPED), Counter[str]())
    names = {reason.name for reason in Reason} | {status.name for status in Status}
    names |= {f"state {state.name}" for state in E2EState}
    names |= {f"status {status.name}" for status in ProfileStatus}
    names |= {"line", "mixture", "scene", "stale", "two senders", "two_senders", "usable"}
    assert {name for name in names if not met[name]} == set()


def streams_of(dbc: str) -> Counter[str]:
    """Return what the streams of a DBC meet, also if the tests of them ran elsewhere."""
    if dbc not in MET:
        traffic = traffic_of(dbc)
        runs = [Stream(traffic, p, ALL.index(p)).run(FRAMES).met for p in profiles_of(dbc)]
        MET[dbc] = sum(runs, Counter[str]())
    return MET[dbc]


@pytest.mark.parametrize("seed", [0, 1, LIMIT_SEED, LIMIT_SEED + 1])
def test_a_random_dbc_is_received_as_in_python(seed: int) -> None:
    """Other places and lengths of signals: of counters, transfer IDs and pages, too."""
    layout = Layout.from_text(random_dbc(seed))
    traffic = Traffic(layout, seed)
    for profile in (PROFILES[3], PROFILES[6], PROFILES[13]):
        receivers = Stream(traffic, profile, seed).run(FRAMES)
        receivers.check(c_core.harness("reception", layout))


def test_a_sender_that_is_faster_than_any_cycle_time() -> None:
    """By more than the factor of 10 that a receiver expects at most."""
    profile = replace(PROFILES[3], settings={"cycle_ms": 3000.0})
    receivers = Stream(traffic_of("maplines.dbc"), profile, seed=5).run(2 * FRAMES)
    receivers.check(c_core.harness("reception", receivers.layout))


def test_components_of_lines() -> None:
    """Of mixtures and of other lines; beyond the last one, and of slots without a line, none."""
    receivers = Stream(traffic_of("maplines.dbc"), PROFILES[3], seed=2).run(FRAMES)
    for slot in (*Slot, 8, 255):
        for i in (0, 1, 2, 8, 255):
            receivers.component(slot, i)
    receivers.check(c_core.harness("reception", receivers.layout))


class Records:
    """Records of one line or of a scene, to be changed and sent in frames of CAN FD."""

    def __init__(self, **settings: Any) -> None:
        self.receivers = Receivers(layout_of("maplines.dbc"), **settings)
        self.layout, self.codec = self.receivers.layout, self.receivers.codec

    def of(self, line: MapLine, counter: int) -> list[bytes]:
        """Return the records of a line whose first one has a counter."""
        encoder = self.codec.encoder()
        (frames,) = encoder.encode_lines([line], fd=True, counters={line.slot: counter})
        return [frame.data for frame in frames]

    def changed(self, record: bytes, slot: Slot, **raw: Any) -> bytes:
        """Return a record with other raw values and its checksum."""
        return changed_record(self.codec, record[: self.layout.record_bytes], slot, **raw)

    def feed(self, owner: Any, record: bytes, t_ns: int) -> None:
        """Feed a record."""
        can_id = self.layout.messages_of[owner].fd_can_id
        assert can_id is not None
        self.receivers.frame(can_id, record, t_ns)

    def check(self) -> Counter[Reason]:
        """Compare both receivers; return the counts of reasons."""
        self.receivers.statistics(10**12)
        self.receivers.check(c_core.harness("reception", self.layout))
        return self.receivers.decoder.counts


MS = 1_000_000  # [ns]


def mixture_line(components: int) -> MapLine:
    gaussians = [
        Gaussian([k, 0, 0, 0], np.diag([1e-2, 1e-4, 1e-8, 1e-12])) for k in range(components)
    ]
    weights = np.ones(components) / components
    return MapLine.of_mixture(
        Slot.ROUTE, GaussianMixture(weights, gaussians), x_min=-8, x_max=60, age=0.04
    )


@pytest.mark.parametrize(
    "change",
    [
        {"Kind": 3},
        {"XMin": 2},
        {"XMax": 9},
        {"Age": 9},
        {"ComponentCount": 7},
        {"ComponentWeight": 1},
        {"Status": 4},
        {},
    ],
)
@pytest.mark.parametrize("place", [1, 2, 3])
def test_a_mixture_whose_components_differ(change: dict[str, int], place: int) -> None:
    """One that has other values than the first is of another line; weights must add up to 1."""
    records = Records()
    for k in range(3):
        for i, record in enumerate(records.of(mixture_line(4), 4 * k)):
            changed = records.changed(record, Slot.ROUTE, **(change if i == place and k else {}))
            records.feed(Slot.ROUTE, changed, 50 * k * MS - i * MS)  # a clock that is set back
        records.receivers.component(Slot.ROUTE, place)
    counts = records.check()
    is_one = not change or "Status" in change
    assert records.receivers.met["mixture"] == (3 if is_one else 1)
    assert counts[Reason.CONTENT] == (8 if "ComponentWeight" in change else 0)


def test_a_component_that_comes_again_after_a_break() -> None:
    """Its counter is new then, but the mixture has it."""
    records = Records(timeout_ms=2000.0)
    first, second, third = records.of(mixture_line(3), 0)
    for record, t_ms in ((first, 0), (second, 1), (first, 1200), (third, 1201)):
        records.feed(Slot.ROUTE, record, t_ms * MS)
    assert records.check()[Reason.DUPLICATE] == 1


def test_lines_without_a_range_and_across_the_car_are_in_no_scene() -> None:
    """The other lines of the scene are; and the line of an empty range is one of its slot."""
    records = Records()
    scene = road_scene(Slot)
    encoder = records.codec.encoder()
    for cycle in range(4):
        t_ns = 50 * cycle * MS
        for owner, (frame,) in encoder.encode_scene(scene, age=0.02, fd=True).items():
            record = frame.data
            if owner == Slot.EGO_LEFT and cycle > 0:
                record = records.changed(record, owner, C0=2**18 - 1)
            elif owner == Slot.EGO_RIGHT and cycle > 0:
                record = records.changed(record, owner, XMin=5, XMax=0)
            elif owner == Slot.CENTRE and cycle > 1:
                record = records.changed(record, owner, XMin=7, XMax=0, Status=Status.OUT_OF_RANGE)
            records.feed(owner, record, t_ns)
            if owner == POSE:  # which completes the scene before
                records.receivers.scene(t_ns)
                found = records.receivers.decoder.scene()
                assert len(found.scene.lines if found else ()) == (0, 8, 6, 5)[cycle]
    assert not records.check()
    assert records.receivers.met["line"] == 32


def test_a_frame_that_is_longer_than_any() -> None:
    """A driver that is wrong must not make a receiver in C read beyond the frame."""
    layout = layout_of("maplines.dbc")
    asked = Receivers(layout)._settings()
    for length in (31, 32, 64, 65, 255):
        frame = bytes([FRAME]) + struct.pack("<IBB", 0x348, 0, length) + bytes(length)
        asked += frame + struct.pack("<qq", 0, 0)
    out = c_core.run(c_core.harness("reception", layout), asked)
    wrong, mixed = REASONS[Reason.LENGTH], REASONS[Reason.MIXED]
    assert [*out[1::2]] == [wrong, mixed, mixed, wrong, wrong]


UNUSUAL = unusual_layouts()


@pytest.mark.parametrize("unusual", UNUSUAL)
def test_an_unusual_dbc_is_received_as_in_python(unusual: str) -> None:
    """Without messages that others have, or with signals of other widths."""
    layout = UNUSUAL[unusual]
    traffic = Traffic(layout, 1)
    profiles = [PROFILES[3], PROFILES[7], PROFILES[13]]
    if layout.secured is not None:
        profiles += [SECURED_PROFILES[1], SECURED_PROFILES[5]]
    met = Counter[str]()
    for profile in profiles:
        receivers = Stream(traffic, profile, 1).run(FRAMES)
        receivers.check(c_core.harness("reception", layout))
        met += receivers.met
    assert met["line"] > 20


@pytest.mark.parametrize("dbc", SHIPPED[:2])
def test_in_single_precision_all_decisions_are_the_same(dbc: str) -> None:
    """Numbers of lines differ by their rounding, nothing else does."""
    receivers = Stream(traffic_of(dbc), PROFILES[13], seed=3).run(FRAMES)
    program = c_core.harness("reception", receivers.layout, flags=("-O2", "-DMAPLINES_FLOAT"))
    receivers.check(program, is_float=True)


def test_times_beyond_the_range_are_limited() -> None:
    """The ends of 64 bits are times as any other."""
    receivers = Receivers(layout_of("maplines.dbc"))
    traffic = traffic_of("maplines.dbc")
    ends = (-(2**63), -MAX_TIME - 1, -MAX_TIME, 0, MAX_TIME, MAX_TIME + 1, 2**63 - 1)
    for i, t_ns in enumerate(t for _ in range(20) for t in ends):
        for owner, record in traffic.cycles[i]:
            for frame in traffic.frames(owner, record, fd=i % 2 == 1):
                receivers.frame(frame.can_id, frame.data, t_ns)
        receivers.latest(Slot.NEXT_LEFT, ends[-i % 7])
        receivers.scene(ends[-i % 7])
        receivers.statistics(ends[i % 7])
        receivers.expire(ends[-i % 7])
    receivers.check(c_core.harness("reception", receivers.layout))


@pytest.mark.parametrize("dbc", SHIPPED)
def test_settings_follow_from_the_dbc_as_in_python(dbc: str) -> None:
    """Time-outs, cycle times and windows; what Python refuses, C refuses."""
    receivers, rng, refused = Receivers(layout_of(dbc)), random.Random(1), 0  # noqa: S311
    for times in [(None, None), (20.0, None), (None, 7.3), (3.6e6, 3.6e6), (1e-9, 1e-9)]:
        assert not receivers.settings_of(*times)
    for wrong in (-1.0, float("nan"), float("inf"), 3.6e6 + 1):
        assert receivers.settings_of(wrong, None)
        assert receivers.settings_of(None, wrong)
    names = [field.name for field in fields(E2EConfig)]
    for _ in range(300):
        changed = {name: rng.choice([0, 1, 2, 5, 8, 10, 11, 127, 128, 255]) for name in
                   rng.sample(names[:-1], rng.randrange(1, 4))}  # fmt: skip
        refused += receivers.settings_of(
            None, None, changed | {"clear_to_invalid": rng.random() < 0.5}
        )
    assert 100 < refused < 300
    receivers.check(c_core.harness("reception", receivers.layout))


@pytest.mark.parametrize("owner", [Slot.EGO_LEFT, 8])
@pytest.mark.parametrize(
    ("dbc", "change", "problem"),
    [
        pytest.param("maplines.dbc", {}, "", id="good"),
        pytest.param("maplines.dbc", {"timeout": 0}, "timeout_ns must be", id="no-timeout"),
        pytest.param(
            "maplines.dbc", {"timeout": HOUR + 1}, "timeout_ns must be", id="long-timeout"
        ),
        pytest.param("maplines.dbc", {"timeout": HOUR, "cycle": HOUR}, "", id="an-hour"),
        pytest.param("maplines.dbc", {"cycle": 0}, "cycle_ns must be", id="no-cycle"),
        pytest.param("maplines.dbc", {"cycle": HOUR + 1}, "cycle_ns must be", id="long-cycle"),
        pytest.param("maplines.dbc", {"step": 127}, "", id="step"),
        pytest.param(
            "maplines.dbc", {"step": 128}, "max_delta_counter must be from 1", id="long-step"
        ),
        pytest.param("short counter", {"step": 7}, "", id="step-of-16-counters"),
        pytest.param(
            "short counter", {"step": 8}, "max_delta_counter must be less than half", id="half"
        ),
        pytest.param("maplines-secoc.dbc", {}, "", id="with-key"),
        pytest.param("maplines-secoc.dbc", {"has_clock": 0}, "", id="without-clock"),
        pytest.param(
            "maplines-secoc.dbc", {"has_mac": 0}, "authenticator: mac must be", id="no-mac"
        ),
        pytest.param("short freshness", {}, "", id="short-freshness-with-clock"),
        pytest.param(
            "short freshness", {"has_clock": 0}, "authenticator: without a clock", id="no-clock"
        ),
    ],
)
def test_wrong_settings_are_named(
    dbc: str, change: dict[str, int], problem: str, owner: int
) -> None:
    """Each bound of the structure that a caller fills, for a slot and for the pose error."""
    layout = layout_of(dbc) if dbc.endswith(".dbc") else UNUSUAL[dbc]
    given = {"timeout": 10**8, "cycle": 10**8, "step": 3, "has_mac": 1, "has_clock": 1} | change
    if dbc == "short counter" and owner == 8:
        pytest.skip("the counter of the pose error is longer")
    settings = struct.pack("<3dBB", 0.0, 0.0, 3.0, 0, 0) + struct.pack("<Bqq", 0, 1, 0)
    asked = struct.pack("<BBqqBBB", PROBLEM, owner, *given.values())
    out = c_core.run(c_core.harness("reception", layout), settings + asked)
    assert out[1] == len(out) - 2
    text = out[2:].decode()
    assert text.startswith(problem) if problem else not text


def settings_with_key(window_us: int = 10**6, not_before_us: int = 0, stale: float = 3.0) -> bytes:
    """Return what the harness reads of settings with a key and a clock."""
    key_id, secret = KEY
    data = struct.pack("<3dBBB", 0.0, 0.0, stale, 0, 1, key_id) + secret
    return data + struct.pack("<Bqq", 1, window_us, not_before_us)


FEED = struct.pack("<BIBB8sqq", 0, 0x340, 0, 8, bytes(8), 0, 0)
FOREIGN = bytes([REASONS[Reason.FOREIGN], 0])


@pytest.mark.parametrize(
    ("dbc", "settings"),
    [
        pytest.param("maplines.dbc", {}, id="no-authenticated-message"),
        pytest.param("maplines-secoc.dbc", {"window_us": 0}, id="no-window"),
        pytest.param("maplines-secoc.dbc", {"window_us": 2**55}, id="window-of-all-values"),
        pytest.param("maplines-secoc.dbc", {"not_before_us": -1}, id="before-0"),
        pytest.param("maplines-secoc.dbc", {"stale": float("nan")}, id="stale-cycles"),
    ],
)
def test_with_wrong_settings_every_frame_is_foreign(dbc: str, settings: Any) -> None:
    """A receiver without its key must not accept frames without a MAC instead."""
    program = c_core.harness("reception", layout_of(dbc))
    questions: list[tuple[Any, ...]] = [(1, "<Bq", 0, 0), (2, "<q", 0), (3, "<q", 0), (4, "<q", 0)]
    asked = b"".join(bytes([kind]) + struct.pack(*of) for kind, *of in questions)
    given = c_core.run(program, settings_with_key(**settings) + FEED + asked)
    assert given[:3] == b"\1" + FOREIGN
    no_line = struct.pack("<BqdBB3B", 0, 0, float("inf"), E2EState.NODATA, 0xFF, 1, 0, 0)
    assert given[3 : 3 + len(no_line)] == no_line
    numbers = struct.calcsize(f"<{len(Reason) + 6}QI")
    assert given[-numbers - 9 : -numbers] == bytes(9)  # no owner has statistics
    good = c_core.run(program, settings_with_key() + FEED) if dbc != "maplines.dbc" else b"\0"
    assert good[:1] == b"\0"


def test_without_a_pose_error_there_is_no_scene() -> None:
    layout = UNUSUAL["no pose error"]
    asked = Receivers(layout)._settings() + struct.pack("<Bq", SCENE, 0)
    out = c_core.run(c_core.harness("reception", layout), asked)
    assert out == b"\0" + struct.pack("<BdBB3B", 0, float("inf"), E2EState.NODATA, 0xFF, 1, 0, 0)


def test_a_slot_that_the_dbc_does_not_have_has_no_line() -> None:
    """Without assertions, the result of this mistake of a caller is defined."""
    program = c_core.harness("reception", layout_of("maplines.dbc"), flags=("-O1", "-DNDEBUG"))
    asked = b"".join(struct.pack("<BBq", 1, slot, 0) for slot in (8, 255))
    data = struct.pack("<3dBB", 0.0, 0.0, 3.0, 0, 0) + struct.pack("<Bqq", 0, 1, 0)
    no_line = struct.pack("<BqdBB3B", 0, 0, float("inf"), E2EState.NODATA, 0xFF, 1, 0, 0)
    assert c_core.run(program, data + asked) == b"\0" + 2 * no_line
