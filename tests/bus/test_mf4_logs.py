"""MF4 logs of other tools: fields that are missing, several groups, what is no frame, and times."""

from __future__ import annotations

import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from support.recordings import frames_of

from maplines_can.bus import LogFrame, read_log
from maplines_can.logs.log_summary import LogSummary, Skipped
from maplines_can.logs.mf4_log import Mf4Reader
from maplines_can.recordings.blocks import read_blocks
from maplines_can.values.errors import LogError

asammdf = pytest.importorskip("asammdf", reason="asammdf is an optional dependency")
from asammdf.blocks import v4_constants as v4  # noqa: E402
from asammdf.blocks.conversion_utils import from_dict  # noqa: E402
from asammdf.blocks.v4_blocks import SourceInformation  # noqa: E402

START = datetime(2026, 3, 4, 5, 6, 7, 890123, UTC)
START_NS = 1772600767_890123000
EXTENDED = 1 << 31
Fields = Mapping[str, Any]


def signal(name: str, t: Any, fields: Fields, bus: int = v4.BUS_TYPE_CAN) -> Any:
    """Records of a group: those of frames have fields of the names of the standard."""
    arrays = {key: np.asarray(values) for key, values in fields.items()}
    kinds = [(f"{name}.{key}", each.dtype, each.shape[1:]) for key, each in arrays.items()]
    samples = np.zeros(len(t), kinds)
    for key, each in arrays.items():
        samples[f"{name}.{key}"] = each
    source = SourceInformation(source_type=v4.SOURCE_BUS, bus_type=bus)
    return asammdf.Signal(samples, np.array(t), name=name, source=source)


def fields(n: int = 3, width: int = 8, **others: Any) -> dict[str, Any]:
    """The fields of frames that each reader needs, and others; None leaves one out."""
    given = {
        "BusChannel": np.full(n, 1, np.uint8),
        "ID": np.full(n, 0x340, np.uint32),
        "DLC": np.full(n, can.util.len2dlc(width), np.uint8),
        "DataLength": np.full(n, width, np.uint8),
        "DataBytes": np.arange(n * width, dtype=np.uint8).reshape(n, width),
        **others,
    }
    return {name: values for name, values in given.items() if values is not None}


def written(path: Path, *signals: Any, start: datetime = START, change: Any = None) -> Path:
    with asammdf.MDF(version="4.10") as mdf:
        mdf.header.start_time = start
        mdf.header.abs_time = round(mdf.header.abs_time, -3)  # asammdf rounds it as a float
        for each in signals:
            mdf.append(each)
        if change is not None:
            change(mdf)
        mdf.save(path, overwrite=True)
    return path


def read(path: Path) -> tuple[list[LogFrame], LogSummary]:
    """The frames and the summary, of both ways to read."""
    log, blocks = read_log(path), read_blocks(path)
    frames = list(log)
    assert [frame for block in blocks for frame in frames_of(block)] == frames
    assert blocks.summary == log.summary
    return frames, log.summary


IDS = np.array([0x340, 0x12345, 0x7FF], np.uint32)
MARKED = IDS | np.array([0, EXTENDED, EXTENDED], np.uint32)


def numbers(*values: int) -> Any:
    return np.array(values, np.uint8)


