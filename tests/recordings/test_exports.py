"""Exports, each read back by the reader of the other project, and compared with `read_lines`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can import Codec, MapLine, Slot
from maplines_can.cli import main
from maplines_can.recordings.formats import About, beside, open_tables, suffix_of
from maplines_can.recordings.line_tables import UPPER_TRIANGLE, LineTable, Table
from maplines_can.recordings.read_lines import line_tables, read_lines
from maplines_can.values.errors import MissingExtraError
from maplines_can.values.line import PARAMETERS, Kind, Status
from maplines_can.wire import E2EState
from maplines_can.wire.layout.record_signals import slot_title

COVARIANCE = [f"cov_{PARAMETERS[i]}_{PARAMETERS[j]}" for i, j in UPPER_TRIANGLE]


@pytest.fixture(scope="module")
def table(faulty_log: Path) -> LineTable:
    return read_lines(faulty_log)


def export(log: Path, path: Path) -> Path:
    """Write the lines of a log, block by block."""
    about = About.of(Codec.from_dbc(), str(log), ())
    writer = open_tables(beside(path), about, suffix_of(path))
    for part in line_tables(log, block_frames=500):
        writer.write(part)
    assert writer.close() == [path]
    return path


def shown(table: Table) -> Table:
    """Return the lines that a controller might have used."""
    return table.where(table["usable"] & np.isfinite(table["y_off"]))


def reference(table: Table, k: int, x: Any) -> tuple[Any, Any]:
    """Return positions of the line in a row at x, and their sigmas, written out."""
    y_off, beta, c0, c1 = (float(table[name][k]) for name in PARAMETERS)
    cov = np.empty((4, 4))
    for (i, j), name in zip(UPPER_TRIANGLE, COVARIANCE, strict=True):
        cov[i, j] = cov[j, i] = table[name][k]
    x = np.asarray(x)
    J = np.stack([np.ones_like(x), x / np.cos(beta) ** 2, x**2 / 2, x**3 / 6], axis=-1)
    return y_off + np.tan(beta) * x + c0 / 2 * x**2 + c1 / 6 * x**3, np.sqrt(
        ((J @ cov) * J).sum(-1)
    )


# ---- foxglove.SceneUpdate ------------------------------------------------------------------


def scene_messages(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the schema of the topic ``bands``, and its messages."""
    reader = pytest.importorskip("mcap.reader", reason="needs the extra tables")
    with path.open("rb") as stream:
        found = [
            (schema, message.data)
            for schema, channel, message in reader.make_reader(stream).iter_messages(
                topics=["bands"], log_time_order=False
            )
        ]
    assert {schema.name for schema, _ in found} == {"foxglove.SceneUpdate"}
    assert {schema.encoding for schema, _ in found} == {"jsonschema"}
    return json.loads(found[0][0].data), [json.loads(data) for _, data in found]


def test_a_scene_has_the_lines_and_their_bands(
    faulty_log: Path, table: LineTable, tmp_path: Path
) -> None:
    """An entity for each line that may be used, a deletion for each other one."""
    schema, updates = scene_messages(export(faulty_log, tmp_path / "drive.mcap"))
    assert len(updates) == len(table)
    validate = pytest.importorskip("jsonschema").Draft202012Validator(schema).validate
    kept = table["usable"] & np.isfinite(table["y_off"])
    assert 0 < kept.sum() < len(table)
    for k, (update, is_kept) in enumerate(zip(updates, kept, strict=True)):
        validate(update)
        (one,) = update["entities"] if is_kept else update["deletions"]
        assert len(update["entities"]) + len(update["deletions"]) == 1
        assert one["id"] == slot_title(Slot[table["slot"][k]])
        assert 10**9 * one["timestamp"]["sec"] + one["timestamp"]["nsec"] == table["t_ns"][k]
        if is_kept:
            check_entity(table, k, one)
    assert (
        max(len(json.dumps(update, separators=(",", ":"))) for update in updates) < 4000
    )  # 0.3 kB in the file


