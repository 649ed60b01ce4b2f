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


# ---- start values ----------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("signal", "start", "rest", "expected"),
    [
        pytest.param("S : 0|4@1+ (1,0) [0|8]", 15, 'VAL_ 256 S 0 "P" 15 "SNA" ;', 15, id="named"),
        pytest.param("S : 0|8@1+ (1,5) [0|4]", 3, "", 3, id="disjoint range"),
        pytest.param("S : 0|8@1+ (0.5,0) [100|0]", 3, "", 3, id="reversed range"),
        pytest.param("S : 0|8@1+ (0,7) [0|0]", 9, "", 9, id="factor 0"),
        pytest.param("S : 0|64@1+ (1,0) [0|0]", "1.84467440737096E+19", "", 2**64 - 1, id="digits"),
    ],
)  # fmt: skip
def test_a_start_value_is_sent_raw(
    tmp_path: Path, signal: str, start: object, rest: str, expected: int
) -> None:
    """Neither a name, a range nor a float changes it; cantools reads it in the payload."""
    path = dbc(tmp_path, signal, rest)
    data = payload(dbc(tmp_path, signal, f"{starts(S=start)}{rest}"))
    dbc(tmp_path, signal, rest)
    assert raw(path, data) == {"S": expected}


@pytest.mark.parametrize(
    ("kind", "text", "expected"),
    [
        pytest.param("INT 0 65535", "12", 12, id="INT"),
        pytest.param("HEX 0 65535", "12", 12, id="HEX"),
        pytest.param("FLOAT 0 1E+011", "12", 12, id="FLOAT"),
        pytest.param("FLOAT 0 1E+011", "9223372036854775809", 2**63 + 1, id="FLOAT of 64 bits"),
        pytest.param("STRING", '"12"', 12, id="STRING"),
        pytest.param("STRING", '"0x1F"', 31, id="STRING in hexadecimal"),
        pytest.param('ENUM "0","1","a;b"', "2", 2, id="ENUM"),
    ],
)
def test_start_values_of_each_kind_of_attribute(
    tmp_path: Path, kind: str, text: str, expected: int
) -> None:
    """cantools makes floats of FLOAT, and refuses STRING, so the text is read."""
    rest = f'BA_DEF_ SG_ "GenSigStartValue" {kind};\nBA_ "GenSigStartValue" SG_ 256 S {text};'
    data = payload(dbc(tmp_path, "S : 0|64@1+ (1,0) [0|0]", rest))
    assert int.from_bytes(data, "little") == expected


def test_a_float_starts_with_its_raw_value(tmp_path: Path) -> None:
    rest = f"SIG_VALTYPE_ 256 F : 1;\n{starts(F='1.5').replace('INT -1e9 1e9', 'FLOAT 0 1')}"
    data = payload(dbc(tmp_path, "F : 32|32@1- (2,0) [0|0]", rest))
    assert struct.unpack_from("<f", data, 4) == (1.5,)


@pytest.mark.parametrize(
    ("rest", "expected"),
    [
        pytest.param("", 40, id="no attribute: physical 0"),
        pytest.param(START, 0, id="default of the attribute"),
        pytest.param(START.replace('" 0;', '" 7;'), 7, id="another default"),
        pytest.param(START.replace('" 0;', '" 256;'), 40, id="default that does not fit"),
    ],
)
def test_a_signal_without_a_start_value(tmp_path: Path, rest: str, expected: int) -> None:
    assert payload(dbc(tmp_path, "S : 0|8@1+ (1,-40) [0|0]", rest))[0] == expected


def test_a_start_value_that_its_bits_cannot_have_is_an_error_at_the_start(tmp_path: Path) -> None:
    path = dbc(tmp_path, "S : 0|8@1+ (1,0) [0|0]", starts(S="1.5").replace("INT", "FLOAT"))
    text = r"message M: S: its start value .*'1.5', is no raw value of its 8 bits, \[0, 255\]"
    with pytest.raises(RestbusError, match=text):
        config(path)
    assert payload(path, S=4)[0] == 4


# ---- ranges and values of users ----------------------------------------------------------

ODD = """
    Raw : 0|8@1+ (1,5) [0|4]
    Rev : 8|8@1+ (0.5,-20) [100|0]
    Nil : 16|8@1+ (0,1) [0|0]
    Far : 60|8@1+ (1,0) [0|0]
    Five : 24|8@1+ (1,0) [5|10]
    Zero : 32|8@1+ (1,0) [0.0|0.0]
    Text : 40|8@1+ (1,0) [0|3]
"""


