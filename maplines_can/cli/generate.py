"""The command ``maplines generate``: one subcommand for what it writes."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..generation.c_build import ALL, Features, build_of
from ..generation.c_files import c_files, check_name
from ..generation.c_tables import identifier_of
from ..generation.vector_files import vector_files
from ..generation.vectors import SCHEMA
from ..maps import town_path
from ..propagation import MapError
from ..values.line import Slot
from ..values.output_files import whole_file
from ..wire import SHIPPED
from .command_line import add_command, add_group, add_json, number, option_group
from .drive_options import add_route, add_view, map_of, route_of
from .file_arguments import add_force, check_new
from .options import add_encoding, layout_from
from .sending import add_map_error, map_error_of

if TYPE_CHECKING:
    from ..generation.fmu import SentRoute
    from ..wire.layout.message_layout import Layout


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


ABOUT_C = """\
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
EXAMPLES_C = """\
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
    parser = add_command(subparsers, "c", _generate_c, ABOUT_C, EXAMPLES_C)
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
    return parser


def _generate_c(arguments: argparse.Namespace) -> int:
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


ABOUT_FMU = """\
Generate a node on a CAN bus as an FMU, for simulators and test benches: FMI 3.0 co-simulation with
the layered standard FMI-LS-BUS 1.0 for CAN, on the level of frames ("low cut").

  receiver   takes frames; gives the mean and the covariance of the line of each slot, its lateral
             position and standard deviation at some x, age and E2E state, and the lane with width
             and centre
  sender     takes lines with their covariances; gives frames at their deadlines, as "maplines send"
  sender --map
             takes a pose with its covariance, and computes from it the lines of the map along a
             route, which is chosen here: that of "maplines drive", or --route

The archive has the sources in C, what builds them, and a binary for each platform that a compiler
is here for: that of this machine, and Windows with MinGW (x86_64-w64-mingw32-gcc). docs/fmu.md
lists the variables.

The headers of FMI come from fmpy, which is in the extra "fmi": pip install -e ".[fmi]"
"""
EXAMPLES_FMU = """\
examples:
  maplines generate fmu receiver
  maplines generate fmu sender
  maplines generate fmu sender --map town.xodr --route 1..7
  maplines generate fmu receiver --dbc maplines-pose.dbc --out lane.fmu --force
  fmpy validate maplines_receiver.fmu
"""
NODES = ("receiver", "sender")


def add_fmu(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand ``fmu`` to those of ``maplines generate`` and return its parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "fmu",
        description=ABOUT_FMU,
        epilog=EXAMPLES_FMU,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("node", choices=NODES, metavar="NODE", help=", ".join(NODES))
    option_group(parser, "message").add_argument(
        "--dbc",
        default=SHIPPED[0],
        metavar="FILE",
        help=f"DBC of the messages, yours or one of {', '.join(SHIPPED)} (default: maplines.dbc)",
    )
    add_encoding(parser)
    scenario = option_group(parser, "scenario")
    scenario.add_argument(
        "--map",
        nargs="?",
        const=str(town_path()),
        metavar="FILE",
        help="map of a sender; without a file, the town of this package",
    )
    add_route(scenario)
    add_view(scenario)
    add_map_error(scenario)
    scenario.add_argument(
        "--seed",
        type=number(int, 0, 2**32),
        default=0,
        help="seed of a route chosen at random, on other maps than the town (default: 0)",
    )
    option_group(parser, "output").add_argument(
        "--out",
        metavar="FILE",
        help="name of the FMU (default: maplines_NODE.fmu; with --map, maplines_map_sender.fmu)",
    )
    add_force(parser)
    add_json(parser, "the name of the FMU, its platforms and the number of its variables")
    parser.set_defaults(run=partial(_generate_fmu, parser))
    return parser


def _generate_fmu(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    from ..generation.fmu import fmu_of, written

    _check_options(parser, arguments)
    kind = arguments.node if arguments.map is None else f"map_{arguments.node}"
    path = Path(arguments.out or f"maplines_{kind}.fmu")
    check_new(arguments, path)
    layout = layout_from(arguments.dbc, arguments.encoding)
    route = None if arguments.map is None else _route(arguments, layout)
    fmu = fmu_of(arguments.node, layout, route)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        part.write_bytes(written(fmu))
    figures = {
        "file": str(path),
        "platforms": list(fmu.platforms),
        "variables": len(fmu.variables),
    }
    if route is not None:
        figures |= {
            "route_m": round(route.lines.path.length, 3),
            "sections": len(route.lines.starts),
        }
    if arguments.json:
        print(json.dumps(figures, indent=2))
    else:
        platforms = ", ".join(fmu.platforms) or "none: there is no C compiler here"
        print(f"{path}\nbinaries for {platforms}")
        if route is not None:
            length = 1e-3 * route.lines.path.length
            print(
                f"lines of {route.name} along {length:.2f} km, {len(route.lines.starts)} sections"
            )
    return 0


def _check_options(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Check that the options of a map come with one.

    Raises:
        ValueError: they do not.
    """
    if arguments.map is not None and arguments.node != "sender":
        raise ValueError("--map is of a sender: a receiver takes frames, and needs no map")
    for name in ("route", "lines", "window", "map_error", "max_sigma", "seed"):
        if arguments.map is None and getattr(arguments, name) != parser.get_default(name):
            option = "--" + name.replace("_", "-")
            raise ValueError(f"{option} is of a sender with a map; add --map FILE")


def _route(arguments: argparse.Namespace, layout: Layout) -> SentRoute:
    """Return the lines along a route that the options ask for."""
    from ..generation.fmu import SentRoute

    road_map = map_of(arguments.map)
    return SentRoute(
        road_map.name,
        road_map.along(route_of(road_map, arguments)),
        [slot for slot in tuple(Slot)[: arguments.lines] if slot in layout.messages],
        tuple(arguments.window),
        map_error_of(arguments) or MapError(),
        arguments.max_sigma,
    )


ABOUT_VECTORS = """\
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
EXAMPLES_VECTORS = """\
examples:
  maplines generate c --out ecu
  maplines generate vectors --out ecu
  cd ecu && cc -std=c99 -ffp-contract=off run_vectors.c maplines.c maplines_dbc.c -lm -o run_vectors
  ./run_vectors maplines.txt
"""


def add_vectors(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand ``vectors`` to those of ``maplines generate`` and return its parser."""
    parser = add_command(subparsers, "vectors", _generate_vectors, ABOUT_VECTORS, EXAMPLES_VECTORS)
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
    return parser


def _generate_vectors(arguments: argparse.Namespace) -> int:
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


#: Subcommands, with one line of help.
GENERATORS = {
    "c": (add_c, "the C core with the tables of a DBC: a sender and a receiver in an ECU"),
    "fmu": (add_fmu, "a receiver or a sender as an FMU, for simulators"),
    "vectors": (add_vectors, "frames and the lines that they are, for any other receiver"),
}
DESCRIPTION = "Generate from a DBC what an ECU needs: one subcommand for each."


def add_generate(commands: Any) -> None:
    """Add the command ``generate`` with its subcommands."""
    example = "maplines generate c --dbc maplines.dbc --out ecu"
    add_group(commands, "generate", DESCRIPTION, "what", GENERATORS, example)
