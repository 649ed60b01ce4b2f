"""J1939: signals by parameter group, from any sender, also of more than 8 bytes."""

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can.bus import SignalDecoder, read_signals
from maplines_can.logs.j1939 import Reassembler, pgn_of
from maplines_can.values.errors import DriveFileError, LogError

#: Functions without types of cantools.
j1939: Any = import_module("cantools.j1939")
#: CCVS1 (PDU2), TSC1 (PDU1, to address 0), DM1 and a proprietary group of 20 bytes each, and two
#: messages of one group; Status is no group of J1939.
DBC = """VERSION ""
NS_ :
BS_:
BU_: Car
BO_ 2566844926 CCVS1: 8 Car
 SG_ Speed : 8|16@1+ (0.00390625,0) [0|250] "km/h" Car
BO_ 2348810494 TSC1: 8 Car
 SG_ Torque : 24|8@1+ (1,-125) [-125|125] "%" Car
BO_ 2566834942 DM1: 20 Car
 SG_ First : 0|8@1+ (1,0) [0|0] "" Car
 SG_ Last : 152|8@1+ (1,0) [0|0] "" Car
BO_ 2565800190 PropA: 20 Car
 SG_ End : 152|8@1+ (1,0) [0|0] "" Car
BO_ 2364539904 EEC1_0: 8 Car
 SG_ Rpm0 : 24|16@1+ (0.125,0) [0|0] "rpm" Car
BO_ 2364539907 EEC1_3: 8 Car
 SG_ Rpm3 : 24|16@1+ (0.125,0) [0|0] "rpm" Car
BO_ 2566847744 Status: 8 Car
 SG_ Level : 0|8@1+ (1,0) [0|0] "" Car
BA_DEF_ "ProtocolType" STRING ;
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "ProtocolType" "";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "ProtocolType" "J1939";
BA_ "VFrameFormat" BO_ 2566847744 1;
"""
SPEED = bytes.fromhex("ff0024ffffffffff")  # 36 km/h
#: Recorded from can-j1939 2.0.12 on python-can 4.6.1: 1 to 20 to all, and 21 to 40 to address 5,
#: with the answers of that.
BAM = [
    *("18ECFF27#20140003FFCAFE00", "1CEBFF27#0101020304050607"),
    *("1CEBFF27#0208090A0B0C0D0E", "1CEBFF27#030F1011121314FF"),
]
RTS = [
    *("18EC0527#101400030100EF00", "1CEC2705#110101FFFF00EF00", "1CEB0527#0115161718191A1B"),
    *("1CEC2705#110102FFFF00EF00", "1CEB0527#021C1D1E1F202122"),
    *("1CEC2705#110103FFFF00EF00", "1CEB0527#03232425262728FF", "1CEC2705#13140003FF00EF00"),
]


@pytest.fixture
def dbc(tmp_path: Path) -> Path:
    path = tmp_path / "truck.dbc"
    path.write_text(DBC)
    return path


def log_of(folder: Path, frames: list[str]) -> Path:
    path = folder / "a.log"
    path.write_text("".join(f"({1 + i / 10:.6f}) can0 {f}\n" for i, f in enumerate(frames)))
    return path


def test_parameter_groups_are_those_of_cantools() -> None:
    """For all kinds of identifiers."""
    for can_id in [0, 0x1FFFFFFF, *np.random.default_rng(1).integers(1 << 29, size=2000).tolist()]:
        assert j1939.pgn_from_frame_id(can_id) == pgn_of(can_id)


@pytest.mark.parametrize(
    ("old", "new", "is_group"),
    [
        pytest.param('BA_ "ProtocolType" "J1939";', "", False, id="no-protocol"),
        pytest.param(
            'BA_ "ProtocolType" "J1939";',
            'BA_ "VFrameFormat" BO_ 2566844926 3;',
            True,
            id="frame-format",
        ),
        pytest.param(
            'BA_DEF_DEF_ "ProtocolType" "";\n',
            'BA_DEF_DEF_ "ProtocolType" "J1939";\n',
            True,
            id="by-default",
        ),
        pytest.param("2566847744 1;", "2566844926 1;", False, id="another-format"),
    ],
)
def test_which_messages_are_groups(
    tmp_path: Path, dbc: Path, old: str, new: str, is_group: bool
) -> None:
    """As ProtocolType and VFrameFormat say; others are known by their whole identifier."""
    text = DBC.replace(old, new)
    if "DEF_DEF_" in old:
        text = text.replace('BA_ "ProtocolType" "J1939";', "")
    dbc.write_text(text)
    decoder = SignalDecoder(dbc, {"x": "Speed"})

    assert decoder.decode(0x18FEF1FE, SPEED, is_extended=True) == {"x": 36.0}
    assert decoder.decode(0x0CFEF127, SPEED, is_extended=True) == ({"x": 36.0} if is_group else {})
    assert (decoder.can_ids is None) == is_group


