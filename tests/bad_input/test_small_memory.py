"""No table fills the memory, whatever it contains or claims; see ``bus/test_log_limits.py``."""

import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from support.bombs import MB, MOST, SIZE, gzipped, read_in_little_memory

#: A file with this suffix in front of the last one is read by this function.
READ = """
from pathlib import Path
from maplines_can import Codec
from maplines_can.simulation import RecordedDrive
from maplines_can.bus import key_from_file
from maplines_can.logs.signal_log import read_table
from maplines_can.cli.consume_camera import _WANTED, MAX_LINES
from maplines_can.cli.consume_input import table_rows
from maplines_can.simulation.truth import read_truth
from maplines_can.study.files import GaussianFile

READERS = {
    ".gaussians": lambda path: [GaussianFile.opened(Path(path))],
    ".truth": read_truth,
    ".drive": lambda path: [RecordedDrive.from_csv(path)],
    ".camera": lambda path: list(table_rows(path, _WANTED, MAX_LINES)),
    ".dbc": lambda path: [Codec.from_dbc(path)],
    ".signals": read_table,
    ".key": lambda path: [key_from_file(path)],
}

def read(path):
    return READERS[Path(path).suffixes[0]](path)

"""


def write_npz(path: Path, arrays: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> None:
    """Write the members of an ``.npz`` as they are given."""
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in arrays.items():
            archive.writestr(f"{name}.npy", data)


def npy(shape: tuple[int, ...], data: bytes = b"", *, by_columns: bool = False) -> bytes:
    """An array that claims to have a shape."""
    text = f"{{'descr': '<f8', 'fortran_order': {by_columns}, 'shape': {shape}}}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def write_npz_files(folder: Path) -> Iterator[tuple[str, str]]:
    many, zeros = 10**8, bytes(2 * MB)
    cov = npy((many, 4, 4), zeros)
    members = {
        "rows": ({"mean": npy((many, 4), zeros), "cov": cov}, "ends before its 100000000 rows"),
        "columns": ({"mean": npy((10, many), zeros), "cov": cov}, "must have shape (N, 4)"),
        "by-columns": (
            {"mean": npy((many, 4), zeros, by_columns=True), "cov": cov},
            "save numpy.ascontiguousarray",
        ),
        "header": (
            {"mean": b"\x93NUMPY\x02\x00" + struct.pack("<L", SIZE * MB) + zeros, "cov": cov},
            "needs an array of numbers",
        ),
    }
    for name, (arrays, reason) in members.items():
        write_npz(folder / f"{name}.gaussians.npz", arrays)
        yield f"{name}.gaussians.npz", reason
    write_npz(folder / "bz2.gaussians.npz", {"mean": cov, "cov": cov}, zipfile.ZIP_BZIP2)
    yield "bz2.gaussians.npz", "in a way that numpy does not use"


def write_parquet_files(folder: Path) -> Iterator[tuple[str, str]]:
    zeros, small = pa.array(np.zeros(9 * MB)), pa.array(np.zeros(9 * MB, dtype=np.int8))
    plain = {"use_dictionary": False, "compression": "zstd", "row_group_size": len(zeros)}
    names = [f"mean_{i}" for i in range(4)]
    names += [f"cov_{i}{j}" for i in range(4) for j in range(i, 4)]
    table = pa.table(dict.fromkeys(names, small) | {"mean_0": zeros})
    pq.write_table(table, folder / "page.gaussians.parquet", data_page_size=SIZE * MB, **plain)
    yield "page.gaussians.parquet", "in a row group, more than"
    repeated = pa.DictionaryArray.from_arrays(np.zeros(10**5, dtype=np.int32), ["x" * MB])
    times = pa.array(np.zeros(10**5))
    texts = {"lane": repeated, "stated_lane": repeated, "slot": repeated}
    pq.write_table(pa.table(texts | {"time": times}), folder / "texts.truth.parquet")
    yield "texts.truth.parquet", "has no column drive_time"
    rows = pa.table({"slot": repeated, "t": times})
    with pq.ParquetWriter(folder / "rows.camera.parquet", rows.schema) as writer:
        for _ in range(30):
            writer.write_table(rows)
    yield "rows.camera.parquet", "has more than 200000 rows"


def write_sparse_files(folder: Path) -> Iterator[tuple[str, str]]:
    """Files of zeros that take no room: one line without an end."""
    for name, reason in {
        "line.gaussians.csv": "line 1 has more than 65536 characters",
        "line.truth.csv": "line 1 has more than 65536 characters",
        "line.drive.csv": "line 1 has more than 65536 characters",
        "line.camera.csv": "line 1 has more than 65536 characters",
        "line.dbc": "is too large",
        "line.signals.toml": "is too large",
        "line.key": "it has more than 1024 bytes",
    }.items():
        with (folder / name).open("wb") as file:
            file.truncate(SIZE * MB)
        (folder / name).chmod(0o600)
        yield name, reason


#: Maps by name: how they begin, what they repeat, how many MB of it, and the reason.
MAPS = {
    "road.xodr": ("<OpenDRIVE><road>", "<a b='1'/>", 60, "<road> takes more than 128 MB"),
    "way.osm": ("<osm><way id='1'>", "<nd ref='1'/>", 60, "<way> takes more than 128 MB"),
    "lanelet.xml": ("<commonRoad><lanelet>", "<point><x>1</x></point>", 60, "<lanelet> takes"),
    "values.geojson": ('{"a":[', "[],", 15, "values of more than 96 MB"),
    "deep.geojson": ("[", "[", 15, "values of more than 96 MB"),
    "row.csv": ("line,x,y\n", "x", 31, "line 2 has more than 65536 characters"),
    "bytes.csv": ("line,x,y\n", "a,1,2\n", 60, "more than 32 MB"),
}


def test_no_map_fills_the_memory(tmp_path: Path) -> None:
    """Compressed files of at most 100 kB, which took gigabytes."""
    for name, (head, unit, size, _) in MAPS.items():
        (tmp_path / f"{name}.gz").write_bytes(gzipped(head.encode(), unit.encode(), size))
    read = "from maplines_can.maps import load\n\ndef read(path):\n    return [load(path)]\n"
    outcomes = read_in_little_memory(read, [tmp_path / f"{name}.gz" for name in MAPS])
    for name, (*_, reason) in MAPS.items():
        _, text, peak = outcomes[f"{name}.gz"]
        assert text.startswith("MapFileError: "), name
        assert reason in text, name
        assert peak < MOST, name


def test_no_table_fills_the_memory(tmp_path: Path) -> None:
    """Each is refused in one line by a process with 300 MB."""
    reasons = dict(write_npz_files(tmp_path))
    reasons |= dict(write_parquet_files(tmp_path))
    reasons |= dict(write_sparse_files(tmp_path))
    outcomes = read_in_little_memory(READ, [tmp_path / name for name in reasons])
    for name, reason in reasons.items():
        records, text, peak = outcomes[name]
        assert reason in text, name
        assert not records, name
        assert peak < MOST, name
        assert "\n" not in text, name
