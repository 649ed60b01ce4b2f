"""Layouts of the project's DBCs."""

from pathlib import Path

from secoc_streams import FORM

from maplines_can.wire import Layout

ROOT = Path(__file__).parents[3]


def test_the_readme_has_the_ids_of_the_dbc() -> None:
    """The table of slots in dbc/README.md agrees with maplines.dbc."""
    page = (ROOT / "dbc" / "README.md").read_text()
    for channel in Layout.from_dbc().channels.values():
        row = f"| 0x{channel.can_id:03X} | 0x{channel.fd_can_id:03X} | 0x{channel.data_id:04X} |"
        assert row in page


def test_both_dbcs_have_the_same_record() -> None:
    """The signals, pages, IDs and checksums of maplines.dbc are in maplines-secoc.dbc too."""
    plain, secured = Layout.from_dbc(), Layout.from_dbc(ROOT / "dbc" / "maplines-secoc.dbc")
    assert plain.signals == secured.signals
    assert plain.page_of_id.items() <= secured.page_of_id.items()
    assert (plain.secured, secured.secured) == (None, FORM)


def test_the_readme_has_the_authenticated_ids_of_the_dbc() -> None:
    """The table of slots in dbc/README.md agrees with maplines-secoc.dbc."""
    page = (ROOT / "dbc" / "README.md").read_text()
    for channel in Layout.from_dbc(ROOT / "dbc" / "maplines-secoc.dbc").channels.values():
        assert f"| 0x{channel.secured_can_id:03X} | 0x{channel.secured_data_id:04X} |" in page
