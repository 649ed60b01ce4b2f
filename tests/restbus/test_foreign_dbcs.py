"""DBCs of others in a restbus: start values, ranges, pages, lengths, and bits of two signals."""

from __future__ import annotations

import json
import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import can
import cantools
import pytest
from e2e import p01, p11
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.bus.clock import RealClock, VirtualClock
from maplines_can.bus.virtual_time import VirtualNetwork, VirtualTimeBus
from maplines_can.cli import main
from maplines_can.logs.j1939 import Reassembler, pgn_of
from maplines_can.restbus import Config, Restbus
from maplines_can.values.errors import RestbusError

HEAD = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A\n\n'
START = 'BA_DEF_ SG_ "GenSigStartValue" INT -1e9 1e9;\nBA_DEF_DEF_ "GenSigStartValue" 0;\n'


def dbc(folder: Path, signals: str, rest: str = "", *, length: int = 8, can_id: int = 256) -> Path:
    """Write a DBC of one message M, whose signals are rows such as ``S : 0|8@1+ (1,0) [0|0]``."""
    rows = "".join(f' SG_ {row.strip()} "" A\n' for row in signals.strip().splitlines())
    path = folder / "m.dbc"
    path.write_text(f"{HEAD}BO_ {can_id} M: {length} A\n{rows}\n{rest}\n", encoding="utf-8")
    return path


def starts(**values: object) -> str:
    return START + "".join(
        f'BA_ "GenSigStartValue" SG_ 256 {name} {value};\n' for name, value in values.items()
    )


def config(path: Path, events: list[dict[str, Any]] | None = None, **message: Any) -> Config:
    entry = {"name": "M", "dbc": str(path), "cycle_ms": 10, **message}
    return Config.from_dict({"message": [entry], "event": events or []})


def frames(config: Config, seconds: float = 0.05) -> list[can.Message]:
    """Return the frames that another node receives on virtual time."""
    clock = VirtualClock()
    network = VirtualNetwork(clock)
    with VirtualTimeBus(network) as bus, VirtualTimeBus(network) as other:
        restbus = Restbus(config, bus, clock)
        restbus.start()
        clock.run_for(seconds)
        restbus.stop()
        return list(iter(lambda: other.recv(0), None))


def payload(path: Path, **signals: Any) -> bytes:
    return bytes(frames(config(path, signals=signals), 0.0)[0].data)


def raw(path: Path, data: bytes) -> dict[str, Any]:
    """Return the raw values that cantools reads in a payload."""
    database: Any = cantools.database.load_file(path)
    decoded: dict[str, Any] = database.decode_message(
        "M", data, scaling=False, decode_choices=False
    )
    return decoded


@given(
    data=st.data(),
    bits=st.integers(1, 64),
    is_signed=st.booleans(),
    is_motorola=st.booleans(),
    factor=st.sampled_from(["1", "2", "0.1", "-0.25", "0.7", "-0.7"]),
    stated_range=st.sampled_from(["[0|0]", "[0|4]", "[100|0]"]),
)
def test_any_signal_starts_with_a_raw_value_and_is_set_to_a_physical_one(
    tmp_path_factory: pytest.TempPathFactory,
    data: Any,
    bits: int,
    is_signed: bool,
    is_motorola: bool,
    factor: str,
    stated_range: str,
) -> None:
    """Each value of its bits, as cantools reads the payload; no range changes a start value."""
    folder = tmp_path_factory.getbasetemp()
    first = data.draw(st.integers(0, 64 - bits))
    place = f"{first ^ 7}|{bits}@0" if is_motorola else f"{first}|{bits}@1"
    lowest = -(2 ** (bits - 1)) if is_signed else 0
    highest = lowest + 2**bits - 1
    value, offset = data.draw(st.integers(lowest, highest)), data.draw(st.integers(-9, 9))
    signal = f"S : {place}{'-' if is_signed else '+'} ({factor},{offset}) "
    started = payload(dbc(folder, signal + stated_range, starts(S=value)))
    for beyond in (lowest - 1, highest + 1):
        path = dbc(folder, signal + stated_range, starts(S=beyond))
        with pytest.raises(RestbusError, match=rf"of its {bits} bits, \[{lowest}, {highest}\]"):
            config(path)
    path = dbc(folder, signal + "[0|0]")
    assert raw(path, started) == {"S": value}
    physical = Fraction(factor) * value + offset
    if physical.denominator == 1 or abs(value) < 2**40:
        value_set = int(physical) if physical.denominator == 1 else float(physical)
        assert raw(path, payload(path, S=value_set)) == {"S": value}


def attribute(kind: str, text: str) -> str:
    """Return a start value of S of a kind of attribute."""
    return f'BA_DEF_ SG_ "GenSigStartValue" {kind};\nBA_ "GenSigStartValue" SG_ 256 S {text};'


def wide(value: int) -> str:
    """Return the bytes of a signal of 64 bits."""
    return value.to_bytes(8, "little").hex()


