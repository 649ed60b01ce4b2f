"""Secret keys from where they are kept: a file or the environment, and never a command line."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path

from ..errors import KeyMaterialError
from ..wire import Key

__all__ = ["key_from_env", "key_from_file"]


def key_from_file(path: str | Path, key_id: int = 1) -> Key:
    """A key from a file that holds its 32 or 64 hex digits and nothing else.

    Raises:
        KeyMaterialError: the file cannot be read, others may read it too, or it holds no key.
        MissingExtraError: the package cryptography is not installed.
    """
    path = Path(path)
    _refuse_a_key(path.name, "a file")
    try:
        mode = path.stat().st_mode
        if os.name != "nt" and mode & stat.S_IROTH:  # elsewhere the mode says nothing
            raise KeyMaterialError(
                f"{path}: everybody on this machine may read the key (mode "
                f"{stat.S_IMODE(mode):04o}); chmod 600 {path}, and make a new key if that was so "
                "for long"
            )
        return Key.from_hex(path.read_bytes().decode("ascii", "replace"), key_id, str(path))
    except OSError as error:
        raise KeyMaterialError(f"{path}: cannot be read: {error.strerror or error}") from error


def key_from_env(name: str, key_id: int = 1) -> Key:
    """A key from an environment variable that holds its 32 or 64 hex digits.

    Raises:
        KeyMaterialError: there is no such variable, or it holds no key.
        MissingExtraError: the package cryptography is not installed.
    """
    _refuse_a_key(name, "an environment variable")
    if name not in os.environ:
        raise KeyMaterialError(f"environment variable {name} is not set; it must hold the key")
    return Key.from_hex(os.environ[name], key_id, f"environment variable {name}")


def _refuse_a_key(name: str, place: str) -> None:
    if re.fullmatch("(?:[0-9A-Fa-f]{2}){8,}", name):  # and do not repeat it in the error
        del name
        raise KeyMaterialError(
            f"what should name {place} looks like a key itself; put the key into {place}, name "
            "that, and make a new key: others may have seen this one"
        )
