# ruff: noqa: RUF001 - units and comments of several scripts
"""The encoding of a DBC is found by its units, or stated."""

import warnings
from pathlib import Path

import pytest
from support.dbcs import DBC

from maplines_can import Codec, LayoutError
from maplines_can.bus import SignalDecoder, read_signals
from maplines_can.cli import main
from maplines_can.dbc_files.encoding import text_of
from maplines_can.dbc_files.parser import parse_database, read_text
from maplines_can.recordings.fitting import fits
from maplines_can.recordings.read_lines import read_lines
from maplines_can.restbus import Config

CAR = """VERSION ""
NS_ :
BS_:
BU_: Car
BO_ 256 Engine: 8 Car
 SG_ Temp : 0|8@1+ (1,-40) [-40|214] "{unit}" Car
CM_ SG_ 256 Temp "{comment}";
"""


def car(unit: str, comment: str, encoding: str) -> bytes:
    return CAR.format(unit=unit, comment=comment).encode(encoding)


@pytest.mark.parametrize(
    ("encoding", "unit", "comment"),
    [
        pytest.param("ascii", "C", "Temperature", id="ascii"),
        pytest.param("utf-8", "°C", "Öl, 油温", id="utf-8"),
        pytest.param("utf-8-sig", "°C", "Öl", id="utf-8-mark"),
        pytest.param("utf-16", "℃", "油温", id="utf-16"),
        pytest.param("cp1252", "°C", "Öltemperatur", id="cp1252"),
        pytest.param("cp1252", "µm", "é", id="cp1252-micro"),
        pytest.param("cp1250", "°C", "źródło ťž", id="cp1250"),
        pytest.param("cp1251", "км/ч", "Скорость", id="cp1251"),
        pytest.param("cp1251", "°С", "", id="cp1251-cyrillic-letter"),
        pytest.param("cp932", "℃", "油温", id="cp932"),
        pytest.param("cp932", "°C", "エンジン回転数", id="cp932-degree"),
        pytest.param("cp936", "℃", "油温，当前值", id="cp936"),
        pytest.param("cp936", "转", "", id="cp936-word-that-is-utf-8"),
        pytest.param("cp936", "安", "", id="cp936-word-of-degree-and-square"),
        pytest.param("cp949", "℃", "유온", id="cp949"),
        pytest.param("cp949", "도", "", id="cp949-word-of-two-micros"),
    ],
)
def test_units_are_right(encoding: str, unit: str, comment: str) -> None:
    """In each encoding that tools write; no warning, as the unit exists."""
    text = text_of(car(unit, comment, encoding), "car.dbc")

    (message,) = parse_database(text, "car.dbc").messages
    assert unit == message.signals[0].unit


def test_an_uncertain_unit_is_said() -> None:
    """The bytes of cp950 are no unit that is known in another code page."""
    with pytest.warns(UserWarning, match=r"in cp1252, .* whether '¢J' is right; .*--encoding"):
        text_of(car("℃", "", "cp950"), "car.dbc")


def test_uncertain_names_are_said_each_once() -> None:
    """Also those of values; a comment has no effect, and three are shown."""
    names = ["开", "关", "停", "倒"]
    rows = "".join(f'{i} "{name}" ' for i, name in enumerate([*names, "开"]))
    data = (CAR.format(unit="C", comment="油") + f"VAL_ 256 Temp {rows};\n").encode("cp936")
    with pytest.warns(UserWarning, match=r"whether '¿ª', '¹Ø', 'Í£' and 1 more is right") as found:
        text_of(data, "car.dbc")

    assert len(found) == 1
    assert "油".encode("cp936").decode("cp1252") not in str(found[0].message)


def test_utf_8_is_certain_if_the_units_do_not_say_otherwise() -> None:
    """Its comments and names of values are right, and nothing is said of them."""
    text = CAR.format(unit="C", comment="油") + 'VAL_ 256 Temp 0 "开" ;\n'

    assert text_of(text.encode(), "car.dbc") == text


def test_bytes_that_no_code_page_has_refuse_nothing() -> None:
    """A file of several encodings: the unit is read, and the comment has a replacement."""
    data = car("°C", "{}", "cp1252").replace(b"{}", b"\x81\x8d\x98\xff\x30")
    (message,) = parse_database(text_of(data, "car.dbc"), "car.dbc").messages

    assert message.signals[0].unit == "°C"
    assert "\ufffd" in str(message.signals[0].comment)


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["no-mark", "mark"])
def test_a_stated_encoding_is_taken(mark: bytes) -> None:
    """It is not checked by units, and a byte order mark is not part of the text."""
    data = mark + car("°C", "", "utf-8")

    assert text_of(data, "car.dbc", "utf-8") == CAR.format(unit="°C", comment="")
    assert '"Â°C"' in text_of(car("°C", "", "utf-8"), "car.dbc", "cp1252")