BYTE, WIDE = "S : 0|8@1+ (1,0) [0|0]", "S : 0|64@1+ (1,0) [0|0]"
ODD = """
    Raw : 0|8@1+ (1,5) [0|4]
    Rev : 8|8@1+ (0.5,-20) [100|0]
    Nil : 16|8@1+ (0,1) [0|0]
    Far : 60|8@1+ (1,0) [0|0]
    Five : 24|8@1+ (1,0) [5|10]
    Zero : 32|8@1+ (1,0) [0.0|0.0]
    Text : 40|8@1+ (1,0) [0|3]
"""
MUX = """
    Mux M : 0|8@1+ (1,0) [0|0]
    Sig m3 : 8|8@1+ (1,0) [0|0]
    Oth m9 : 8|8@1+ (1,0) [0|0]
    All : 16|8@1+ (1,0) [0|0]
"""
#: One bit has no page 5; what is only there shares no bits.
MUX_OF_A_BIT = MUX.replace("0|8@1+", "0|1@1+").replace("m3", "m1").replace("m9 : 8", "m5 : 16")
SHARED = """
    Low : 0|8@1+ (1,0) [0|0]
    Word : 0|16@1+ (1,0) [0|0]
    Motorola : 7|12@0+ (1,0) [0|0]
    Alone : 56|8@1+ (1,0) [0|0]
"""
PAGE_0 = MUX.replace("m9", "m0")
MOST = starts(S="1.84467440737096E+19")
FLOAT = f"SIG_VALTYPE_ 256 F : 1;\n{starts(F='1.5').replace('INT -1e9 1e9', 'FLOAT 0 1')}"


@pytest.mark.parametrize(
    ("signals", "rest", "stated", "expected"),
    [
        # Start values are raw: neither a name, a range nor a float changes them.
        ("S : 0|4@1+ (1,0) [0|8]", starts(S=15) + 'VAL_ 256 S 0 "P" 15 "SNA" ;', {}, "0f"),
        ("S : 0|8@1+ (1,5) [0|4]", starts(S=3), {}, "03"),
        ("S : 0|8@1+ (0.5,0) [100|0]", starts(S=3), {}, "03"),
        ("S : 0|8@1+ (0,7) [0|0]", starts(S=9), {}, "09"),
        (WIDE, MOST, {}, "ff" * 8),
        ("F : 32|32@1- (2,0) [0|0]", FLOAT, {}, "000000000000c03f"),
        ("S : 0|24@1- (1,0) [0|0]", "SIG_VALTYPE_ 256 S : 1;", {}, "00" * 8),
        # Of each kind of attribute: cantools makes floats of FLOAT, and refuses STRING.
        (WIDE, attribute("INT 0 65535", "12"), {}, wide(12)),
        (WIDE, attribute("HEX 0 65535", "12"), {}, wide(12)),
        (WIDE, attribute("FLOAT 0 1E+011", "12"), {}, wide(12)),
        (WIDE, attribute("FLOAT 0 1E+011", "9223372036854775809"), {}, wide(2**63 + 1)),
        (WIDE, attribute("STRING", '"12"'), {}, wide(12)),
        (WIDE, attribute("STRING", '"0x1F"'), {}, wide(31)),
        (WIDE, attribute('ENUM "0","1","a;b"', "2"), {}, wide(2)),
        # Without one: physical 0, or the default of the attribute if it fits.
        ("S : 0|8@1+ (1,-40) [0|0]", "", {}, "28"),
        ("S : 0|8@1+ (1,-40) [0|0]", START, {}, "00"),
        ("S : 0|8@1+ (1,-40) [0|0]", START.replace('" 0;', '" 7;'), {}, "07"),
        ("S : 0|8@1+ (1,-40) [0|0]", START.replace('" 0;', '" 256;'), {}, "28"),
        (BYTE + "\nS : 8|8@1+ (1,0) [0|0]", starts(S=5), {}, "050500"),
        (ODD, "", {}, "00" * 8),
        # Values of users, of which a named one is raw; a list is sent in turn.
        (ODD, 'VAL_ 256 Text 9 "Nine" ;', {"Text": ["Nine", 2], "Zero": 255},
         "00000000ff09 00000000ff02 00000000ff09 00000000ff02"),
        (BYTE, "", {"S": {"ramp": [0, 80], "period_s": 0.04, "phase_deg": 90}}, "14 28 3c 00 14"),
        ("S : 0|8@1+ (0.5,0) [0|0]", "", {"S": {"count": [0, 1], "step": 0.5}}, "00 01 02 00"),
        ("S : 0|8@1+ (2,10) [0|0]", 'VAL_ 256 S 3 "Three" 5 "Five" ;',
         {"S": {"count": ["Three", "Five"], "step": 2}}, "03 04 05"),
        # Wide values between floats have the decimal factor.
        (WIDE.replace("(1,0)", "(0.5,7)"), "", {"S": 2**61 + 8}, wide(2**62 + 2)),
        (WIDE.replace("(1,0)", "(0.5,7)"), "", {"S": 2**20 + 7}, wide(2**21)),
        (WIDE.replace("(1,0)", "(0.1,0)"), "", {"S": 2**60 + 1}, wide(10 * 2**60 + 10)),
        # Pages that exist are sent in turn, unless a start value is one of them.
        (MUX, "", {"Sig": 1, "Oth": 2, "All": 5}, "030105 090205 030105 090205"),
        (PAGE_0, starts(Mux=3), {}, "03 03 03"),
        (PAGE_0, starts(Mux=1), {}, "00 03 00"),
        (PAGE_0, START, {}, "00 03 00"),
        (MUX_OF_A_BIT, starts(Oth=1, All=2), {"Sig": 7}, "010702 010702"),
        (MUX, 'VAL_ 256 Mux 3 "Three" 12 "Empty" ;', {}, "03 09"),
        (MUX, 'VAL_ 256 Mux 12 "Empty" ;', {"Mux": "Empty", "Sig": 255}, "0c00000000000000"),
        (MUX, "", {"Mux": {"count": [3, 9], "step": 6}}, "03 09 03"),
        (MUX, "", {"Mux": [3, 9]}, "03 09 03"),
        # Of bits that signals share, those are sent that are stated; set before start.
        (SHARED, "", {"Low": 0x12, "Alone": 255}, "12000000000000ff"),
        (SHARED, "", {"Word": 0x1234}, "3412"),
        (SHARED, "", {"Motorola": 0xABC}, "abc0"),
        (SHARED, "", {"Low": 0x34, "Word": 0x1234}, "3412"),
        (SHARED, starts(Word=0xABCD), {"Low": 0x12}, "12ab"),
        (SHARED, starts(Word=0xABCD), {}, "cdab"),
        (SHARED, starts(Low=0xCD, Word=0xABCD), {}, "cdab"),
        (SHARED, starts(Low=1, Word=0xAB02), {}, "01ab"),
        (MUX + "Over : 0|4@1+ (1,0) [0|0]", "", {"Over": 3, "Mux": 3}, "03"),
    ],
)  # fmt: skip
def test_frames_begin_with_these_bytes(
    tmp_path: Path, signals: str, rest: str, stated: dict[str, Any], expected: str
) -> None:
    bytes_of_frames = expected.split()
    made = config(dbc(tmp_path, signals, rest), signals=stated)
    sent = [m.data.hex() for m in frames(made, 0.01 * (len(bytes_of_frames) - 1))]
    assert [f[: len(e)] for f, e in zip(sent, bytes_of_frames, strict=True)] == bytes_of_frames