def test_several_messages_of_one_group(dbc: Path) -> None:
    """The one with the sender of the frame has it; a frame of a third one is counted."""
    decoder = SignalDecoder(dbc, {"zero": "Rpm0", "three": "Rpm3"})
    data = bytes.fromhex("ffffff4038ffffff")

    assert decoder.decode(0x0CF00400, data, is_extended=True) == {"zero": 1800.0}
    assert decoder.decode(0x1CF00403, data, is_extended=True) == {"three": 1800.0}
    assert decoder.decode(0x0CF00421, data, is_extended=True) == {}
    assert decoder.damage() == {"address 0x21 is of none of EEC1_0, EEC1_3, which have one PGN": 1}


def test_several_messages_of_one_group_to_other_receivers(dbc: Path) -> None:
    """In PDU1, the receiver tells them apart, too, and address 254 of a DBC is any other sender."""
    dbc.write_text(
        DBC.replace(
            "BO_ 2348810494 TSC1",
            'BO_ 2348810497 ToOne: 8 Car\n SG_ One : 24|8@1+ (1,-125) [0|0] "" Car\n'
            'BO_ 2348810753 ToTwo: 8 Car\n SG_ Two : 24|8@1+ (1,-125) [0|0] "" Car\n'
            "BO_ 2348810494 TSC1",
        )
    )
    decoder = SignalDecoder(dbc, {"any": "Torque", "one": "One", "two": "Two"})

    for can_id, name in ((0x0C000101, "one"), (0x0C000201, "two"), (0x0C000150, "any")):
        assert decoder.decode(can_id, SPEED, is_extended=True) == {name: 130.0}


def test_values_of_several_senders_are_said(dbc: Path, tmp_path: Path) -> None:
    """With their addresses and numbers; one of them is taken by its address."""
    other = "18FEF100#FF0012FFFFFFFFFF"
    log = log_of(tmp_path, [f"18FEF127#{SPEED.hex()}", other, other])

    text = r"x = CCVS1\.Speed has .* several senders: 0x00 \(2\), 0x27 \(1\); .* CCVS1\.Speed@0x00"
    with pytest.warns(UserWarning, match=text):
        assert len(read_signals(log, dbc, {"x": "CCVS1.Speed"})["x"][1]) == 3
    one = read_signals(log, dbc, {"x": "CCVS1.Speed@0x27", "y": "Speed@0"})
    assert [one["x"][1].tolist(), one["y"][1].tolist()] == [[36.0], [18.0, 18.0]]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        pytest.param("Speed@256", "'256' must be the address of a sender, 0 to 255", id="range"),
        pytest.param("Speed@-1", "'-1' must be the address", id="negative"),
        pytest.param("Speed@x", "'x' must be the address", id="text"),
        pytest.param("Level@1", "Status is no parameter group", id="no-group"),
    ],
)
def test_wrong_addresses(dbc: Path, name: str, text: str) -> None:
    """Each names the series and what is wrong."""
    with pytest.raises(DriveFileError, match=rf"signals: x = '{name}': .*{text}"):
        SignalDecoder(dbc, {"x": name})


@pytest.mark.parametrize(
    ("frames", "names", "values"),
    [
        pytest.param(BAM, {"a": "First", "b": "Last"}, [1.0, 20.0], id="to-all"),
        pytest.param(RTS, {"a": "End"}, [40.0], id="to-one"),
        pytest.param(
            [f for pair in zip(BAM, RTS[:4], strict=True) for f in pair] + RTS[4:],
            {"a": "Last", "b": "End"},
            [20.0, 40.0],
            id="both-at-once",
        ),
        pytest.param(
            [*RTS[:5], "1CEC2705#110201FFFF00EF00", RTS[2], RTS[4], *RTS[5:]],
            {"a": "End"},
            [40.0],
            id="sent-again",
        ),
        pytest.param([*BAM[:2], *BAM], {"a": "Last"}, [20.0], id="begun-again"),
    ],
)
def test_long_messages_are_put_together(
    dbc: Path, tmp_path: Path, frames: list[str], names: dict[str, str], values: list[float]
) -> None:
    """As can-j1939 sent them; the time is that of the last packet."""
    found = read_signals(log_of(tmp_path, frames), dbc, names)

    assert [found[name][1].tolist() for name in names] == [[value] for value in values]
    begun = sum(frame == frames[0] for frame in frames)
    assert sum(found.skipped.values()) == begun - 1  # a transfer that is begun again
    last = max(i for i, frame in enumerate(frames) if "#03" in frame)
    assert max(t for series in found.values() for t in series[0]) == pytest.approx(1 + last / 10)


@pytest.mark.parametrize(
    ("frames", "is_counted"),
    [
        pytest.param(BAM[:3], True, id="no-end"),
        pytest.param([BAM[0], *BAM[2:]], True, id="no-first"),
        pytest.param([*BAM[:2], BAM[3]], True, id="no-second"),
        pytest.param([*BAM[:2], BAM[1], *BAM[2:]], True, id="twice"),
        pytest.param(BAM[1:], False, id="no-announcement"),
        pytest.param([BAM[0].replace("1400", "0800"), *BAM[1:]], False, id="short"),
        pytest.param([BAM[0].replace("140003", "140004"), *BAM[1:]], False, id="packets"),
        pytest.param([*BAM[:3], BAM[3][:-2]], True, id="short-packet"),
        pytest.param([*BAM[:3], "1CEBFF28#030F1011121314FF"], True, id="another-sender"),
    ],
)
def test_incomplete_transfers_give_nothing(
    dbc: Path, tmp_path: Path, frames: list[str], is_counted: bool
) -> None:
    """They are counted, if their group is of a signal."""
    with pytest.raises(LogError) as found:
        read_signals(log_of(tmp_path, frames), dbc, {"a": "Last"})

    text = "1 time: incomplete transfers of the parameter group 0xfeca"
    assert (text in str(found.value)) == is_counted


