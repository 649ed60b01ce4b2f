"""A log without a whole record is an error in each command, which names what fits.

The frames are those of the encoders of the package's DBCs, in rows of candump -L.
"""

from __future__ import annotations

import io
import json
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import maplines_can as ml
from maplines_can import Authenticator, Codec, Gaussian, Key, MapLine, Polyline, Slot, map_scene
from maplines_can.bus import Skipped
from maplines_can.cli import main
from maplines_can.wire import default_dbc_path

#: A frame: time [s], CAN ID as in candump, data as hex digits.
Row = tuple[float, str, str]
SECRET = bytes(range(16))
CYCLES = 12
FOREIGN = [(1000 + 0.01 * k, f"{0x100 + k % 3:03X}", f"{k % 256:02X}001122") for k in range(90)]


@cache
def rows_of(name: str) -> list[Row]:
    """Return the frames of cycles of the ego lane in the DBC of the package with this name."""
    secured, fd = "secoc" in name, name in ("maplines-secoc", "maplines-scene")
    authenticator = Authenticator(Key(SECRET), clock=lambda: 10**15) if secured else None
    encoder = Codec.from_dbc(default_dbc_path(f"{name}.dbc"), authenticator).encoder()
    x = np.linspace(-50, 120, 35)
    lines = {
        slot: Polyline(np.column_stack([x, y + 0 * x]))
        for slot, y in ((Slot.EGO_LEFT, 1.75), (Slot.EGO_RIGHT, -1.75))
    }
    ego = Gaussian(np.zeros(3), np.diag([0.1, 0.1, 0.003]) ** 2)
    scene = encoder.prepare_scene(map_scene(lines, ego, correlation_time=5.0), fd=fd)
    cycles = [encoder.encode_scene(scene, age=0.02, fd=fd).values() for _ in range(CYCLES)]
    return [
        (1000 + 0.05 * k + 0.0005 * i, f"{frame.can_id:03X}", bytes(frame.data).hex())
        for k, cycle in enumerate(cycles)
        for i, frame in enumerate(frame for frames in cycle for frame in frames)
    ]


def changed(rows: list[Row], change: Callable[[str, str], tuple[str, str]]) -> list[Row]:
    """Return rows with other CAN IDs or data."""
    return [(t, *change(can_id, data)) for t, can_id, data in rows]