@pytest.mark.parametrize(
    ("signals", "rest", "events", "expected"),
    [
        (MUX, "", {0.005: "set M.Mux 9", 0.025: "reset M.Mux"}, "03 09 09 09 03"),
        (SHARED, "", {0.005: "set M.Low 1", 0.015: "reset M.Low", 0.025: "set M.Word 2"},
         "0000 0100 0000 0200"),
        (SHARED, starts(Word=0xABCD), {0.005: "set M.Low 1"}, "cdab 01ab"),
        (SHARED, "", {0.005: "set M.Low 1", 0.006: "set M.Alone 2", 0.015: "reset M.Low"},
         "0000000000000000 0100000000000002 0000000000000002"),
    ],
)  # fmt: skip
def test_commands_set_and_reset_one_signal(
    tmp_path: Path, signals: str, rest: str, events: dict[float, str], expected: str
) -> None:
    """The pages go on as if none had been set."""
    commands = [{"at_s": t, "command": command} for t, command in events.items()]
    sent = frames(config(dbc(tmp_path, signals, rest), commands), 0.01 * expected.count(" "))
    assert [m.data.hex()[: len(e)] for m, e in zip(sent, expected.split(), strict=True)] == (
        expected.split()
    )


PROTECTED = """
    A : 0|8@1+ (1,0) [0|0]
    B : 8|4@1+ (1,0) [0|0]
    C : 17|8@1+ (1,0) [0|0]
    D : 62|4@1+ (1,0) [0|0]
"""
E2E: dict[str, Any] = {"profile": 2, "data_id": [0] * 16, "counter": "B", "crc": "A"}
#: DBCs by name: the signals and the rest.
DBCS = {
    "odd": (ODD, 'VAL_ 256 Text 1 "Twice" 2 "Twice" 9 "Nine" 300 "Large" ;'),
    "start": (BYTE, starts(S="1.5").replace("INT", "FLOAT")),
    "byte": (BYTE, ""), "mux": (MUX, ""), "bit": (MUX_OF_A_BIT, ""), "shared": (SHARED, ""),
    "over": (MUX + "Over : 0|4@1+ (1,0) [0|0]", ""), "e2e": (PROTECTED, ""),
    "twice": (BYTE + "\nS : 8|8@1+ (1,0) [0|0]", ""),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "signals", "text"),
    [
        ("start", {}, r"S: its start value .*'1.5', is no raw value of its 8 bits, \[0, 255\]"),
        ("twice", {"S": 1}, "M has 2 signals 'S'; rename them"),
        ("odd", {"Raw": 10}, r"Raw cannot be set: its range in the DBC, \[0\|4\], has none of"),
        ("odd", {"Rev": 50}, r"Rev cannot be set: its range in the DBC is reversed, \[100\|0\]"),
        ("odd", {"Nil": 1}, "Nil cannot be set: its factor in the DBC is 0"),
        ("odd", {"Far": 0}, "Far cannot be set: its bits lie beyond the 8 bytes"),
        ("odd", {"Five": 4}, r"Five must be a number in \[5, 10\] km, got 4"),
        ("odd", {"Five": {"ramp": [5], "period_s": 1}}, r"ramp must be \[FIRST, LAST\], got \[5"),
        ("odd", {"Five": {"period_s": 1}}, "Five needs count, ramp, sine or script"),
        ("odd", {"Five": {"script": "nowhere.py"}}, 'Five: script must be "FILE.py:FUNCTION"'),
        ("odd", {"Five": {"script": ":f"}}, 'Five: script must be "FILE.py:FUNCTION"'),
        ("odd", {"Five": {"count": [5, 9], "step": 5}}, r"step must be .* in \[1e-12, 4\] km"),
        ("odd", {"Five": {"script": "s.py:g"}}, "s.py has no function 'g'; its functions are: f"),
        ("odd", {"Five": 11}, r"Five must be a number in \[5, 10\] km, got 11"),
        ("odd", {"Zero": 256}, r"Zero must be a number in \[0, 255\], got 256"),
        ("odd", {"Zero": 10**400}, r"Zero must be a number in \[0, 255\]"),
        ("odd", {"Zero": float("nan")}, r"Zero must be a number in \[0, 255\], got nan"),
        ("odd", {"Text": "Twice"}, "'Twice' is the name of 1 and 2; give the number"),
        ("odd", {"Text": "Large"}, "Text: 'Large' is 300, no raw value of its 8 bits"),
        ("odd", {"Text": [1, 4]}, r"Text must be a number in \[0, 3\], got 4"),
        *(
            ("mux", {"Mux": value}, f"Mux{key} selects a page, and .* is none .* pages are 3, 9")
            for value, key in (
                (1, ""), ([3, 4], ""), ({"count": [3, 9]}, ": count"),
                ({"ramp": [3, 9], "period_s": 1}, ": ramp"),
                ({"sine": [9, 3], "period_s": 1}, ": sine"),
            )
        ),
        # It would send a page twice.
        ("mux", {"Mux": {"count": [3, 9], "step": 0.5}}, r"step must be .* \[1, 6\], got 0.5"),
        ("bit", {"Oth": 7}, "Oth: is on no page that M can have"),
        ("shared", {"Low": 1, "Word": 0}, "message M: Low and Word have common bits"),
        ("shared", {"Low": [0, 1], "Word": 0}, "Low and Word have common bits"),
        ("shared", {"Low": {"count": [0, 9]}, "Word": 0}, "Low and Word have common bits"),
        # A multiplexer changes, so that nothing agrees with it, if it is not set.
        ("over", {"Over": 3}, "Mux and Over have common bits"),
    ],
)  # fmt: skip
def test_a_value_that_a_signal_cannot_have_is_an_error_at_the_start(
    tmp_path: Path, name: str, signals: dict[str, Any], text: str
) -> None:
    (tmp_path / "s.py").write_text("def f(t):\n    return t\n")
    path = dbc(tmp_path, *DBCS[name])
    path.write_text(path.read_text().replace('[5|10] ""', '[5|10] "km"'))
    entry = {"name": "M", "dbc": str(path), "cycle_ms": 10, "signals": signals}
    with pytest.raises(RestbusError, match=text):
        Config.from_dict({"message": [entry]}, tmp_path)