@pytest.mark.parametrize(
    ("data", "encoding", "text"),
    [
        pytest.param(
            car("°C", "", "cp1252"), "utf-8", r"car: is not in encoding=utf-8: ", id="not"
        ),
        pytest.param(b"x", "utf-9", r"encoding='utf-9' is none that Python knows", id="unknown"),
        pytest.param(b"x", "a\0", r"encoding='a\\x00' is none that Python knows", id="nul"),
        pytest.param(b"\xef\xbb\xbf\xff", None, r"car: is not in encoding=utf-8-sig", id="mark"),
        pytest.param(b"\xff\xfeA", None, r"car: is not in encoding=utf-16", id="mark-16"),
    ],
)
def test_an_encoding_that_does_not_fit(data: bytes, encoding: str | None, text: str) -> None:
    """A statement of the user, or a byte order mark, is certain: the rest is an error."""
    with pytest.raises(LayoutError, match=text):
        text_of(data, "car", encoding)


@pytest.fixture
def gbk(tmp_path: Path) -> Path:
    """A DBC of lines whose comment is in cp936."""
    path = tmp_path / "lines.dbc"
    path.write_bytes(DBC.read_bytes() + 'CM_ "油温";\n'.encode("cp936"))
    return path


def test_each_function_that_reads_a_dbc_takes_an_encoding(gbk: Path, tmp_path: Path) -> None:
    """The text is read in it, and one that does not fit is an error."""
    log = tmp_path / "a.log"
    log.write_text("(1.0) can0 123#00\n")
    signals = {"y": "EgoLeft.YOff"}

    assert "油温" in read_text(gbk, "cp936")
    assert Codec.from_dbc(gbk, encoding="cp936").can_ids == Codec.from_dbc().can_ids
    assert SignalDecoder(gbk, signals, encoding="cp936").can_ids
    for read in (
        lambda: Codec.from_dbc(gbk, encoding="utf-8"),
        lambda: SignalDecoder(gbk, signals, encoding="utf-8"),
        lambda: read_signals(log, gbk, signals, encoding="utf-8"),
        lambda: read_lines(log, dbc=gbk, encoding="utf-8"),
        lambda: fits(log, [gbk], "utf-8"),
        lambda: Config.from_dict(
            {"lines": {"scenario": "production", "dbc": str(gbk)}, "encoding": "utf-8"}
        ),
        lambda: Config.from_dict(
            {"message": [{"name": "Pose", "dbc": str(gbk)}]}, encoding="utf-8"
        ),
    ):
        with pytest.raises(ValueError, match="is not in encoding=utf-8"):
            read()


@pytest.mark.parametrize(
    "command",
    [
        ["decode", "{log}", "--dbc"],
        ["decode", "{log}", "-o", "{log}.csv", "--dbc"],
        ["decode", "{log}", "-o", "{log}.d/d", "--dbc"],
        ["plot", "{log}", "-o", "{log}.png", "--dbc"],
        ["generate", "c", "--out", "{log}.c", "--dbc"],
        ["generate", "vectors", "--out", "{log}.c", "--dbc"],
        ["generate", "fmu", "sender", "--out", "{log}.fmu", "--dbc"],
        ["claims", "--dbc"],
        ["demo", "--dbc"],
        ["drive", "--drive", "{log}", "--signals", "{log}.toml", "--signals-dbc"],
        ["consume", "fusion", "{log}", "--signals", "{log}.toml", "--signals-dbc"],
        ["consume", "check", "{log}", "--camera", "{log}", "--camera-dbc"],
    ],
    ids=lambda command: " ".join(command[:2]),
)
def test_each_command_takes_the_encoding(
    command: list[str], gbk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It reaches the reader of the DBC."""
    log = tmp_path / "a.log"
    log.write_text("(1.0) can0 123#00\n")
    log.with_name("a.log.toml").write_text('speed = "EgoLeft.YOff"\nyaw_rate = "EgoLeft.Beta"\n')
    argv = [word.format(log=log) for word in command]

    assert main([*argv, str(gbk), "--encoding", "utf-8"]) == 1
    assert "lines.dbc: is not in --encoding utf-8: " in capsys.readouterr().err


def test_a_restbus_takes_the_encoding(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """That of the command comes first; a warning is a line without the place in the code."""
    (tmp_path / "car.dbc").write_bytes(car("°Re", "", "cp1252") + b'VAL_ 256 Temp 1 "\xbf\xaa" ;\n')
    config = tmp_path / "r.toml"
    config.write_text(
        'seconds=0.1\ndbc="car.dbc"\nencoding="utf-8"\n[[message]]\nname="Engine"\ncycle_ms=50\n'
    )
    run = ["restbus", str(config), "--virtual-time"]

    assert main(run) == 1
    assert "car.dbc: is not in --encoding utf-8" in capsys.readouterr().err
    assert main([*run, "--encoding", "cp1252"]) == 0
    config.write_text(config.read_text().replace('encoding="utf-8"', ""))
    capsys.readouterr()
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main(run) == 0
    first = capsys.readouterr().err.splitlines()[0]
    assert first.startswith("maplines: ")
    assert "it is uncertain whether '¿ª' is right" in first
