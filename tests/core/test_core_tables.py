"""Tables of a DBC that the core checks, since it reads and writes where they say."""

import shutil
from dataclasses import replace
from typing import Any

import make_declarations
import numpy as np
import pytest
from support.scene_streams import COMPLETE, new_codec

from maplines_can.core import lib
from maplines_can.core.memory import structure
from maplines_can.model import elementary
from maplines_can.values.elementary import exp2
from maplines_can.values.errors import LayoutError
from maplines_can.wire import core_tables
from maplines_can.wire.layout.signal import Signal

KIND = Signal("Kind", 0, 3, False, False, 1.0, 0.0, "", 0, 7)


def is_accepted(dbc: str, change: dict[str, Any]) -> bool:
    """Return whether the core takes the tables of a DBC with other members."""
    content = core_tables.content_of(new_codec(dbc).layout)
    for name, value in change.items():
        before = content[name]
        content[name] = {**before, **value} if isinstance(before, dict) else value
    made = structure("maplines_dbc_t", core_tables._plain(content))
    return bool(lib.maplines_check_tables(made))


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no cc")
def test_the_declarations_are_those_of_the_headers() -> None:
    """After a change of a header, tools/make_declarations.py writes them again."""
    assert make_declarations.PATH.read_text() == make_declarations.declarations()


def test_a_signal_anywhere_in_a_record_is_accepted() -> None:
    """What is changed below is refused for its own sake."""
    assert is_accepted(COMPLETE, {"kind": replace(KIND, length=63)})
    assert is_accepted(COMPLETE, {"kind": {}})  # the DBC has no such signal


@pytest.mark.parametrize(
    "change",
    [
        pytest.param({"line": {"pages": 17}}, id="pages"),
        pytest.param({"line": {"pages": 0}}, id="no-pages"),
        pytest.param({"line": {"pages": 2, "short_pages": 3}}, id="short-pages"),
        pytest.param({"line": {"crc_byte": 127}}, id="checksum"),
        pytest.param({"pose": {"pages": 0}}, id="no-pose"),
        pytest.param({"max_components": 65}, id="components"),
        pytest.param({"kind": replace(KIND, start=1020, length=5)}, id="end-of-a-signal"),
        pytest.param({"kind": replace(KIND, length=64)}, id="length"),
        pytest.param({"kind": {"first": 0, "length": 3}}, id="no-scale"),
        pytest.param({"covariance": {"rows": 5}}, id="rows"),
        pytest.param({"covariance": {"order": {0: 4, 1: 1, 2: 2, 3: 3}}}, id="order"),
        pytest.param({"straight": None}, id="no-levels"),
    ],
)
def test_tables_beyond_a_record_are_refused(change: dict[str, Any]) -> None:
    """It would be read and written beyond a record, or a structure."""
    assert not is_accepted(COMPLETE, change)


def test_a_layout_whose_tables_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the DBC: the package made the tables."""
    given = core_tables.content_of
    monkeypatch.setattr(
        core_tables, "content_of", lambda layout: {**given(layout), "max_components": 65}
    )

    with pytest.raises(LayoutError, match=r"maplines\.dbc: the core takes its tables"):
        core_tables.tables_of(new_codec(COMPLETE).layout)


def test_powers_of_two() -> None:
    """At the ends of the numbers, too, those of the model."""
    ends = [-2001, -1074.6, -1074, -1022, -0.0, 1023, 1023.9]
    exponents = np.array([*ends, *np.random.default_rng(1).uniform(-200, 200, 1000)])
    assert exp2(exponents).tolist() == [elementary.exp2(x) for x in exponents.tolist()]