@pytest.mark.parametrize(
    ("name", "entry", "text"),
    [
        ("byte", {"count": 2.5}, r"count must be a whole number in \[1, 1000\]"),
        ("byte", {"priority": 3}, "unknown key 'priority'"),
        ("e2e", {"e2e": E2E | {"data_id": [1.5] * 16}}, "data_id must be a whole number in .*1.5"),
        ("e2e", {"e2e": E2E | {"data_id": 7}}, "data_id of profile 2 must be a list of 16"),
        ("e2e", {"e2e": E2E | {"data_id": [0] * 15}}, "data_id of profile 2 must be a list of 16"),
        ("e2e", {"e2e": E2E | {"counter": "D"}}, "counter: D cannot be sent: its bits lie beyond"),
        ("e2e", {"e2e": E2E | {"crc": "C"}}, "crc must begin with a byte, C does not"),
        ("e2e", {"e2e": E2E | {"crcs": 1}}, "unknown key 'crcs'; did you mean 'crc'"),
        ("e2e", {"e2e": E2E | {"profile": 11, "data_id": 1, "data_id_mode": "low"}},
         "must be both or nibble, got 'low'"),
        ("mode", {"e2e": E2E | {"profile": 5, "data_id": 1, "data_id_mode": "nibble"}},
         "unknown key 'data_id_mode'"),
        ("nibble", {"e2e": E2E | {"profile": 11, "data_id": 1, "data_id_mode": "nibble"}},
         "nibble is missing; name the signal of 4 bits"),
    ],
)  # fmt: skip
def test_a_setting_that_a_message_cannot_have(
    tmp_path: Path, name: str, entry: dict[str, Any], text: str
) -> None:
    more = {
        "mode": ("A : 0|16@1+ (1,0) [0|0]\nB : 16|8@1+ (1,0) [0|0]", ""),
        "nibble": (PROTECTED.replace("C : 17|8", "C : 12|8"), ""),
    }
    path = dbc(tmp_path, *(DBCS | more)[name])
    with pytest.raises(RestbusError, match=text):
        config(path, **entry)


@pytest.mark.parametrize(
    ("name", "commands", "entry", "text"),
    [
        ("mux", ["set M.Mux 1"], {}, r"event at 0 s: M.Mux selects a page, and 1"),
        ("shared", ["set M.Low 1", "set M.Word 2"], {},
         "event at 1 s: M.Word has bits of Low, which has another value; reset Low"),
        ("e2e", ["set M.B 1"], {"e2e": E2E}, r"M.B is set by e2e; damage it with a fault instead"),
    ],
)  # fmt: skip
def test_a_command_that_cannot_be_obeyed_is_an_error_at_the_start(
    tmp_path: Path, name: str, commands: list[str], entry: dict[str, Any], text: str
) -> None:
    events = [{"at_s": t, "command": command} for t, command in enumerate(commands)]
    with pytest.raises(RestbusError, match=text):
        frames(config(dbc(tmp_path, *DBCS[name]), events, **entry))