def test_signals_with_odd_ranges_are_sent_with_raw_0(tmp_path: Path) -> None:
    path = dbc(tmp_path, ODD)
    assert payload(path) == bytes(8)
    assert config(path).notices == [
        "M: sent without Far: its bits lie beyond the 8 bytes of the message"
    ]


@pytest.mark.parametrize(
    ("signal", "value", "text"),
    [
        ("Raw", 10, r"Raw cannot be set: its range in the DBC, \[0\|4\], has none of the values"),
        ("Rev", 50, r"Rev cannot be set: its range in the DBC is reversed, \[100\|0\]"),
        ("Nil", 1, "Nil cannot be set: its factor in the DBC is 0"),
        ("Far", 0, "Far cannot be set: its bits lie beyond the 8 bytes"),
        ("Five", 4, r"Five must be a number in \[5, 10\] km, got 4"),
        ("Five", {"ramp": [5], "period_s": 1}, r"Five: ramp must be \[FIRST, LAST\], got \[5\]"),
        ("Five", {"period_s": 1}, "Five needs count, ramp, sine or script"),
        ("Five", {"script": "nowhere.py"}, 'Five: script must be "FILE.py:FUNCTION"'),
        ("Five", {"script": ":f"}, 'Five: script must be "FILE.py:FUNCTION"'),
        ("Five", {"count": [5, 9], "step": 5}, r"step must be a number in \[1e-12, 4\] km, got 5"),
        ("Five", {"script": "s.py:g"}, "s.py has no function 'g'; its functions are: f"),
        ("Five", 11, r"Five must be a number in \[5, 10\] km, got 11"),
        ("Zero", 256, r"Zero must be a number in \[0, 255\], got 256"),
        ("Zero", 10**400, r"Zero must be a number in \[0, 255\]"),
        ("Zero", float("nan"), r"Zero must be a number in \[0, 255\], got nan"),
        ("Text", "Twice", "'Twice' is the name of 1 and 2; give the number"),
        ("Text", "Large", "Text: 'Large' is 300, no raw value of its 8 bits"),
        ("Text", [1, 4], r"Text must be a number in \[0, 3\], got 4"),
    ],
)
def test_a_value_that_a_signal_cannot_have_is_an_error_at_the_start(
    tmp_path: Path, signal: str, value: object, text: str
) -> None:
    path = dbc(tmp_path, ODD, 'VAL_ 256 Text 1 "Twice" 2 "Twice" 9 "Nine" 300 "Large" ;')
    path.write_text(path.read_text().replace('[5|10] ""', '[5|10] "km"'))
    (tmp_path / "s.py").write_text("def f(t):\n    return t\n")
    entry = {"name": "M", "dbc": str(path), "cycle_ms": 10, "signals": {signal: value}}
    with pytest.raises(RestbusError, match=text):
        Config.from_dict({"message": [entry]}, tmp_path)


def test_a_named_value_is_raw_and_a_list_is_sent_in_turn(tmp_path: Path) -> None:
    path = dbc(tmp_path, ODD, 'VAL_ 256 Text 9 "Nine" ;')
    sent = frames(config(path, signals={"Text": ["Nine", 2], "Zero": 255}), 0.03)
    assert [tuple(m.data[4:6]) for m in sent] == [(255, 9), (255, 2), (255, 9), (255, 2)]


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


def test_a_ramp_begins_again(tmp_path: Path) -> None:
    """It begins at its phase, here a quarter of its period of 40 ms."""
    path = dbc(tmp_path, "S : 0|8@1+ (1,0) [0|0]")
    ramp = {"ramp": [0, 80], "period_s": 0.04, "phase_deg": 90}
    sent = frames(config(path, signals={"S": ramp}), 0.05)
    assert [m.data[0] for m in sent] == [20, 40, 60, 0, 20, 40]


def test_a_step_that_is_no_whole_number(tmp_path: Path) -> None:
    path = dbc(tmp_path, "S : 0|8@1+ (0.5,0) [0|0]")
    sent = frames(config(path, signals={"S": {"count": [0, 1], "step": 0.5}}), 0.03)
    assert [m.data[0] for m in sent] == [0, 1, 2, 0]
    with pytest.raises(RestbusError, match=r"count must be a whole number in \[1, 1000\]"):
        config(path, count=2.5)


