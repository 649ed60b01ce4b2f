"""The files of the test vectors of a DBC, with their schema and a runner in C."""

from __future__ import annotations

import hashlib
from pathlib import Path, PurePath

from ..wire.layout.message_layout import Layout
from ..wire.tables import check
from .c_files import core_folder
from .vector_cases import cases_of
from .vectors import SCHEMA, Vectors, vectors_of


def vector_files(layout: Layout, name: str) -> dict[str, str]:
    """Return the files of the vectors of a DBC by their names; ``name`` is that of its tables.

    Raises:
        LayoutError: the DBC has no C; see ``tables.check``.
        MissingExtraError: it has authenticated messages, and cryptography is not installed.
    """
    vectors = vectors_from(layout)
    tests = core_folder() / "tests"
    runner = (tests / "run_vectors.c").read_text(encoding="utf-8")
    return {
        f"{name}.json": vectors.json,
        SCHEMA: (tests / "vectors" / SCHEMA).read_text(encoding="utf-8"),
        f"{name}.txt": vectors.text,
        "run_vectors.c": runner.replace("harness_dbc", f"{name}_dbc")
        .replace("my.", f"{name}.")
        .replace("my_dbc", f"{name}_dbc"),
        "aes_cmac.h": (tests / "aes_cmac.h").read_text(encoding="utf-8"),
    }


def vectors_from(layout: Layout) -> Vectors:
    """Return the vectors of a DBC file."""
    check(layout)
    digest = hashlib.sha256(Path(layout.source).read_bytes()).hexdigest()
    return vectors_of(cases_of(layout), PurePath(layout.source).name, digest)
