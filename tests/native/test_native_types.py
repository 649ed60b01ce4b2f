"""Other objects than those of the extension module, where it takes its own: a TypeError."""

import array
import re
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scene_streams import COMPLETE, new_codec, road_scene

from maplines_can import native
from maplines_can.wire import Frame

core = native.core
pytestmark = pytest.mark.skipif(not native.is_active, reason="there is no C path")


def tables() -> Any:
    return new_codec(COMPLETE)._c_tables


#: By name: plain ones, those of other modules of C, and those of this one.
STRANGE: dict[str, Any] = {
    "None": lambda: None,
    "object": object,
    "int": lambda: 5,
    "bytes": lambda: b"tables",
    "array of NumPy": lambda: np.zeros(200),
    "array": lambda: array.array("d", [0.0] * 200),
    "pattern": lambda: re.compile("x"),
    "compressor": zlib.compressobj,
    "codec": lambda: new_codec(COMPLETE),
    "type": lambda: core.Tables,
    "sender": lambda: core.Sender(tables(), Frame),
    "decoder": lambda: new_codec(COMPLETE).decoder(),
    "prepared scene": lambda: core.Sender(tables(), Frame).prepare(road_scene(), 0),
    "paths": lambda: core.paths((), 0),
}


@pytest.mark.parametrize("name", STRANGE)
def test_what_is_no_table_is_refused(name: str) -> None:
    """By each type and function that takes the tables of a DBC."""
    strange = STRANGE[name]()
    uses: list[Callable[[], Any]] = [
        lambda: core.Sender(strange, Frame),
        lambda: core.encode_records(strange, (), *[np.zeros(0)] * 15),
        lambda: core.cover_mixtures(strange, *[np.zeros(0)] * 3, 1, *[np.zeros(0)] * 2),
        lambda: core.decode_records(strange, *[np.zeros(0)] * 15),
    ]
    for use in uses:
        with pytest.raises(TypeError, match=r"tables must be _native\.Tables"):
            use()


@pytest.mark.parametrize("name", STRANGE)
def test_other_arguments_of_another_type_are_refused(name: str) -> None:
    """The class of frames, content of tables, and powers."""
    strange = STRANGE[name]()
    own = tables()
    none = [np.zeros(0)] * 15
    uses: list[Callable[[], Any]] = [
        lambda: core.Sender(own, strange),
        lambda: core.Tables(strange),
        lambda: core.encode_records(own, strange, *none),
        lambda: core.decode_records(own, np.zeros(0, "u1"), np.zeros(0, "u2"), strange, *none[:12]),
        lambda: core.Sender(own, Frame).lines([], strange, 0),
    ]
    for use in uses:
        with pytest.raises(TypeError):
            use()


@pytest.mark.parametrize("name", [name for name in STRANGE if name != "paths"])
def test_what_are_no_lines_of_a_map_are_left_to_python(name: str) -> None:
    """None, or an error of a caller: no capsule of another kind is read."""
    strange = STRANGE[name]()
    fit, settings, pose = (1.0, 1.0, 1.0), (0.0, 1.0, 1.0, 1.0), np.zeros(3)
    rule = np.zeros((1, 3)), np.ones(1), np.ones(1)
    refit = core.refit(core.paths((), 0), pose, (0.0, 1.0, 1.0), fit)
    assert core.refit(strange, pose, (0.0, 1.0, 1.0), fit) is None
    for each in (strange, refit):
        assert core.map_lines(each, pose, np.eye(3), settings, rule) is None
        assert core.map_scene(each, pose, np.eye(3), settings, rule) is None
    for each in (strange, core.paths((), 0)):
        with pytest.raises(ValueError, match="PyCapsule"):
            core.refit_values(each, np.zeros((1, 3)), np.zeros((1, 1, 4)))
        with pytest.raises(ValueError, match="PyCapsule"):
            core.refit_field(each, np.zeros(3))


@pytest.mark.parametrize(
    "content",
    [
        pytest.param({"line": {"pages": 17}}, id="pages"),
        pytest.param({"line": {"pages": 2, "short_pages": 3}}, id="short-pages"),
        pytest.param({"line": {"crc_byte": 127}}, id="checksum"),
        pytest.param({"max_components": 65}, id="components"),
        pytest.param({"kind": (1.0, 0.0, 0, 1, 1020, 5, 0, 0)}, id="end-of-a-signal"),
        pytest.param({"kind": (1.0, 0.0, 0, 1, 0, 65, 0, 0)}, id="length"),
        pytest.param({"kind": (1.0, 0.0, 0, 1, 0, 0, 0, 0)}, id="no-bits"),
    ],
)
def test_content_beyond_the_structures_is_refused(content: Any) -> None:
    """It would be read and written beyond a record."""
    with pytest.raises(ValueError, match=r"content is not that of a DBC|within a record"):
        core.Tables(content)
