"""The subcommand ``maplines generate c``."""

from __future__ import annotations

import argparse
from typing import Any

from ..generation.c_build import build_of
from ..generation.c_files import c_files
from ..generation.c_tables import identifier_of
from ..wire import SHIPPED
from .generated_files import add_features, add_out, check_new_files, features_from, write_files
from .options import add_encoding, layout_from
from .parsing import option_group

__all__ = ["add_c"]

ABOUT = """\
Generate C for an ECU from a DBC: a sender and a receiver of its lines, in C99, without allocation
and without dependencies but the C library.

  maplines.h         the interface; its first comment is the manual. It includes maplines_build.h
                     and maplines_state.h
  maplines.c         the core: the same for each DBC
  NAME_dbc.h, .c     the constant NAME_dbc with all bits, factors and CAN IDs of the DBC
  CMakeLists.txt     a static library of them, for CMake and pkg-config

Payloads, decoded numbers, reasons and states are those of the Python package to the last bit, if
the compiler fuses no multiplication with an addition: give gcc and clang -ffp-contract=off.

The files depend on the DBC and on the version of this package only: the same DBC gives the same
files. maplines.h sets the sizes of its structures for the DBC. With several DBCs in one program,
give --dbc for each of them in one call, so that the sizes suffice for all.

Leave out what the program does not need: --receiver --no-scenes --no-mixtures --slots 4 is the
smallest receiver, of a quarter of the code and a twelfth of the memory; one of maplines-scene.dbc
has the least memory. A receiver remembers the records of two lines of the most components, and
twice as many as may be lost in a row. So a duplicate that comes later than that is STALE and not
DUPLICATE, as Python has it.
"""
EXAMPLES = """\
examples:
  maplines generate c
  cc -std=c99 -O2 -ffp-contract=off -c maplines.c maplines_dbc.c
  maplines generate c --dbc maplines-pose.dbc --out ecu
  maplines generate c --dbc short.dbc --name lines --out ecu --force
  maplines generate c --dbc maplines.dbc --dbc maplines-pose.dbc --out both
  maplines generate c --receiver --no-scenes --no-mixtures --slots 4 --float --out small
"""


def add_c(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand ``c`` to those of ``maplines generate`` and return its parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "c",
        description=ABOUT,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = option_group(parser, "message").add_argument
    add(
        "--dbc",
        action="append",
        dest="dbcs",
        metavar="FILE",
        help="DBC of the messages, yours or one of "
        f"{', '.join(SHIPPED)}; may be given several times (default: maplines.dbc)",
    )
    add_encoding(parser)
    add(
        "--name",
        action="append",
        dest="names",
        metavar="NAME",
        help="name of the tables, NAME_dbc; with several DBCs, one for each (default: that of the "
        "file, such as maplines_pose of maplines-pose.dbc)",
    )
    add_features(parser, sides=True)
    add_out(parser, "the names of the files, the features and the sizes")
    parser.set_defaults(run=_run)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    dbcs = arguments.dbcs or [SHIPPED[0]]
    names = arguments.names or [identifier_of(dbc) for dbc in dbcs]
    if len(names) != len(dbcs) or len({name.lower() for name in names}) != len(names):
        raise ValueError(
            f"--name must give each DBC a name of its own, got {', '.join(names)} for "
            f"{', '.join(dbcs)}; give --name as many times as --dbc"
        )
    layouts = {
        name: layout_from(dbc, arguments.encoding) for name, dbc in zip(names, dbcs, strict=True)
    }
    features = features_from(arguments)
    files = c_files(layouts, features)
    check_new_files(arguments, files)
    write_files(arguments, files, {"build": build_of(layouts, features)._asdict()})
    return 0