def test_ends_may_have_names(tmp_path: Path) -> None:
    """They are raw, so their physical values are beyond the factor and the offset."""
    path = dbc(tmp_path, "S : 0|8@1+ (2,10) [0|0]", 'VAL_ 256 S 3 "Three" 5 "Five" ;')
    sent = frames(config(path, signals={"S": {"count": ["Three", "Five"], "step": 2}}), 0.02)
    assert [m.data[0] for m in sent] == [3, 4, 5]


@pytest.mark.parametrize(
    ("bits", "code", "most"), [(16, "e", 65504), (32, "f", 3.4e38), (64, "d", 1e308)]
)
def test_floats_of_each_length(tmp_path: Path, bits: int, code: str, most: float) -> None:
    """Wide whole numbers are floats here; more than the greatest is refused."""
    kind = "SIG_VALTYPE_ 256 S : 2;" if bits == 64 else "SIG_VALTYPE_ 256 S : 1;"
    path = dbc(tmp_path, f"S : 0|{bits}@1- (0.5,0) [0|0]", kind)
    for value in (-0.25, most / 2, 2**60 + 1 if bits > 16 else 3):
        data = payload(path, S=value)
        assert struct.unpack_from(f"<{code}", data) == struct.unpack(
            f"<{code}", struct.pack(f"<{code}", 2 * value)
        )
    with pytest.raises(RestbusError, match="S must be a number in"):
        payload(path, S=2 * most)


@pytest.mark.parametrize("factor", [1, 2])  # with 2, the range ends at infinity
@pytest.mark.parametrize("value", [float("inf"), float("-inf"), float("nan")])
def test_a_float_takes_finite_values_only(tmp_path: Path, value: float, factor: int) -> None:
    path = dbc(tmp_path, f"S : 0|64@1- ({factor},0) [0|0]", "SIG_VALTYPE_ 256 S : 2;")
    assert struct.unpack("<d", payload(path, S=1e308)) == (1e308 / factor,)
    with pytest.raises(RestbusError, match="S must be a number in"):
        config(path, signals={"S": value})


def test_the_longest_signal_that_can_be_set(tmp_path: Path) -> None:
    rows = "S : 0|1000@1+ (1,0) [0|0]\nT : 1000|1001@1+ (1,0) [0|0]"
    path = dbc(tmp_path, rows, J1939, length=300, can_id=0x98FECA03)
    sent = frames(config(path, cycle_ms=60_000, signals={"S": 2**1000 - 1}), 10.0)
    assert b"".join(bytes(m.data[1:]) for m in sent[1:])[:126] == b"\xff" * 125 + b"\0"
    with pytest.raises(RestbusError, match="T cannot be set: it has more than 1000 bits"):
        config(path, cycle_ms=60_000, signals={"T": 0})


def test_wide_values_between_floats_have_the_decimal_factor(tmp_path: Path) -> None:
    path = dbc(tmp_path, "S : 0|64@1+ (0.5,7) [0|0]")
    assert int.from_bytes(payload(path, S=2**61 + 8), "little") == 2**62 + 2
    assert int.from_bytes(payload(path, S=2**20 + 7), "little") == 2**21
    path = dbc(tmp_path, "S : 0|64@1+ (0.1,0) [0|0]")
    assert int.from_bytes(payload(path, S=2**60 + 1), "little") == 10 * 2**60 + 10


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


# ---- pages -------------------------------------------------------------------------------

MUX = """
    Mux M : 0|8@1+ (1,0) [0|0]
    Sig m3 : 8|8@1+ (1,0) [0|0]
    Oth m9 : 8|8@1+ (1,0) [0|0]
    All : 16|8@1+ (1,0) [0|0]
"""


def test_pages_that_exist_are_sent_in_turn(tmp_path: Path) -> None:
    """No page is 0, the start value of a multiplexer that states none."""
    sent = frames(config(dbc(tmp_path, MUX), signals={"Sig": 1, "Oth": 2, "All": 5}), 0.03)
    assert [bytes(m.data[:3]) for m in sent] == [b"\3\1\5", b"\x09\2\5", b"\3\1\5", b"\x09\2\5"]


def test_a_start_value_that_is_a_page_stays(tmp_path: Path) -> None:
    """One that is no page, and a default of the attribute that is one, do not."""
    mux = MUX.replace("m9", "m0")
    for rest, expected in ((starts(Mux=3), {3}), (starts(Mux=1), {0, 3}), (START, {0, 3})):
        assert {m.data[0] for m in frames(config(dbc(tmp_path, mux, rest)))} == expected


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


