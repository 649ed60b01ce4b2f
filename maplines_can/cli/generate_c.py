"""The subcommand ``maplines generate c``."""

from __future__ import annotations

import argparse
from typing import Any

from ..generation.c_files import c_files
from ..generation.tables import identifier_of
from ..wire import SHIPPED
from ..wire.tables import limits_of
from .generated_files import add_out, check_new_files, write_files
from .options import add_encoding, layout_from
from .parsing import option_group

__all__ = ["add_c"]

ABOUT = """\
Generate C for an ECU from a DBC: a sender and a receiver of its lines, in C99, without allocation
and without dependencies but the C library.

  maplines.h         the interface; its first comment is the manual
  maplines.c         the core: the same for each DBC
  NAME_dbc.h, .c     the constant NAME_dbc with all bits, factors and CAN IDs of the DBC
  CMakeLists.txt     a static library of them, for CMake and pkg-config

Payloads, decoded numbers, reasons and states are those of the Python package to the last bit, if
the compiler fuses no multiplication with an addition: give gcc and clang -ffp-contract=off.

The files depend on the DBC and on the version of this package only: the same DBC gives the same
files. maplines.h sets the sizes of its structures for the DBC. With several DBCs in one program,
give --dbc for each of them in one call, so that the sizes suffice for all.
"""
EXAMPLES = """\
examples:
  maplines generate c
  cc -std=c99 -O2 -ffp-contract=off -c maplines.c maplines_dbc.c
  maplines generate c --dbc maplines-pose.dbc --out ecu
  maplines generate c --dbc short.dbc --name lines --out ecu --force
  maplines generate c --dbc maplines.dbc --dbc maplines-pose.dbc --out both
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
    add_out(parser, "the names of the files and the limits")
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
    files = c_files(layouts)
    check_new_files(arguments, files)
    write_files(arguments, files, {"limits": limits_of(list(layouts.values()))._asdict()})
    return 0
