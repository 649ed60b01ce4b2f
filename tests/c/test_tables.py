"""Tables of a DBC in C, and which DBCs have none."""

from copy import copy
from dataclasses import replace

import pytest
from scene_layouts import layout_of

from maplines_can.generation.c_tables import identifier_of, tables_of
from maplines_can.study.code_dbcs import dbc_writer_for
from maplines_can.study.codes import CODES as STUDY_CODES
from maplines_can.values.errors import LayoutError
from maplines_can.wire.core_tables import CODES
from maplines_can.wire.layout.message_layout import Layout


def test_the_name_of_a_table_is_an_identifier() -> None:
    for dbc in ("my car.dbc", "ü.dbc", "_x.dbc", "", "9", "a-b.c.dbc"):
        name = identifier_of(dbc)
        assert name.isidentifier()
        assert name.isascii()
        assert name[0] != "_"


@pytest.mark.parametrize("code", sorted(STUDY_CODES.keys() - set(CODES)))
def test_a_covariance_code_of_the_study_is_refused_by_name(code: str) -> None:
    layout = Layout.from_text(dbc_writer_for(code).dbc(), "study.dbc")
    with pytest.raises(LayoutError, match=rf"study.dbc.*'{code}' is none of the core"):
        tables_of(layout)


@pytest.mark.parametrize(
    ("name", "length", "words"),
    [
        pytest.param("YOff", 62, "YOff.*at most [0-9]+ bits", id="mean"),
        pytest.param("TransferId0", 9, "TransferId0.*at most 8 bits", id="transfer-ids"),
        pytest.param("Counter", 33, "Counter.*at most 32 bits", id="counter"),
        pytest.param("ComponentCount", 7, "ComponentCount.*at most 6 bits", id="components"),
    ],
)
def test_what_is_larger_than_c_can_hold_is_refused_by_name(
    name: str, length: int, words: str
) -> None:
    layout = layout_of("maplines-pose.dbc" if name == "YOff" else "maplines.dbc")
    wide = copy(layout)  # without the checks of the constructor
    vars(wide)["signals"] = {**layout.signals, name: replace(layout[name], length=length)}
    with pytest.raises(LayoutError, match=words):
        tables_of(wide)
