"""Layouts of the project's DBCs."""

from dataclasses import replace
from pathlib import Path

import pytest
from support.secoc_streams import LAYOUT

from maplines_can import Codec, Slot
from maplines_can.values.errors import EncodeError
from maplines_can.wire import Layout

ROOT = Path(__file__).parents[3]


def test_the_readme_has_the_ids_of_the_dbc() -> None:
    """The table of slots in dbc/README.md agrees with maplines.dbc."""
    page = (ROOT / "dbc" / "README.md").read_text()
    for messages in Layout.from_dbc().messages.values():
        row = f"| 0x{messages.can_id:03X} | 0x{messages.fd_can_id:03X} | 0x{messages.data_id:04X} |"
        assert row in page


def test_both_dbcs_have_the_same_record() -> None:
    """The signals, pages, IDs and checksums of maplines.dbc are in maplines-secoc.dbc too."""
    plain, secured = Layout.from_dbc(), Layout.from_dbc(ROOT / "dbc" / "maplines-secoc.dbc")
    assert plain.signals == secured.signals
    assert plain.message_of_id.items() <= secured.message_of_id.items()
    assert (plain.secured, secured.secured) == (None, LAYOUT)


def test_the_readme_has_the_authenticated_ids_of_the_dbc() -> None:
    """The table of slots in dbc/README.md agrees with maplines-secoc.dbc."""
    page = (ROOT / "dbc" / "README.md").read_text()
    for messages in Layout.from_dbc(ROOT / "dbc" / "maplines-secoc.dbc").messages.values():
        assert f"| 0x{messages.secured_can_id:03X} | 0x{messages.secured_data_id:04X} |" in page


def test_a_slot_without_messages_is_refused_in_a_batch() -> None:
    """No record is made or checked with the data ID of another slot."""
    layout = Layout.from_dbc()
    left = {Slot.EGO_LEFT: layout.messages[Slot.EGO_LEFT]}
    codec = Codec(replace(layout, messages=left))
    payloads = codec.batch.encode([[1.75, 0, 0, 0]], slot=Slot.EGO_LEFT)
    for use in (
        lambda: codec.batch.encode([[1.75, 0, 0, 0]], slot=Slot.EGO_RIGHT),
        lambda: codec.batch.decode(payloads, Slot.EGO_RIGHT),
    ):
        with pytest.raises(EncodeError, match="no message for slot 1"):
            use()
