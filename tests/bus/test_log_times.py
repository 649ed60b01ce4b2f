"""Kinds of the time stamps of text logs: found once, stated, and said."""

import io
import os
import random
from itertools import accumulate
from pathlib import Path
from typing import Any

import pytest

from maplines_can.bus import LogFrame, read_log
from maplines_can.logs import text_rows as rows_module
from maplines_can.logs.log_times import kind_of
from maplines_can.values.errors import LogError


def ns(stamps: Any) -> list[int]:
    return [round(1e9 * stamp) for stamp in stamps]


def jitter(gap: float, count: int, seed: int = 1) -> list[float]:
    """Gaps with the jitter of a sender, after the first one."""
    rng = random.Random(seed)  # noqa: S311 - not a secret
    return [0.0, *(round(gap + rng.uniform(-2e-4, 2e-4), 6) for _ in range(count - 1))]


def bursts(gap: float, size: int, count: int) -> list[float]:
    """Gaps of transfers of several frames."""
    rng = random.Random(2)  # noqa: S311
    return [gap if i % size == 0 else 1.1e-4 + rng.uniform(0, 9e-6) for i in range(count)]


MERGED = sorted([*(0.01 * k for k in range(50)), *(0.0007 + 0.01 * k for k in range(50))])
#: Rows 2 and 3, 12 and 13, ... are swapped, as of two interfaces.
SWAPPED = [MERGED[i + (i % 10 == 1) - (i % 10 == 2)] for i in range(100)]
PAIRS = [MERGED[i ^ 1] for i in range(100)]
STREAMS = {
    "no row": ([], "zero"),
    "one row": ([0.5], "zero"),
    "two rows": ([0.5, 0.51], "zero"),
    "two rows of one moment": ([0.05, 0.05], "zero"),
    "three rows": ([0.0, 0.05, 0.1], "zero"),
    "three differences": ([0.0, 0.05, 0.05], "delta"),
    "five rows": ([0.01, 0.01, 0.06, 0.06, 0.11], "zero"),
    "five differences": ([0.0, 0.0501, 0.0499, 0.05, 0.0502], "delta"),
    "all zero": ([0.0] * 100, "zero"),
    "all of one moment": ([0.01] * 100, "zero"),
    "regular": ([0.05 * k for k in range(100)], "zero"),
    "regular differences": ([0.0, *[0.05] * 99], "delta"),
    "jitter": ([*accumulate(jitter(0.05, 100))], "zero"),
    "differences with jitter": (jitter(0.05, 100), "delta"),
    "few differences with jitter": (jitter(0.01, 10), "delta"),
    "bursts of equal stamps": ([0.05 * (k // 16) for k in range(100)], "zero"),
    "one burst, then another": ([0.01] * 60 + [0.06] * 40, "zero"),
    "coarse clock": ([0.0156 * (k // 33) for k in range(100)], "zero"),
    "differences of bursts": (bursts(0.05, 4, 100), "delta"),
    "differences of long bursts": (bursts(0.05, 40, 100), "delta"),
    "differences of one burst": (bursts(0.05, 40, 42), "delta"),
    "differences of regular bursts": ([0.0499, 0.0001] * 50, "delta"),
    "differences that rise in a cycle": ([0.001, 0.004, 0.01, 0.035] * 25, "delta"),
    "large first difference": ([1234.5, *jitter(0.02, 99)[1:]], "delta"),
    "two interfaces": (MERGED, "zero"),
    "two interfaces, some swapped": (SWAPPED, "zero"),
    "two interfaces, all swapped": (PAIRS, "zero"),
    "rows 2 and 3 swapped": ([0.0, 0.00029, 0.00012, 0.0005, 0.0005, 0.00675, 0.01], "zero"),
    "gaps": ([0.0, 0.1, 0.2, 30.0, 30.1, 600.0, 600.1], "zero"),
    "begin of a log that is cut": ([500.0 + 0.01 * k for k in range(100)], "zero"),
    "two recordings": ([0.05 * (k % 41) for k in range(82)], "zero"),
    "three recordings": ([0.05 * (k % 41) for k in range(100)], "zero"),
    "absolute": ([1.7e9, 1.7e9 + 0.1], "absolute"),
    "absolute after zero": ([0.0, 1.7e9], "absolute"),
}


@pytest.mark.parametrize(("stamps", "kind"), STREAMS.values(), ids=STREAMS)
def test_the_kind_of_stamps(stamps: list[float], kind: str) -> None:
    """Of streams as they are recorded."""
    assert kind == kind_of(ns(stamps))


def log_of(path: Path, stamps: Any) -> Path:
    path.write_text("".join(f" ({stamp:010.6f})  can0  340   [1]  00\n" for stamp in stamps))
    return path


@pytest.mark.parametrize("begin", [1, 50, 99, 100, 101, 500])
def test_nothing_changes_the_kind_later(tmp_path: Path, begin: int) -> None:
    """Rows that are swapped, or begin again, are no differences: wherever they stand."""
    stamps = [0.01 * k for k in range(600)]
    stamps[begin], stamps[begin + 1] = stamps[begin + 1], stamps[begin]
    log = read_log(log_of(tmp_path / "a.txt", [*stamps, *stamps]))
    assert [f.t_ns for f in log] == ns([*stamps, *stamps])
    assert log.summary.times == "zero"
    assert "the time stamps begin again in line 601" in log.summary.notices[-1]


@pytest.mark.parametrize(
    ("drop", "is_restart"), [(0.09, False), (0.1, False), (0.11, True), (0.2, True)]
)
def test_what_begins_again(tmp_path: Path, drop: float, is_restart: bool) -> None:
    """A stamp that is more than 0.1 s, and more than half of the highest one, below that."""
    stamps = [0.01 * k for k in range(21)]
    log = read_log(log_of(tmp_path / "a.txt", [*stamps, 0.2 - drop, 0.3]), times="zero")
    assert len([*log]) == 23
    assert bool(log.summary.notices) == is_restart


@pytest.mark.parametrize("times", ["absolute", "zero", "delta"])
def test_a_kind_that_is_stated_is_taken(tmp_path: Path, times: Any) -> None:
    """Against all evidence, and without a notice."""
    stamps = [0.0, *[0.05] * 20]
    log = read_log(log_of(tmp_path / "a.txt", stamps), times=times)
    assert [f.t_ns for f in log] == ns(accumulate(stamps) if times == "delta" else stamps)
    assert (log.summary.times, log.summary.notices) == (times, [])


def test_a_row_that_is_damaged_or_no_frame_counts_as_a_difference(tmp_path: Path) -> None:
    """Its time has passed for the next one."""
    path = tmp_path / "a.log"
    path.write_text(
        "(0.0) can0 340#00\n(0.1) can0 340#R\n(0.1) can0 20000004#00\n(0.1) can0 340#0\n"
        "(0.1) can0 340#01\n"
    )
    log = read_log(path, times="delta")
    found: list[LogFrame] = []
    with pytest.raises(LogError, match="1 of 5 records are damaged"):
        found.extend(log)
    assert [f.t_ns for f in found] == [0, 400_000_000]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        *((f"a.{x}", "", r"times is 'delta', but the format \.\w+ has one kind")
          for x in ("blf", "mf4", "db", "trc")),
        ("a.txt", ";$FILEVERSION=1.1\n", r"the format \.trc has one kind of time stamps; use 'au"),
        ("b.txt", " (2023-11-14 22:13:20.1)  can0  340   [1]  00\n", "is a date, not a difference"),
    ],
)  # fmt: skip
def test_what_has_no_differences(tmp_path: Path, name: str, content: str, words: str) -> None:
    """A format with its own kind of times, also if its content tells it; and a date."""
    (tmp_path / name).write_text(content)
    with pytest.raises(LogError, match=words):
        list(read_log(tmp_path / name, times="delta"))


class Sender:
    """A pipe, and what reads it."""

    def __init__(self, **options: Any) -> None:
        read, self._write = os.pipe()
        self._file = os.fdopen(read, "rb")
        self._options = options

    def send(self, *rows: str) -> None:
        os.write(self._write, "".join(row + "\n" for row in rows).encode())

    def __enter__(self) -> Any:
        return self

    def log(self) -> Any:
        return read_log(self._file, **self._options)

    def __exit__(self, *exception: object) -> None:
        os.close(self._write)
        self._file.close()


pipes = pytest.mark.skipif(os.name == "nt", reason="Windows does not tell whether a pipe has data")


@pipes
@pytest.mark.parametrize(
    ("rows", "options"),
    [
        pytest.param(["(1700000000.5) c 123#00", "(1700000000.6) c 123#01"], {}, id="absolute"),
        pytest.param([" (0.5)  c  123   [1]  00"], {}, id="first"),
        pytest.param(["(0.0) c 123#00", "(0.0) c 123#00", "(0.5) c 123#00"], {}, id="zeros-first"),
        pytest.param(["(0.5) c 123#00", "(0.5) c 123#01"], {"times": "delta"}, id="stated"),
        pytest.param(["c  123   [1]  00", "c  123   [1]  00"], {}, id="no-stamps"),
    ],
)
def test_no_row_waits_whose_time_is_certain(rows: list[str], options: Any) -> None:
    """Each is returned as soon as its line has arrived; the pipe stays open."""
    with Sender(**options) as sender:
        log = sender.log()
        for row in rows:
            sender.send(row)
            assert next(log).can_id == 0x123


@pipes
def test_a_row_of_a_pipe_waits_for_the_decision_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """At most for the time that is set; the rows that have come by then decide."""
    monkeypatch.setattr(rows_module, "MAX_WAIT", 0.05)
    with Sender() as sender:
        log = sender.log()
        sender.send(*(f"({gap:.6f}) c 123#00" for gap in jitter(0.01, 6)))
        assert [next(log).t_ns for _ in range(6)] == ns(accumulate(jitter(0.01, 6)))
        assert log.summary.times == "delta"
        sender.send("(0.5) c 123#00")
        assert next(log).t_ns == ns(accumulate([*jitter(0.01, 6), 0.5]))[-1]


@pipes
def test_no_row_of_a_pipe_waits_for_more_than_100(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows_module, "MAX_WAIT", 1e9)
    with Sender() as sender:
        log = sender.log()
        sender.send(*(f"({k / 100:.6f}) c 123#00" for k in range(101)))
        assert [next(log).t_ns for _ in range(101)] == ns(k / 100 for k in range(101))


def test_a_stream_without_a_descriptor_is_read_to_the_decision() -> None:
    """It cannot be asked whether it has data."""
    stream: Any = io.BufferedReader(io.BytesIO(b"(0.0) c 123#00\n" + b"(0.5) c 123#00\n" * 9))
    log = read_log(stream)
    assert [f.t_ns for f in log][-1] == ns([4.5])[0]
    assert log.summary.notices == [
        "the time stamps are taken as differences (candump -t d); "
        "--times absolute|zero|delta states the kind"
    ]
