"""The directory of a study: its manifest, the results of its tasks, and its tables."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...values.errors import StudyError
from ...values.input_files import json_of


class StudyDirectory:
    """The files of one study.

    Args:
        path: created if it does not exist.
        description: everything that the result of the study depends on, as JSON values.

    Raises:
        StudyError: the directory holds another study, or other files.
    """

    def __init__(self, path: Path, description: Mapping[str, Any]) -> None:
        self.path = path
        manifest = path / "study.json"
        text = json.dumps(description, indent=2)
        #: Identifies the study.
        self.fingerprint = hashlib.sha256(text.encode()).hexdigest()[:12]
        try:
            if manifest.exists():
                _compare(manifest, json.loads(text))
            elif path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise StudyError(f"{path}: holds other things than a study; name a new directory")
            else:
                path.mkdir(parents=True, exist_ok=True)
                self.write(manifest.name, text.encode() + b"\n")
            (path / "chunks").mkdir(exist_ok=True)
        except (OSError, ValueError) as error:
            if isinstance(error, StudyError):
                raise
            raise StudyError(f"{path}: cannot be used: {error}") from error

    def write(self, name: str, content: bytes) -> None:
        """Write a file as a whole or not at all."""
        path = self.path / name
        partial = path.with_name(f".{path.name}.{os.getpid()}")
        partial.write_bytes(content)
        partial.replace(path)

    def store(self, key: str, result: Mapping[str, Any]) -> None:
        """Store the result of a task."""
        text = json.dumps(result, separators=(",", ":"))
        self.write(f"chunks/{key}.json.gz", gzip.compress(text.encode(), 6, mtime=0))

    def done(self) -> set[str]:
        """Return the keys of the tasks whose results are stored."""
        chunks = (self.path / "chunks").glob("*.json.gz")
        return {path.name.removesuffix(".json.gz") for path in chunks}

    def result(self, key: str) -> Any:
        """Return the result of a task.

        Raises:
            StudyError: its file is damaged.
        """
        path = self.path / "chunks" / f"{key}.json.gz"
        try:
            text = gzip.decompress(path.read_bytes()).decode()
            return json_of(text, path.name, ValueError)
        except (OSError, EOFError, ValueError) as error:
            raise StudyError(
                f"{path}: cannot be read ({error}); delete it and run the study again"
            ) from error


def _compare(manifest: Path, wanted: Mapping[str, Any]) -> None:
    """Raise ``StudyError`` if a manifest describes another study than the wanted one."""
    there = json_of(manifest.read_text(encoding="utf-8"), str(manifest), StudyError)
    if not isinstance(there, dict):
        raise StudyError(f"{manifest}: is not the manifest of a study")
    for key, value in wanted.items():
        if there.get(key) != value:
            raise StudyError(
                f"{manifest.parent}: holds another study: there {key} is "
                f"{json.dumps(there.get(key))}, and now {json.dumps(value)}; name another "
                "directory, or ask for the same"
            )
