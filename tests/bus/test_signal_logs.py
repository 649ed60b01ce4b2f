"""Signals of any DBC are read from logs as time series."""

from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest

from maplines_can import LayoutError
from maplines_can.bus import read_signals
from maplines_can.logs.signal_log import read_table
from maplines_can.simulation import DriveFileError, RecordedDrive
from maplines_can.values.errors import LogError

DBC = """VERSION ""
NS_ :
BS_:
BU_: Car
BO_ 256 Position: 8 Car
 SG_ X : 0|32@1- (0.001,0) [0|0] "m" Car
 SG_ Y : 32|32@1- (0.001,0) [0|0] "m" Car
BO_ 2147484160 Motion: 6 Car
 SG_ Heading : 7|16@0+ (0.01,0) [0|0] "deg" Car
 SG_ Speed : 23|16@0+ (0.01,0) [0|0] "km/h" Car
 SG_ Valid : 39|8@0+ (1,0) [0|0] "" Car
BO_ 258 Muxed: 8 Car
 SG_ Which M : 0|8@1+ (1,0) [0|0] "" Car
 SG_ First m0 : 8|16@1+ (1,0) [0|0] "" Car
 SG_ Second m1 : 8|16@1+ (1,0) [0|0] "" Car
BO_ 259 Other: 8 Car
 SG_ Speed : 0|16@1+ (1,0) [0|0] "" Car
 SG_ Overlap : 8|16@1+ (1,0) [0|0] "" Car
VAL_ 2147484160 Valid 0 "no" 1 "yes" ;
"""
NAMES = {
    "x": "Position.X",
    "y": "Y",
    "heading_deg": "Heading",
    "speed_kmh": "Motion.Speed",
}


@pytest.fixture
def dbc(tmp_path: Path) -> Path:
    path = tmp_path / "car.dbc"
    path.write_text(DBC)
    return path


def log_of(path: Path, dbc: Path, *extra: can.Message, n: int = 50) -> Path:
    """Write a log of a car at 36 km/h along x, encoded by cantools."""
    database: Any = cantools.database.load_file(dbc, strict=False)  # signals of Other overlap
    with can.Logger(path) as writer:
        for i in range(n):
            t = i * 0.1
            position = database.encode_message("Position", {"X": 10 * t, "Y": -2.5})
            motion = {"Heading": 350 + 0.5 * i if i < 20 else 0.5 * i - 10, "Speed": 36, "Valid": 1}
            writer(can.Message(100 + t, arbitration_id=256, is_extended_id=False, data=position))
            writer(
                can.Message(
                    100.02 + t,
                    arbitration_id=512,
                    is_extended_id=True,
                    data=database.encode_message("Motion", motion),
                )
            )
        for message in extra:
            writer(message)
    return path


@pytest.mark.parametrize("suffix", ["log", "asc", "blf"])
def test_drive_of_a_log(tmp_path: Path, dbc: Path, suffix: str) -> None:
    """From the log to poses; the heading is interpolated without its step at 360 deg."""
    signals = read_signals(log_of(tmp_path / f"drive.{suffix}", dbc), dbc, NAMES)
    assert {name: len(t) for name, (t, _) in signals.items()} == dict.fromkeys(NAMES, 50)
    assert not signals.skipped
    drive = RecordedDrive.from_signals(signals)
    assert drive.skipped == 1  # the first position, before the first heading
    t = np.linspace(drive.start, drive.end, 100)
    state = drive.at(t)
    np.testing.assert_allclose(state.pose[:, 0], 10 * (t - t[0]) + 1, atol=2e-3)
    np.testing.assert_allclose(state.pose[:, 1], -2.5, atol=1e-9)
    start = state.pose[0, 2]
    np.testing.assert_allclose(state.pose[:, 2] - start, np.radians(5) * (t - t[0]), atol=1e-6)
    np.testing.assert_allclose(state.speed, 10.0)


