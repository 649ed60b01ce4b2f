"""The decoder in C and the one in Python, with the same frames: the same objects, bit for bit."""

import gc
import pickle
import random
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import fields, replace
from enum import Enum
from functools import partial
from typing import Any

import numpy as np
import pytest
from both_codecs import python_alone
from c_layouts import unusual_layouts
from c_receivers import MAX_TIME, Vault
from c_streams import KEY, OTHER_KEY, PROFILES, SECURED_PROFILES, Stream, Traffic, traffic_of
from random_dbc import random_dbc
from scene_layouts import layout_of
from scene_streams import (
    COMPLETE,
    CONDITIONAL,
    PERIOD_NS,
    new_codec,
    road_scene,
)

from maplines_can import Gaussian, MapLine, native
from maplines_can.values.line import Slot
from maplines_can.wire import POSE, Codec, Decoder, Key, Layout, Reason, ReceivedFrame
from maplines_can.wire.reception.native_decoder import NativeDecoder
from maplines_can.wire.reception.python_decoder import PythonDecoder
from maplines_can.wire.reception.views import STALE_CYCLES

pytestmark = pytest.mark.skipif(not native.is_active, reason="there is no C path")

FRAMES = 600


def decoders(
    layout: Layout, vault: Vault | None = None, **settings: Any
) -> tuple[Decoder, Decoder]:
    """Return a decoder in C and one in Python."""

    def codec() -> Codec:
        return Codec(layout, None if vault is None else vault.authenticator())

    with python_alone():
        in_python = codec().decoder(**settings)
    in_c = codec().decoder(**settings)
    assert (type(in_c), type(in_python)) == (NativeDecoder, PythonDecoder)
    return in_c, in_python


def content(value: Any) -> Any:
    """Return all that an object holds, to the last bit, with the types."""
    if isinstance(value, np.ndarray):
        flags = value.flags
        return value.shape, value.dtype, value.tobytes(), flags.writeable, flags.c_contiguous
    if isinstance(value, Enum) or value is None:
        return value
    if isinstance(value, float):
        return float, np.float64(value).tobytes()
    if isinstance(value, tuple | list):
        return type(value), [*map(content, value)]
    if isinstance(value, dict | Counter) or type(value).__name__ == "mappingproxy":
        return {key: content(one) for key, one in value.items()}
    if hasattr(value, "__dataclass_fields__"):
        return type(value), [content(getattr(value, field.name)) for field in fields(value)]
    return type(value), value


class Both:
    """Both decoders; what they are asked is compared at once."""

    def __init__(
        self,
        layout: Layout,
        *,
        stale_cycles: float = STALE_CYCLES,
        vault: Vault | None = None,
        **settings: Any,
    ) -> None:
        self.layout, self.vault, self._stale = layout, vault, stale_cycles
        self.in_c, self.in_python = decoders(layout, vault, **settings)
        self.decoder, self.met = self.in_c, Counter[str]()
        self.newest: dict[Slot, MapLine] = {}

    def frame(self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False) -> None:
        found = self._same(
            lambda one: one.feed(can_id, data, limited(t_ns), is_extended=is_extended)
        )
        if isinstance(found, Reason):
            self.met[found.name] += 1
            return
        for line in found:
            self.newest[line.slot] = line
            self.met["line" if line.mixture is None else "mixture"] += 1

    def latest(self, slot: Slot, now_ns: int) -> None:
        view = self._same(lambda one: one.latest(slot, limited(now_ns), stale_cycles=self._stale))
        assert view.line is self.newest.get(slot)
        self.met["usable"] += view.usable

    def scene(self, now_ns: int) -> None:
        if self.layout.pose is not None:
            view = self._same(
                lambda one: one.latest_scene(limited(now_ns), stale_cycles=self._stale)
            )
            assert self.in_c.scene() is view.received
            self.met["scene"] += view.scene is not None

    def expire(self, t_ns: int) -> None:
        self._same(lambda one: one.expire(limited(t_ns)))

    def statistics(self, now_ns: int) -> None:
        self._same(lambda one: one.slots(limited(now_ns)))
        self._same(lambda one: one.pose_error(limited(now_ns)))
        self._same(numbers_of)
        for owner in self.in_c.checks:
            self._same(partial(check_of, owner=owner, t_ns=limited(now_ns)))

    def _same(self, ask: Callable[[Decoder], Any]) -> Any:
        found, expected = ask(self.in_c), ask(self.in_python)
        assert content(found) == content(expected)
        return found


