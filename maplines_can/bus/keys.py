"""Read secret keys from a file or the environment, and keep them out of messages."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path

from ..values.errors import KeyMaterialError
from ..wire import Key

#: Text that may be a key or a part of one: 16 or more hex digits with at most one separator
#: between two of them. The first two are adjacent, so that the last letter of a word before the key
#: is not taken for its first digit.
KEY_LIKE = re.compile(r"[0-9A-Fa-f]{2}(?:[^0-9A-Za-z/\\]?[0-9A-Fa-f]){14,}")
#: Most bytes of a file of a key, which has 64 digits and perhaps blanks.
MAX_FILE = 1024


def key_from_file(path: str | Path, key_id: int = 1) -> Key:
    """Return the key in a file that holds its 32 or 64 hex digits and nothing else.

    If the path is a key by mistake, the error does not repeat it. For the key ID see ``Key``.

    Raises:
        KeyMaterialError: the file cannot be read, is readable by everybody, or holds no key.
        MissingExtraError: the package cryptography is not installed.
    """
    try:
        if not isinstance(path, str | Path):
            raise KeyMaterialError(f"path must be a str or a Path, got a {type(path).__name__}")
        path = Path(path)
        if "\0" in str(path):
            raise KeyMaterialError("path has a NUL character, so it is not that of a file")
        if KEY_LIKE.search(path.name) and not os.path.exists(path):
            raise KeyMaterialError(_TYPED.format("a file"))
        if path.is_dir():
            raise KeyMaterialError(f"{path}: is a directory, not the file of a key")
        mode = path.stat().st_mode
        if os.name != "nt" and mode & stat.S_IROTH:  # the mode means nothing on Windows
            raise KeyMaterialError(
                f"{path}: everybody on this machine may read the key (mode "
                f"{stat.S_IMODE(mode):04o}); chmod 600 {path}, and make a new key if others may "
                "have read this one"
            )
        with path.open("rb") as file:
            content = file.read(MAX_FILE + 1)
        if len(content) > MAX_FILE:
            raise KeyMaterialError(
                f"{path}: is no file of a key: it has more than {MAX_FILE} bytes"
            )
        return Key.from_hex(content.decode("ascii", "replace"), key_id, str(path))
    except OSError as error:
        raise KeyMaterialError(f"{path}: cannot be read: {error.strerror or error}") from error
    finally:
        content = b""
        del path, key_id, content  # a traceback may show the locals


def key_from_env(name: str, key_id: int = 1) -> Key:
    """Return the key in an environment variable that holds its 32 or 64 hex digits.

    If the name is a key by mistake, the error does not repeat it.

    Raises:
        KeyMaterialError: the variable is not set, or holds no key.
        MissingExtraError: the package cryptography is not installed.
    """
    try:
        if not isinstance(name, str):
            raise KeyMaterialError(f"name must be a str, got a {type(name).__name__}")
        if name in os.environ:
            return Key.from_hex(os.environ[name], key_id, f"environment variable {name}")
        if KEY_LIKE.search(name):
            raise KeyMaterialError(_TYPED.format("an environment variable"))
        raise KeyMaterialError(f"environment variable {name} is not set; it must hold the key")
    finally:
        del name, key_id  # a traceback may show the locals


def without_keys(text: str) -> str:
    """Return the text with everything that may be a key hidden.

    >>> without_keys("unrecognized arguments: --keyfile 00112233-44556677 --rate 10")
    'unrecognized arguments: --keyfile (hidden) --rate 10'
    """
    return KEY_LIKE.sub("(hidden)", text)


_TYPED = (
    "the name of {0} was expected, but this looks like a key itself; put the key into {0}, give "
    "the name, and make a new key: others may have seen this one"
)