def test_tables(tmp_path: Path, dbc: Path) -> None:
    """In TOML and in CSV."""
    log = log_of(tmp_path / "drive.log", dbc)
    toml, table = tmp_path / "signals.toml", tmp_path / "signals.csv"
    toml.write_text("".join(f'{column} = "{name}"\n' for column, name in NAMES.items()))
    table.write_text("column,signal\n" + "".join(f"{c}, {n}\n" for c, n in NAMES.items()))
    expected = read_signals(log, dbc, NAMES)
    for path in (toml, table):
        found = read_signals(log, dbc, path)
        assert list(found) == list(NAMES)
        for name in NAMES:
            np.testing.assert_array_equal(found[name], expected[name])


def test_frames_that_do_not_fit_are_counted(tmp_path: Path, dbc: Path) -> None:
    """Too short; a standard frame with the number of an extended one is another message."""
    extra = [
        can.Message(200.0, arbitration_id=256, is_extended_id=False, data=b"123"),
        can.Message(200.1, arbitration_id=512, is_extended_id=False, data=b"12345678"),
        can.Message(200.2, arbitration_id=258, is_extended_id=False, data=b"\x01\x07\x00ABCDE"),
        can.Message(200.3, arbitration_id=258, is_extended_id=False, data=b"\x00\x09\x00ABCDE"),
        can.Message(200.4, arbitration_id=258, is_extended_id=False, data=b"\x05\x09\x00ABCDE"),
    ]
    log = log_of(tmp_path / "drive.log", dbc, *extra)
    names = {**NAMES, "second": "Second", "valid": "Valid"}
    signals = read_signals(log, dbc, names)
    assert signals["second"][1].tolist() == [7.0]
    assert signals["valid"][1].tolist() == [1.0] * 50
    assert len(signals["x"][0]) == 50
    assert signals.skipped == {
        "the data do not fit the message Position": 1,
        "the data do not fit the message Muxed": 1,
    }


def test_channel(tmp_path: Path, dbc: Path) -> None:
    """Frames of another interface are ignored."""
    log = log_of(tmp_path / "drive.log", dbc)
    both = log.read_text() + log.read_text().replace("vcan0", "can7").replace(" 0 ", " can7 ")
    log.write_text(both)
    assert len(read_signals(log, dbc, NAMES)["x"][0]) == 100
    assert len(read_signals(log, dbc, NAMES, channel="can7")["x"][0]) == 50
    with pytest.raises(LogError, match=r"has no value of x = Position\.X; .* or the channel"):
        read_signals(log, dbc, NAMES, channel="can9")


@pytest.mark.parametrize(
    ("names", "text"),
    [
        ({"x": "Position.Z"}, "signals: x = 'Position.Z': is not in .*car.dbc"),
        ({"x": "Speed"}, "is ambiguous in .*; use one of Motion.Speed, Other.Speed"),
        ({"x": ""}, "is not in"),
    ],
)
def test_signals_that_are_not_in_the_dbc(
    tmp_path: Path, dbc: Path, names: dict[str, str], text: str
) -> None:
    with pytest.raises(DriveFileError, match=text):
        read_signals(log_of(tmp_path / "drive.log", dbc), dbc, names)


