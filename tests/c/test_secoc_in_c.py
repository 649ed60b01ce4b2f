"""Authenticated frames in C: the same frames, and the same reasons, as in Python."""

import random
import struct
from collections import Counter
from typing import Any

import c_core
import pytest
from scene_layouts import layout_of
from secoc_streams import SECRET

from maplines_can.values.errors import EncodeError
from maplines_can.values.line import MapLine, Slot
from maplines_can.wire import Authenticator, Codec, Key, Reason, Verifier
from maplines_can.wire.layout.slot_messages import SecuredLayout
from maplines_can.wire.protection.secoc import MAX_FRESHNESS

KEYS = (Key(SECRET, 1), Key(bytes(byte ^ 0xFF for byte in SECRET), 7))
REASONS = {reason: i + 1 for i, reason in enumerate(Reason)}
LAYOUTS = (SecuredLayout(48, 7, 8), SecuredLayout(64, 3, 1), SecuredLayout(48, 4, 4))
DATA_ID = layout_of("maplines-secoc.dbc").messages[Slot.EGO_LEFT].secured_data_id
NOWS = (0, 1, 5_000_000, 1_750_000_000_000_000, MAX_FRESHNESS - 2_000_000)


def program() -> Any:
    return c_core.harness("secoc", layout_of("maplines-secoc.dbc"))


def clock_at(us: int) -> Any:
    """Return a clock that stands at a time [us]."""
    return lambda: 1000 * us


def numbers_of(layout: SecuredLayout) -> bytes:
    return bytes([layout.authentic_bytes, layout.freshness_bytes, layout.mac_bytes])


def test_aes_cmac_of_the_tests_is_that_of_cryptography() -> None:
    """The vectors of RFC 4493, section 4, and data of any length."""
    rng = random.Random(4)  # noqa: S311
    data = [rng.randbytes(n) for n in range(100)]
    text = bytes.fromhex("6bc1bee22e409f96e93d7e117393172a")
    asked = b"".join(struct.pack("<BH", 0, len(d)) + d for d in [b"", text, *data])
    given = c_core.run(program(), asked)
    assert given[:16].hex() == "bb1d6929e95937287fa37d129b756746"
    assert given[16:32].hex() == "070a16b46b4d4144f79bdd9dd04a287c"
    assert given[32:] == b"".join(KEYS[0].mac(d) for d in data)


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: f"{layout.freshness_bytes} bytes")
def test_frames_of_a_sender_are_those_of_python(layout: SecuredLayout) -> None:
    """Also after a clock that stands still, is set back, or is at its end."""
    rng, asked, expected = random.Random(5), b"", b""  # noqa: S311
    for _ in range(500):
        last, now = rng.choice([0, 7, 10**15, MAX_FRESHNESS - 1, MAX_FRESHNESS]), rng.choice(NOWS)
        key_id, record = rng.choice([1, 7, 9]), rng.randbytes(32)
        asked += bytes([2]) + numbers_of(layout) + struct.pack("<qqBB", now, last, key_id, 32)
        asked += record
        sender = Authenticator(*KEYS, clock=clock_at(now), not_before=last)
        try:
            sender.use(key_id)
            data = sender.secure(record, DATA_ID, layout)
        except (ValueError, EncodeError):
            expected += struct.pack("<BqB", 0, last, 0)
            continue
        expected += struct.pack("<BqB", 1, sender.last_sent, len(data)) + data
    assert c_core.run(program(), asked) == expected


def test_an_encoder_with_a_key_signs_as_in_python() -> None:
    """Each line is one frame; without a further freshness value, it is refused."""
    rng, now, asked, expected = random.Random(7), 0, b"", b""  # noqa: S311
    sender = Authenticator(*KEYS, clock=lambda: 1000 * now)
    encoder = Codec(layout_of("maplines-secoc.dbc"), sender).encoder()
    for now in [rng.randrange(10**15) for _ in range(50)] + [MAX_FRESHNESS, MAX_FRESHNESS]:
        slot, y = rng.choice([*Slot]), rng.uniform(-8, 8)
        asked += struct.pack("<BqBdB", 3, now, slot, y, 1)
        line = MapLine.mean_only(slot, [y, 0, 0, 0], age=0.0, x_min=0.0, x_max=80.0)
        try:
            (frame,) = encoder.encode(line, fd=True)
        except EncodeError:
            expected += bytes([13, 0])  # MAPLINES_NO_SIGNATURE
            continue
        expected += bytes([0, len(frame.data)]) + frame.data
    assert expected.endswith(bytes([13, 0]))
    assert c_core.run(program(), asked) == expected


NO_MESSAGE, NO_SIGNATURE = 1, 13


