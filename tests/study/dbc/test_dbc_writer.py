"""The description of the record, its DBC and its page agree."""

import re
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cantools
import pytest

from maplines_can.cli.options import line_codec_from
from maplines_can.study.codes import CODES
from maplines_can.study.dbc.dbc_writer import DbcWriter, SignalSpec
from maplines_can.study.dbc.record_spec import (
    CONDITIONAL,
    DEFAULT,
    SCENES,
    WHOLE_SCENES,
    dbc_name,
    dbc_writer_for,
)
from maplines_can.values.line import Kind, Slot, Status
from maplines_can.wire import Codec, Layout
from maplines_can.wire.layout.pose_layout import SCENE
from maplines_can.wire.layout.scene_layout import NoLine

ROOT = Path(__file__).parents[3]


@cache
def load(name: str) -> Any:
    """Return one of the databases of the package."""
    return cantools.database.load_file(ROOT / "dbc" / name)


@pytest.fixture(scope="module")
def database() -> Any:
    return load("maplines.dbc")


def test_the_files_are_up_to_date() -> None:
    """The DBCs and the tables in dbc/README.md are those of the description."""
    check = [sys.executable, ROOT / "tools" / "make_dbc.py", "--check"]
    done = subprocess.run(check, capture_output=True, text=True, check=False)  # type: ignore[arg-type]
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_bit_is_used_once(database: Any) -> None:
    """Four pages of 64 bits, and the FD message of 256."""
    for slot in Slot:
        name = "".join(part.capitalize() for part in slot.name.split("_"))
        classic = database.get_message_by_name(name)
        fd = database.get_message_by_name(f"{name}Fd")
        assert (classic.length, fd.length, fd.is_fd, classic.is_fd) == (8, 32, True, False)
        assert sum(signal.length for signal in fd.signals) == 256
        for page in range(4):
            assert (
                sum(s.length for s in classic.signals if page in (s.multiplexer_ids or [page]))
                == 64
            )


def test_every_bit_of_a_whole_scene_is_used_once() -> None:
    """64 bytes in each of the four messages, of which the authenticated ones have a trailer."""
    messages = load("maplines-scene.dbc").messages

    assert [message.name for message in messages] == [
        "Scene2",
        "Scene2SecOC",
        "Scene",
        "SceneSecOC",
    ]
    for message in messages:
        assert (message.length, message.is_fd) == (64, True)
        assert sum(signal.length for signal in message.signals) == 512


@pytest.mark.parametrize("name", ["maplines.dbc", "maplines-scene.dbc"])
def test_each_signal_explains_itself(name: str) -> None:
    """It has a comment, unit and range; its message has a cycle time and a send type."""
    units = {"YOff": "m", "Beta": "rad", "C0": "1/m", "C1": "1/m^2", "Age": "ms", "XMax": "m"}
    for message in load(name).messages:
        assert message.comment
        assert message.cycle_time == 50
        assert message.send_type == "Cyclic"
        assert message.senders == ["PositionEcu"]
        for signal in message.signals:
            assert signal.comment, signal.name
            assert signal.minimum is not None
            assert signal.receivers == ["AdasEcu"]
            if plain := re.fullmatch(rf"(?:E\w+t|Line\d)?({'|'.join(units)})", signal.name):
                assert signal.unit == units[plain[1]]


def test_names_of_kinds_in_whole_scenes() -> None:
    """Those of the places without a line are there, too."""
    message = load("maplines-scene.dbc").get_message_by_name("Scene2")
    choices = message.get_signal_by_name("EdgeRightKind").choices
    assert {int(n): str(text) for n, text in choices.items()} == {
        one.value: one.name for one in (*Kind, *NoLine)
    }


def test_value_tables_are_the_enumerations(database: Any) -> None:
    """A trace tool shows FULL and DASHED instead of numbers."""
    message = database.get_message_by_name("EgoLeft")
    for name, enumeration in (("Status", Status), ("Kind", Kind)):
        choices = message.get_signal_by_name(name).choices
        assert {int(n): str(text) for n, text in choices.items()} == {
            e.value: e.name for e in enumeration
        }


def test_the_page_names_the_ids_of_the_dbc() -> None:
    """The table of slots in dbc/README.md agrees with the DBC."""
    page = (ROOT / "dbc" / "README.md").read_text()
    for messages in Layout.from_dbc().messages.values():
        row = f"| 0x{messages.can_id:03X} | 0x{messages.fd_can_id:03X} | 0x{messages.data_id:04X} |"
        assert row in page
    scene = Layout.from_dbc(ROOT / "dbc" / "maplines-scene.dbc").scene
    assert scene is not None
    for own in scene.messages.values():
        ids = f"| 0x{own.fd_can_id:03X} | 0x{own.data_id:04X} "
        assert f"{ids}| 0x{own.secured_can_id:03X} | 0x{own.secured_data_id:04X} |" in page