def test_other_files(tmp_path: Path, dbc: Path) -> None:
    """Each missing or wrong file raises the error of its kind."""
    log = log_of(tmp_path / "drive.log", dbc, n=2)
    with pytest.raises(LogError, match="no such file"):
        read_signals(tmp_path / "none.log", dbc, NAMES)
    with pytest.raises(LayoutError, match="cannot be read"):
        read_signals(log, tmp_path / "none.dbc", NAMES)
    with pytest.raises(LayoutError, match="not a valid DBC"):
        read_signals(log, log, NAMES)
    with pytest.raises(LogError, match=r"has no value of speed = Other\.Speed"):
        read_signals(log, dbc, {"speed": "Other.Speed"})


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("t.toml", "x = ", "is not valid TOML"),
        ("t.toml", "", "has no signal"),
        ("t.toml", "x = 5", "x must be the name of a signal"),
        ("t.toml", "[x]\ny = 'a'", "x must be the name of a signal"),
        ("t.csv", "x,Position.X\n", "line 1: the header must be column,signal"),
        ("t.csv", "", "line 1: the header must be"),
        ("t.csv", "column,signal\nx\n", "'x' must be a column and a signal"),
        ("t.csv", "column,signal\nx,A\nx,B\n", "'x,B' must be a column and a signal, each colu"),
        ("t.csv", "column,signal\nx,\n", "x must be the name of a signal"),
    ],
)
def test_bad_tables(tmp_path: Path, name: str, text: str, message: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(DriveFileError, match=message):
        read_table(path)
    path.write_bytes(b"\xff\xfe\x80")
    with pytest.raises(DriveFileError, match="not a text in UTF-8"):
        read_table(path)
    with pytest.raises(DriveFileError, match="cannot be read"):
        read_table(tmp_path / "none.toml")


@pytest.mark.parametrize(("size", "fits"), [(10**6, True), (10**6 + 1, False)])
def test_a_table_has_a_megabyte_at_most(tmp_path: Path, size: int, fits: bool) -> None:
    """A greater file is most likely a log, and not read whole."""
    path = tmp_path / "signals.toml"
    path.write_text("x = 'A.B'\n#".ljust(size, "."))
    if fits:
        assert read_table(path) == {"x": "A.B"}
    else:
        with pytest.raises(DriveFileError, match="is too large"):
            read_table(path)


def test_a_damaged_log(tmp_path: Path, dbc: Path) -> None:
    """Its good part is used; if it has not all signals, the damage explains what is missing."""
    log = log_of(tmp_path / "drive.log", dbc, n=2)
    log.write_text(log.read_text() + "(nonsense\n")
    signals = read_signals(log, dbc, NAMES)
    assert len(signals["x"][0]) == 2
    (reason,) = signals.skipped
    assert "1 of 5 records are damaged" in reason
    with pytest.raises(LogError, match="1 of 5 records are damaged"):
        read_signals(log, dbc, {**NAMES, "second": "Second"})


def test_signals_of_frames_with_the_same_number(tmp_path: Path, dbc: Path) -> None:
    """One of 11 and one of 29 bits are different messages; times are those of the frames."""
    dbc.write_text(DBC.replace("BO_ 259 Other", "BO_ 512 Other").replace("Overlap : 8|", "Z : 16|"))
    other = can.Message(107.25, arbitration_id=512, is_extended_id=False, data=b"\x2a" + bytes(7))
    log = log_of(tmp_path / "drive.log", dbc, other, n=3)
    signals = read_signals(log, dbc, {"speed": "Motion.Speed", "other": "Other.Speed"})
    assert [list(series) for series in signals["other"]] == [[107.25], [42.0]]
    np.testing.assert_allclose(signals["speed"][0], [100.02, 100.12, 100.22])
    np.testing.assert_allclose(signals["speed"][1], 36.0)
    assert (len(signals), list(signals)) == (2, ["speed", "other"])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        pytest.param({"is_extended_id": True}, "other frames are extended 0x100", id="extended"),
        pytest.param({"arbitration_id": 0x110}, "other frames are 0x110", id="another-id"),
        pytest.param({"channel": "can7"}, "the channels are can7", id="another-channel"),
        pytest.param({"is_remote_frame": True}, "there is no frame", id="no-frame"),
    ],
)
def test_a_missing_signal_names_what_is_there(
    dbc: Path, tmp_path: Path, settings: dict[str, Any], words: str
) -> None:
    """The CAN IDs of the other frames, or their channels."""
    path = tmp_path / "other.log"
    with can.Logger(path) as writer:
        message: dict[str, Any] = {
            "arbitration_id": 256,
            "is_extended_id": False,
            "channel": "can0",
        }
        writer(can.Message(timestamp=1.0, **message | {"dlc": 8} | settings))
    with pytest.raises(LogError, match=words):
        read_signals(path, dbc, {"x": "Position.X"}, channel="can0")