def check_entity(table: LineTable, k: int, entity: Any) -> None:
    """Compare the mean and the bands with the row, to half a millimetre."""
    assert entity["frame_id"] == "base_link"
    assert entity["lifetime"] == {"sec": 0, "nsec": 100_000_000}  # two cycles of 50 ms
    (mean,) = entity["lines"]
    x, y = (np.array([point[axis] for point in mean["points"]]) for axis in "xy")
    assert x[[0, -1]] == pytest.approx([table["x_min"][k], table["x_max"][k]], abs=6e-4)
    expected, sigma = reference(table, k, np.linspace(table["x_min"][k], table["x_max"][k], len(x)))
    assert y == pytest.approx(expected, abs=6e-4)
    for number, band in enumerate(entity["triangles"], 1):
        ends = np.array([point["y"] for point in band["points"]]).reshape(-1, 2)
        bounds = expected + np.outer([-number, number], sigma)
        assert np.abs(ends.T - bounds).max() < 6e-4
        assert max(band["indices"]) == len(band["points"]) - 1
    assert len(entity["triangles"]) == (0 if table["status"][k] == "UNKNOWN" else 3)


def test_foxglove_takes_the_scene(faulty_log: Path, tmp_path: Path) -> None:
    """Each field is one of the message that Foxglove publishes, and has its type."""
    package = "foxglove_schemas_protobuf.SceneUpdate_pb2"
    found = pytest.importorskip(package, reason="needs foxglove-schemas-protobuf").SceneUpdate
    parse = pytest.importorskip("google.protobuf.json_format").ParseDict
    _, updates = scene_messages(export(faulty_log, tmp_path / "drive.mcap"))
    for update in updates:
        for one in (*update["entities"], *update["deletions"]):
            for name in ("timestamp", "lifetime"):  # which protobuf has as text
                if name in one:
                    text = f"{one[name]['sec']}.{one[name]['nsec']:09}s"
                    zero = "1970-01-01T00:00:00Z"
                    one[name] = text if name == "lifetime" else zero
        message = parse(update, found())  # raises for a field that there is not
        assert len(message.entities) + len(message.deletions) == 1
        assert all(len(entity.lines[0].points) == 11 for entity in message.entities)


def test_a_line_without_a_covariance_has_no_bands(tmp_path: Path) -> None:
    log = log_of(tmp_path, MapLine.mean_only(Slot.ROUTE, [1.75, 0, 0, 0], age=0.02))
    _, updates = scene_messages(export(log, tmp_path / "drive.mcap"))
    entities = [one for update in updates for one in update["entities"]]
    assert entities
    assert not any(entity["triangles"] for entity in entities)


def log_of(folder: Path, line: MapLine) -> Path:
    """Return a log in which a line is sent again and again, so that it becomes usable."""
    encoder, path = Codec.from_dbc().encoder(), folder / "lines.log"
    rows = [
        f"({100 + cycle / 20:.6f}) can0 {frame.can_id:03X}#{frame.data.hex().upper()}\n"
        for cycle in range(20)
        for frame in encoder.encode(line)
    ]
    path.write_text("".join(rows))
    return path


def test_a_scene_can_be_left_out(faulty_log: Path, tmp_path: Path, capsys: Any) -> None:
    pytest.importorskip("mcap", reason="needs the extra tables")
    sizes = []
    for name, options in (("with", []), ("without", ["--no-bands"])):
        out = tmp_path / f"{name}.mcap"
        assert main(["decode", str(faulty_log), "-o", str(out), *options]) == 0
        sizes.append(out.stat().st_size)
    assert sizes[0] > sizes[1]
    assert main(["decode", str(faulty_log), "-o", str(tmp_path / "a.csv"), "--no-bands"]) == 1
    assert "--no-bands is for .mcap" in capsys.readouterr().err


# ---- ROS 2 bags ----------------------------------------------------------------------------


def test_a_bag(faulty_log: Path, table: LineTable, tmp_path: Path) -> None:
    """rosbags reads the messages by the definitions in the bag."""
    highlevel = pytest.importorskip("rosbags.highlevel", reason="needs the extra ros")
    bag = export(faulty_log, tmp_path / "drive.rosbag2")
    with highlevel.AnyReader([bag]) as reader:
        found = {
            f"/{slot_title(slot)}": [
                (time, reader.deserialize(data, connection.msgtype))
                for connection, time, data in reader.messages()
                if connection.topic == f"/{slot_title(slot)}"
            ]
            for slot in Slot
        }
        assert {one.msgtype for one in reader.connections} == {"maplines_msgs/msg/Line"}
    for slot in Slot:
        lines = table.where(table["slot"] == slot.name)
        messages = found[f"/{slot_title(slot)}"]
        assert [time for time, _ in messages] == lines["t_ns"].tolist()
        for k, (_, message) in enumerate(messages):
            check_message(lines, k, message)
    assert sum(map(len, found.values())) == len(table) > 300


