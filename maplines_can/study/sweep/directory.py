"""The directory of a study: what it is, what is done of it, and its tables."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...errors import StudyError
from .tasks import unpacked

__all__ = ["StudyDirectory"]


class StudyDirectory:
    """The files of one study: what it is, what is done of it, and its tables.

    Args:
        path: is made where it is not there.
        description: of the study, all that its result depends on.

    Raises:
        StudyError: the directory holds another study, or other things.
    """

    MANIFEST = "study.json"

    def __init__(self, path: Path, description: Mapping[str, Any]) -> None:
        self.path = path
        self._results = path / "chunks"
        description = json.loads(json.dumps(description))  # as it is read back
        manifest = path / self.MANIFEST
        try:
            if manifest.exists():
                self._compare(json.loads(manifest.read_text(encoding="utf-8")), description)
            elif path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise StudyError(f"{path}: holds other things than a study; name a new directory")
            self._results.mkdir(parents=True, exist_ok=True)
            if not manifest.exists():
                self.write(self.MANIFEST, json.dumps(description, indent=2).encode() + b"\n")
        except (OSError, ValueError) as error:
            if isinstance(error, StudyError):
                raise
            raise StudyError(f"{path}: cannot be used: {error}") from error
        digest = hashlib.sha256(json.dumps(description, sort_keys=True).encode())
        #: Tells this study from all others.
        self.fingerprint = digest.hexdigest()[:12]

    def _compare(self, there: Any, wanted: Mapping[str, Any]) -> None:
        if not isinstance(there, dict):
            raise StudyError(f"{self.path / self.MANIFEST}: is no manifest of a study")
        differing = [key for key in wanted if there.get(key) != wanted[key]]
        if differing:
            key = differing[0]
            raise StudyError(
                f"{self.path}: holds another study: there {key} is {json.dumps(there.get(key))}, "
                f"and now {json.dumps(wanted[key])}; name another directory, or ask for the same"
            )

    def write(self, name: str, content: bytes) -> None:
        """A file that is there as a whole or not at all."""
        path = self.path / name
        partial = path.with_name(f".{path.name}.{os.getpid()}")
        partial.write_bytes(content)
        partial.replace(path)

    def store(self, key: str, content: bytes) -> None:
        """Keep the result of a task."""
        self.write(f"chunks/{key}.json.gz", content)

    def done(self) -> set[str]:
        """The tasks whose results are there."""
        return {path.name.removesuffix(".json.gz") for path in self._results.glob("*.json.gz")}

    def result(self, key: str) -> Any:
        """The result of a task.

        Raises:
            StudyError: its file is damaged.
        """
        path = self._results / f"{key}.json.gz"
        try:
            return unpacked(path.read_bytes())
        except (OSError, EOFError, ValueError) as error:
            raise StudyError(
                f"{path}: cannot be read ({error}); delete it and run the study again"
            ) from error
