"""Files in the user's cache: what is expensive to compute again, and may be lost at any time.

Nothing here raises an error of the system: without a home, or with one that cannot be written,
there is no cache.
"""

from __future__ import annotations

import os
import stat
import sys
from contextlib import suppress
from pathlib import Path

from .output_files import whole_file

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