def test_messages_of_one_name_and_messages_that_are_too_long(tmp_path: Path) -> None:
    with pytest.raises(RestbusError, match="has 65 bytes, and 64 can be sent at most"):
        config(dbc(tmp_path, BYTE, length=65))
    (tmp_path / "m.dbc").write_text(f"{HEAD}BO_ 1 M: 8 A\n\nBO_ 2 M: 8 A\n")
    with pytest.raises(RestbusError, match="has 2 messages of this name"):
        config(tmp_path / "m.dbc")


@pytest.mark.parametrize(
    ("signals", "rest", "notices"),
    [
        (ODD, "", ["M: sent without Far: its bits lie beyond the 8 bytes of the message"]),
        (MUX_OF_A_BIT, starts(Oth=1, All=2), []),
        (SHARED, starts(Low=0xCD, Word=0xABCD), []),
        (SHARED, starts(Low=1, Word=0xAB02),
         ["M: start values differ in common bits, in which are sent: Low before Word"]),
        ("S : 0|24@1- (1,0) [0|0]", "SIG_VALTYPE_ 256 S : 1;",
         ["M: sent without S: it is a float of 24 bits"]),
        # Nobody sets these multiplexers, so it is no error.
        ("A M : 0|8@1+ (1,0) [0|0]\nB M : 4|8@1+ (1,0) [0|0]\nC m1 : 16|8@1+ (1,0) [0|0]\n"
         "D m3 : 24|8@1+ (1,0) [0|0]", "SG_MUL_VAL_ 256 C A 1-2;\nSG_MUL_VAL_ 256 D B 3-3;",
         ["M: start values differ in common bits, in which are sent: A before B"]),
    ],
)  # fmt: skip
def test_what_is_odd_is_told(tmp_path: Path, signals: str, rest: str, notices: list[str]) -> None:
    assert config(dbc(tmp_path, signals, rest)).notices == notices


def test_a_sine_between_its_ends(tmp_path: Path) -> None:
    """An eighth and a twelfth of a period beyond the phase."""
    path = dbc(tmp_path, "S : 0|16@1- (0.001,0) [0|0]")
    for period, phase, expected in (
        (0.08, 360, [0, 7.071, 10, 7.071]),
        (0.08, 90, [10, 7.071, 0, -7.071]),
        (0.12, 360, [0, 5, 8.66, 10]),
    ):
        sine = {"sine": [-10, 10], "period_s": period, "phase_deg": phase}
        sent = frames(config(path, signals={"S": sine}), 0.03)
        values = [int.from_bytes(m.data[:2], "little", signed=True) / 1000 for m in sent]
        assert values == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("bits", "code", "most"), [(16, "e", 65504), (32, "f", 3.4e38), (64, "d", 1e308)]
)
def test_floats_of_each_length(tmp_path: Path, bits: int, code: str, most: float) -> None:
    """Wide whole numbers are floats here; more than the greatest is refused, and what is none."""
    kind = "SIG_VALTYPE_ 256 S : 2;" if bits == 64 else "SIG_VALTYPE_ 256 S : 1;"
    path = dbc(tmp_path, f"S : 0|{bits}@1- (0.5,0) [0|0]", kind)
    for value in (-0.25, most / 2, 2**60 + 1 if bits > 16 else 3):
        data = payload(path, S=value)
        assert struct.unpack_from(f"<{code}", data) == struct.unpack(
            f"<{code}", struct.pack(f"<{code}", 2 * value)
        )
    for beyond in (2 * most, float("inf"), float("-inf"), float("nan")):
        with pytest.raises(RestbusError, match="S must be a number in"):
            payload(path, S=beyond)


def test_the_longest_signal_that_can_be_set(tmp_path: Path) -> None:
    rows = "S : 0|1000@1+ (1,0) [0|0]\nT : 1000|1001@1+ (1,0) [0|0]"
    path = dbc(tmp_path, rows, J1939, length=300, can_id=0x98FECA03)
    sent = frames(config(path, cycle_ms=60_000, signals={"S": 2**1000 - 1}), 10.0)
    assert b"".join(bytes(m.data[1:]) for m in sent[1:])[:126] == b"\xff" * 125 + b"\0"
    with pytest.raises(RestbusError, match="T cannot be set: it has more than 1000 bits"):
        config(path, cycle_ms=60_000, signals={"T": 0})


