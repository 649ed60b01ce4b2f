"""The measurement of a sender's CPU runs, and each row of its table has figures."""

import importlib.util
import re
from pathlib import Path

import pytest


def test_each_row_has_a_share_and_a_ratio(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The peer is once itself; whoever sends scenes takes more than wake-ups alone."""
    tools = Path(__file__).parents[1] / "tools"
    monkeypatch.syspath_prepend(tools)
    for library in ("OPENBLAS", "MKL", "OMP"):  # the module sets them; this restores them
        monkeypatch.setenv(f"{library}_NUM_THREADS", "1")
    spec = importlib.util.spec_from_file_location("sender_load", tools / "sender_load.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.main(["--quick"]) == 0

    text = capsys.readouterr().out
    sizes = re.findall(r"(\d+) transfers, (\d+) frames", text)
    assert sizes == [("9", "38"), ("9", "30"), ("2", "2")]
    rows = re.findall(r"^   (.+?) +([\d.]+) % +(\d+) us/cycle +([\d.]+)x$", text, re.MULTILINE)
    shares = [(name, float(share)) for name, share, _, _ in rows]
    assert len(rows) == 15
    for table in (dict(shares[i : i + 5]) for i in range(0, 15, 5)):
        assert 0 < table["wake-ups alone"] < table["with map_scene"]
    assert [ratio for name, _, _, ratio in rows if name == "send_periodic"] == ["1.00"] * 3