def check_message(lines: Table, k: int, message: Any) -> None:
    """Compare a message with a row: its values are the same, its points on the line."""
    row = {name: lines[name][k] for name in lines.columns}
    assert (message.slot, message.kind) == (Slot[row["slot"]], Kind[row["kind"]])
    assert (message.status, message.state) == (Status[row["status"]], E2EState[row["state"]])
    for name in ("usable", "two_senders", "counter"):
        assert getattr(message, name) == row[name]
    for name, expected in (("mean", PARAMETERS), ("covariance", COVARIANCE)):
        assert np.array_equal(
            getattr(message, name), [row[one] for one in expected], equal_nan=True
        )
    for name in ("age", "x_min", "x_max"):
        assert np.array_equal(getattr(message, name), row[name], equal_nan=True)
    stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    assert message.header.frame_id == "base_link"
    if np.isnan(row["y_off"]):
        assert not message.points
        return
    assert stamp == row["t_ns"] - round(row["age"] * 1e9)
    x = np.array([one.point.x for one in message.points])
    assert x[[0, -1]].tolist() == [row["x_min"], row["x_max"]]
    y, sigma = reference(lines, k, x)
    assert [one.point.y for one in message.points] == pytest.approx(y, abs=1e-9)
    of_y = np.zeros((len(x), 9))
    of_y[:, 4] = sigma**2
    assert np.array([one.covariance for one in message.points]) == pytest.approx(of_y, rel=1e-9)


def test_a_bag_is_replaced_and_a_folder_is_not(
    faulty_log: Path, tmp_path: Path, capsys: Any
) -> None:
    pytest.importorskip("rosbags", reason="needs the extra ros")
    out = tmp_path / "drive.rosbag2"
    for options, status in (([], 0), ([], 1), (["--force"], 0)):
        assert main(["decode", str(faulty_log), "-o", str(out), *options]) == status
        assert sorted(one.name for one in out.iterdir()) == ["drive.mcap", "metadata.yaml"]
    (out / "metadata.yaml").unlink()
    assert main(["decode", str(faulty_log), "-o", str(out), "--force"]) == 1
    assert "is a folder that is no bag" in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == [out]


# ---- ASAM OSI ------------------------------------------------------------------------------


def test_a_trace_is_nowhere_overconfident(
    faulty_log: Path, table: LineTable, tmp_path: Path
) -> None:
    """osi-python reads the boundaries, whose errors cover those of the lines."""
    trace = pytest.importorskip("osi3trace.osi_trace", reason="needs the extra osi")
    path = export(faulty_log, tmp_path / "drive.osi.mcap")
    reader = trace.OSITrace(str(path), "SensorData", topic="MapLines.SensorData")
    messages = [*reader]
    texts = {record.name: record.metadata for record in reader.get_file_metadata()}
    assert "boundary_line_rmse" in texts["maplines_can"]["lost"]
    assert texts["net.asam.osi.trace"]["zero_time"] == "1970-01-01T00:00:00Z"
    reader.close()
    lines = shown(table)
    rows = {(int(t), Slot[slot]): k for k, (t, slot) in enumerate(
        zip(lines["t_ns"], lines["slot"], strict=True))}  # fmt: skip
    assert len(rows) == len(lines) > 100
    assert sum(len(message.lane_boundary) for message in messages) == len(lines)
    random = np.random.default_rng(1)
    for message in messages:
        found = [one.header.tracking_id.value for one in message.lane_boundary]
        assert len({*found}) == len(found)
        end = nanoseconds(message.timestamp)
        times = [max(t for t, slot in rows if slot == one and t <= end) for one in found]
        assert max(times) == end
        assert max(times) - min(times) < 50_000_000
        ks = [rows[t, Slot(one)] for t, one in zip(times, found, strict=True)]
        poses = [int(lines["t_ns"][k]) - round(lines["age"][k] * 1e9) for k in ks]
        assert nanoseconds(message.last_measurement_time) == max(poses)
        for k, boundary in zip(ks, message.lane_boundary, strict=True):
            check_boundary(lines, k, boundary, random)


