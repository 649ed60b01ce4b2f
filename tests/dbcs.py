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
