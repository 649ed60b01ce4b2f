"""Files that a command writes: one that exists is replaced only with ``--force``."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parsing import option_group


def add_force(parser: argparse.ArgumentParser) -> None:
    """Add ``--force``, for ``check_new``."""
    option_group(parser, "output").add_argument(
        "--force",
        action="store_true",
        help="replace files that exist (default: end with an error before anything is written)",
    )


def check_new(arguments: argparse.Namespace, *paths: str | Path | None) -> None:
    """Check that no file to be written exists, unless ``--force`` is given.

    Commands call this before their work, which may take long.

    Args:
        arguments: with those of ``add_force``.
        paths: of the files; None for one that is not wanted.

    Raises:
        ValueError: a file exists.
    """
    if arguments.force:
        return
    for path in paths:
        if path is not None and Path(path).exists():
            raise ValueError(
                f"{path} exists already; use another name, or --force to replace the file"
            )
