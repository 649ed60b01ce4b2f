"""Each name of a signal has one definition in a DBC, as formats with one per name need."""

from collections import defaultdict
from functools import cache
from typing import Any

import cantools
import pytest

from maplines_can.study.code_dbcs import dbc_writer_for
from maplines_can.study.codes import CODES
from maplines_can.values.errors import LayoutError
from maplines_can.wire import SHIPPED, Layout, default_dbc_path
from maplines_can.wire.layout.pose_layout import PoseLayout

#: DBCs whose records have pages.
PAGED = [name for name in SHIPPED if name != "maplines-scene.dbc"]


@cache
def texts() -> dict[str, str]:
    shipped = {name: default_dbc_path(name).read_text("utf-8") for name in SHIPPED}
    return shipped | {code: dbc_writer_for(code).dbc() for code in CODES}


@pytest.mark.parametrize("name", texts())
def test_each_name_has_one_definition(name: str) -> None:
    """Length, sign, conversion, range, unit and names of values; byte order, too."""
    found = defaultdict(set)
    database: Any = cantools.database.load_string(texts()[name], "dbc")
    for message in database.messages:
        for s in message.signals:
            law = (s.length, s.is_signed, s.is_float, s.byte_order, s.scale, s.offset)
            found[s.name].add((*law, s.minimum, s.maximum, s.unit, str(s.choices)))
    assert {name: laws for name, laws in found.items() if len(laws) > 1} == {}


@pytest.mark.parametrize("name", PAGED)
def test_names_without_the_prefix_are_read(name: str) -> None:
    """A DBC of before has the same layout."""
    text = texts()[name]
    before = text.replace("PosePage", "Page").replace("PoseTransferId", "TransferId")
    assert before.count("SG_ Page M") == 9
    one, other = Layout.from_text(text), Layout.from_text(before)

    assert isinstance(one.pose, PoseLayout)
    assert isinstance(other.pose, PoseLayout)
    assert list(one.signals.items()) == list(other.signals.items())
    assert list(one.pose.signals.items()) == list(other.pose.signals.items())
    assert one.pose.short_pages == other.pose.short_pages
    assert one.pose["Page0"].dbc_name == "PosePage0"
    assert other.pose["Page0"].dbc_name == one["Page0"].dbc_name == "Page0"


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        pytest.param("SG_ PosePage M", "SG_ PoseLeaf M", "one multiplexer, named PosePage", id="m"),
        pytest.param("SG_ Page M", "SG_ PosePage M", "one multiplexer, named Page$", id="line"),
        pytest.param("PoseTransferId1 m1", "PoseX m1", "no signal 'PoseTransferId1'", id="none"),
        pytest.param(
            "PoseTransferId2 m2 : 59|2", "PoseTransferId2 m2 : 58|2", "PoseTransferId", id="place"
        ),
        pytest.param(
            "PoseTransferId1 m1 : 59|2@1+ (1",
            "PoseTransferId1 m1 : 59|2@1+ (2",
            "PoseTransferId1",
            id="law",
        ),
        pytest.param(
            "PoseTransferId1 : 123|2@1+ (1",
            "PoseTransferId1 : 123|2@1+ (2",
            "PoseTransferId1 differ",
            id="other-message",
        ),
    ],
)
def test_errors_have_the_names_of_the_dbc(old: str, new: str, error: str) -> None:
    text = texts()["maplines.dbc"]
    head, _, pose = text.partition("BO_ 860 ")
    edited = (
        head.replace(old, new) + "BO_ 860 " + pose
        if error.endswith("$")
        else head + "BO_ 860 " + pose.replace(old, new, 1)
    )
    assert edited != text
    with pytest.raises(LayoutError, match=error):
        Layout.from_text(edited)
