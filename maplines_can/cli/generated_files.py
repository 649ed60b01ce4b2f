"""The folder of generated files: its options, and writing to it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ..generation.c_build import ALL, Features
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


def add_features(parser: argparse.ArgumentParser, *, sides: bool) -> None:
    """Add the options of what a library in C has; ``features_from`` reads them.

    Args:
        parser: of the command.
        sides: it may have only one side, a receiver or a sender.
    """
    add = parser.add_argument_group("library").add_argument
    if sides:
        add("--receiver", action="store_true", help="only a receiver (default: and a sender)")
        add("--sender", action="store_true", help="only a sender (default: and a receiver)")
    add("--no-scenes", action="store_true", help="no lines with the error of their pose")
    add("--no-mixtures", action="store_true", help="lines of several Gaussians are dropped")
    add("--no-secoc", action="store_true", help="no authenticated frames")
    add(
        "--slots",
        type=int,
        default=ALL.slots,
        metavar="N",
        help="the first N lines: 1 is EGO_LEFT, 2 adds EGO_RIGHT, 4 NEXT_LEFT and NEXT_RIGHT "
        "(default: 8, all)",
    )
    add("--float", action="store_true", help="a receiver computes with float, not with double")


def features_from(arguments: argparse.Namespace) -> Features:
    """Return what the options of ``add_features`` ask for."""
    receiver, sender = (getattr(arguments, side, False) for side in ("receiver", "sender"))
    return Features(
        receiver=receiver or not sender,
        sender=sender or not receiver,
        scenes=not arguments.no_scenes,
        mixtures=not arguments.no_mixtures,
        secoc=not arguments.no_secoc,
        slots=arguments.slots,
        single=arguments.float,
    )


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