def test_pages_that_the_multiplexer_cannot_have(tmp_path: Path) -> None:
    """One bit has no page 5; what is only there cannot be set, and does not share bits."""
    mux = MUX.replace("0|8@1+", "0|1@1+").replace("m3", "m1").replace("m9 : 8", "m5 : 16")
    path = dbc(tmp_path, mux, starts(Oth=1, All=2))
    made = config(path, signals={"Sig": 7})
    assert made.notices == []
    assert {bytes(m.data[:3]) for m in frames(made)} == {b"\1\7\2"}
    with pytest.raises(RestbusError, match="Oth: is on no page that M can have"):
        config(path, signals={"Oth": 7})


def test_a_named_page_without_signals_can_be_set(tmp_path: Path) -> None:
    path = dbc(tmp_path, MUX, 'VAL_ 256 Mux 3 "Three" 12 "Empty" ;')
    assert {m.data[0] for m in frames(config(path))} == {3, 9}
    assert payload(path, Mux="Empty", Sig=255) == bytes([12, *bytes(7)])


@pytest.mark.parametrize(
    ("value", "key"),
    [
        (1, ""), ([3, 4], ""), ({"count": [3, 9]}, ": count"), ({"count": [3, 4]}, ": count"),
        ({"ramp": [3, 9], "period_s": 1}, ": ramp"), ({"sine": [9, 3], "period_s": 1}, ": sine"),
    ],
)  # fmt: skip
def test_a_page_of_the_configuration_that_does_not_exist_is_an_error_at_the_start(
    tmp_path: Path, value: object, key: str
) -> None:
    text = f"message M: Mux{key} selects a page, and .* is none of the DBC; its pages are 3, 9"
    with pytest.raises(RestbusError, match=text):
        config(dbc(tmp_path, MUX), signals={"Mux": value})


def test_a_step_within_a_page_is_an_error(tmp_path: Path) -> None:
    """It would send a page twice; the error has the factor."""
    path = dbc(tmp_path, MUX)
    with pytest.raises(RestbusError, match=r"step must be a number in \[1, 6\], got 0.5"):
        config(path, signals={"Mux": {"count": [3, 9], "step": 0.5}})


def test_pages_that_exist_may_be_counted_and_set(tmp_path: Path) -> None:
    path = dbc(tmp_path, MUX)
    for value in ({"count": [3, 9], "step": 6}, [3, 9]):
        sent = frames(config(path, signals={"Mux": value}), 0.03)
        assert [m.data[0] for m in sent] == [3, 9, 3, 9]
    events = [
        {"at_s": 0.005, "command": "set M.Mux 9"},
        {"at_s": 0.025, "command": "reset M.Mux"},
    ]
    sent = frames(config(path, events), 0.04)
    assert [m.data[0] for m in sent] == [3, 9, 9, 9, 3]


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
    with pytest.raises(RestbusError, match=r"event at 1 s: M.Mux selects a page, and 1"):
        frames(config(dbc(tmp_path, MUX), [{"at_s": 1, "command": "set M.Mux 1"}]))


# ---- bits that signals share -------------------------------------------------------------

SHARED = """
    Low : 0|8@1+ (1,0) [0|0]
    Word : 0|16@1+ (1,0) [0|0]
    Motorola : 7|12@0+ (1,0) [0|0]
    Alone : 56|8@1+ (1,0) [0|0]
"""


@pytest.mark.parametrize(
    ("signals", "stated", "expected"),
    [
        pytest.param({"Low": 0x12}, {}, "1200", id="one set"),
        pytest.param({"Word": 0x1234}, {}, "3412", id="the longer set"),
        pytest.param({"Motorola": 0xABC}, {}, "abc0", id="Motorola set"),
        pytest.param({"Low": 0x34, "Word": 0x1234}, {}, "3412", id="both set, the same bits"),
        pytest.param({"Low": 0x12}, {"Word": 0xABCD}, "12ab", id="set before start"),
        pytest.param({}, {"Word": 0xABCD}, "cdab", id="start before none"),
        pytest.param({}, {"Low": 0xCD, "Word": 0xABCD}, "cdab", id="starts agree"),
    ],
)
def test_signals_that_share_bits_are_sent_as_stated(
    tmp_path: Path, signals: dict[str, int], stated: dict[str, int], expected: str
) -> None:
    path = dbc(tmp_path, SHARED, starts(**stated))
    made = config(path, signals=signals | {"Alone": 255})
    assert made.notices == []
    assert bytes(frames(made, 0.0)[0].data).hex() == f"{expected}0000000000ff"