@pytest.mark.parametrize(
    ("dbc", "is_fd", "refusal"),
    [
        pytest.param("maplines-secoc.dbc", 1, 0, id="authenticated"),
        pytest.param("maplines-secoc.dbc", 0, NO_MESSAGE, id="classic"),
        pytest.param("maplines.dbc", 1, NO_MESSAGE, id="no-message"),
    ],
)
def test_an_encoder_with_a_key_sends_authenticated_frames_only(
    dbc: str, is_fd: int, refusal: int
) -> None:
    asked = struct.pack("<BqBdB", 3, 7, Slot.ROUTE, 0.0, is_fd)
    assert c_core.run(c_core.harness("secoc", layout_of(dbc)), asked)[0] == refusal


@pytest.mark.parametrize("components", [3, 0])
@pytest.mark.parametrize("signed", [0, 1, 2, 3])
@pytest.mark.parametrize("is_busy", [False, True])
def test_a_line_or_scene_of_which_a_frame_is_not_signed(
    components: int, signed: int, is_busy: bool
) -> None:
    """Nothing is sent, and the counters of all owners stay: all of it or none.

    The last freshness values run out, or the security module gives no MAC.
    """
    last = 10**6 if is_busy else MAX_FRESHNESS - signed
    asked = struct.pack("<BI", 5, signed) if is_busy else b""
    asked += struct.pack("<BqBq", 4, last, components, 0)
    refusal, frames, route, pose = struct.unpack("<BBII", c_core.run(program(), asked))
    if signed < 3:
        assert (refusal, frames, route, pose) == (NO_SIGNATURE, 0, 0, 0)
    else:
        assert (refusal, frames) == (0, 3)
        assert (route, pose) == ((3, 0) if components else (1, 1))


def test_a_mac_that_fails_the_second_time_is_no_replay() -> None:
    """The MAC of an old frame is computed twice: also with the freshness value before."""
    layout = LAYOUTS[1]
    sender = Authenticator(*KEYS, clock=clock_at(2**24 + 1000))
    data = sender.secure(bytes(32), DATA_ID, layout)
    asked, answers = b"", []
    for calls in (0, 1, 2):
        asked += struct.pack("<BI", 5, calls) + bytes([1]) + numbers_of(layout)
        asked += struct.pack("<BqqqB", 0, 0, 1, 2**24 + 5000, len(data)) + data
        reason = (Reason.KEY, Reason.MAC, Reason.REPLAY)[calls]
        answers.append((REASONS[reason], 2**24 + 5000))
    assert [*struct.iter_unpack("<Bq", c_core.run(program(), asked))] == answers


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: f"{layout.freshness_bytes} bytes")
def test_a_receiver_decides_as_in_python(layout: SecuredLayout) -> None:
    """Freshness values about the window, replays, other keys, damaged frames, ends of the range."""
    rng, asked, expected, met = random.Random(6), b"", b"", Counter[str]()  # noqa: S311
    for _ in range(4000):
        has_clock = layout.freshness_bytes < 7 or rng.random() < 0.7
        window, now = rng.choice([1, 1000, 1_000_000]), rng.choice(NOWS)
        clock = rng.choice([now, now, -5, 3])
        away = rng.choice([0, 1, -1, window, window + 1, -window, -window - 1, -window - 2, 2**24,
                           -(2**24), 2**24 + window + 1, 2**33])  # fmt: skip
        fresh = max(1, min(now + away, MAX_FRESHNESS))
        last = max(0, min(fresh + rng.choice([-1, 0, 1, -(10**6), 10**6]), MAX_FRESHNESS))
        sender = Authenticator(*KEYS, clock=clock_at(fresh))
        sender.use(rng.choice([1, 7]))
        data = bytearray(sender.secure(rng.randbytes(32), DATA_ID, layout))
        match rng.randrange(6):
            case 0:
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            case 1:
                data = data[: rng.randrange(len(data))]
            case 2:
                data[layout.authentic_bytes - 1] = 3
        receiver = Authenticator(
            *KEYS,
            clock=clock_at(clock) if has_clock else None,
            window_ns=1000 * window,
            not_before=last,
        )
        verify = Verifier(receiver, layout)
        answer = verify(bytes(data), DATA_ID)
        reason = REASONS[answer] if isinstance(answer, Reason) else 0
        met[answer.name if isinstance(answer, Reason) else "accepted"] += 1
        expected += struct.pack("<Bq", reason, verify.last_accepted.get(DATA_ID, last))
        asked += bytes([1]) + numbers_of(layout)
        asked += struct.pack("<BqqqB", has_clock, clock, window, last, len(data)) + bytes(data)
    given = c_core.run(program(), asked)
    wrong = [i for i in range(0, len(expected), 9) if given[i : i + 9] != expected[i : i + 9]]
    assert not wrong, (wrong[0] // 9, given[wrong[0] :][:9], expected[wrong[0] :][:9])
    assert set(met) == {"accepted", "LENGTH", "KEY", "MAC", "REPLAY", "AGE"}
