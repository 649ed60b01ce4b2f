"""Other DBCs than the project's own, made by editing its text."""

from __future__ import annotations

import re
from pathlib import Path

DBC = Path(__file__).parents[1] / "dbc" / "maplines.dbc"


def edited(tmp_path: Path, *edits: tuple[str, str]) -> Path:
    """A copy of maplines.dbc with regular expressions replaced; each must be found."""
    text = DBC.read_text()
    for pattern, replacement in edits:
        text, found = re.subn(pattern, replacement, text)
        assert found, pattern
    path = tmp_path / "edited.dbc"
    path.write_text(text)
    return path


def motorola(tmp_path: Path) -> Path:
    """The default record with some signals in Motorola order, in the same bits' bytes."""
    # Two byte-aligned places: Age and XMax stay; a field may only move where its bytes are its own.
    return edited(
        tmp_path,
        (r"SG_ Counter m0 : 16\|8@1\+", "SG_ Counter m0 : 23|8@0+"),
        (r"SG_ Counter : 16\|8@1\+", "SG_ Counter : 23|8@0+"),
    )
