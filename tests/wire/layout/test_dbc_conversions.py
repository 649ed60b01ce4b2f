"""The table of conversions in dbc/README.md says what is measured."""

import logging
import re
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import dbc_conversions
import pytest

PAGE = Path(__file__).parents[3] / "dbc" / "README.md"


def stated(tool: str) -> list[list[str]]:
    """Return format, messages kept and what is lost in the rows of a tool."""
    rows = re.findall(rf"^\| {tool} [\d.]+ \| (.*) \|$", PAGE.read_text("utf-8"), re.MULTILINE)
    return [row.split(" | ") for row in rows]


@pytest.fixture
def quiet() -> Iterator[None]:
    """Without the warnings of canmatrix."""
    logging.disable()
    yield
    logging.disable(logging.NOTSET)


def test_conversions_by_cantools() -> None:
    """DBC, KCD and SYM keep all messages."""
    measured = [list(row[1:]) for row in dbc_conversions.rows("cantools")]

    assert stated("cantools") == measured
    assert [row[1] for row in measured] == ["76 of 76"] * 3


@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("quiet")
def test_conversions_by_canmatrix() -> None:
    """Of the version in the table; others lose other things."""
    pytest.importorskip("canmatrix")
    if version("canmatrix") != dbc_conversions.CANMATRIX:
        pytest.skip(f"canmatrix is {version('canmatrix')}")

    assert stated("canmatrix") == [list(row[1:]) for row in dbc_conversions.rows("canmatrix")]