def check_boundary(lines: Table, k: int, boundary: Any, random: np.random.Generator) -> None:
    """Compare a boundary with a row at its points, and at others between them."""
    points = np.array([(one.position.x, one.position.y) for one in boundary.boundary_line])
    errors = np.array([one.position.y for one in boundary.boundary_line_rmse])
    assert len(points) == len(errors) == 17
    ends = lines["x_min"][k], lines["x_max"][k]
    assert tuple(points[[0, -1], 0]) == ends
    y, sigma = reference(lines, k, points[:, 0])
    assert points[:, 1] == pytest.approx(y, abs=1e-9)
    assert (errors >= sigma * (1 - 1e-9)).all()
    x = random.uniform(*ends, 50)
    y, sigma = reference(lines, k, x)
    distance = np.interp(x, *points.T) - y
    assert (np.interp(x, points[:, 0], errors) >= 0.99 * np.hypot(sigma, distance)).all()
    assert (errors < 1.6 * sigma.max() + 0.05).all()


def nanoseconds(time: Any) -> int:
    return int(time.seconds * 10**9 + time.nanos)


# ---- all of them ---------------------------------------------------------------------------

NEEDS = {".mcap": "mcap", ".rosbag2": "rosbags", ".osi.mcap": "osi3trace"}


@pytest.mark.parametrize("suffix", NEEDS)
def test_a_damaged_log_keeps_what_is_intact(
    suffix: str, faulty_log: Path, tmp_path: Path, capsys: Any
) -> None:
    pytest.importorskip(NEEDS[suffix])
    log, folder = tmp_path / "damaged.log", tmp_path / "many"
    log.write_text(faulty_log.read_text() + "garbage\n")
    out = tmp_path / f"drive{suffix}"
    assert main(["decode", str(log), "-o", str(out)]) == 1
    assert "1 of" in capsys.readouterr().err
    whole = export(faulty_log, tmp_path / f"whole{suffix}")
    assert count(out) == count(whole) > 100
    many = ["decode", str(faulty_log), "-o", str(folder), "--format", suffix[1:], "--jobs", "1"]
    assert main(many) == 0
    assert count(folder / "lines" / f"faulty{suffix}") == count(whole)
    assert not [*tmp_path.rglob(".*")]


def summary_of(path: Path) -> Any:
    """Return the summary of an MCAP file, or of that of a bag."""
    from mcap.reader import make_reader

    file = next(path.glob("*.mcap")) if path.is_dir() else path
    with file.open("rb") as stream:
        return make_reader(stream).get_summary()


def count(path: Path) -> int:
    """Return the number of messages."""
    return int(summary_of(path).statistics.message_count)


@pytest.mark.parametrize(
    ("suffix", "topics"),
    [
        (".mcap", {"Route", "bands"}),
        (".rosbag2", {"/Route"}),
        (".osi.mcap", {"MapLines.SensorData"}),
    ],
)
def test_channels_have_topics_of_their_own(suffix: str, topics: set[str], tmp_path: Path) -> None:
    pytest.importorskip(NEEDS[suffix])
    log = log_of(tmp_path, MapLine.with_sigma(Slot.ROUTE, [1.75, 0, 0, 0], [0.1, 0.01, 1e-3, 1e-5]))
    whole = summary_of(export(log, tmp_path / f"a{suffix}"))
    log.write_text(log.read_text() + log.read_text().replace("can0", "can1"))
    both = summary_of(export(log, tmp_path / f"b{suffix}"))
    assert {channel.topic for channel in whole.channels.values()} == topics
    join = "." if suffix == ".osi.mcap" else "/"
    assert {channel.topic for channel in both.channels.values()} == {
        f"{'/' * topic.startswith('/')}{channel}{join}{topic.strip('/')}"
        for topic in topics
        for channel in ("can0", "can1")
    }
    assert both.statistics.message_count == 2 * whole.statistics.message_count > 20


@pytest.mark.parametrize(
    ("suffix", "module", "extra"),
    [(".rosbag2", "rosbags.rosbag2", "ros"), (".osi.mcap", "osi3.osi_sensordata_pb2", "osi")],
)
def test_a_missing_extra_is_named(
    suffix: str, module: str, extra: str, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf'install the extra "{extra}"'):
        open_tables(beside(tmp_path / f"a{suffix}"), About("", "", ""), suffix)
    assert not [*tmp_path.iterdir()]


def test_scenes_have_no_place(faulty_log: Path, tmp_path: Path, capsys: Any) -> None:
    for suffix in (".rosbag2", ".osi.mcap"):
        out = tmp_path / f"a{suffix}"
        pose = ["--dbc", "maplines-pose.dbc", "--scenes"]
        assert main(["decode", str(faulty_log), "-o", str(out), *pose]) == 1
        assert f"{suffix} has lines only" in capsys.readouterr().err
