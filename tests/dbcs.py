"""The codec of the project's own DBC, and other DBCs made by editing its text."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from maplines_can.wire import Codec

DBC = Path(__file__).parents[1] / "dbc" / "maplines.dbc"


@cache
def default_codec() -> Codec:
    """The codec of maplines.dbc, loaded once; for tests that leave its counters alone."""
    return Codec.from_dbc()


def edited(tmp_path: Path, *edits: tuple[str, str]) -> Path:
    """A copy of maplines.dbc with regular expressions replaced; each must be found."""
    text = DBC.read_text()
    for pattern, replacement in edits:
        text, found = re.subn(pattern, replacement, text)
        assert found, pattern
    path = tmp_path / "edited.dbc"
    path.write_text(text)
    return path
