"""Files that are written: whole under their names, or not at all; and files in the user's cache.

The cache has what is expensive to compute again, and may be lost at any time. Nothing of it raises
an error of the system: without a home, or with one that cannot be written, there is no cache.
"""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path


def temporary_path(path: Path) -> Path:
    """Return where a file is written until it is whole: beside it.

    What is no file, such as a device, is written to directly.
    """
    if path.exists() and not path.is_file():
        return path
    return path.with_name(f".{path.name}.{os.getpid()}.part")


def write_error(error: OSError, path: str | PathLike[str]) -> OSError:
    """Return an error in writing with the name of the file, and the reason of the system alone.

    One that is not of the system, without a number, is returned as it is.

    >>> print(write_error(OSError(28, "a library could not write"), "drive.csv"))
    [Errno 28] No space left on device: 'drive.csv'
    """
    if error.errno is None:
        return error
    return OSError(error.errno, os.strerror(error.errno), os.fspath(path))


@contextmanager
def whole_file(path: str | PathLike[str]) -> Iterator[Path]:
    r"""Yield a temporary path of a file, which gets its name at the end.

    Raises:
        OSError: it cannot be written. A file that was there before stays as it was.

    >>> with whole_file(tmp / "drive.csv") as path:  # doctest: +SKIP
    ...     path.write_text("t,y\n")
    """
    final = Path(path).resolve()  # a link stays one
    part = temporary_path(final)
    try:
        yield part
        if part != final:
            part.replace(final)
    except OSError as error:
        raise write_error(error, path) from None
    finally:
        if part != final:
            with suppress(OSError):
                part.unlink(missing_ok=True)


@contextmanager
def writing(path: Path, kind: type[Exception], close: Callable[[], object]) -> Iterator[None]:
    """Write to an open file; if that fails, close and rename it, so that no half one has its name.

    Args:
        path: of the file.
        kind: type of the error.
        close: closes it.

    Raises:
        kind: the file cannot be written to; the message has its name and the reason.
    """
    try:
        yield
    except OSError as error:
        left = ""
        with suppress(OSError):
            close()
        if path.is_file():
            with suppress(OSError):
                left = f"; what was written before is in {path.replace(f'{path}.part')}"
        reason = write_error(error, path).strerror or error
        raise kind(f"{path}: cannot be written: {reason}{left}") from error


#: Most files of the cache, of which the oldest are removed; most bytes of each.
MAX_FILES, MAX_BYTES = 64, 1 << 20


def cache_folder() -> Path | None:
    """Return the folder of this package in the user's cache; None if there is no such place."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA", "")
    elif sys.platform == "darwin":
        base = "~/Library/Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    path = os.path.expanduser(base)  # "~" if there is no home; Path.expanduser would raise
    return Path(path, "maplines_can") if os.path.isabs(path) else None


def read_cached(name: str) -> str:
    """Return the text of a file; empty if there is none, or it is not a file of this user."""
    if (folder := cache_folder()) is None:
        return ""
    with suppress(OSError, ValueError):
        found = (folder / name).lstat()
        owner = os.getuid() if hasattr(os, "getuid") else found.st_uid
        if stat.S_ISREG(found.st_mode) and found.st_uid == owner and found.st_size <= MAX_BYTES:
            return (folder / name).read_text(encoding="utf-8")
    return ""


def write_cached(name: str, text: str) -> None:
    """Write the text of a file, which appears as a whole; if it cannot be written, do nothing."""
    if (folder := cache_folder()) is None or len(text.encode()) > MAX_BYTES:
        return
    with suppress(OSError, ValueError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with whole_file(folder / name) as path:
            path.write_text(text, encoding="utf-8")
        by_age = sorted(folder.iterdir(), key=lambda path: path.lstat().st_mtime_ns, reverse=True)
        for path in by_age[MAX_FILES:]:
            path.unlink(missing_ok=True)
