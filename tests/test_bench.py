"""The bench runs, says what it measured, and refuses to compare what is not the same."""

import importlib.util
import json
from pathlib import Path

import pytest

TARGETS = {"refit": 3, "scene": 2, "signals": 2, "batch": 2, "one": 0}


@pytest.fixture
def bench(monkeypatch):
    """The tool as a module, in sizes that take no time."""
    pytest.importorskip("filterpy")
    path = Path(__file__).parents[1] / "tools" / "bench.py"
    spec = importlib.util.spec_from_file_location("bench", path)
    module = importlib.util.module_from_spec(spec)
    for library in ("OPENBLAS", "MKL", "OMP"):  # the module sets them; put back what was there
        monkeypatch.setenv(f"{library}_NUM_THREADS", "1")
    spec.loader.exec_module(module)
    tiny = module.Sizes(poses=16, lines=8, singles=8, rounds=2, seconds=0.0)
    monkeypatch.setattr(module, "QUICK", tiny)
    return module


def test_every_part_gives_a_row_for_each_of_its_targets(bench, capsys):
    assert bench.main(["--quick", "--json"]) == 0

    report = json.loads(capsys.readouterr().out)
    judged = [row["part"] for row in report["results"] if row["target"]]
    assert {part: judged.count(part) for part in bench.PARTS} == TARGETS
    for row in report["results"]:
        assert 0 < row["ratio_min"] <= row["ratio"] <= row["ratio_max"]
        assert min(row["ours_s"], row["peer_s"], row["ours_bytes"], row["peer_bytes"]) > 0
        assert (row["met"] is None) == (row["target"] is None)


def test_the_table_has_its_columns_in_line(bench, capsys):
    bench.main(["--quick", "signals", "one"])

    lines = capsys.readouterr().out.splitlines()
    rows = [line for line in lines if "cantools" in line and "[" in line]
    assert [len(rows[0])] * 6 == [len(row) for row in rows]
    assert not any(line.startswith("4") for line in lines), "only the parts asked for"


@pytest.mark.parametrize(("target", "status"), [(0.0, 0), (1e9, 1)])
def test_a_missed_target_is_an_error_with_strict_only(bench, monkeypatch, target, status):
    def part(sizes, seed):
        yield bench.Pair("ours", "peer", 1, lambda: bytes(10), lambda: bytes(10), target)

    monkeypatch.setitem(bench.PARTS, "one", (part, "one"))

    assert bench.main(["one", "--quick"]) == 0
    assert status == bench.main(["one", "--quick", "--strict"])


def test_growth_must_stay_below_its_target(bench):
    pair = bench.Pair("ours", "peer", 1, lambda: bytes(10), lambda: bytes(10), 1e9, growth=True)

    result = bench.measured(pair, bench.QUICK)

    assert (result["target"], result["met"]) == ("< 1e+09x", True)


@pytest.mark.parametrize("difference", [1e-3, float("nan")])
def test_sides_that_differ_are_not_compared(bench, difference):
    with pytest.raises(SystemExit, match="lines of the two sides differ by"):
        bench.agree("lines", difference, 1e-6)


def test_an_unknown_part_is_named(bench, capsys):
    with pytest.raises(SystemExit):
        bench.main(["moon"])

    assert "no part moon; there are refit, scene" in capsys.readouterr().err
