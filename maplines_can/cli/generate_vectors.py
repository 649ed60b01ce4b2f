"""The subcommand ``maplines generate vectors``."""

from __future__ import annotations

import argparse
import json
from typing import Any

from ..generation.c_files import check_name
from ..generation.c_tables import identifier_of
from ..generation.vector_files import vector_files
from ..generation.vectors import SCHEMA
from ..wire import SHIPPED
from .generated_files import add_features, add_out, check_new_files, features_from, write_files
from .options import add_encoding, layout_from
from .parsing import option_group

__all__ = ["add_vectors"]

ABOUT = """\
Generate test vectors from a DBC: frames with their times of reception, and what a receiver makes of
them. Whoever writes a receiver from the DBC proves it with them.

  NAME.json             the cases: frames, then the reason or the lines; the mean and the covariance
                        of a line, its lateral position and standard deviation at 0, 20, 40, 80 m,
                        its status and age; E2E states, counters, scenes. Each number is given in
                        decimal and, exact, in hexadecimal
  vectors.schema.json   describes NAME.json
  NAME.txt              the same, one step a line, for a program without a JSON library
  run_vectors.c         runs NAME.txt through the receiver of "maplines generate c", and says which
                        cases fail: a template for other receivers
  aes_cmac.h            for the authenticated messages of a DBC

There are cases for both ends of each signal, random bits, each reason that the DBC can have, each
status and each E2E state. The same DBC gives the same files. They have the hash of the DBC and that
of the cases, which is the hash of all lines of NAME.txt after the one that states it. For a library
that lacks something, give the options of "maplines generate c" here, too: there are no cases for
what it has not.

A DBC with authenticated messages, such as maplines-pose.dbc and maplines-secoc.dbc, needs the extra
secoc of this package (cryptography).
"""
EXAMPLES = """\
examples:
  maplines generate c --out ecu
  maplines generate vectors --out ecu
  cd ecu && cc -std=c99 -ffp-contract=off run_vectors.c maplines.c maplines_dbc.c -lm -o run_vectors
  ./run_vectors maplines.txt
"""


def add_vectors(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand ``vectors`` to those of ``maplines generate`` and return its parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "vectors",
        description=ABOUT,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = option_group(parser, "message").add_argument
    add(
        "--dbc",
        default=SHIPPED[0],
        metavar="FILE",
        help=f"DBC of the messages, yours or one of {', '.join(SHIPPED)} (default: maplines.dbc)",
    )
    add_encoding(parser)
    add(
        "--name",
        metavar="NAME",
        help="name of the files and of the tables in C, as with 'maplines generate c' (default: "
        "that of the DBC)",
    )
    add_features(parser, sides=False)
    add_out(parser, "the names of the files, the number of cases and the hashes")
    parser.set_defaults(run=_run)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    name = arguments.name or identifier_of(arguments.dbc)
    check_name(name)
    layout = layout_from(arguments.dbc, arguments.encoding)
    names = (f"{name}.json", SCHEMA, f"{name}.txt", "run_vectors.c", "aes_cmac.h")
    check_new_files(arguments, names)
    files = vector_files(layout, name, features_from(arguments))
    content = json.loads(files[f"{name}.json"])
    figures = {"cases": len(content["cases"]), "dbc": content["dbc"], "sha256": content["sha256"]}
    write_files(arguments, files, figures)
    return 0