#: Fields of a group, and what is read of its three frames.
FIELDS: list[tuple[dict[str, Any], dict[str, Any]]] = [
    # The field IDE tells extended IDs, or bit 31 of the ID, as for asammdf.
    *(
        ({"ID": ids, "IDE": ide}, {"can_id": IDS.tolist(), "is_extended": expected})
        for ids, ide, expected in (
            (MARKED, None, [False, True, True]), (IDS, numbers(0, 1, 1), [False, True, True]),
            (MARKED, numbers(0, 1, 1), [False, True, True]),
            (MARKED, numbers(0, 0, 0), [False, True, True]),  # a field that is never set
            (IDS, None, [False, True, False]),  # neither: those of more than 11 bits
        )
    ),
    # Lengths are those of the field of this name, of the DLC, or of all bytes.
    ({"DataLength": numbers(0, 3, 8)}, {"length": [0, 3, 8]}),
    ({"DataLength": numbers(8, 9, 12)}, {"length": [8, 8, 8]}),
    ({"DataLength": None, "DLC": numbers(0, 3, 8)}, {"length": [0, 3, 8]}),
    ({"DataLength": None, "DLC": numbers(0, 9, 15)}, {"length": [0, 8, 8]}),
    ({"DataLength": None, "DLC": None}, {"length": [8, 8, 8]}),
    ({"DataLength": numbers(8, 12, 64), "width": 64}, {"length": [8, 12, 64]}),
    ({"DataLength": None, "DLC": numbers(8, 9, 15), "width": 64}, {"length": [8, 12, 64]}),
    ({"DataLength": None, "DLC": numbers(8, 9, 15), "EDL": numbers(0, 0, 1), "width": 64},
     {"length": [8, 8, 64]}),
    ({"BusChannel": None}, {"channel": ["", "", ""]}),
    ({"BusChannel": numbers(7, 2, 7)}, {"channel": ["7", "2", "7"]}),
    ({"BusChannel": np.array([b"CAN 2", b"CAN 1", b"CAN 2"])},
     {"channel": ["CAN 2", "CAN 1", "CAN 2"]}),
    # What is no frame on the bus is counted.
    ({"Dir": numbers(0, 1, 0)}, {}),
    ({"Dir": np.array([b"Rx", b"Tx", b"Rx"])}, {}),
    ({"Dir": numbers(0, 2, 1)}, {"length": [8, 8], "skipped": {Skipped.REQUEST: 1}}),
    ({"Dir": np.array([b"TxRq", b"TXRQ", b"Tx"])},
     {"length": [8], "skipped": {Skipped.REQUEST: 2}}),
    ({"RTR": numbers(0, 1, 1)}, {"length": [8], "skipped": {Skipped.REMOTE: 2}}),
    ({"RTR": numbers(0, 1, 1), "Dir": numbers(1, 1, 2)},
     {"length": [8], "skipped": {Skipped.REMOTE: 1, Skipped.REQUEST: 1}}),
]  # fmt: skip


@pytest.mark.parametrize(("given", "expected"), FIELDS)
def test_fields_of_a_group(tmp_path: Path, given: dict[str, Any], expected: Any) -> None:
    all_fields = fields(**given)
    frames, summary = read(
        written(tmp_path / "a.mf4", signal("CAN_DataFrame", [0, 1, 2], all_fields))
    )
    found: dict[str, Any] = {"length": [len(frame.data) for frame in frames]}
    for name in ("can_id", "is_extended", "channel"):
        found[name] = [getattr(frame, name) for frame in frames]
    found["skipped"] = summary.skipped
    expected = {"length": [8, 8, 8], "skipped": {}} | expected
    assert {name: found[name] for name in expected} == expected
    if len(frames) == 3:
        rows = all_fields["DataBytes"]
        assert [f.data for f in frames] == [
            bytes(row[: len(f.data)]) for f, row in zip(frames, rows, strict=True)
        ]


def test_numbers_that_a_conversion_names(tmp_path: Path) -> None:
    """The texts of IDE are for people; a conversion of numbers holds, such as DLC to length."""

    def convert(mdf: Any) -> None:
        texts: dict[str, object] = {
            "val_0": 0,
            "text_0": "standard",
            "val_1": 1,
            "text_1": "extended",
        }
        numbers: dict[str, object] = {"a": 1.0, "b": 1.0}
        for channel in mdf.groups[0].channels:
            if channel.name in {"CAN_DataFrame.IDE", "CAN_DataFrame.DataLength"}:
                is_text = channel.name.endswith("IDE")
                channel.conversion = from_dict(texts if is_text else numbers)

    group = fields(IDE=np.array([0, 1, 0], np.uint8), DataLength=np.array([7, 2, 2], np.uint8))
    path = written(tmp_path / "a.mf4", signal("CAN_DataFrame", [0, 1, 2], group), change=convert)
    frames, _ = read(path)
    assert [frame.is_extended for frame in frames] == [False, True, False]
    assert [len(frame.data) for frame in frames] == [8, 3, 3]