def test_start_values_that_contradict_each_other_are_told(tmp_path: Path) -> None:
    made = config(dbc(tmp_path, SHARED, starts(Low=1, Word=0xAB02)))
    assert "start values differ in common bits" in made.notices[0]
    assert "Low before Word" in made.notices[0]
    assert bytes(frames(made, 0.0)[0].data[:2]) == b"\x01\xab"


def test_values_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    path = dbc(tmp_path, SHARED)
    for low in (1, [0, 1], {"count": [0, 9]}):
        signals = {"Low": low, "Word": 0}
        with pytest.raises(RestbusError, match="message M: Low and Word have common bits"):
            config(path, signals=signals)
    events = [
        {"at_s": 0.0, "command": "set M.Low 1"},
        {"at_s": 0.1, "command": "reset M.Low"},
        {"at_s": 0.2, "command": "set M.Word 2"},
    ]
    assert bytes(frames(config(path, events), 0.3)[-1].data[:2]) == b"\2\0"
    del events[1]
    text = r"event at 0.2 s: M.Word has bits of Low, which has another value; reset Low"
    with pytest.raises(RestbusError, match=text):
        frames(config(path, events))
    # A multiplexer changes, so that nothing agrees with it, if it is not set.
    mux = dbc(tmp_path, f"{MUX.rstrip()}\n    Over : 0|4@1+ (1,0) [0|0]\n")
    with pytest.raises(RestbusError, match="Mux and Over have common bits"):
        config(mux, signals={"Over": 3})
    assert bytes(frames(config(mux, signals={"Over": 3, "Mux": 3}), 0.0)[0].data[:1]) == b"\3"


def test_a_command_comes_before_a_start_value(tmp_path: Path) -> None:
    path = dbc(tmp_path, SHARED, starts(Word=0xABCD))
    sent = frames(config(path, [{"at_s": 0.005, "command": "set M.Low 1"}]), 0.01)
    assert [bytes(m.data[:2]) for m in sent] == [b"\xcd\xab", b"\x01\xab"]


def test_a_float_of_a_length_that_no_float_has(tmp_path: Path) -> None:
    made = config(dbc(tmp_path, "S : 0|24@1- (1,0) [0|0]", "SIG_VALTYPE_ 256 S : 1;"))
    assert made.notices == ["M: sent without S: it is a float of 24 bits"]
    assert bytes(frames(made, 0.0)[0].data) == bytes(8)


def test_multiplexers_that_share_bits_are_told(tmp_path: Path) -> None:
    """Nobody sets them, so it is no error."""
    signals = "A M : 0|8@1+ (1,0) [0|0]\nB M : 4|8@1+ (1,0) [0|0]\nC m1 : 16|8@1+ (1,0) [0|0]"
    rest = "SG_MUL_VAL_ 256 C A 1-2;\n"
    made = config(
        dbc(tmp_path, signals + "\nD m3 : 24|8@1+ (1,0) [0|0]", f"{rest}SG_MUL_VAL_ 256 D B 3-3;")
    )
    assert made.notices == ["M: start values differ in common bits, in which are sent: A before B"]


def test_a_command_resets_one_signal(tmp_path: Path) -> None:
    events = [
        {"at_s": 0.0, "command": "set M.Low 1"},
        {"at_s": 0.0, "command": "set M.Alone 2"},
        {"at_s": 0.015, "command": "reset M.Low"},
    ]
    sent = frames(config(dbc(tmp_path, SHARED), events), 0.02)
    assert bytes(sent[-1].data) == bytes(7) + b"\2"


def test_what_e2e_sets_cannot_be_set(tmp_path: Path) -> None:
    signals = """
        A : 0|8@1+ (1,0) [0|0]
        B : 8|4@1+ (1,0) [0|0]
        C : 17|8@1+ (1,0) [0|0]
        D : 62|4@1+ (1,0) [0|0]
    """
    path = dbc(tmp_path, signals)
    e2e = {"profile": 2, "data_id": [0] * 16, "counter": "B", "crc": "A"}
    with pytest.raises(RestbusError, match=r"M.B is set by e2e; damage it with a fault instead"):
        frames(config(path, [{"at_s": 0.0, "command": "set M.B 1"}], e2e=e2e))
    with pytest.raises(RestbusError, match=r"data_id must be a whole number in .*, got 1.5"):
        config(path, e2e=e2e | {"data_id": [1.5] * 16})
    for data_id in (7, [0] * 15):
        with pytest.raises(RestbusError, match="data_id of profile 2 must be a list of 16"):
            config(path, e2e=e2e | {"data_id": data_id})
    with pytest.raises(RestbusError, match="counter: D cannot be sent: its bits lie beyond the 8"):
        config(path, e2e=e2e | {"counter": "D"})
    with pytest.raises(RestbusError, match="crc must begin with a byte, C does not"):
        config(path, e2e=e2e | {"crc": "C"})


