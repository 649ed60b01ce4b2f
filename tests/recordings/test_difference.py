"""How two logs differ: laws of a difference, and what each change is called."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.recordings import record

from maplines_can import Codec, Gaussian, Kind, MapLine, Slot
from maplines_can.bus import LogFrame
from maplines_can.cli import main
from maplines_can.recordings.difference import Difference, LoggedLines, difference
from maplines_can.recordings.plots.difference_panels import difference_panels
from maplines_can.recordings.record_matching import matched
from maplines_can.wire import default_dbc_path

CODEC = Codec.from_dbc()
SIGMA = np.array([0.1, 0.01, 1e-3, 1e-5])
Log = Callable[..., LoggedLines]


@pytest.fixture
def log(tmp_path: Path) -> Log:
    """Return a function that writes frames as a log, and reads its lines."""
    numbers = count()

    def written(frames: list[LogFrame], codec: Codec = CODEC) -> LoggedLines:
        path = tmp_path / f"{next(numbers)}.log"
        rows = [
            f"({f.t_ns // 10**9}.{f.t_ns % 10**9 // 1000:06d}) {f.channel} {f.can_id:03X}#"
            f"{f.data.hex()}\n"
            for f in frames
        ]
        path.write_text("".join(rows))
        return LoggedLines.of(path, codec, times="absolute")

    return written


def moved(frames: list[LogFrame], t_ns: int, drift: float = 0.0, channel: str = "can7") -> Any:
    """Shift the times."""
    begin = frames[0].t_ns
    return [f._replace(t_ns=f.t_ns + t_ns + round((f.t_ns - begin) * drift), channel=channel)
            for f in frames]  # fmt: skip


def drive(
    cycles: int = 600,
    change: Callable[[MapLine, int], MapLine | None] = lambda line, _: line,
    *,
    stands: bool = False,
) -> list[LogFrame]:
    """Two lines at 20 Hz, more than two periods of the counter, of a car that weaves or stands."""
    encoder, frames = CODEC.encoder(), list[LogFrame]()
    for k in range(cycles):
        for slot in (Slot.EGO_LEFT, Slot.EGO_RIGHT):
            y = 1.75 - 3.5 * slot + (0 if stands else np.sin(k / 31) + 0.3 * np.sin(k / 7))
            mean = [y, 0.0 if stands else 0.02 * np.cos(k / 31), 1e-4, 0]
            line = change(MapLine(slot, Gaussian(mean, np.diag(SIGMA**2)), x_max=60.0), k)
            for i, f in enumerate(encoder.encode(line) if line is not None else []):
                t_ns = 10**15 + 50_000_000 * k + 1_000_000 * slot + 200_000 * i
                frames.append(LogFrame(f.can_id, f.data, t_ns, False, "can0", True))
    return frames


PLAIN = drive()


def mirrored(one: Difference, two: Difference) -> bool:
    """Whether B against A says the same as A against B."""
    order = np.argsort(two.alignment.b)
    return bool(
        (one.alignment.a == two.alignment.b[order]).all()
        and (one.alignment.b == two.alignment.a[order]).all()
        and np.allclose(one.distance, two.distance[order])
        and np.allclose(one.ratio, 1 / two.ratio[order][:, ::-1])
        and one.is_equal == two.is_equal
        and (one.only[0] == two.only[1]).all()
        and one.parts(1) == two.parts(0)
        and one.alignment.offset == pytest.approx(-two.alignment.offset, abs=1e-6)
    )


@pytest.mark.parametrize("name", ["faulty_log", "scene_log"])
def test_a_log_does_not_differ_from_itself(name: str, request: Any, capsys: Any) -> None:
    """Whatever was lost or dropped."""
    path = str(request.getfixturevalue(name))
    dbc = ["--dbc", "maplines-pose.dbc"] * (name == "scene_log")
    capsys.readouterr()
    assert main(["diff", path, path, *dbc]) == 0
    out = capsys.readouterr().out
    assert "the logs are equal" in out
    assert "differ    0 lines" in out
    assert main(["diff", path, path, "--json", *dbc]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["equal"]
    assert found["identical"] == found["a"]["lines"] > 300
    assert not found["lines"] + found["only_a"]["parts"] + found["only_b"]["parts"]


@pytest.mark.parametrize("offset_ns", [0, 1000, -7_300_000_000, 12_800_000_000, 10**17])
@pytest.mark.parametrize("drift", [0.0, 1e-4])
@pytest.mark.parametrize("stands", [False, True])
def test_other_clocks_and_channels_make_no_difference(
    log: Log, offset_ns: int, drift: float, stands: bool
) -> None:
    """Neither a multiple of the period of the counters, nor lines that are always the same."""
    frames = drive(stands=True) if stands else PLAIN
    found = difference(log(frames), log(moved(frames, offset_ns, drift)))
    assert found.is_equal
    assert found.alignment.method == "counters"
    assert found.alignment.offset == pytest.approx(offset_ns / 1e9, abs=2e-6)
    assert found.alignment.drift == pytest.approx(drift, abs=1e-7)


def test_jitter_and_a_drift_are_told_apart(log: Log) -> None:
    """The drift is known better than one part in 10^6, and what is left is the jitter."""
    rng = np.random.default_rng(2)
    late = [f._replace(t_ns=f.t_ns + int(rng.exponential(2e6))) for f in PLAIN]
    found = difference(log(PLAIN), log(moved(sorted(late, key=lambda f: f.t_ns), 0, 5e-5)))
    assert found.alignment.drift == pytest.approx(5e-5, abs=1e-5)
    assert 1e-4 < found.alignment.rest[0] < found.alignment.rest[1] < 0.02


@pytest.mark.parametrize(
    ("begin", "end"), [(0, 3), (10, 11.5), (5.03, 5.08), (0, 20), (29, 31), (1, 29)]
)
def test_a_part_that_is_removed_is_named(log: Log, begin: float, end: float) -> None:
    """Exactly; and by the other log, as a part that only it has."""
    a = log(PLAIN)
    t = [(f.t_ns - PLAIN[0].t_ns) / 1e9 for f in PLAIN]
    b = log(moved([f for f, at in zip(PLAIN, t, strict=True) if not begin <= at < end], 10**12))
    found = difference(a, b)
    gone = np.setdiff1d(a.rows["t_ns"], b.rows["t_ns"] - 10**12)
    assert a.rows["t_ns"][found.only[0]].tolist() == sorted(gone)
    (part,) = found.parts(0)
    times = (np.array([min(gone), max(gone)]) - PLAIN[0].t_ns) / 1e9
    assert (part.begin, part.end) == pytest.approx(tuple(times))
    assert sum(part.lines.values()) == len(gone)
    assert not found.parts(1)
    assert {name for name, one in found.differs.items() if one.any()} <= {"state"}
    assert not found.is_equal
    assert mirrored(found, difference(b, a))


def wider(line: MapLine, factor: float) -> MapLine:
    return MapLine(line.slot, Gaussian(line.gaussian.mean, factor * line.gaussian.cov), x_max=60.0)


def to_the_left(line: MapLine, y: float) -> MapLine:
    mean = line.gaussian.mean + np.array([y, 0, 0, 0])
    return MapLine(line.slot, Gaussian(mean, line.gaussian.cov), x_max=60.0)


CHANGES: dict[str, tuple[Callable[[MapLine], MapLine], list[str]]] = {
    "covariance": (lambda line: wider(line, 1.1), ["covariance"]),
    "mean": (
        lambda line: to_the_left(line, 0.05),
        ["mean"],
    ),
    "kind": (
        lambda line: MapLine(line.slot, line.gaussian, x_max=60.0, kind=Kind.KERB), ["kind"]
    ),
    "range": (lambda line: MapLine(line.slot, line.gaussian, x_max=50.0), ["x_max"]),
    "age": (lambda line: MapLine(line.slot, line.gaussian, x_max=60.0, age=0.1), ["age"]),
}  # fmt: skip


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("at", [0, 300, 599])
def test_a_line_that_is_changed_is_named(log: Log, change: str, at: int) -> None:
    """Only it, with what differs, and the same with A and B exchanged."""
    apply, names = CHANGES[change]
    a = log(PLAIN)
    b = log(drive(change=lambda line, k: apply(line) if (k, line.slot) == (at, 1) else line))
    found = difference(a, b)
    (k,) = found.differing
    row = found.line_dict(k)
    assert row["slot"] == "EGO_RIGHT"
    assert row["t"] == pytest.approx(at * 0.05 + 0.001)
    assert row["differs"] == names
    assert not found.is_equal
    assert mirrored(found, difference(b, a))


@pytest.mark.parametrize("sigmas", [0.3, 1.0, 4.0])
def test_distances_are_in_sigmas_of_the_difference(log: Log, sigmas: float) -> None:
    """A shift of s sigmas of one log is s / sqrt(2) of two independent errors."""

    a = log(PLAIN)
    b = log(drive(change=lambda line, _: to_the_left(line, sigmas * SIGMA[0])))
    found = difference(a, b, at=[0.0])
    assert len(found.differing) == len(a.rows)
    decoded = np.sqrt(a.rows["cov"][0, 0, 0])
    expected = np.array(
        [
            np.sqrt(d @ np.linalg.inv(one + two) @ d)
            for d, one, two in zip(
                found.pairs[1]["mean"] - found.pairs[0]["mean"],
                found.pairs[0]["cov"], found.pairs[1]["cov"], strict=True,
            )
        ]
    )  # fmt: skip
    assert found.distance == pytest.approx(expected, rel=1e-6)
    assert found.distance.mean() == pytest.approx(sigmas * SIGMA[0] / decoded / 2**0.5, rel=0.1)
    (row,) = found.positions()["EGO_LEFT"]
    assert row.mean == pytest.approx(sigmas * SIGMA[0], abs=0.01)
    assert row.mean_sigma == pytest.approx(row.mean / decoded / 2**0.5, rel=0.02)
    bound = float(found.distance.max())
    assert difference(a, b, sigma=bound * 1.001).is_equal
    assert not difference(a, b, sigma=bound * 0.999).is_equal


def test_ratios_of_sigmas_are_those_of_the_covariances(log: Log) -> None:
    """Within the factor 1 + sigma, they count as equal."""
    a, b = log(PLAIN), log(drive(change=lambda line, _: wider(line, 1.44)))
    found = difference(a, b)
    one, two = (rows[0]["cov"] for rows in found.pairs)
    values = np.sqrt(np.linalg.eigvals(np.linalg.solve(one, two)).real)
    assert found.ratio[0] == pytest.approx([values.min(), values.max()], rel=1e-6)
    assert found.ratio[0] == pytest.approx([1.2, 1.2], rel=0.05)
    assert difference(a, b, sigma=0.3).is_equal
    assert not difference(a, b, sigma=0.1).is_equal


def test_scenes_that_differ_are_named(tmp_path: Path, capsys: Any) -> None:
    """And nothing else: here, the correlation time of the pose errors of one half of a log."""
    paths = [
        record(tmp_path / f"{time}.log", "--pose-error", "--correlation-time", time, seconds=3.0)
        for time in ("5", "9")
    ]
    rows, other = (path.read_text().splitlines() for path in paths)
    pose = [row.split()[2] for row in other if " 35C#" in row]
    places = [k for k, row in enumerate(rows) if " 35C#" in row]
    assert len(pose) == len(places)
    for k, data in list(zip(places, pose, strict=True))[len(pose) // 2 :]:
        rows[k] = " ".join([*rows[k].split()[:2], data])
    changed = tmp_path / "c.log"
    changed.write_text("\n".join(rows) + "\n")
    found = difference(LoggedLines.of(paths[0], CODEC), LoggedLines.of(changed, CODEC))
    assert not len(found.differing)
    assert found.scenes is not None
    assert 20 < len(found.scenes.differing) < 40
    assert min(found.scenes.differing) > 1.4
    assert not found.is_equal
    capsys.readouterr()
    assert main(["diff", str(paths[0]), str(changed)]) == 1
    assert " differ (at 1." in capsys.readouterr().out


def test_a_sender_that_restarts_is_aligned(log: Log) -> None:
    """Its counters begin again at 0, in both logs; in one of them the begin is missing."""
    both = PLAIN[: 8 * 100] + moved(PLAIN[: 8 * 300], 8_000_000_000, channel="can0")
    found = difference(log(both), log(moved(both[8 * 50 :], 3 * 10**9)))
    assert found.parts(0)[0].lines == {Slot.EGO_LEFT: 50, Slot.EGO_RIGHT: 50}
    assert len(found.parts(0)) == 1
    assert not found.differs["mean"].any()


def test_logs_without_times_are_aligned_by_their_order(tmp_path: Path) -> None:
    """candump writes none without -L and -t."""
    rows = [f"  can0  {f.can_id:03X}   [8]  {f.data.hex(' ')}\n" for f in PLAIN]
    paths = tmp_path / "a.txt", tmp_path / "b.txt"
    paths[0].write_text("".join(rows))
    paths[1].write_text("".join(rows[8 * 200 :]))
    found = difference(*(LoggedLines.of(path, CODEC) for path in paths))
    assert not found.alignment.has_time
    assert len(found.alignment.a) == 800
    assert found.as_dict()["alignment"]["offset"] is None


def test_logs_of_two_dbcs_are_compared(tmp_path: Path) -> None:
    """The same drive as lines of their own and as whole scenes: alike, but not equal."""
    paths = [record(tmp_path / "a.log"), record(tmp_path / "b.log", "--dbc", "maplines-scene.dbc")]
    codecs = [CODEC, Codec.from_dbc(default_dbc_path("maplines-scene.dbc"))]
    logs = [LoggedLines.of(*both) for both in zip(paths, codecs, strict=True)]
    found = difference(*logs, at=[20.0])
    assert len(found.alignment.a) > 0.95 * len(logs[0].rows)
    rows = found.positions()
    assert rows.keys() >= {"EGO_LEFT", "EGO_RIGHT"}
    assert all(abs(row.largest) < 0.2 for (row,) in rows.values())
    assert not found.is_equal


def test_logs_with_nothing_in_common_say_so(log: Log) -> None:
    """Another slot, at another time."""
    other = drive(20, lambda line, _: MapLine(Slot.ROUTE, line.gaussian))
    found = difference(log(PLAIN[:80]), log(other))
    assert found.alignment.method == "nothing"
    assert len(found.only[0]) == 20
    assert not found.is_equal


@pytest.mark.parametrize(
    ("time", "slots", "differing", "missing"),
    [
        pytest.param((3.0, 14.9), None, 0, 0, id="equal"),
        pytest.param((14.0, 16.0), None, 2, 0, id="a-change"),
        pytest.param((14.0, 16.0), [Slot.EGO_RIGHT], 1, 0, id="of-one-slot"),
        pytest.param((19.0, 20.49), None, 0, 20, id="a-part-that-is-missing"),
        pytest.param((19.0, 20.49), [Slot.EGO_LEFT], 0, 10, id="of-one-slot-missing"),
    ],
)
def test_a_part_of_the_logs_is_compared(
    log: Log, time: Any, slots: Any, differing: int, missing: int
) -> None:
    """By the time of A, of lines that only B has, too; both logs are aligned as a whole."""
    changed = drive(change=lambda line, k: to_the_left(line, 0.1) if k == 300 else line)
    begin = changed[0].t_ns
    kept = [f for f in changed if not 20 <= (f.t_ns - begin) / 1e9 < 21]
    a, b = log(PLAIN), log(moved(kept[8 * 20 :], 7 * 10**9))
    found = difference(a, b, time=time, slots=slots)
    assert found.is_equal is (not differing and not missing)
    assert found.differs["mean"].sum() == differing
    assert len(found.only[0]) == missing
    other = difference(b, a, time=(time[0] - 1, time[1] - 1), slots=slots)
    assert len(other.only[1]) == missing
    assert other.differs["mean"].sum() == differing


def test_channels_are_chosen(tmp_path: Path, capsys: Any) -> None:
    """Each log may have its own; one that is not there is named with those there are."""
    a = record(tmp_path / "a.log", seconds=1.0)
    b = tmp_path / "b.log"
    b.write_text(a.read_text().replace(" vcan0 ", " can3 "))
    words = ["diff", str(a), str(b), "--channel", "vcan0"]
    assert main([*words, "--channel-b", "can3"]) == 0
    capsys.readouterr()
    assert main(words) == 1
    assert "has no frame of channel 'vcan0'; there are 'can3'" in capsys.readouterr().err


def test_panels_show_the_differences(log: Log) -> None:
    """Positions with the sigma of the difference, and the parts of both logs on the clock of A."""
    a = log(PLAIN[: 8 * 400])
    changed = drive(500, lambda line, k: to_the_left(line, 0.1) if k == 300 else line)
    b = log(moved(changed[8 * 100 :], 10**12))
    found = difference(a, b, at=[0.0])
    positions, parts = difference_panels(found)
    left, _ = positions.bands
    assert np.nanmax(left.y) == pytest.approx(0.1, abs=0.01)
    assert np.nanmedian(left.high[0] - left.y) == pytest.approx(SIGMA[0] * 2**0.5, rel=0.1)
    assert parts.rows == ["ego left differs", "ego right differs", "only in A", "only in B"]
    begins = {parts.rows[strip.row]: strip.begin for strip in parts.strips}
    assert begins == pytest.approx({"only in A": 0.0, "only in B": 20.0}, abs=1e-6)
    # The first lines of B differ in their states, which begin there.
    last = {dots.label: dots.x[-1] for dots in parts.dots}
    assert last == pytest.approx({"ego left differs": 15.0, "ego right differs": 15.001})
    assert all((dots.x[:-1] < 6).all() for dots in parts.dots)


@pytest.mark.parametrize("suffix", [".png", ".html"])
def test_a_picture_is_written_once(faulty_log: Path, tmp_path: Path, suffix: str) -> None:
    """Of two logs without a difference, too; a file that exists is kept."""
    pytest.importorskip("matplotlib" if suffix == ".png" else "bokeh")
    out = tmp_path / f"diff{suffix}"
    words = ["diff", str(faulty_log), str(faulty_log), "-o", str(out)]
    assert main(words) == 0
    assert out.stat().st_size > 1000
    assert main(words) == 1


@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 60)), max_size=20),
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 60)), max_size=20),
    st.integers(0, 20),
)
def test_matches_are_mutually_nearest(
    a: list[tuple[int, int]], b: list[tuple[int, int]], reach: int
) -> None:
    """As one finds by looking at all pairs; each line is matched once."""
    keys_a, t_a = np.array(a, float).reshape(-1, 2).T
    keys_b, t_b = np.array(b, float).reshape(-1, 2).T
    in_a, in_b = matched(keys_a, t_a, keys_b, t_b, reach)
    assert len(set(in_a.tolist())) == len(in_a) == len(set(in_b.tolist()))
    away = np.where(keys_a[:, None] == keys_b, np.abs(t_a[:, None] - t_b), np.inf)
    for i, j in zip(in_a, in_b, strict=True):
        assert away[i, j] == away[i].min() == away[:, j].min() <= reach
    if away.size and away.min() <= reach:
        assert len(in_a)


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["-", "-"], "cannot both be -"),
        (["LOG", "FOREIGN"], "has no line to compare"),
        (["LOG", "nowhere.log"], "no such file"),
        (["LOG", "LOG", "--dbc-b", "maplines-pose.dbc"], "take --dbc maplines.dbc"),
    ],
)
def test_what_cannot_be_compared_is_one_line(
    words: list[str], error: str, faulty_log: Path, tmp_path: Path, capsys: Any
) -> None:
    """With status 1."""
    (tmp_path / "foreign.log").write_text("(1.0) can0 123#00\n")
    paths = {"LOG": str(faulty_log), "FOREIGN": str(tmp_path / "foreign.log")}
    capsys.readouterr()
    assert main(["diff", *(paths.get(word, word) for word in words)]) == 1
    err = capsys.readouterr().err
    assert error in err
    assert sum("error" in row for row in err.splitlines()) == 1


def test_text_names_what_differs(tmp_path: Path, capsys: Any) -> None:
    """Alignment, lines, parts, states side by side; and damage is an error."""
    a = record(tmp_path / "a.log", seconds=4.0)
    rows = a.read_text().splitlines(keepends=True)
    b = tmp_path / "b.log"
    b.write_text("".join([*rows[:200], "no frame\n", *rows[400:]]))
    capsys.readouterr()
    assert main(["diff", str(a), str(b), "--at", "0,20"]) == 1
    out, err = capsys.readouterr()
    for text in ("by slot and counters", "no drift", "only in A", "ego left in A: ", "at 0 m"):
        assert text in out
    assert "damaged" in err
