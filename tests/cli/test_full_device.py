"""Commands whose output has no room: one line, status 1, and no half file of the name."""

import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from support.recordings import record

from maplines_can.bus import LogWriter
from maplines_can.cli import main
from maplines_can.recordings.formats import SUFFIXES
from maplines_can.restbus.config import EXAMPLE
from maplines_can.values.errors import LogError
from maplines_can.wire import Frame

NO_ROOM = "cannot be written: File too large"
LOGS = (".log", ".asc", ".blf", ".mf4")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("drive") / "drive.log", seconds=4.0)


@contextmanager
def file_limit(size: int) -> Iterator[None]:
    """Let no file grow beyond a size [byte]: the error is that of a full device."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def needs(suffix: str) -> None:
    package = {".mf4": "asammdf", ".rosbag2": "rosbags", ".osi.mcap": "osi3"}.get(suffix)
    if package is not None and not find_spec(package):
        pytest.skip(f"needs {package}")


@pytest.mark.parametrize("size", [0, 5000])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_table_without_room(
    suffix: str, size: int, log: Path, tmp_path: Path, capsys: Any
) -> None:
    """No file is left, and one that was there stays."""
    needs(suffix)
    out = tmp_path / f"lines{suffix}"
    out.write_text("old")
    with file_limit(size):
        assert main(["decode", str(log), "-o", str(out), "--force"]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == f"maplines: error: {out}: {NO_ROOM}"
    assert [*tmp_path.iterdir()] == [out]
    assert out.read_text() == "old"


@pytest.mark.parametrize("name", ["plot.png", "plot.html"])
def test_a_plot_without_room(name: str, log: Path, tmp_path: Path, capsys: Any) -> None:
    """So a picture and a page."""
    out = tmp_path / name
    with file_limit(5000):
        assert main(["plot", str(log), "-o", str(out)]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == f"maplines: error: {out}: {NO_ROOM}"
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize("size", [0, 5000])
@pytest.mark.parametrize("suffix", LOGS)
def test_a_recording_without_room(suffix: str, size: int, tmp_path: Path, capsys: Any) -> None:
    """The restbus ends with an error, however little is written when it ends."""
    needs(suffix)
    out = tmp_path / f"restbus{suffix}"
    words = [str(EXAMPLE), "--virtual-time", "--seconds", "3", "--record", str(out)]
    if suffix == ".mf4" and size == 0:
        pytest.skip("asammdf has no room for a file of its own")
    with file_limit(size):
        assert main(["restbus", *words]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.splitlines()[-1] == (
        f"maplines: error: {out}: {NO_ROOM}; what was written before is in {out}.part"
    )
    assert [*tmp_path.iterdir()] == [tmp_path / f"restbus{suffix}.part"]


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
def test_a_log_goes_on_to_raise(suffix: str, tmp_path: Path) -> None:
    """Whoever drops the error of a frame gets it again."""
    path = tmp_path / f"a{suffix}"
    log = LogWriter(path, start=0.0)
    refused = 0
    with file_limit(100):
        for k in range(20_000):
            try:
                log.write(Frame(0x100, bytes(8)), 1 + k / 1e3)
            except LogError:
                refused += 1
    assert 0 < refused == 20_000 - log.frames
    with pytest.raises(LogError, match=NO_ROOM):
        log.close()


FULL = Path("/dev/full")


def run(words: str, redirected: str) -> tuple[int, str]:
    """Run a command in a shell; return its status, and what is on standard error."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command = f"{sys.executable} -m maplines_can.cli {words} {redirected}"
    done = subprocess.run(  # noqa: S602 - of this test
        command, shell=True, capture_output=True, text=True, check=False, env=environment
    )
    return done.returncode, done.stderr


@pytest.mark.skipif(not FULL.exists(), reason="needs Linux")
@pytest.mark.parametrize("words", ["--version", "decode --help", "scenarios", "decode {log}"])
def test_standard_output_without_room(words: str, log: Path) -> None:
    """Help, a few lines that Python writes at the end only, and many."""
    status, printed = run(words.format(log=log), f">{FULL}")
    assert status == 1
    assert printed.splitlines()[-1] == (
        "maplines: error: standard output: cannot be written: No space left on device"
    )
    assert "Exception" not in printed


def test_a_reader_that_has_ended_is_no_error(log: Path) -> None:
    """So with ``head``, and if standard output was closed before the start."""
    for redirected in ("| true", ">&-"):
        assert run(f"decode {log}", redirected)[0] == 0
    assert run("scenarios", ">&- 2>&-") == (0, "")
