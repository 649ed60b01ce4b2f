"""Layouts of the project's DBCs."""

from pathlib import Path

from secoc_streams import LAYOUT

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