@pytest.mark.parametrize(
    ("given", "t", "words"),
    [
        ({"IDE": np.array([b"no", b"yes", b"yes"])}, [0, 1, 2], r"\.IDE of a group is no number"),
        ({"ID": None}, [0, 1, 2], r"a group of frames has no field CAN_DataFrame\.ID"),
        ({"DataBytes": None}, [0, 1, 2], r"has no field CAN_DataFrame\.DataBytes"),
        ({}, [0, 1, 1e10], "the time stamp is beyond 64 bits of nanoseconds"),
    ],
)
def test_groups_that_are_no_frames(
    tmp_path: Path, given: dict[str, Any], t: list[float], words: str
) -> None:
    with pytest.raises(LogError, match=words):
        read(written(tmp_path / "a.mf4", signal("CAN_DataFrame", t, fields(**given))))


@pytest.mark.parametrize(
    ("name", "bus", "kind"),
    [
        ("CAN_ErrorFrame", v4.BUS_TYPE_CAN, Skipped.ERROR),
        ("CAN_RemoteFrame", v4.BUS_TYPE_CAN, Skipped.REMOTE),
        ("CAN_OverloadFrame", v4.BUS_TYPE_CAN, Skipped.OTHER),
        ("LIN_Frame", v4.BUS_TYPE_LIN, Skipped.OTHER),
    ],
)
def test_other_groups_are_counted(tmp_path: Path, name: str, bus: int, kind: Skipped) -> None:
    """Beside frames, and alone."""
    other = signal(name, [0, 1], {"BusChannel": np.ones(2, np.uint8)}, bus)
    empty = signal("CAN_ErrorFrame", [], {"ID": np.zeros(0, np.uint32)})
    frames = signal("CAN_DataFrame", [0, 1, 2], fields())
    found, summary = read(written(tmp_path / "a.mf4", frames, other, empty))
    assert (len(found), summary.skipped) == (3, {kind: 2})
    found, summary = read(written(tmp_path / "b.mf4", other))
    assert (found, summary.skipped) == ([], {kind: 2})


def without(flag: str) -> Any:
    """Make a group that says less of itself."""

    def change(mdf: Any) -> None:
        group = mdf.groups[0].channel_group
        if flag == "flags":
            group.flags = 0
        elif flag == "source":
            group.acq_source = None
        else:
            group.acq_source.bus_type = v4.BUS_TYPE_OTHER

    return change


@pytest.mark.parametrize("missing", ["flags", "source", "bus"])
def test_groups_that_say_less(tmp_path: Path, missing: str) -> None:
    """Without the flag of bus events, a source or a kind of bus, the channel's name is enough."""
    group = signal("CAN_DataFrame", [0, 1, 2], fields())
    frames, _ = read(written(tmp_path / "a.mf4", group, change=without(missing)))
    assert len(frames) == 3


@pytest.mark.skipif(not hasattr(time, "tzset"), reason="the zone of a process cannot be set here")
@pytest.mark.parametrize(("zone", "hours"), [("JST-9", 9), ("EST5", -5)])
def test_a_start_without_a_zone_is_local_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zone: str, hours: int
) -> None:
    """As python-can writes it, and reads it."""
    with monkeypatch.context() as patch:
        patch.setenv("TZ", zone)
        time.tzset()
        group = signal("CAN_DataFrame", [0, 1, 2], fields())
        path = written(tmp_path / "a.mf4", group, start=START.replace(tzinfo=None))
        frames, _ = read(path)
        with can.MF4Reader(path) as messages:
            expected = [message.timestamp for message in messages]
    time.tzset()
    assert frames[0].t_ns == START_NS - hours * 3600 * 10**9
    assert [frame.t_ns / 1e9 for frame in frames] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("block", [2, 3, 5, 1 << 16])
def test_groups_are_merged_by_their_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    """Of other fields, widths and channels, and in blocks that end at different times."""
    monkeypatch.setattr("maplines_can.logs.mf4_log.BLOCK_FRAMES", block)
    times = [np.arange(0, 9, 0.5), np.arange(0.25, 20, 3), np.arange(4, 5, 0.125)]
    groups = [
        signal("CAN_DataFrame", times[0], fields(len(times[0]), BusChannel=None)),
        signal("CAN_DataFrame", times[1], fields(len(times[1]), 64, DataLength=None)),
        signal(
            "CAN_DataFrame", times[2],
            fields(len(times[2]), ID=np.full(len(times[2]), 5 | EXTENDED, np.uint32)),
        ),
    ]  # fmt: skip
    frames, _ = read(written(tmp_path / "a.mf4", *groups))
    expected = sorted(
        (START_NS + round(t * 1e9), channel, length, can_id)
        for part, channel, length, can_id in zip(
            times, ["", "1", "1"], [8, 64, 8], [0x340, 0x340, 5], strict=True
        )
        for t in part.tolist()
    )
    assert [frame.t_ns for frame in frames] == [t_ns for t_ns, *_ in expected]
    assert sorted((f.t_ns, f.channel, len(f.data), f.can_id) for f in frames) == expected