def test_a_message_of_whole_packets(dbc: Path) -> None:
    """14 bytes are two packets; no padding ends the second one."""
    reassembler = Reassembler([0xFECA])
    frames = ["18ECFF27#200E0002FFCAFE00", *BAM[1:3]]

    assert [feed(reassembler, frame) for frame in frames] == [None, None, bytes(range(1, 15))]
    assert not +reassembler.incomplete
    to_one = Reassembler([0xEF00])
    whole = [to_one.feed(int(f[:8], 16), bytes.fromhex(f[9:])) for f in RTS]
    assert [w.can_id for w in whole if w] == [0x1CEF0527]


@pytest.mark.parametrize("answer", ["1CEC2705#FF01FFFFFF00EF00", "18EC0527#FF01FFFFFF00EF00"])
def test_an_abort_ends_a_transfer(answer: str) -> None:
    """Of the receiver or of the sender; one of another group does not."""
    reassembler = Reassembler([0xEF00])
    for other in (answer.replace("00EF00", "00EE00"), answer):
        whole = [feed(reassembler, f) for f in [*RTS[:4], other, *RTS[4:]]]
        assert [w for w in whole if w] == ([bytes(range(21, 41))] if other != answer else [])
    assert reassembler.incomplete == {0xEF00: 1}


def feed(reassembler: Reassembler, frame: str) -> bytes | None:
    can_id, data = frame.split("#")
    whole = reassembler.feed(int(can_id, 16), bytes.fromhex(data))
    return whole and whole.data


def test_channels_are_apart(dbc: Path, tmp_path: Path) -> None:
    """The packets of one transfer are of one channel."""
    log = log_of(tmp_path, BAM)
    log.write_text(log.read_text().replace("can0 1CEBFF27#02", "can1 1CEBFF27#02"))
    with pytest.raises(LogError, match="incomplete transfers"):
        read_signals(log, dbc, {"a": "Last"})


def test_no_frames_raise(dbc: Path) -> None:
    """Random frames, most of them of the transport protocol."""
    decoder = SignalDecoder(dbc, {"a": "Last", "b": "End", "c": "Speed", "d": "Rpm0"})
    rng = np.random.default_rng(2)
    can_ids = [0x18ECFF27, 0x1CEBFF27, 0x18EC0527, 0x1CEC2705, 0x1CEB0527, 0x18FEF127]
    for _ in range(5000):
        head = [rng.choice([16, 17, 32, 255, 1, 2, 3]), rng.choice([0, 1, 9, 20, 255]), 0, 3, 255]
        group = rng.choice([b"\x00\xef\x00", b"\xca\xfe\x00"]).ljust(3, b"\0")
        data = (bytes(head) + group)[: rng.choice([8, 8, 8, 3])]
        decoder.decode(int(rng.choice(can_ids)), data, is_extended=True)
    assert all(count > 0 for count in decoder.damage().values())


@pytest.mark.parametrize(
    ("length", "expected"),
    [
        pytest.param(8, {"le": 0x0201, "be": 0x0304, "bits": 0x5, "last": 8.0}, id="whole"),
        pytest.param(7, {"le": 0x0201, "be": 0x0304, "bits": 0x5}, id="without-the-last"),
        pytest.param(4, {"le": 0x0201, "be": 0x0304}, id="to-a-signal"),
        pytest.param(3, {"le": 0x0201}, id="within-a-signal"),
        pytest.param(1, {}, id="within-the-first"),
        pytest.param(0, {}, id="empty"),
    ],
)
def test_short_frames(tmp_path: Path, length: int, expected: dict[str, float]) -> None:
    """Signals that are in the data are read, in either byte order; the frame is counted."""
    path = tmp_path / "car.dbc"
    path.write_text(
        'VERSION ""\nNS_ :\nBS_:\nBU_: Car\nBO_ 256 M: 8 Car\n'
        ' SG_ le : 0|16@1+ (1,0) [0|0] "" Car\n SG_ be : 23|16@0+ (1,0) [0|0] "" Car\n'
        ' SG_ bits : 32|4@1+ (1,0) [0|0] "" Car\n SG_ last : 63|8@0+ (1,0) [0|0] "" Car\n'
    )
    decoder = SignalDecoder(path, {name: name for name in ("le", "be", "bits", "last")})

    assert decoder.decode(256, bytes([1, 2, 3, 4, 5, 6, 7, 8][:length])) == expected
    what = "end before a signal of" if expected else "do not fit"
    counted = {f"the data {what} the message M": 1} if length < 8 else {}
    assert decoder.skipped == counted