@pytest.mark.parametrize("writer", [CONDITIONAL, WHOLE_SCENES, *map(dbc_writer_for, CODES)])
def test_the_database_has_the_layout_of_the_text(writer: DbcWriter) -> None:
    """The numbers of the text are exact."""
    own, read = Layout.from_dbc(writer.database()), Layout.from_text(writer.dbc())
    assert own.signals == read.signals
    assert own.messages == read.messages
    assert own.secured == read.secured
    assert own.covariance_code == read.covariance_code
    assert (own.pose is None) is (read.pose is None)
    assert own.is_same_as(read)


@pytest.mark.parametrize("code", CODES)
def test_the_dbc_of_each_code_has_a_name(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``--dbc`` takes it in any folder; a file of that name comes first."""
    monkeypatch.chdir(tmp_path)
    assert line_codec_from(dbc_name(code)).layout.covariance_code == code
    Path(dbc_name(code)).write_text(dbc_writer_for("Sigmas").dbc())
    assert line_codec_from(dbc_name(code)).layout.covariance_code == "Sigmas"


def test_the_tool_writes_the_dbc_of_each_code(tmp_path: Path) -> None:
    """For tools that read files."""
    command = [sys.executable, ROOT / "tools" / "make_dbc.py", "--codes", tmp_path / "dbc"]
    subprocess.run(command, check=True)  # type: ignore[arg-type]
    written = {path.name: path.read_text() for path in (tmp_path / "dbc").iterdir()}
    assert written == {dbc_name(code): dbc_writer_for(code).dbc() for code in CODES}


def test_a_page_that_is_too_full_is_refused() -> None:
    """The constructor of the writer raises."""
    wide = SignalSpec(name="Wide", bits=59, about="", why="")
    with pytest.raises(ValueError, match="page 1 has 65 bits, more than 64"):
        DbcWriter(((wide,), (wide,), (wide,), (wide,)))


def test_a_whole_scene_that_is_too_large_is_refused() -> None:
    """With five lines it would have more bytes than a CAN FD frame; so with four and a MAC."""
    for places, secured_places, needed in ((5, 3, 77), (4, 4, 77)):
        scene = replace(SCENES, places=places, secured_places=secured_places)
        with pytest.raises(ValueError, match=f"64 bytes at most, but {needed} are needed"):
            replace(WHOLE_SCENES, scene=scene).database()


def test_signals_of_the_record_in_lines_need_lines_with_a_fixed_slot() -> None:
    """The last bits of the others have their slots."""
    for change in ({"fixed": {SCENE: (Slot.EGO_LEFT,)}}, {"secured_places": 1}):
        with pytest.raises(ValueError, match="but there are 2 tails"):
            replace(SCENES, **change)


def test_another_arrangement_of_pages_works(tmp_path: Path) -> None:
    """Pages in another order and other CAN IDs are written, loaded, encoded and decoded."""
    first, second, third, fourth = DEFAULT.pages
    other = DbcWriter(
        (first, fourth, third, second), first_can_id=0x100, first_fd_can_id=0x108, cycle_ms=20
    )
    path = tmp_path / "other.dbc"
    path.write_text(other.dbc())
    codec = Codec.from_dbc(path)
    assert min(codec.can_ids) == 0x100
    assert codec.layout.messages[Slot.EGO_LEFT].cycle_ms == 20
    payload = codec.batch.encode([[1.75, 0, 0, 0]])
    assert codec.batch.decode(payload).mean[0, 0] == 1.75


def test_a_single_field_is_wider_over_the_same_range() -> None:
    """All other fields stay the same. The field may be one of the mean."""

    def fields(writer: Any) -> Any:
        return {spec.name: spec for page in writer.pages for spec in page}

    plain = fields(dbc_writer_for("Cholesky"))
    for name in ("RatioC0C1", "YOff"):
        wider = fields(dbc_writer_for("Cholesky", 0, {name: 1}))
        assert wider[name].bits == plain[name].bits + 1
        assert wider[name].range[0] == plain[name].range[0]
        assert wider[name].factor == plain[name].factor / 2
        assert {**wider, name: None} == {**plain, name: None}
    with pytest.raises(ValueError, match="field_bits must be of YOff"):
        dbc_writer_for("Cholesky", 0, {"Crc": 1})
