"""The files of the test vectors of a DBC, with their schema and a runner in C."""

from __future__ import annotations

import hashlib
from pathlib import Path, PurePath

from ..wire.layout.message_layout import Layout
from .c_build import ALL, Features, build_of
from .c_files import core_folder
from .line_cases import LineCases
from .scene_cases import SceneCases
from .vectors import SCHEMA, Case, Vectors, vectors_of


def vector_files(layout: Layout, name: str, features: Features = ALL) -> dict[str, str]:
    """Return the files of the vectors of a DBC by their names.

    Args:
        layout: of the DBC.
        name: of its tables in C.
        features: of the receiver.

    Raises:
        LayoutError: the DBC has no C, or needs a feature that is left out; see ``build_of``.
        MissingExtraError: it has authenticated messages, and cryptography is not installed.
    """
    vectors = vectors_from(layout, features)
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


def vectors_from(layout: Layout, features: Features = ALL) -> Vectors:
    """Return the vectors of a DBC file for a receiver with these features."""
    build_of({"": layout}, features)  # it has C
    digest = hashlib.sha256(Path(layout.source).read_bytes()).hexdigest()
    return vectors_of(cases_of(layout, features), PurePath(layout.source).name, digest)


def cases_of(layout: Layout, features: Features = ALL) -> list[Case]:
    """Return the cases of a DBC for a receiver with these features, always the same ones.

    Raises:
        MissingExtraError: the DBC has authenticated messages, and cryptography is not installed.
    """
    cases = LineCases(layout, features) if layout.scene is None else SceneCases(layout, features)
    return [*cases.all()]