def limited(t_ns: int) -> int:
    return max(-MAX_TIME, min(t_ns, MAX_TIME))


def numbers_of(decoder: Decoder) -> Any:
    return (
        decoder.frames, decoder.lines, decoder.line_frames, decoder.pose_errors,
        decoder.pose_frames, decoder.lost, decoder.pending, decoder.counts, decoder.can_ids,
        {owner: one.last_accepted for owner, one in decoder.verifiers.items()},
    )  # fmt: skip


def check_of(decoder: Decoder, owner: Any, t_ns: int) -> Any:
    check = decoder.checks[owner]
    return (
        check.stats(), check.cycle_ns, check.state, check.status, check.lost, check.two_senders,
        check.has_one_sender(t_ns), check.counter_was_reused(t_ns), dict(check.statuses),
        check.ahead if check.statuses else None, check.elapse(t_ns), check.state,
    )  # fmt: skip


def run(traffic: Traffic, profile: Any, seed: int, frames: int = FRAMES) -> Counter[str]:
    """Feed a stream to both decoders; return what it meets."""
    stream = Stream(traffic, profile, seed)
    both: Any = Both(traffic.layout, vault=stream.receivers.vault, **profile.settings)
    stream.receivers = both
    stream.run(frames)
    return Counter(both.met)


@pytest.mark.parametrize("dbc", ["maplines.dbc", "maplines-pose.dbc", "maplines-secoc.dbc"])
def test_streams_are_received_as_in_python(dbc: str) -> None:
    """Clean traffic, faults, hostile bytes, clock faults, two senders, restarts, duplicates."""
    met = Counter[str]()
    for i, profile in enumerate(PROFILES):
        met += run(traffic_of(dbc), profile, i, FRAMES if dbc != "maplines-secoc.dbc" else 200)
    wanted = {"line", "scene", "usable", "DUPLICATE", "STALE", "CRC", "CONTENT", "FOREIGN"}
    assert wanted - met.keys() == set()
    assert layout_of(dbc).is_conditional == (met["mixture"] == 0)


@pytest.mark.parametrize("seed", range(6))
def test_a_random_dbc_is_received_as_in_python(seed: int) -> None:
    layout = Layout.from_text(random_dbc(seed))
    for profile in (PROFILES[3], PROFILES[6], PROFILES[13]):
        run(Traffic(layout, seed), profile, seed)


UNUSUAL = unusual_layouts()


@pytest.mark.parametrize("unusual", UNUSUAL)
def test_an_unusual_dbc_is_received_as_in_python(unusual: str) -> None:
    assert run(Traffic(UNUSUAL[unusual], 2), PROFILES[7], 2)["line"] > 10


