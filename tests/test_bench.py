"""The benchmark runs, reports what it measured, and compares equal results only."""

import gc
import importlib.util
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

TARGETS = {"refit": 3, "scene": 3, "window": 2, "signals": 2, "batch": 2, "one": 0, "map": 2}
TARGETS["cycle"] = 3


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The tool as a module, with tiny sizes."""
    pytest.importorskip("filterpy")
    path = Path(__file__).parents[1] / "tools" / "bench.py"
    spec = importlib.util.spec_from_file_location("bench", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    for library in ("OPENBLAS", "MKL", "OMP"):  # the module sets them; this restores them
        monkeypatch.setenv(f"{library}_NUM_THREADS", "1")
    spec.loader.exec_module(module)
    tiny = module.Sizes(poses=16, lines=8, singles=8, roads=1, rounds=2, seconds=0.0)
    monkeypatch.setattr(module, "QUICK", tiny)
    gc.freeze()  # the tool collects garbage before each turn; that of other tests takes long
    yield module
    gc.unfreeze()


def test_every_part_gives_a_row_for_each_of_its_targets(
    bench: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """The JSON report has ratios, times and memory of each pair."""
    assert bench.main(["--quick", "--json"]) == 0

    report = json.loads(capsys.readouterr().out)
    targets = [row["part"] for row in report["results"] if row["target"]]
    assert {part: targets.count(part) for part in bench.PARTS} == TARGETS
    for row in report["results"]:
        assert 0 < row["ratio_min"] <= row["ratio"] <= row["ratio_max"]
        assert min(row["ours_s"], row["peer_s"], row["ours_bytes"], row["peer_bytes"]) > 0
        assert (row["met"] is None) == (row["target"] is None)
