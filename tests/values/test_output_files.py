"""Files are whole, or not there; an error has the name and the reason."""

import errno
import os
from pathlib import Path

import pytest

from maplines_can.values.errors import LogError
from maplines_can.values.output_files import whole_file, writing

FULL = OSError(errno.ENOSPC, "a library says so in its own words")


def test_a_file_gets_its_name_at_the_end(tmp_path: Path) -> None:
    """Nothing else is left; a link still names the file that it named."""
    path, link = tmp_path / "a.csv", tmp_path / "link.csv"
    link.symlink_to(path)
    with whole_file(link) as part:
        part.write_text("t,y\n")
        assert not path.exists()
    assert (link.is_symlink(), path.read_text()) == (True, "t,y\n")
    assert sorted(tmp_path.iterdir()) == [path, link]


@pytest.mark.parametrize("before", [None, "old"])
@pytest.mark.parametrize("error", [FULL, KeyboardInterrupt(), ValueError("x")])
def test_a_failure_leaves_what_was_there(
    error: BaseException, before: str | None, tmp_path: Path
) -> None:
    """An error of the system gets the name of the file."""
    path = tmp_path / "a.csv"
    if before is not None:
        path.write_text(before)
    with pytest.raises(type(error)) as caught, whole_file(path) as part:  # noqa: PT012
        part.write_text("half")
        raise error
    assert [*tmp_path.iterdir()] == ([] if before is None else [path])
    assert before is None or path.read_text() == before
    if error is FULL:
        assert str(caught.value) == f"[Errno 28] {os.strerror(errno.ENOSPC)}: '{path}'"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux")
def test_a_device_is_written_to(tmp_path: Path) -> None:
    """It is not replaced by a file."""
    link = tmp_path / "full.csv"
    link.symlink_to("/dev/full")
    with (
        pytest.raises(OSError, match=r"No space left on device: '.*full\.csv'"),
        whole_file(link) as part,
    ):
        part.write_text("t,y\n")
    assert Path("/dev/full").is_char_device()
    with whole_file("/dev/null") as part:
        part.write_text("t,y\n")
    assert Path("/dev/null").is_char_device()


def test_a_half_written_file_is_set_aside(tmp_path: Path) -> None:
    """It is closed; the message says where it is."""
    path, closed = tmp_path / "a.log", []
    path.write_text("half")
    text = f"{path}: cannot be written: No space left on device; what was written before is in "
    with (
        pytest.raises(LogError, match=f"^{text}{path}.part$"),
        writing(path, LogError, lambda: closed.append(1)),
    ):
        raise FULL
    assert (closed, [*tmp_path.iterdir()]) == ([1], [tmp_path / "a.log.part"])