def scene_frames(dbc: str, cycles: int = 6) -> list[ReceivedFrame]:
    """Return the frames of scenes."""
    encoder, scene = new_codec(dbc).encoder(), road_scene(Slot)
    return [
        ReceivedFrame(frame.can_id, frame.data, PERIOD_NS * cycle + 250_000 * i, frame.is_extended)
        for cycle in range(cycles)
        for i, frame in enumerate(
            frame for own in encoder.encode_scene(scene, age=0.02).values() for frame in own
        )
    ]


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_frames_that_have_arrived_together(dbc: str) -> None:
    """As one after the other; what is no frame ends it."""
    frames = scene_frames(dbc)
    alone, together = decoders(layout_of(dbc))[0], decoders(layout_of(dbc))
    one_by_one = [alone.feed(*frame[:3], is_extended=frame[3]) for frame in frames]
    for decoder in together:
        assert content(decoder.feed_all(iter(frames))) == content(one_by_one)
        assert numbers_of(decoder) == numbers_of(alone)
        assert content(decoder.scene()) == content(alone.scene())
        for wrong in (5, [frames[0][:3]], [5]):
            with pytest.raises(TypeError):
                decoder.feed_all(wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_objects_are_those_of_python(dbc: str) -> None:
    """They can be copied, pickled, printed and changed as others; arrays are read-only."""
    in_c, in_python = decoders(layout_of(dbc))
    frames = scene_frames(dbc)
    for decoder in (in_c, in_python):
        decoder.feed_all(frames)
    for found, expected in (
        (in_c.latest(Slot.CENTRE, 0).line, in_python.latest(Slot.CENTRE, 0).line),
        (in_c.scene(), in_python.scene()),
    ):
        assert found is not None
        assert repr(found) == repr(expected)
        assert content(pickle.loads(pickle.dumps(found))) == content(  # noqa: S301
            pickle.loads(pickle.dumps(expected))  # noqa: S301
        )
        assert content(deepcopy(found)) == content(deepcopy(expected))
    line = in_c.latest(Slot.CENTRE, 0).line
    assert isinstance(line, MapLine)
    assert [*vars(line)] == [field.name for field in fields(MapLine)]
    assert replace(line, age=1.0).age == 1.0
    with pytest.raises(AttributeError, match="cannot assign to field"):
        line.age = 2.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        line.gaussian.cov[0, 0] = 1.0
    assert content(Gaussian(line.gaussian.mean, line.gaussian.cov)) == content(line.gaussian)


class Eight:
    """What has a length and bytes, but is no buffer."""

    def __len__(self) -> int:
        return 8

    def __bytes__(self) -> bytes:
        return bytes(8)


KNOWN, WHOLE = 0x340, 0x348
CALLS: dict[str, Callable[[Any], Any]] = {
    "bytearray": lambda one: one.feed(KNOWN, bytearray(8), 0),
    "memoryview": lambda one: one.feed(KNOWN, memoryview(bytes(16))[::2], 0),
    "list": lambda one: one.feed(KNOWN, [0] * 8, 0),
    "array": lambda one: one.feed(np.int64(KNOWN), np.zeros(8, np.uint8), np.int64(5)),
    "bytes by a method": lambda one: one.feed(KNOWN, Eight(), 0),
    "no payload": lambda one: one.feed(KNOWN, b"", 0),
    "text": lambda one: one.feed(KNOWN, "12345678", 0),
    "a number": lambda one: one.feed(KNOWN, 8, 0),
    "none": lambda one: one.feed(KNOWN, None, 0),
    "large bytes": lambda one: one.feed(KNOWN, [256] * 8, 0),
    "a payload longer than any": lambda one: one.feed(WHOLE, bytes(200), 0),
    "a page longer than any": lambda one: one.feed(KNOWN, bytes(300), 0),
    "foreign, whatever it has": lambda one: one.feed(0x7FF, None, None),
    "negative": lambda one: one.feed(-1, None, 0),
    "beyond 32 bits": lambda one: one.feed(KNOWN + 2**32, bytes(8), 0),
    "beyond 64 bits": lambda one: one.feed(2**80, bytes(8), 0),
    "text for an ID": lambda one: one.feed("340", bytes(8), 0),
    "a float for an ID": lambda one: one.feed(float(KNOWN), bytes(8), 0),
    "a list for an ID": lambda one: one.feed([KNOWN], bytes(8), 0),
    "extended": lambda one: one.feed(KNOWN, bytes(8), 0, is_extended=True),
    "one for true": lambda one: one.feed(KNOWN, bytes(8), 0, is_extended=1),
    "numpy's false": lambda one: one.feed(KNOWN, bytes(8), 0, is_extended=np.False_),
    "none for false": lambda one: one.feed(KNOWN, bytes(8), 0, is_extended=None),
    "keywords": lambda one: one.feed(t_ns=0, data=bytes(8), can_id=KNOWN),
    "a large time": lambda one: one.feed(KNOWN, bytes(8), 10**30),
    "a whole float": lambda one: one.feed(KNOWN, bytes(8), 5e9),
    "too few": lambda one: one.feed(KNOWN, bytes(8)),
    "too many": lambda one: one.feed(KNOWN, bytes(8), 0, True),
    "twice": lambda one: one.feed(KNOWN, bytes(8), 0, can_id=KNOWN),
    "unknown keyword": lambda one: one.feed(KNOWN, bytes(8), 0, t=0),
    "latest": lambda one: one.latest(np.int64(2), np.int64(3)),
    "latest of no slot": lambda one: one.latest(8, 0),
    "latest of the pose error": lambda one: one.latest(POSE, 0),
    "latest at half a nanosecond": lambda one: one.latest(0, 0.5),
    "latest at no time": lambda one: one.latest(0, "now"),
    "latest, never stale": lambda one: one.latest(0, 0, stale_cycles=float("inf")),
    "a scene": lambda one: one.latest_scene(10**40, stale_cycles=1),
    "no scene yet": lambda one: (one.scene(), one.slots(0), one.pose_error(0)),
    "expire": lambda one: one.expire(-(10**40)),
    "a check": lambda one: one.checks[8],
}


def answer_of(decoder: Decoder, ask: Callable[[Any], Any]) -> Any:
    try:
        return content(ask(decoder))
    except (TypeError, ValueError, KeyError) as error:
        is_own = isinstance(error, ValueError) and "must be" in str(error)
        return type(error), str(error) if is_own else ""


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_unusual_arguments(dbc: str, call: str) -> None:
    """The same answer, or an error of the same class; what has numbers still has them."""
    in_c, in_python = decoders(layout_of(dbc))
    known, whole = (min(own) for own in ids_of(in_c, layout_of(dbc)))
    assert (known, whole) == (KNOWN, WHOLE) or dbc == CONDITIONAL
    assert answer_of(in_c, CALLS[call]) == answer_of(in_python, CALLS[call])
    assert numbers_of(in_c) == numbers_of(in_python)


def ids_of(decoder: Decoder, layout: Layout) -> Iterable[list[int]]:
    """Return the CAN IDs of the classic and of the CAN FD messages of lines."""
    del decoder
    messages = layout.messages.values()
    yield [own.can_id for own in messages if own.can_id is not None]
    yield [own.fd_can_id for own in messages if own.fd_can_id is not None]


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_nothing_leaks(dbc: str) -> None:
    """Thousands of frames, scenes and errors leave no object behind."""
    frames = scene_frames(dbc, cycles=256)
    decoder, _ = decoders(layout_of(dbc))

    def repeat(turn: int) -> None:
        for can_id, data, t_ns, is_extended in frames:
            now_ns = t_ns + turn * 256 * PERIOD_NS
            decoder.feed(can_id, data, now_ns, is_extended=is_extended)
        for slot in Slot:
            decoder.latest(slot, now_ns)
        for ask in CALLS.values():
            answer_of(decoder, ask)
        assert decoder.latest_scene(now_ns).scene is not None
        gc.collect()

    repeat(0)
    tracemalloc.start()
    try:
        repeat(1)
        before = tracemalloc.get_traced_memory()[0]
        for turn in range(2, 5):
            repeat(turn)
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 20_000  # of 30 000 frames, each of which has a line or a page


def test_a_decoder_is_freed() -> None:
    """Without the collector of cycles: it holds nothing that holds it."""
    gc.disable()
    try:
        before = len([one for one in gc.get_objects() if isinstance(one, NativeDecoder)])
        decoder, _ = decoders(layout_of(COMPLETE))
        assert decoder.checks[Slot.CENTRE].lost == 0
        del decoder, _
        left = len([one for one in gc.get_objects() if isinstance(one, NativeDecoder)])
    finally:
        gc.enable()
    assert left == before


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_memory_that_ends(dbc: str) -> None:
    """MemoryError, wherever it is, and no crash; the decoder goes on."""
    testcapi = pytest.importorskip("_testcapi")
    frames, decoder = scene_frames(dbc, cycles=40), decoders(layout_of(dbc))[0]
    failed, feed, scene, remove = 0, decoder.feed, decoder.scene, testcapi.remove_mem_hooks
    gc.disable()  # what the collector calls must not be what lacks memory
    for i, (can_id, data, t_ns, _) in enumerate(frames):
        testcapi.set_nomemory(i % 61, i % 61 + 1)  # one of them fails
        try:
            feed(can_id, data, t_ns)
            scene()
        except MemoryError:
            failed += 1
        finally:
            remove()
    gc.enable()
    assert failed > 20
    assert decoder.frames > len(frames) - failed
    assert decoder.scene() is not None


def test_the_settings_are_those_of_python() -> None:
    """Also where those that C would choose differ."""
    for dbc in (COMPLETE, CONDITIONAL):
        both = Both(layout_of(dbc), timeout_ms=7.0, cycle_ms=11.0)
        for can_id, data, t_ns, is_extended in scene_frames(dbc):
            both.frame(can_id, data, t_ns, is_extended=is_extended)
        both.statistics(10**9)
        both.scene(10**9)
    assert STALE_CYCLES == 3.0


@pytest.mark.parametrize("profile", SECURED_PROFILES, ids=lambda profile: profile.name)
def test_authenticated_frames_are_received_as_in_python(profile: Any) -> None:
    """With and without a clock and keys: forged, replayed, late, hostile frames."""
    met = run(traffic_of("maplines-secoc.dbc"), profile, 5)
    wanted = {"forged": "MAC", "replayed": "REPLAY", "not auth": "UNAUTHENTICATED"}
    assert {reason for name, reason in wanted.items() if name in profile.name} - met.keys() == set()
    assert (met["line"] > 0) == (profile.has_keys == profile.is_signed)


def test_any_freshness_value_and_clock_of_a_frame() -> None:
    """Also those that no sender sends, at the ends of all numbers; keys come and go."""
    layout = layout_of("maplines-secoc.dbc")
    vault, rng = Vault([KEY, OTHER_KEY]), random.Random(9)  # noqa: S311
    both = Both(layout, vault=vault)
    own, sender = layout.messages[Slot.CENTRE], Traffic(layout, 0)
    assert layout.secured is not None
    assert own.secured_can_id is not None
    records = [record for cycle in sender.cycles[:40] for slot, record in cycle if slot == 4]
    last = 0
    for i in range(600):
        far = 2**62 if i < 550 else 2**63 - 2  # after that one, none is new
        now = rng.choice([0, last, last + 1, last - 10**6, last + 10**6, *[far] * (i % 50 == 49)])
        vault.now_us = max(now, 0)
        signer = Vault([rng.choice([KEY, OTHER_KEY, (9, KEY[1])])], now_us=vault.now_us)
        signer.now_us += rng.choice([0, 0, 0, 10**6, 10**6 + 1, -(10**6), -(10**6) - 1])
        signer.now_us = max(0, min(signer.now_us, 2**63 - 2))
        data = signer.authenticator().secure(
            rng.choice(records), own.secured_data_id, layout.secured
        )
        data = data[: rng.choice([*[len(data)] * 9, 20])] + bytes(rng.choice([0] * 9 + [1, 100]))
        both.frame(own.secured_can_id, data, i * 10**7, is_extended=own.secured_is_extended)
        last = both.in_c.verifiers[Slot.CENTRE].last_accepted.get(own.secured_data_id, 0)
        if i in (200, 400):
            for one in (both.in_c, both.in_python):
                authenticator = one.verifiers[Slot.CENTRE].authenticator
                (authenticator.retire if i == 200 else authenticator.add)(
                    *([OTHER_KEY[0]] if i == 200 else [Key(OTHER_KEY[1], OTHER_KEY[0])])
                )
        both.statistics(i * 10**7)
    assert {"LENGTH", "KEY", "AGE", "REPLAY"} <= both.met.keys()
