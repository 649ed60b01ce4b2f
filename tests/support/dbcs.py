"""The codec of the project's own DBC, and other DBCs made by editing its text."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

from scene_layouts import layout_of

from maplines_can import Slot
from maplines_can.model.records import written
from maplines_can.model.signals import read
from maplines_can.wire import Authenticator, Codec

DBC = Path(__file__).parents[2] / "dbc" / "maplines.dbc"


@cache
def default_codec() -> Codec:
    """The codec of maplines.dbc, loaded once; for tests that leave its counters alone."""
    return new_codec()


def new_codec(authenticator: Authenticator | None = None) -> Codec:
    """``Codec.from_dbc(None, authenticator)`` of a DBC that is loaded once."""
    return Codec(
        layout_of("maplines-secoc.dbc" if authenticator else "maplines.dbc"), authenticator
    )


def changed_record(codec: Codec, payload: bytes, slot: Slot = Slot.EGO_LEFT, **raw: Any) -> bytes:
    """Return a record with other raw values, and what protects it."""
    layout = codec.layout
    values = {name: read(signal, payload) for name, signal in layout.signals.items()}
    return written(layout, values | raw, layout.messages[slot].data_id)


def edited_text(text: str, *edits: tuple[str, str]) -> str:
    """A text with regular expressions replaced; each must be found."""
    for pattern, replacement in edits:
        text, found = re.subn(pattern, replacement, text)
        assert found, pattern
    return text


def edited(tmp_path: Path, *edits: tuple[str, str]) -> Path:
    """A copy of maplines.dbc with regular expressions replaced."""
    path = tmp_path / "edited.dbc"
    path.write_text(edited_text(DBC.read_text(), *edits))
    return path