@pytest.mark.parametrize("factor", ["1", "1.0", "2"])
def test_values_of_64_bits_are_exact(tmp_path: Path, factor: str) -> None:
    """2^63 + 1 is no float; a command has it as text. The range has 15 digits, as tools write."""
    path = dbc(tmp_path, f"S : 0|64@1+ ({factor},0) [0|3.68934881474191E+019]")
    value = (2**63 + 1) * int(float(factor))
    event = {"at_s": 0.02, "command": f"set M.S {value - 2 * int(float(factor))}"}
    counting = {"count": [value, value + 10], "step": 2}
    for stated, first in ((value, 2**63 + 1), (counting, 2**63 + 1)):
        sent = frames(config(path, [event], signals={"S": stated}), 0.03)
        numbers = [int.from_bytes(m.data, "little") for m in sent]
        assert (numbers[0], numbers[-1]) == (first, first - 2)
    sent = frames(config(path, signals={"S": {"count": [value, value + 24], "step": 12}}), 0.03)
    steps = [int.from_bytes(m.data, "little") - (2**63 + 1) for m in sent]
    assert steps == [n % 3 * 12 // int(float(factor)) for n in range(4)]


@pytest.mark.parametrize("order", ["0|64@1", "7|64@0"])
def test_sweeps_end_at_the_limits(tmp_path: Path, order: str) -> None:
    path = dbc(tmp_path, f"S : {order}- (1,0) [0|0]")
    ramp = {"ramp": [-(2**63), 2**63 - 1], "period_s": 0.03, "phase_deg": 359.9999999999999}
    data = bytes(frames(config(path, signals={"S": ramp}), 0.0)[0].data)
    assert int.from_bytes(data, "little" if "@1" in order else "big", signed=True) > 2**62


def test_pages_of_pages_are_sent_in_turn(tmp_path: Path) -> None:
    """Two multiplexers, one with ranges and a multiplexer on a page of its own (SG_MUL_VAL_)."""
    signals = """
        A M : 0|8@1+ (1,0) [0|0]
        B m1M : 8|8@1+ (1,0) [0|0]
        C m4 : 16|8@1+ (1,7) [0|0]
        D m6 : 16|8@1- (1,0) [0|0]
        E m2 : 16|8@1+ (1,0) [0|0]
        F M : 32|8@1+ (1,0) [0|0]
        G m1 : 40|8@1+ (1,0) [0|0]
    """
    rest = (
        "SG_MUL_VAL_ 256 B A 1-1;\nSG_MUL_VAL_ 256 C B 4-5;\nSG_MUL_VAL_ 256 D B 6-6;\n"
        "SG_MUL_VAL_ 256 E A 2-2;\nSG_MUL_VAL_ 256 G F 1-2;\n"
    )
    path = dbc(tmp_path, signals, rest)
    given = {"C": 9, "D": -3, "E": 4, "G": 8}
    sent = [raw(path, bytes(m.data)) for m in frames(config(path, signals=given), 0.05)]
    pages = [(m["A"], m.get("B"), m["F"]) for m in sent]
    assert pages == [(1, 4, 1), (2, None, 2), (1, 5, 1), (2, None, 2), (1, 6, 1), (2, None, 2)]
    assert [m.get("C", m.get("D", m.get("E"))) for m in sent] == [2, 4, 2, 4, -3, 4]
    fixed = [raw(path, bytes(m.data)) for m in frames(config(path, signals={"A": 1}), 0.02)]
    assert [m["B"] for m in fixed] == [4, 5, 6]


def test_a_page_set_live_that_does_not_exist_is_refused_and_the_run_goes_on(tmp_path: Path) -> None:
    errors: list[str] = []
    clock = VirtualClock()
    network = VirtualNetwork(clock)
    with VirtualTimeBus(network) as bus, VirtualTimeBus(network) as other:
        made = config(dbc(tmp_path, MUX), signals={"Mux": 3})
        restbus = Restbus(made, bus, clock, on_error=errors.append)
        restbus.start()
        for text in ("set M.Mux 1", "set M.Mux 999", "set M.Nope 1"):
            restbus.command(text)
        clock.run_for(0.1)
        received = list(iter(lambda: other.recv(0), None))
    assert [m.data[0] for m in received] == [3] * 11
    assert errors[0] == "M.Mux selects a page, and 1 is none of the DBC; its pages are 3, 9"
    assert len(errors) == 3


@pytest.mark.parametrize("can_id", [256, 0x80000000 | 0x1ABCDEF0])
@pytest.mark.parametrize(
    ("length", "sent"),
    [(0, 0), (1, 1), (8, 8), (9, 12), (10, 12), (12, 12), (13, 16), (21, 24), (33, 48), (64, 64)],
)
def test_the_length_decides_on_can_fd(tmp_path: Path, length: int, sent: int, can_id: int) -> None:
    """Without VFrameFormat cantools says that no message is of CAN FD."""
    signal = f"S : {8 * length - 8}|8@1+ (1,0) [0|0]" if length else ""
    made = config(
        dbc(tmp_path, signal, length=length, can_id=can_id), signals={"S": 255} if length else {}
    )
    message = frames(made, 0.0)[0]
    assert (message.is_fd, message.is_extended_id) == (length > 8, can_id > 2047)
    assert message.arbitration_id == can_id & 0x1FFFFFFF
    expected = bytes(length - 1) + b"\xff" if length else b""
    assert bytes(message.data) == expected.ljust(sent, b"\0")
    said = [text for text in made.notices if f"no frame has {length} bytes; {sent} are" in text]
    assert len(said) == (sent > length)


def test_a_short_message_is_of_can_fd_if_the_dbc_says_so(tmp_path: Path) -> None:
    rest = (
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","StandardCAN_FD";\n'
        'BA_DEF_DEF_ "VFrameFormat" "StandardCAN";\nBA_ "VFrameFormat" BO_ 256 2;\n'
    )
    made = config(dbc(tmp_path, "S : 0|8@1+ (1,0) [0|0]", rest))
    assert [(m.is_fd, len(m.data)) for m in frames(made, 0.0)] == [(True, 8)]
    assert made.notices == []


@pytest.mark.parametrize("suffix", ["log", "asc", "blf", "mf4"])
def test_recordings_have_can_fd_frames_of_whole_length(
    tmp_path: Path, suffix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """python-can reads them; the length is in --json and on standard error."""
    if suffix == "mf4":
        pytest.importorskip("asammdf")
    path = dbc(tmp_path, "S : 64|8@1+ (1,0) [0|0]", starts(S=77), length=10)
    table, log = tmp_path / "r.toml", tmp_path / f"r.{suffix}"
    text = f"seconds = 0.05\n[[message]]\nname = 'M'\ndbc = '{path.name}'\ncycle_ms = 10\n"
    table.write_text(text)
    command = ["restbus", str(table), "--virtual-time", "--json", "--record", str(log)]
    assert main(command) == 0
    out, err = capsys.readouterr()
    assert "M: no frame has 10 bytes; 12 are sent" in err
    assert any("12 are sent" in notice for notice in json.loads(out)["notices"])
    with can.LogReader(log) as reader:
        read = list(reader)
    assert {(m.is_fd, len(m.data), m.data[8], m.bitrate_switch) for m in read} == {
        (True, 12, 77, True)
    }


@pytest.mark.parametrize("lines", [False, True])
def test_can_fd_on_a_bus_of_classic_can_is_refused_at_the_start(
    tmp_path: Path, lines: bool
) -> None:
    """A virtual bus of python-can carries CAN FD, although it says that it does not."""
    made = config(dbc(tmp_path, "S : 0|8@1+ (1,0) [0|0]", length=8 if lines else 64))
    if lines:
        table = {"scenario": "production", "fd": True, "moves": False}
        made.lines = Config.from_dict({"lines": table}).lines
    name = "lines" if lines else "M"
    with (
        can.Bus("fd", interface="virtual") as bus,
        pytest.raises(RestbusError, match=f"{name}: sent as CAN FD, and .* open for classic CAN"),
    ):
        Restbus(made, bus, RealClock())
    with can.Bus("fd", interface="virtual", protocol=can.CanProtocol.CAN_FD) as bus:
        Restbus(made, bus, RealClock())


@pytest.mark.parametrize("fd", ["", "fd = true"])
def test_the_command_needs_fd_for_can_fd(
    tmp_path: Path,
    fd: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """``--fd`` and [bus] say so, of a virtual bus, too."""
    monkeypatch.setattr("sys.stdin", None)
    path = dbc(tmp_path, "S : 0|8@1+ (1,0) [0|0]", length=64)
    table = tmp_path / "r.toml"
    text = f"[bus]\ninterface = 'virtual'\n{fd}\n[[message]]\nname = 'M'\ndbc = '{path.name}'\n"
    table.write_text(text + "cycle_ms = 10\n")
    assert main(["restbus", str(table), "--seconds", "0.02"]) == (0 if fd else 1)
    assert ("M: sent as CAN FD, and virtual" in capsys.readouterr().err) == (not fd)


# ---- the nibble of E2E -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("profile", "check", "mode"),
    [
        pytest.param(1, p01.e2e_p01_check, p01.E2E_P01_DATAID_NIBBLE, id="1"),
        pytest.param(11, p11.e2e_p11_check, p11.E2E_P11_DATAID_NIBBLE, id="11"),
    ],
)
@pytest.mark.parametrize("nibble", ["none", "signal", "named"])
def test_the_nibble_of_the_data_id_is_sent(
    tmp_path: Path, profile: int, check: Any, mode: int, nibble: str
) -> None:
    """It stands beside the counter, with or without a signal; the package autosar-e2e checks it."""
    signals = "Crc : 0|8@1+ (1,0) [0|0]\nCounter : 8|4@1+ (1,0) [0|0]\nS : 16|8@1+ (1,0) [0|0]"
    if nibble != "none":
        signals += "\nId : 12|4@1+ (2,1) [0|0]"
    e2e: dict[str, Any] = {"profile": profile, "data_id": 0x934, "data_id_mode": "nibble"}
    e2e |= {"counter": "Counter", "crc": "Crc"} | ({"nibble": "Id"} if nibble == "named" else {})
    path = dbc(tmp_path, signals)
    sent = [bytearray(m.data) for m in frames(config(path, e2e=e2e, signals={"S": 7}), 0.2)]
    assert [m[1] for m in sent] == [0x90 | n % 15 for n in range(21)]
    assert all(check(m, 0x934, data_id_mode=mode) for m in sent)
    if nibble != "none":
        with pytest.raises(RestbusError, match="Id is set by e2e"):
            config(path, e2e=e2e, signals={"Id": 3})
    with pytest.raises(RestbusError, match=r"data_id must be a whole number in \[0, 4095\]"):
        config(path, e2e=e2e | {"data_id": 0x1934})


def test_a_header_behind_other_bytes_and_of_motorola_bytes(tmp_path: Path) -> None:
    """A checksum of one byte has no order; the nibble stays beside the counter."""
    path = dbc(tmp_path, "Crc : 23|8@0+ (1,0) [0|0]\nCounter : 27|4@0+ (1,0) [0|0]")
    e2e = {"profile": 11, "data_id": 0x934, "data_id_mode": "nibble"}
    e2e |= {"counter": "Counter", "crc": "Crc"}
    sent = [bytearray(m.data) for m in frames(config(path, e2e=e2e), 0.02)]
    assert [m[3] for m in sent] == [0x90, 0x91, 0x92]
    mode = p11.E2E_P11_DATAID_NIBBLE
    assert all(p11.e2e_p11_check(m, 0x934, data_id_mode=mode, offset=2) for m in sent)


# ---- J1939 -------------------------------------------------------------------------------

J1939 = (
    'BA_DEF_ "ProtocolType" STRING;\nBA_DEF_ BU_ "NmStationAddress" INT 0 255;\n'
    'BA_ "ProtocolType" "J1939";\n'
)
NODE = 'BA_ "NmStationAddress" BU_ A 37;\n'


@pytest.mark.parametrize(
    ("stated", "node", "table", "expected"),
    [
        pytest.param(0x18FEF1FE, NODE, {}, 0x18FEF125, id="address of the node"),
        pytest.param(0x18FEF103, NODE, {}, 0x18FEF103, id="address of the identifier"),
        pytest.param(0x18FEF1FE, "", {}, 0x18FEF1FE, id="no address"),
        pytest.param(0x18FEF1FE, NODE, {"source_address": 0}, 0x18FEF100, id="source_address"),
        pytest.param(0x18FEF103, "", {"priority": 0}, 0x00FEF103, id="priority"),
    ],
)
def test_a_message_of_j1939_has_the_address_of_its_sender(
    tmp_path: Path, stated: int, node: str, table: dict[str, Any], expected: int
) -> None:
    path = dbc(tmp_path, "S : 0|8@1+ (1,0) [0|0]", J1939 + node, can_id=0x80000000 | stated)
    made = config(path, **table)
    assert {m.arbitration_id for m in frames(made)} == {expected}
    assert made.notices == (
        ["M: the DBC has no address of the sender; 254 is sent, set source_address"]
        if expected & 0xFF == 0xFE
        else []
    )
    with pytest.raises(RestbusError, match=r"source_address must be .* in \[0, 253\], got 254"):
        config(path, source_address=254)


def test_long_messages_of_j1939_are_announced_and_sent_packet_by_packet(tmp_path: Path) -> None:
    """The bytes are those of J1939-21, whose packets are 50 to 200 ms apart."""
    path = dbc(
        tmp_path, "S : 0|16@1+ (1,0) [0|0]\n T : 152|8@1+ (1,0) [0|0]", J1939, length=20,
        can_id=0x80000000 | 0x18FECA03,
    )  # fmt: skip
    made = config(path, cycle_ms=200, signals={"S": 0x1234, "T": 0xAB})
    sent = frames(made, 0.2)
    assert [(m.arbitration_id, bytes(m.data).hex()) for m in sent] == [
        (0x1CECFF03, "20140003ffcafe00"),
        (0x1CEBFF03, "0134120000000000"),
        (0x1CEBFF03, "0200000000000000"),
        (0x1CEBFF03, "030000000000abff"),
        (0x1CECFF03, "20140003ffcafe00"),
    ]
    assert [round(m.timestamp * 1e3) for m in sent] == [0, 50, 100, 150, 200]
    assert not any(m.is_fd for m in sent)
    assert all(m.is_extended_id for m in sent)
    clock = VirtualClock()
    with VirtualTimeBus(VirtualNetwork(clock)) as bus:
        restbus = Restbus(made, bus, clock)
        restbus.start()
        clock.run_for(0.06)
        counts = restbus.as_dict()
    assert (counts["frames"], counts["messages"]["M"]["frames"]) == (2, 2)


def test_a_long_message_for_all_of_a_group_with_a_receiver(tmp_path: Path) -> None:
    """The announcement names the parameter group without the receiver; from F0 on there is none."""
    for can_id, group in ((0x99EFFF03, "00ef01"), (0x98F00503, "05f000")):
        path = dbc(tmp_path, "S : 0|8@1+ (1,0) [0|0]", J1939, length=9, can_id=can_id)
        sent = frames(config(path, cycle_ms=1000), 0.0)
        assert bytes(sent[0].data).hex() == f"20090002ff{group}"


def test_an_address_sends_one_long_message_after_the_other(tmp_path: Path) -> None:
    """Packets do not say to which message they belong."""
    names = {"P": 0x18FECA03, "Q": 0x18FECB03, "R": 0x18FECC04}
    blocks = "".join(
        f'BO_ {0x80000000 | can_id} {name}: 15 A\n SG_ S : 112|8@1+ (1,0) [0|0] "" A\n\n'
        for name, can_id in names.items()
    )
    path = tmp_path / "m.dbc"
    path.write_text(f"{HEAD}{blocks}{J1939}")
    table = {
        "dbc": str(path),
        "message": [
            {"name": name, "cycle_ms": 1000, "signals": {"S": n}} for n, name in enumerate(names, 1)
        ],
    }
    receiver = Reassembler([0xFECA, 0xFECB, 0xFECC])
    sent = frames(Config.from_dict(table), 0.9)
    found = [receiver.feed(m.arbitration_id, bytes(m.data)) for m in sent]
    whole = {(pgn_of(one.can_id), one.can_id & 0xFF, one.data) for one in found if one}
    assert whole == {(0xFEC9 + n, 4 if n == 3 else 3, bytes(14) + bytes([n])) for n in (1, 2, 3)}


@pytest.mark.parametrize(
    ("can_id", "length", "cycle_ms", "text"),
    [
        (0x19EF0503, 20, 1000, "has 20 bytes for one address"),
        (0x18EF0503, 20, 1000, "has 20 bytes for one address, for which J1939 needs the answers"),
        (0x18FECA03, 1786, 60_000, "has 1786 bytes, and 1785 can be sent at most"),
        (0x18FECA03, 20, 150, "J1939 sends its 4 frames 50 ms apart, and address 3 has no time"),
    ],
)
def test_a_long_message_of_j1939_that_cannot_be_sent_is_refused_by_name(
    tmp_path: Path, can_id: int, length: int, cycle_ms: int, text: str
) -> None:
    path = dbc(tmp_path, "S : 0|8@1+ (1,0) [0|0]", J1939, length=length, can_id=0x80000000 | can_id)
    with pytest.raises(RestbusError, match=f"message M: {text}"):
        frames(config(path, cycle_ms=cycle_ms))
