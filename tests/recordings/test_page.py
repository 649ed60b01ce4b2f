"""The page of recordings, followed as it stands in an empty folder."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from test_readme import ROOT, SHELL, commands

from maplines_can.cli import main

PROGRAM = re.compile(r"(?ms)`(\w+\.py)` is:\n\n```python\n(.*?)^```\n")
#: What takes long, and is tested elsewhere.
LONG = ("design",)


def test_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """Its commands in their order, then its programs."""
    for package in ("pyarrow", "matplotlib", "bokeh"):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    # Bokeh takes half a minute for the picture of all points.
    monkeypatch.setattr("maplines_can.recordings.plots.log_panels.MOST_POINTS", 50)
    text = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
    assert len(SHELL.findall(text)) == 4
    for words in commands(text):
        if words[0] not in LONG:
            short = [{"60": "31", "4": "1"}.get(word, word) for word in words]
            assert main(short) == 0
    programs = PROGRAM.findall(text)
    assert [name for name, _ in programs] == ["units.py", "ask.py", "count.py", "bits.py"]
    for name, code in programs:
        capsys.readouterr()
        exec(compile(code, name, "exec"), {})  # noqa: S102 - our own page
        assert "nan" not in capsys.readouterr().out
