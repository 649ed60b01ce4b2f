"""The description of the wire, its DBC and its page are one and the same."""

import subprocess
import sys
from pathlib import Path

import cantools
import pytest

from maplines_can.line import Kind, Slot, Status
from maplines_can.study.dbc.dbc_writer import DbcWriter, SignalSpec
from maplines_can.study.dbc.record_spec import DEFAULT
from maplines_can.wire import Codec

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def database():
    return cantools.database.load_file(ROOT / "dbc" / "maplines.dbc")


def test_the_files_are_up_to_date():
    """dbc/maplines.dbc and the table beside it are what the description gives."""
    check = [sys.executable, ROOT / "tools" / "make_dbc.py", "--check"]
    done = subprocess.run(check, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_bit_is_used_once(database):
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


def test_each_signal_explains_itself(database):
    """Comment, unit where there is one, range, and cycle time and send type of the message."""
    units = {"YOff": "m", "Beta": "rad", "C0": "1/m", "C1": "1/m^2", "Age": "ms", "XMax": "m"}
    for message in database.messages:
        assert message.comment
        assert message.cycle_time == 50
        assert message.send_type == "Cyclic"
        assert message.senders == ["PositionEcu"]
        for signal in message.signals:
            assert signal.comment, signal.name
            assert signal.minimum is not None
            assert signal.receivers == ["AdasEcu"]
            if signal.name in units:
                assert signal.unit == units[signal.name]


def test_value_tables_are_the_enumerations(database):
    """A trace tool shows FULL and DASHED instead of numbers."""
    message = database.get_message_by_name("EgoLeft")
    for name, enumeration in (("Status", Status), ("Kind", Kind)):
        choices = message.get_signal_by_name(name).choices
        assert {int(n): str(text) for n, text in choices.items()} == {
            e.value: e.name for e in enumeration
        }


def test_a_page_that_is_too_full_is_refused():
    """The description itself is checked."""
    wide = SignalSpec(name="Wide", bits=59, about="", why="")
    with pytest.raises(ValueError, match="page 1 has 65 bits, more than 64"):
        DbcWriter(((wide,), (wide,), (wide,), (wide,)))


def test_a_contract_of_another_shape_works(tmp_path):
    """Pages in another order and other IDs: written, loaded, sent, received."""
    first, second, third, fourth = DEFAULT.pages
    other = DbcWriter(
        (first, fourth, third, second), first_can_id=0x100, first_fd_can_id=0x108, cycle_ms=20
    )
    path = tmp_path / "other.dbc"
    path.write_text(other.dbc())
    codec = Codec.from_dbc(path)
    assert min(codec.can_ids) == 0x100
    assert codec.layout.channels[Slot.EGO_LEFT].cycle_ms == 20
    payload = codec.encode_batch([[1.75, 0, 0, 0]])
    assert codec.decode_batch(payload).mean[0, 0] == 1.75