def test_an_unknown_key_of_e2e(tmp_path: Path) -> None:
    e2e = {"profile": 2, "data_id": [0] * 16, "counter": "B", "crc": "A", "crcs": 1}
    with pytest.raises(RestbusError, match="unknown key 'crcs'; did you mean 'crc'"):
        config(dbc(tmp_path, "A : 0|8@1+ (1,0) [0|0]\nB : 8|4@1+ (1,0) [0|0]"), e2e=e2e)


def test_a_name_that_stands_twice(tmp_path: Path) -> None:
    """Both signals have the start value of the name; neither can be set."""
    path = dbc(tmp_path, "S : 0|8@1+ (1,0) [0|0]\nS : 8|8@1+ (1,0) [0|0]", starts(S=5))
    assert payload(path)[:3] == b"\5\5\0"
    with pytest.raises(RestbusError, match="M has 2 signals 'S'; rename them"):
        config(path, signals={"S": 1})
    path.write_text(f"{HEAD}BO_ 1 M: 8 A\n\nBO_ 2 M: 8 A\n")
    with pytest.raises(RestbusError, match="has 2 messages of this name"):
        config(path)


# ---- lengths and CAN FD ------------------------------------------------------------------


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


def test_a_message_that_no_frame_carries_is_refused_by_name(tmp_path: Path) -> None:
    text = "message M: has 65 bytes, and 64 can be sent at most"
    with pytest.raises(RestbusError, match=text):
        config(dbc(tmp_path, "S : 0|8@1+ (1,0) [0|0]", length=65))


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


@pytest.mark.parametrize(
    ("profile", "mode", "text"),
    [(5, "nibble", "unknown key 'data_id_mode'"), (11, "low", "must be both or nibble, got 'low'")],
)
def test_a_mode_that_the_profile_does_not_have(
    tmp_path: Path, profile: int, mode: str, text: str
) -> None:
    """Its data IDs would not be those that the mode says."""
    bits = ("0|16@1+", "16|8@1+") if profile == 5 else ("0|8@1+", "8|4@1+")
    path = dbc(tmp_path, f"Crc : {bits[0]} (1,0) [0|0]\nCounter : {bits[1]} (1,0) [0|0]")
    e2e = {"profile": profile, "data_id": 1, "counter": "Counter", "crc": "Crc"}
    with pytest.raises(RestbusError, match=text):
        config(path, e2e=e2e | {"data_id_mode": mode})


def test_a_nibble_without_a_place_must_be_named(tmp_path: Path) -> None:
    signals = "Crc : 0|8@1+ (1,0) [0|0]\nCounter : 8|4@1+ (1,0) [0|0]\nS : 12|8@1+ (1,0) [0|0]"
    e2e = {
        "profile": 11,
        "data_id": 1,
        "data_id_mode": "nibble",
        "counter": "Counter",
        "crc": "Crc",
    }
    with pytest.raises(RestbusError, match="nibble is missing; name the signal of 4 bits"):
        config(dbc(tmp_path, signals), e2e=e2e)


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
    with pytest.raises(RestbusError, match="unknown key 'priority'"):
        config(dbc(tmp_path, "S : 0|8@1+ (1,0) [0|0]"), priority=3)


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
    """can-j1939 receives both: packets do not say to which message they belong."""
    j1939 = pytest.importorskip("j1939")
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
    received: list[tuple[int, int, bytes]] = []
    unit = j1939.ElectronicControlUnit()
    try:
        unit.subscribe(lambda _p, pgn, sa, _t, data: received.append((pgn, sa, bytes(data))))
        for m in frames(Config.from_dict(table), 0.9):
            unit.notify(m.arbitration_id, m.data, m.timestamp)
    finally:
        unit.stop()
    whole = [
        (0xFECA, 3, bytes(14) + b"\1"), (0xFECB, 3, bytes(14) + b"\2"),
        (0xFECC, 4, bytes(14) + b"\3"),
    ]  # fmt: skip
    assert sorted(received) == whole


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
