"""The folder of generated files: its options, and writing to it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ..values.output_files import whole_file
from .overwriting import add_force, check_new
from .parsing import add_json, option_group


def add_out(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``--out``, ``--force``, and ``--json``, which prints this."""
    option_group(parser, "output").add_argument(
        "--out",
        default=".",
        metavar="DIR",
        help="folder of the files, which is made if there is none (default: this folder)",
    )
    add_force(parser)
    add_json(parser, what)


def check_new_files(arguments: argparse.Namespace, names: Iterable[str]) -> None:
    """Check that no file of these names is in the folder, unless ``--force`` is given.

    Raises:
        ValueError: there is one.
    """
    check_new(arguments, *(Path(arguments.out) / name for name in names))


def write_files(
    arguments: argparse.Namespace, files: Mapping[str, str], figures: Mapping[str, Any]
) -> None:
    """Write files to the folder, and print their names, with ``--json`` also the figures."""
    folder = Path(arguments.out)
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        with whole_file(folder / name) as part:
            part.write_text(text, encoding="utf-8", newline="\n")
    paths = [str(folder / name) for name in files]
    print(json.dumps({"files": paths, **figures}, indent=2) if arguments.json else "\n".join(paths))
