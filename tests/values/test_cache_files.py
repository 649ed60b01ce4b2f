"""The user's cache: never an error, never a foreign file, never more than its bounds."""

import os
import sys
from pathlib import Path

import pytest

from maplines_can.values import output_files
from maplines_can.values.output_files import cache_folder, read_cached, write_cached


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a cache of its own."""
    path = tmp_path / "cache" / "maplines_can"
    monkeypatch.setattr(output_files, "cache_folder", lambda: path)
    return path


@pytest.mark.parametrize(
    ("platform", "variables", "path"),
    [
        pytest.param("linux", {"HOME": "/home/a"}, "/home/a/.cache", id="linux"),
        pytest.param("linux", {"HOME": "/a", "XDG_CACHE_HOME": "/b"}, "/b", id="linux-xdg"),
        pytest.param("linux", {"HOME": "/a", "XDG_CACHE_HOME": "b"}, None, id="linux-relative"),
        pytest.param("darwin", {"HOME": "/Users/a"}, "/Users/a/Library/Caches", id="macos"),
        pytest.param("win32", {"LOCALAPPDATA": "/c/Local"}, "/c/Local", id="windows"),
        pytest.param("win32", {}, None, id="windows-without"),
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="paths of POSIX")
def test_the_folder_is_that_of_the_platform(
    platform: str, variables: dict[str, str], path: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the XDG base directory specification says, and as applications of the others do."""
    for name in ("HOME", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", platform)

    assert cache_folder() == (None if path is None else Path(path, "maplines_can"))


def test_a_text_is_read_again(folder: Path) -> None:
    """Its file is in a folder that only the user can read; nothing else is left there."""
    assert read_cached("a.json") == ""

    write_cached("a.json", "ä")

    assert read_cached("a.json") == "ä"
    assert [path.name for path in folder.iterdir()] == ["a.json"]
    if sys.platform != "win32":
        assert folder.stat().st_mode & 0o077 == 0


def test_the_oldest_files_are_removed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the cache is bounded; and a text that is too long is not written."""
    monkeypatch.setattr(output_files, "MAX_FILES", 2)
    monkeypatch.setattr(output_files, "MAX_BYTES", 10)
    for t, name in enumerate("abc"):
        write_cached(name, name)
        if t < 2:
            os.utime(folder / name, (t, t))
    write_cached("d", 11 * "d")

    assert {"b", "c"} == {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("what", ["file", "link", "directory", "no UTF-8"])
def test_what_is_no_cache_is_no_error(what: str, tmp_path: Path, folder: Path) -> None:
    """A file instead of the folder; a link, a folder or other bytes instead of the file."""
    (tmp_path / "text").write_text("foreign")
    if what == "file":
        folder.parent.write_text("")
    else:
        folder.mkdir(parents=True)
        if what == "link":
            (folder / "a").symlink_to(tmp_path / "text")
        elif what == "no UTF-8":
            (folder / "a").write_bytes(b"\xff")
        else:
            (folder / "a").mkdir()

    assert read_cached("a") == ""
    write_cached("b", "b")


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="needs owners of files")
def test_a_file_of_another_user_is_not_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as one that root or another user has put there."""
    write_cached("a", "a")
    uid = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: uid)

    assert read_cached("a") == ""


def test_without_a_place_there_is_no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is written, such as to a folder named ~."""
    monkeypatch.setattr(output_files, "cache_folder", lambda: None)
    write_cached("a", "a")

    assert read_cached("a") == ""