def test_groups_whose_times_go_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A single one keeps its order; of several, no frame is lost or read twice."""
    single = signal("CAN_DataFrame", [2, 1, 3], fields())
    frames, _ = read(written(tmp_path / "a.mf4", single))
    assert [frame.t_ns - START_NS for frame in frames] == [2 * 10**9, 10**9, 3 * 10**9]
    monkeypatch.setattr("maplines_can.logs.mf4_log.BLOCK_FRAMES", 4)
    rng = np.random.default_rng(1)
    groups = [
        signal("CAN_DataFrame", rng.permutation(n) * 1.0, fields(n, BusChannel=np.full(n, n)))
        for n in (17, 30)
    ]
    frames, _ = read(written(tmp_path / "a.mf4", *groups))
    assert sorted((f.channel, f.t_ns - START_NS) for f in frames) == sorted(
        (str(n), k * 10**9) for n in (17, 30) for k in range(n)
    )


@pytest.mark.parametrize(
    ("start", "start_ns", "times"),
    [
        (START, START_NS, "absolute"),
        (datetime(1970, 1, 1, tzinfo=UTC), 0, "zero"),
        (START.astimezone().replace(tzinfo=None), START_NS, "absolute"),
    ],
    ids=["utc", "none", "local"],
)
def test_times_are_exact(tmp_path: Path, start: datetime, start_ns: int, times: str) -> None:
    """To the nanosecond after the start of the file; one without a zone is local time."""
    group = signal("CAN_DataFrame", [0, 0.01, 86400.000000001], fields())
    frames, summary = read(written(tmp_path / "a.mf4", group, start=start))
    assert [f.t_ns - start_ns for f in frames] == [0, 10_000_000, 86_400_000_000_001]
    assert summary.times == times


def test_signals_are_no_log_of_a_bus(tmp_path: Path) -> None:
    """Such as the MF4 that decode writes."""
    speed = asammdf.Signal(np.arange(3.0), np.arange(3.0), name="Speed")
    path = written(tmp_path / "a.mf4", speed)
    with pytest.raises(LogError, match="no log of a CAN bus: no group has the channel CAN_DataFr"):
        read(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "it does not begin with MDF"),
        (b"This is not a log.\n" * 20, "it does not begin with MDF"),
        (b"MDF     4.10    " * 9, "asammdf cannot open it: "),
    ],
)
def test_a_file_of_something_else_is_one_clear_error(
    tmp_path: Path, content: bytes, words: str
) -> None:
    path = tmp_path / "a.mf4"
    path.write_bytes(content)
    with pytest.raises(LogError, match=rf"not a valid .mf4 file \({words}") as caught:
        read(path)
    assert "\n" not in str(caught.value)


def test_a_log_that_was_not_finalised(tmp_path: Path) -> None:
    """As after a crash of the logger: the number of its records is unknown, and is found."""
    path = written(tmp_path / "a.mf4", signal("CAN_DataFrame", [0, 1, 2], fields()))
    with asammdf.MDF(path) as mdf:
        place = mdf.groups[0].channel_group.address
    content = bytearray(path.read_bytes())
    content[:8] = b"UnFinMF "
    content[60:62] = b"\1\0"  # the count of cycles must be updated
    content[place + 80 : place + 88] = bytes(8)
    path.write_bytes(content)
    frames, _ = read(path)
    assert len(frames) == 3
    other = path.with_suffix("")
    path.rename(other)
    assert list(read_log(other)) == frames


def test_the_file_is_closed(tmp_path: Path) -> None:
    """Also if it is not read to its end."""
    path = written(tmp_path / "a.mf4", signal("CAN_DataFrame", [0, 1, 2], fields()))
    with Mf4Reader(path, LogSummary()) as reader:
        next(iter(reader))
    path.unlink()
