"""What is in a log: counted as frame by frame, whatever its format and its blocks."""

from __future__ import annotations

import gzip
import json
from collections import Counter, defaultdict
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from maplines_can import Codec, MapLine, Slot
from maplines_can.bus import LogFrame, read_log
from maplines_can.cli import main
from maplines_can.logs.first_frames import CanId
from maplines_can.logs.spacings import Spacing, Spacings
from maplines_can.recordings.blocks import read_blocks
from maplines_can.recordings.log_contents import contents_of
from maplines_can.recordings.read_lines import read_lines
from maplines_can.wire import SHIPPED, Reason, default_dbc_path

CODECS = [Codec.from_dbc(default_dbc_path(name)) for name in SHIPPED]


def spacing_of(t_ns: list[int]) -> Spacing:
    """One time after the other."""
    if len(t_ns) < 2:
        return Spacing(len(t_ns), t_ns[0], t_ns[-1], np.nan, np.nan, t_ns[0])
    gap, at = max(((max(b - a, 0), a) for a, b in pairwise(t_ns)), key=lambda one: one[0])
    period = (t_ns[-1] - t_ns[0]) / 1e9 / (len(t_ns) - 1)
    return Spacing(len(t_ns), t_ns[0], t_ns[-1], period, gap / 1e9, at)


@given(
    st.lists(st.tuples(st.integers(0, 5), st.integers(0, 10**12)), min_size=1, max_size=60),
    st.sets(st.integers(1, 59)),
    st.integers(1, 6),
)
@example([(0, 5), (1, 6), (0, 6)], {1, 2}, 1)
def test_spacings_do_not_depend_on_blocks(
    rows: list[tuple[int, int]], cuts: set[int], most: int
) -> None:
    """Of each key, up to the most of them: the count, the mean and the largest gap.

    Times may go back, as of a log that begins again.
    """
    keys, t_ns = np.array(rows).T
    spacings = Spacings(most)
    bounds = [0, *sorted(cut for cut in cuts if cut < len(rows)), len(rows)]
    for low, high in pairwise(bounds):
        spacings.add(keys[low:high], t_ns[low:high])
    expected = {key: spacing_of(t_ns[keys == key].tolist()) for key in set(keys.tolist())}
    assert len(spacings.keys) == min(most, len(expected))
    for key in spacings.keys:
        assert spacings.of(key) == expected[key]
    assert spacings.beyond == len(rows) - sum(spacings.of(key).n for key in spacings.keys)


def by_id(log: Path) -> dict[tuple[str, CanId], list[LogFrame]]:
    found = defaultdict(list)
    for frame in read_log(log):
        found[frame.channel, CanId(frame.can_id, frame.is_extended)].append(frame)
    return found