def random_data(rows: list[Row]) -> list[Row]:
    """Return rows with random data."""
    rng = np.random.default_rng(1)
    return changed(rows, lambda can_id, data: (can_id, rng.bytes(len(data) // 2).hex()))


def written(path: Path, rows: list[Row]) -> Path:
    """Write a log as candump -L does."""
    text = (f"({t:.6f}) can0 {i}#{'#1' * (len(data) > 16)}{data}\n" for t, i, data in rows)
    path.write_text("".join(text))
    return path


def shifted(can_id: str, data: str) -> tuple[str, str]:
    return f"{int(can_id, 16) + 0x10:03X}", data


LINES = rows_of("maplines")
POSE_LINES = rows_of("maplines-pose")
SCENES = rows_of("maplines-scene")
#: Rows of a log, options of the command, and what the error says; {0} is the number of records.
CASES = [
    pytest.param(
        changed(LINES, shifted), [],
        r"none with its CAN IDs, but 0x350..0x351, 0x36c\); 36 records of maplines.dbc are whole "
        "if 0x350..0x351, 0x36c stand for its CAN IDs 0x340..0x341, 0x35c; take the --dbc of the "
        "sender", id="shift",
    ),
    pytest.param(
        changed(LINES, lambda i, data: (f"{int(i, 16):08X}", data)), [],
        "36 records of maplines.dbc are whole if extended 0x340..0x341, extended 0x35c stand for "
        "its CAN IDs 0x340..0x341, 0x35c; take", id="extended",
    ),
    pytest.param(
        FOREIGN, [], r"in 90 frames \(none with its CAN IDs, but 0x100..0x102\); no DBC of this "
        "package fits; take the --dbc of the sender$", id="foreign",
    ),
    pytest.param(
        [*FOREIGN[:40], (1000.4, "340", "0011223344556677"), *FOREIGN[40:]], [],
        r"in 91 frames \(1 with its CAN IDs: 0x340\); no DBC of this package fits", id="stray",
    ),
    pytest.param(
        random_data(POSE_LINES), [], r"\(\d+ with its CAN IDs: 0x35c\); no DBC of this package "
        "fits", id="ids-of-another-dbc",
    ),
    pytest.param(
        changed(LINES, lambda i, data: (i, data[:-2] + f"{int(data[-2:], 16) ^ 0x55:02x}")), [],
        "no DBC of this package fits; .* if the frames are not damaged", id="damaged",
    ),
    pytest.param(
        POSE_LINES, [], "records of maplines-pose.dbc are whole; take --dbc maplines-pose.dbc$",
        id="another-dbc",
    ),
    pytest.param(
        SCENES, [], "of maplines-scene.dbc are whole; take --dbc maplines-scene.dbc", id="scenes",
    ),
    pytest.param(
        changed(SCENES, shifted), ["--dbc", "maplines-scene.dbc"],
        "are whole if 0x389 stand for its CAN IDs 0x379", id="shifted-scenes",
    ),
    pytest.param(
        rows_of("maplines-secoc"), [], "36 records of maplines-secoc.dbc are whole, but "
        "authenticated; take --dbc maplines-secoc.dbc and the key of the sender", id="secoc",
    ),
    pytest.param(
        rows_of("maplines-secoc"), ["--dbc", "maplines-secoc.dbc"],
        "36 records of maplines-secoc.dbc are whole, but authenticated; take the key of the sender",
        id="no-key",
    ),
    pytest.param(
        rows_of("maplines-secoc"), ["--key-file", "OTHER"],
        "36 records of maplines-secoc.dbc are whole, but authenticated; take the key of the sender",
        id="another-key",
    ),
    pytest.param(
        LINES, ["--key-file", "OTHER"], "36 records are whole, but not authenticated; leave out "
        "the key", id="key-for-none",
    ),
    pytest.param(
        [row for row in POSE_LINES if row[1] != "35C"], ["--dbc", "maplines-pose.dbc"],
        "records of lines are whole, but the pose errors that they need are not there",
        id="no-pose-errors",
    ),
    pytest.param([], [], "has no frame, read as candump$", id="empty"),
]  # fmt: skip


def options_of(folder: Path, options: list[str]) -> list[str]:
    """Return options with the path of another key than that of the sender."""
    key = folder / "other.key"
    key.write_text(bytes(range(1, 17)).hex())
    key.chmod(0o600)
    return [str(key) if option == "OTHER" else option for option in options]


def error_of(err: str) -> str:
    """Return the only error on standard error."""
    (error,) = [row for row in err.splitlines() if row.startswith("maplines: error: ")]
    return error


@pytest.mark.parametrize(("rows", "options", "error"), CASES)
def test_decode_says_what_fits(
    rows: list[Row], options: list[str], error: str, tmp_path: Path, capsys: Any
) -> None:
    """As rows, from a pipe, as a file, and as a data set: status 1 and the same sentence."""
    log, options = written(tmp_path / "a.log", rows), options_of(tmp_path, options)
    for out in ([], ["-o", str(tmp_path / "lines.csv")]):
        assert main(["decode", str(log), *options, *out]) == 1
        found = capsys.readouterr()
        assert found.out == ""
        assert re.search(error, error_of(found.err))
        assert f"error: {log}: " in found.err
    if "--key-file" in options:
        return
    assert main(["decode", str(log), *options, "-o", str(tmp_path / "set"), "--jobs", "1"]) == 1
    assert re.search(error, error_of(capsys.readouterr().err))
    result = json.loads((tmp_path / "set" / "manifest.jsonl").read_text().splitlines()[1])
    assert re.search(error, result["error"])
    assert (result["lines"], result["rows"], result["frames"]) == (0, 0, len(rows))


@pytest.mark.parametrize(("rows", "options", "error"), CASES[:3])
def test_a_pipe_is_tried_on_its_first_frames(
    rows: list[Row], options: list[str], error: str, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    """They are kept, since a pipe cannot be read twice."""
    data = written(tmp_path / "a.log", rows).read_bytes()
    for out in ([], ["-o", str(tmp_path / "lines.csv")]):
        stream = io.TextIOWrapper(io.BufferedReader(io.BytesIO(data)))
        monkeypatch.setattr(sys, "stdin", stream)
        assert main(["decode", "-", *options, *out]) == 1
        assert re.search(error, error_of(capsys.readouterr().err))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Truth of a short drive."""
    path = str(tmp_path_factory.mktemp("drive") / "truth.csv")
    assert main(["drive", "--as-fast-as-possible", "--seconds", "0.2", "--truth", path]) == 0
    return path


COMMANDS = {
    "fusion": ["consume", "fusion", "LOG"],
    "steer": ["consume", "steer", "LOG"],
    "check": ["consume", "check", "LOG", "--simulate"],
    "plot": ["plot", "LOG", "-o", "OUT.png"],
    "accuracy": ["accuracy", "TRUTH", "LOG"],
    "auto": ["decode", "LOG", "--dbc", "auto"],
    "restbus": ["restbus", "CONFIG", "--virtual-time"],
    "design": ["design", "--frames", "3", "--set", "LOG", "--n", "100", "--out", "OUT.dbc"],
    "camera": ["consume", "fusion", "GOOD", "--camera", "LOG"],
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("rows", "error"),
    [
        pytest.param(changed(LINES, shifted), "are whole if 0x350..0x351", id="shift"),
        pytest.param(FOREIGN, "no DBC of this package fits; take the --dbc", id="foreign"),
        pytest.param([], "has no frame", id="empty"),
    ],
)
def test_each_command_says_what_fits(
    command: str, rows: list[Row], error: str, truth: str, tmp_path: Path, capsys: Any
) -> None:
    """With status 1, and one error that names the log."""
    paths = {
        "LOG": str(written(tmp_path / "a.log", rows)),
        "GOOD": str(written(tmp_path / "good.log", LINES)),
        "TRUTH": truth,
        "CONFIG": str(tmp_path / "restbus.toml"),
    }
    config = f'[bus]\ninterface = "virtual"\n[lines]\nlog = {json.dumps(paths["LOG"])}\n'
    Path(paths["CONFIG"]).write_text(config)
    words = [
        paths.get(word, word.replace("OUT", str(tmp_path / "out"))) for word in COMMANDS[command]
    ]
    capsys.readouterr()
    assert main(words) == 1
    found = error_of(capsys.readouterr().err)
    assert error in found
    assert paths["LOG"] in found


# ---- what is no error ------------------------------------------------------------------------


def test_a_time_out_that_leaves_out_all_lines_is_no_error(tmp_path: Path, capsys: Any) -> None:
    """The frames are whole records with the default."""
    log = str(written(tmp_path / "a.log", LINES))
    for out in ([], ["-o", str(tmp_path / "lines.csv")]):
        assert main(["decode", log, "--transfer-timeout", "0.01", *out]) == 0
        err = capsys.readouterr().err
        assert "36 records are whole with the default cycle and transfer time-out" in err


def test_seconds_that_end_before_a_scene_are_no_error(tmp_path: Path, capsys: Any) -> None:
    """Of a log without a whole record they are."""
    late = [(t + 1.0, i, data) for t, i, data in LINES if i == "35C"]
    early = [row for row in LINES if row[1] != "35C"]
    log = str(written(tmp_path / "a.log", [*early, *late]))
    assert main(["consume", "steer", log, "--seconds", "0.5"]) == 0
    err = capsys.readouterr().err
    assert "no usable scene with a boundary of the ego lane in --seconds 0.5, with" in err
    assert (
        main(["consume", "steer", str(written(tmp_path / "b.log", FOREIGN)), "--seconds", "0.5"])
        == 1
    )


def test_whole_records_without_a_usable_line_are_no_error(tmp_path: Path) -> None:
    """Pose errors alone, and lines that do not fit their message."""
    poses = [row for row in LINES if row[1] == "35C"]
    assert main(["decode", str(written(tmp_path / "pose.log", poses))]) == 0
    encoder = Codec.from_dbc().encoder()
    far = MapLine(Slot.EGO_LEFT, Gaussian([300.0, 0, 0, 0], np.diag([0.05, 1e-4, 1e-8, 1e-12])))
    rows = [(1000.0, f"{one.can_id:03X}", bytes(one.data).hex()) for one in encoder.encode(far)]
    assert main(["decode", str(written(tmp_path / "far.log", rows))]) == 0


# ---- the API ---------------------------------------------------------------------------------


def test_read_lines_warns(tmp_path: Path) -> None:
    """The table is empty, and the warning names the argument."""
    log = written(tmp_path / "a.log", POSE_LINES)
    with pytest.warns(
        UserWarning,
        match=r"a\.log: no record of maplines\.dbc is whole .* take dbc=maplines-pose\.dbc",
    ):
        assert not len(ml.read_lines(log))
    with pytest.warns(UserWarning, match="has no frame"):
        assert [len(table) for table in ml.line_tables(written(log, []))] == [0]


def test_the_summary_of_a_log_is_in_each_result(tmp_path: Path, capsys: Any) -> None:
    """Remote frames are counted in the API, in a manifest, in JSON and on standard error."""
    log = tmp_path / "a.log"
    text = written(log, LINES).read_text()
    log.write_text(f"(999.9) can0 123#R\n{text}(1009.0) can0 124#R3\n")
    counts = {"remote frame": 2}
    assert ml.read_lines(log).log.skipped == {Skipped.REMOTE: 2}
    assert main(["decode", str(log), "-o", str(tmp_path / "set"), "--jobs", "1"]) == 0
    result = json.loads((tmp_path / "set" / "manifest.jsonl").read_text().splitlines()[1])
    assert (result["skipped"], result["format"], result["rows"]) == (counts, "candump", 24)
    for words in (["steer"], ["fusion"], ["check", "--simulate"]):
        assert main(["consume", *words, str(log), "--json"]) in (0, 1, 3)
        out, err = capsys.readouterr()
        assert json.loads(out.splitlines()[-1])["skipped"] in (counts, {"remote frame": 1})
        assert f"{log}: skipped: 2 remote frames" in err
    assert main(["decode", str(log)]) == 0
    assert "skipped: 2 remote frames" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(["decode", "LOG"], id="decode"),
        pytest.param(["decode", "LOG", "-o", "OUT.csv"], id="file"),
        pytest.param(["decode", "LOG", "-o", "OUT", "--jobs", "1"], id="data-set"),
        pytest.param(["decode", "LOG", "--dbc", "auto"], id="auto"),
        pytest.param(["plot", "LOG", "-o", "OUT.png"], id="plot"),
        pytest.param(["consume", "steer", "LOG"], id="steer"),
        pytest.param(["consume", "fusion", "LOG", "--camera", "LOG"], id="camera"),
        pytest.param(["accuracy", "TRUTH", "LOG"], id="accuracy"),
    ],
)
def test_the_kind_of_times_reaches_the_reader(
    words: list[str], truth: str, tmp_path: Path, capsys: Any
) -> None:
    """Of each command that reads a log: absolute times that are taken for differences fit none."""
    paths = {"LOG": str(written(tmp_path / "a.log", LINES)), "TRUTH": truth}
    words = [paths.get(word, word.replace("OUT", str(tmp_path / "out"))) for word in words]
    assert main([*words, "--times", "delta"]) == 1
    assert (
        "36 records are whole but for their time stamps; check --times" in capsys.readouterr().err
    )
