"""Tables of lines: the values of ``MapLine`` and ``Scene``, and the files that others read."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can import Codec, MapLine, Slot
from maplines_can.bus import read_log
from maplines_can.cli import main
from maplines_can.recordings.formats import About, beside, open_tables
from maplines_can.recordings.line_tables import Table
from maplines_can.recordings.read_lines import line_tables, read_lines
from maplines_can.values.errors import LogError
from maplines_can.wire import Decoder, Reason, default_dbc_path

AT = (0.0, 20.0, 47.5)
POSE_DBC = default_dbc_path("maplines-pose.dbc")


def decoded(log: Path, dbc: Any = None) -> tuple[list[MapLine], list[Reason], Decoder]:
    decoder = Codec.from_dbc(dbc).decoder()
    lines: list[MapLine] = []
    reasons: list[Reason] = []
    for frame in read_log(log):
        found = decoder.feed(frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended)
        if isinstance(found, Reason):
            reasons.append(found)
        else:
            lines += found
    return lines, reasons, decoder


def test_a_row_is_a_line(faulty_log: Path) -> None:
    """Every column that a ``MapLine`` has, with positions and sigmas of its own methods."""
    lines, reasons, _ = decoded(faulty_log)
    table = read_lines(faulty_log, at=AT)
    assert len(table) == len(lines) > 300
    assert [*table["slot"]] == [line.slot.name for line in lines]
    assert [*table["kind"]] == [line.kind.name for line in lines]
    assert [*table["status"]] == [line.status.name for line in lines]
    assert table["t_ns"].tolist() == [line.t_ns for line in lines]
    assert np.allclose(table["t"], table["t_ns"] / 1e9, rtol=0, atol=1e-6)
    assert set(table["state"]) >= {"INIT", "VALID"}
    assert table["usable"].sum() > 100
    assert not table["usable"][table["state"] != "VALID"].any()
    for x in AT:
        is_in = np.array([line.x_min <= x <= line.x_max for line in lines])
        for name, expected in (("y", MapLine.y), ("sigma", MapLine.y_sigma)):
            column = table[f"{name}{x:g}"]
            assert (np.isfinite(column) == is_in).all()
            values = [
                float(expected(line, x)) for line, here in zip(lines, is_in, strict=True) if here
            ]
            assert np.allclose(column[is_in], values, rtol=1e-12, atol=0)
    rejected = [r for r in reasons if r not in (Reason.PENDING, Reason.FOREIGN)]
    assert [*table.rejects["reason"]] == [reason.name for reason in rejected]


def test_scenes_have_the_width_and_the_centre(scene_log: Path) -> None:
    """Those of ``Scene.width`` and ``Scene.centre``, of the scenes that the decoder shows."""
    decoder, scenes = Codec.from_dbc(POSE_DBC).decoder(), {}
    for frame in read_log(scene_log):
        decoder.feed(frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended)
        if (received := decoder.scene()) is not None:
            scenes[received.t_ns] = received
    table = read_lines(scene_log, dbc=POSE_DBC, at=(20.0,), scenes=True).scenes
    assert table["t_ns"].tolist() == [*scenes]
    compared = 0
    for k, received in enumerate(scenes.values()):
        low, high = received.scene.x_range((Slot.EGO_LEFT, Slot.EGO_RIGHT))
        for name in ("width", "centre"):
            value, sigma = table[f"{name}20"][k], table[f"sigma_{name}20"][k]
            if not low <= 20 <= high:
                assert np.isnan(value)
                continue
            expected = getattr(received.scene, name)(20.0)
            assert abs(value - expected.value) < 1e-12
            assert sigma == pytest.approx(float(expected.sigma), rel=1e-9)
            compared += 1
    assert compared > 100


def test_blocks_are_the_whole(faulty_log: Path) -> None:
    whole = read_lines(faulty_log, at=AT)
    for block_frames in (100, 1000):
        parts = [*line_tables(faulty_log, at=AT, block_frames=block_frames)]
        for name, column in whole.columns.items():
            again = np.concatenate([part.columns[name] for part in parts])
            assert column.tobytes() == again.tobytes()


def test_slots_and_rows_are_chosen(faulty_log: Path) -> None:
    table = read_lines(faulty_log, slots=[Slot.EGO_LEFT])
    assert {*table["slot"]} == {"EGO_LEFT"}
    whole = read_lines(faulty_log)
    assert len(table) == (whole["slot"] == "EGO_LEFT").sum()
    assert len(whole.where(whole["usable"])) == whole["usable"].sum()


def test_a_log_without_times_has_none(tmp_path: Path) -> None:
    codec = Codec.from_dbc()
    line = MapLine.mean_only(Slot.ROUTE, [1.75, 0, 0, 0], age=0.02)
    rows = [f"can0  {f.can_id:03X}   [8]  {f.data.hex(' ')}" for f in codec.encoder().encode(line)]
    path = tmp_path / "plain.log"
    path.write_text("\n".join(rows) + "\n")
    table = read_lines(path)
    assert len(table) == 1
    assert np.isnan(table["t"]).all()


def test_a_damaged_log_gives_what_is_intact(faulty_log: Path, tmp_path: Path) -> None:
    path = tmp_path / "damaged.log"
    path.write_text(faulty_log.read_text() + "garbage\n")
    with pytest.warns(UserWarning, match="1 of .* records are damaged"):
        table = read_lines(path)
    assert len(table) == len(read_lines(faulty_log))
    with pytest.raises(LogError, match="no such file"):
        read_lines(tmp_path / "none.log")


@pytest.mark.parametrize("x", [np.nan, 1001.0, -np.inf])
def test_wrong_distances_raise(faulty_log: Path, x: float) -> None:
    with pytest.raises(ValueError, match="at must be distances"):
        read_lines(faulty_log, at=[x])


# ---- files ---------------------------------------------------------------------------------


def write(log: Path, path: Path, dbc: Any = None, **options: Any) -> list[Path]:
    about = About.of(Codec.from_dbc(dbc), str(log), AT)
    writer = open_tables(beside(path), about, path.suffix)
    for table in line_tables(log, at=AT, dbc=dbc, block_frames=500, **options):
        writer.write(table)
    return writer.close()


def check(columns: dict[str, Any], table: Table) -> None:
    """Compare the columns of a file, with nan or None for what is not there."""
    for name in table.columns:
        expected, found = table[name], columns[name]
        if expected.dtype.kind == "f":
            found = np.array([np.nan if one in ("", None) else float(one) for one in found])
            assert np.array_equal(found, expected, equal_nan=True), name
        elif expected.dtype.kind == "b":
            assert [str(one).lower() for one in found] == [str(one).lower() for one in expected]
        else:
            assert [str(one) for one in found] == [str(one) for one in expected], name


def test_csv_and_json_lines(faulty_log: Path, tmp_path: Path) -> None:
    table = read_lines(faulty_log, at=AT)
    for suffix in ("csv", "jsonl"):
        files = write(faulty_log, tmp_path / f"drive.{suffix}")
        assert [file.name for file in files] == [f"drive.{suffix}", f"drive.rejects.{suffix}"]
        for file, part in zip(files, table.parts.values(), strict=True):
            if suffix == "csv":
                with file.open() as text:
                    rows: list[dict[str, Any]] = [*csv.DictReader(text)]
            else:
                rows = [json.loads(row) for row in file.read_text().splitlines()]
            assert len(rows) == len(part) > 0
            check({name: [row[name] for row in rows] for name in part.columns}, part)
    assert not [*tmp_path.glob(".*")]


@pytest.mark.parametrize("name", ["faulty_log", "scene_log"])
def test_lines_are_printed_as_they_are_in_tables(
    capsys: pytest.CaptureFixture[str], request: pytest.FixtureRequest, name: str
) -> None:
    """``usable`` has one meaning: it was that of the line alone in what is printed."""
    log, dbc = request.getfixturevalue(name), POSE_DBC if name == "scene_log" else None
    table, options = read_lines(log, at=AT, dbc=dbc), ["--dbc", str(dbc)] * (dbc is not None)
    assert 0 < table["usable"].sum() < len(table)
    names = ["slot", "kind", "status", "usable", "state", "two_senders", "components", "age"]
    for form in ([], ["--csv"]):
        assert main(["decode", str(log), *options, *form]) == 0
        out = capsys.readouterr().out.splitlines()
        rows: list[dict[str, Any]] = [*csv.DictReader(out)] if form else [*map(json.loads, out)]
        kept = Table({name: table.columns[name] for name in names}, table.categories)
        check({name: [row[name] for row in rows] for name in names}, kept)


def test_parquet(faulty_log: Path, tmp_path: Path) -> None:
    """Values, units, and what the file says of its source."""
    pq = pytest.importorskip("pyarrow.parquet")
    lines, rejects = write(faulty_log, tmp_path / "drive.parquet")
    table = read_lines(faulty_log, at=AT)
    for file, part in ((lines, table), (rejects, table.rejects)):
        found = pq.read_table(file)
        check({name: found[name].to_pylist() for name in part.columns}, part)
    schema = pq.read_schema(lines)
    assert schema.metadata[b"maplines.dbc"] == b"maplines.dbc"
    assert len(schema.metadata[b"maplines.dbc_sha256"]) == 64
    units = {name: (schema.field(name).metadata or {}).get(b"unit") for name in schema.names}
    assert units["y20"] == units["sigma47.5"] == b"m"
    assert (units["c0"], units["cov_beta_c1"], units["slot"]) == (b"1/m", b"rad*1/m^2", None)


def test_data_frames(faulty_log: Path) -> None:
    table = read_lines(faulty_log, at=AT)
    pytest.importorskip("pyarrow")
    assert table.to_arrow()["slot"].to_pylist() == [*table["slot"]]
    for package, convert in (("pandas", table.to_pandas), ("polars", table.to_polars)):
        pytest.importorskip(package)
        frame = convert()
        assert np.array_equal(frame["sigma20"].to_numpy(), table["sigma20"], equal_nan=True)
        assert [*frame["slot"]] == [*table["slot"]]


def test_mf4(scene_log: Path, tmp_path: Path) -> None:
    """A group a slot, scenes with their width, and categories as texts."""
    asammdf = pytest.importorskip("asammdf")
    (file,) = write(scene_log, tmp_path / "drive.mf4", POSE_DBC, scenes=True)
    table = read_lines(scene_log, at=AT, dbc=POSE_DBC, scenes=True)
    with asammdf.MDF(file) as mdf:
        left = table.where(table["slot"] == "EGO_LEFT")
        signal = mdf.get("EgoLeft.sigma20")
        assert signal.unit == "m"
        assert np.array_equal(signal.samples, left["sigma20"], equal_nan=True)
        begin = table["t_ns"].min()
        assert np.allclose(signal.timestamps, (left["t_ns"] - begin) / 1e9, rtol=0, atol=1e-9)
        assert [one.decode() for one in mdf.get("EgoLeft.state").samples] == [*left["state"]]
        width = mdf.get("scenes.sigma_width20")
        assert np.array_equal(width.samples, table.scenes["sigma_width20"], equal_nan=True)


def test_mcap(faulty_log: Path, tmp_path: Path) -> None:
    """A topic a slot, in JSON with a schema that has the units."""
    reader = pytest.importorskip("mcap.reader")
    (file,) = write(faulty_log, tmp_path / "drive.mcap")
    table = read_lines(faulty_log, at=AT)
    with file.open("rb") as stream:
        found = [*reader.make_reader(stream).iter_messages(log_time_order=False)]
    lines = [json.loads(m.data) for s, _, m in found if s.name == "maplines.lines"]
    assert len(lines) == len(table)
    names = [*table.columns]
    names.remove("t_ns")
    columns = {name: [row.get(name) for row in lines] for name in names}
    kept = Table({name: table.columns[name] for name in names}, table.categories)
    check(columns, kept)
    topics = {channel.topic for _, channel, _ in found}
    assert {"EgoLeft", "EgoRight", "rejects"} <= topics
    schema = json.loads(next(s.data for s, _, _ in found if s.name == "maplines.lines"))
    assert schema["properties"]["y20"] == {"type": "number", "description": "[m]"}


def test_an_aborted_file_is_not_there(faulty_log: Path, tmp_path: Path) -> None:
    for suffix in (".csv", ".jsonl"):
        writer = open_tables(beside(tmp_path / f"a{suffix}"), About("", "", ""), suffix)
        writer.write(read_lines(faulty_log))
        writer.abort()
    assert not [*tmp_path.iterdir()]