@pytest.mark.parametrize(("log", "dbc"), [("faulty_log", SHIPPED[0]), ("scene_log", SHIPPED[2])])
def test_contents_are_those_of_frame_by_frame(
    log: str, dbc: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames by CAN ID with their owners; lines by slot with their states, lost and dropped."""
    path: Path = request.getfixturevalue(log)
    small = partial(read_blocks, block_frames=100)
    monkeypatch.setattr("maplines_can.recordings.log_contents.read_blocks", small)
    found = contents_of(path, CODECS)
    frames = by_id(path)
    assert found.frames == sum(map(len, frames.values()))
    assert {(one.channel, one.can_id) for one in found.messages} == frames.keys()
    for one in found.messages:
        own = frames[one.channel, one.can_id]
        assert one.spacing == spacing_of([frame.t_ns for frame in own])
        assert one.lengths == (min(map(len, (f.data for f in own))), max(len(f.data) for f in own))
        whose = [codec.layout.message_of_id.get(one.can_id) for codec in CODECS]
        first = next((own for own in whose if own is not None), None)
        if first is None:
            assert one.name is None
        else:
            assert one.name is not None
            assert (one.name.owner, one.name.frame != "classic") == first
    reception = next(one for one in found.receptions if one.fit.name == dbc)
    result = reception.as_dict([*found.channels], found.begin_ns)
    table = read_lines(path, dbc=default_dbc_path(dbc))
    decoder = CODECS[SHIPPED.index(dbc)].decoder()
    for frame in read_log(path):
        decoder.feed(frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended)
    decoder.expire(found.end_ns + 10**18)
    for row in result["lines"]:
        lines = table.where(table["slot"] == row["slot"])
        assert row["count"] == len(lines)
        assert row["states"] == Counter(lines["state"].tolist())
        assert row["gap"] == pytest.approx(np.diff(lines["t_ns"]).max() / 1e9)
    assert sum(row["count"] for row in result["lines"]) == len(table) > 0
    assert result["lost"] == decoder.lost
    assert result["pose_errors"] == decoder.pose_errors
    rejects = {reason.name: n for reason, n in decoder.counts.items()}
    rejects.pop("FOREIGN", None)
    assert result["rejects"] == rejects
    assert {row["owner"]: row["ok"] for row in result["messages"]} == {
        owner.name if isinstance(owner, Slot) else owner: stats.ok
        for owner, stats in decoder.messages(found.end_ns).items()
    }
    json.dumps(found.as_dict(), allow_nan=False)


ROW = "(1.{:06d}) {} {}\n".format


def shown(capsys: Any, *words: str) -> tuple[int, str, str]:
    capsys.readouterr()
    status = main(["info", *words])
    out, err = capsys.readouterr()
    return status, out, err


@pytest.mark.parametrize(
    ("text", "status", "rows"),
    [
        pytest.param(ROW(0, "can0", "123#00") + ROW(9000, "can1", "123#0011"), 0,
                     ["1 on channel can0", "0x123", "no DBC of this package"],
                     id="foreign-on-two-channels"),
        pytest.param("  can0  123  [1]  00\n", 0, ["no time stamps", "0x123"], id="no-times"),
        pytest.param(ROW(0, "can0", "123#00") + ROW(1, "can0", "20000080#0000000000000000")
                     + ROW(2, "can0", "123#R"), 0,
                     ["skipped   ", "1 error frame", "1 remote frame"], id="skipped"),
        pytest.param(ROW(0, "can0", "123#00") + "no frame\n", 1, ["0x123"], id="damaged"),
        pytest.param(ROW(0, "a\x1bb", "123#00"), 0, ["a?b"], id="control-character"),
    ],
)  # fmt: skip
def test_text_of_odd_logs(
    text: str, status: int, rows: list[str], tmp_path: Path, capsys: Any
) -> None:
    """Each says what is intact; only damage is an error."""
    log = tmp_path / "odd.log"
    log.write_text(text)
    found, out, err = shown(capsys, str(log))
    assert found == status
    assert [row for row in rows if row not in out] == []
    assert ("error" in err) is bool(status)


@pytest.mark.parametrize(
    ("words", "frames"),
    [
        pytest.param([], 4, id="all"),
        pytest.param(["--channel", "can1"], 2, id="channel"),
        pytest.param(["--time", "0.5..1.4"], 2, id="time"),
        pytest.param(["--time", "0.5..", "--channel", "can0"], 1, id="both"),
        pytest.param(["--time", "9.."], 0, id="none"),
    ],
)
def test_a_part_is_chosen(words: list[str], frames: int, tmp_path: Path, capsys: Any) -> None:
    """By the channel, and by the time from the first frame on."""
    log = tmp_path / "a.log"
    log.write_text("".join(f"({5 + k / 2}) can{k % 2} 123#00\n" for k in range(4)))
    status, out, _ = shown(capsys, str(log), "--json", *words)
    assert status == 0
    assert json.loads(out)["frames"] == frames
    assert shown(capsys, str(log), "--channel", "can9")[0] == 1


def test_an_empty_log_says_so(tmp_path: Path, capsys: Any) -> None:
    """It has neither a time nor a message."""
    log = tmp_path / "empty.log"
    log.write_text("")
    status, out, _ = shown(capsys, str(log))
    assert status == 0
    assert "has no frame" in out
    assert "time  " not in out


def test_json_has_a_row_for_each_log(faulty_log: Path, tmp_path: Path, capsys: Any) -> None:
    """Also of a packed one, and of a stream; the facts are the same."""
    packed = tmp_path / "drive.log.gz"
    packed.write_bytes(gzip.compress(faulty_log.read_bytes()))
    status, out, _ = shown(capsys, "--json", str(faulty_log), str(packed))
    assert status == 0
    first, second = map(json.loads, out.splitlines())
    assert first.pop("log") != second.pop("log")
    assert first.pop("bytes") > second.pop("bytes")
    assert first == second
    (found,) = first["dbcs"]
    assert found["dbc"] == "maplines.dbc"
    assert found["rejects"][Reason.CRC.name] > 0
    assert found["lost"] > 0


def test_two_senders_are_named(tmp_path: Path, capsys: Any) -> None:
    """Of one slot, each with a counter of its own."""
    line = MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0, 0, 0])
    encoders = [CODECS[0].encoder(), CODECS[0].encoder()]
    for _ in range(100):
        encoders[1].encode(line)
    frames = [f for k in range(400) for f in encoders[k % 2].encode(line)]
    log = tmp_path / "two.log"
    rows = enumerate(f"{f.can_id:03X}#{f.data.hex()}" for f in frames)
    log.write_text("".join(f"({1 + k // 4 * 0.025 + k % 4 / 1e4:.6f}) can0 {row}\n"
                           for k, row in rows))  # fmt: skip
    status, out, _ = shown(capsys, str(log))
    assert status == 0
    assert "; TWO SENDERS at " in out


def test_text_names_states_gaps_and_drops(faulty_log: Path, capsys: Any) -> None:
    """A row for each CAN ID of the DBC, for each slot, and one for the frames that were dropped."""
    status, out, _ = shown(capsys, str(faulty_log))
    assert status == 0
    assert "EgoLeft (ego left) of maplines.dbc" in out
    assert "ego left: " in out
    assert " crc, " in out
    assert "lost by their counters" in out
    _, other, _ = shown(capsys, str(faulty_log), "--dbc", "maplines-scene.dbc")
    assert "take --dbc maplines.dbc" in other
