"""The description of the record, its DBC and its page agree."""

import re
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cantools
import make_dbc
import pytest

from maplines_can.cli.options import layout_from
from maplines_can.generation.dbc.dbc_writer import DbcWriter, SignalSpec
from maplines_can.generation.dbc.record_spec import CONDITIONAL, DEFAULT, SCENES, WHOLE_SCENES
from maplines_can.study.code_dbcs import dbc_name, dbc_writer_for
from maplines_can.study.codes import CODES
from maplines_can.values.line import Kind, Slot, Status
from maplines_can.wire import Codec, Layout
from maplines_can.wire.layout.pose_layout import SCENE
from maplines_can.wire.layout.scene_layout import NoLine

ROOT = Path(__file__).parents[2]


@cache
def load(name: str) -> Any:
    """Return one of the databases of the package."""
    return cantools.database.load_file(ROOT / "dbc" / name)


def test_the_files_are_up_to_date(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The DBCs and the tables in dbc/README.md are those of the description; so are all codes."""
    stale = [path for path, text in make_dbc.wanted().items() if path.read_text() != text]
    assert not stale
    monkeypatch.setattr(sys, "argv", ["make_dbc.py", "--codes", str(tmp_path / "dbc")])
    assert make_dbc.main() == 0
    written = {path.name: path.read_text() for path in (tmp_path / "dbc").iterdir()}
    assert written == {dbc_name(code): dbc_writer_for(code).dbc() for code in CODES}


def test_every_bit_is_used_once() -> None:
    """Four pages of 64 bits, the FD message of 256, and 64 bytes of a whole scene."""
    for slot in Slot:
        name = "".join(part.capitalize() for part in slot.name.split("_"))
        classic, fd = (load("maplines.dbc").get_message_by_name(name + end) for end in ("", "Fd"))
        assert (classic.length, fd.length, fd.is_fd, classic.is_fd) == (8, 32, True, False)
        assert sum(signal.length for signal in fd.signals) == 256
        for page in range(4):
            own = (s.length for s in classic.signals if page in (s.multiplexer_ids or [page]))
            assert sum(own) == 64
    messages = load("maplines-scene.dbc").messages
    assert [m.name for m in messages] == ["Scene2", "Scene2SecOC", "Scene", "SceneSecOC"]
    for message in messages:
        assert (message.length, message.is_fd) == (64, True)
        assert sum(signal.length for signal in message.signals) == 512


@pytest.mark.parametrize("name", ["maplines.dbc", "maplines-scene.dbc"])
def test_each_signal_explains_itself(name: str) -> None:
    """It has a comment, unit and range; its message has a cycle time and a send type."""
    units = {"YOff": "m", "Beta": "rad", "C0": "1/m", "C1": "1/m^2", "Age": "ms", "XMax": "m"}
    for message in load(name).messages:
        assert message.comment
        assert (message.cycle_time, message.send_type) == (50, "Cyclic")
        assert message.senders == ["PositionEcu"]
        for signal in message.signals:
            assert signal.comment, signal.name
            assert signal.minimum is not None
            assert signal.receivers == ["AdasEcu"]
            if plain := re.fullmatch(rf"(?:E\w+t|Line\d)?({'|'.join(units)})", signal.name):
                assert signal.unit == units[plain[1]]


@pytest.mark.parametrize(
    ("name", "message", "signal", "members"),
    [
        ("maplines.dbc", "EgoLeft", "Status", Status),
        ("maplines.dbc", "EgoLeft", "Kind", Kind),
        ("maplines-scene.dbc", "Scene2", "EdgeRightKind", (*Kind, *NoLine)),
    ],
)
def test_value_tables_are_the_enumerations(
    name: str, message: str, signal: str, members: Any
) -> None:
    """A trace tool shows FULL and DASHED instead of numbers."""
    choices = load(name).get_message_by_name(message).get_signal_by_name(signal).choices
    assert {int(n): str(text) for n, text in choices.items()} == {e.value: e.name for e in members}


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


@pytest.mark.parametrize("code", [*CODES, CONDITIONAL.covariance_code])
def test_the_database_has_the_layout_of_the_text(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its numbers are exact. ``--dbc`` takes the name; a file of that name comes first."""
    monkeypatch.chdir(tmp_path)
    writer = CONDITIONAL if code not in CODES else dbc_writer_for(code)
    name = "maplines-pose.dbc" if code not in CODES else dbc_name(code)
    own, read = Layout.from_dbc(writer.database()), layout_from(name)
    assert read.covariance_code == own.covariance_code == code
    assert own.signals == read.signals
    assert (own.messages, own.secured) == (read.messages, read.secured)
    assert (own.pose is None) is (read.pose is None)
    assert own.is_same_as(read)
    if code == "Float16":
        Path(name).write_text(dbc_writer_for("Sigmas").dbc())
        assert layout_from(name).covariance_code == "Sigmas"


def test_records_that_do_not_fit_are_refused() -> None:
    """A page that is too full, a frame that is too long, and tails without lines for them."""
    wide = SignalSpec(name="Wide", bits=59, about="", why="")
    with pytest.raises(ValueError, match="page 1 has 65 bits, more than 64"):
        DbcWriter(((wide,), (wide,), (wide,), (wide,)))
    for places, secured_places in ((5, 3), (4, 4)):
        scene = replace(SCENES, places=places, secured_places=secured_places)
        with pytest.raises(ValueError, match="64 bytes at most, but 77 are needed"):
            replace(WHOLE_SCENES, scene=scene).database()
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
