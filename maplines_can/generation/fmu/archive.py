"""An FMU as a zip file: descriptions, sources, and what the compilers here make of them.

The same DBC and the same compilers give the same bytes.
"""

from __future__ import annotations

import hashlib
import io
import re
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from importlib import util
from pathlib import Path, PurePath
from typing import NamedTuple

from ...values.errors import LayoutError, missing_extra
from ...wire.layout.message_layout import Layout
from ..c_build import roomy_build
from ..c_files import core_folder, headers, propagation_sources, source
from ..c_tables import tables_of
from . import variables as code
from .compilers import binaries
from .node_variables import (
    CHECKS,
    POSITIONS,
    LeftOut,
    controller_rows,
    line_rows,
    pose_rows,
    receiver_rows,
    sender_rows,
)
from .route import SentRoute, route_source
from .variables import Row, Variable, variables_of
from .xml_files import BUS, build_description, manifest, model_description, terminals

#: C files of each node, besides the core and the tables of the DBC.
COMMON = ("fmu.h", "bus.h", "bus.c", "fmi3.c", "access.c", "unsupported.c", "controller.c")
SENDER = ("sender.c", "tx_queue.h", "tx_queue.c")
OWN = {
    "receiver": ("receiver.h", "receiver.c"),
    "sender": ("sender.h", *SENDER, "line_input.c"),
    "map_sender": ("sender.h", *SENDER, "pose_input.c", "route.h"),
}
#: Headers of FMI 3.0, which fmpy has.
HEADERS = ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h")
#: Time of the files in the archive: the first that zip has.
EPOCH = (1980, 1, 1, 0, 0, 0)
#: Name of the tables in C.
TABLES = "maplines"


class Fmu(NamedTuple):
    """An FMU that is not written yet."""

    identifier: str
    files: Mapping[str, bytes]  #: by their names in the archive
    variables: Sequence[Variable]
    platforms: Sequence[str]  #: with a binary, such as x86_64-linux


def fmu_of(node: str, layout: Layout, route: SentRoute | None = None) -> Fmu:
    """Return the FMU of a receiver or a sender of the messages of a DBC.

    Args:
        node: "receiver" or "sender".
        layout: of the DBC.
        route: lines of a map, for a sender that takes poses; None for one that takes lines.

    Raises:
        LayoutError: the DBC has no C; the message has the cure.
        MissingExtraError: fmpy is not installed.
        OSError: a compiler fails.
    """
    check(node, layout)
    kind = kind_of(node, route)
    identifier = identifier_of(kind)
    variables = described(variables_of(rows_of(node, layout, route)), layout)
    sources, token = sources_of(node, layout, route)
    version = re.findall(r'#define MAPLINES_VERSION "(.+)"', sources["maplines.h"])[0]
    about = f"{ABOUT[kind]}, by the messages of {PurePath(layout.source).name}"
    about += f", along a route on {route.name}" if route else ""
    compiled = sorted(name for name in sources if name.endswith(".c"))
    built = binaries(identifier, sources, compiled)
    files = {
        "modelDescription.xml": model_description(identifier, about, version, token, variables),
        "terminalsAndIcons/terminalsAndIcons.xml": terminals(),
        f"extra/{BUS}/fmi-ls-manifest.xml": manifest(),
        "sources/buildDescription.xml": build_description(identifier, compiled),
        **{f"sources/{name}": text.encode() for name, text in sources.items()},
        **{f"binaries/{name}": binary for name, binary in built.items()},
    }
    return Fmu(identifier, files, variables, [name.partition("/")[0] for name in built])


def kind_of(node: str, route: SentRoute | None) -> str:
    """Return the kind of a node: "receiver", "sender", or "map_sender"."""
    return node if route is None else f"map_{node}"


def identifier_of(kind: str) -> str:
    """Return the model identifier of a kind of node."""
    return f"maplines_{kind}"


def check(node: str, layout: Layout) -> None:
    """Check that the messages of a DBC are for a node without keys, which gives or takes lines.

    Raises:
        LayoutError: they are not.
    """
    if not any(own.can_id or own.fd_can_id for own in layout.messages_of.values()):
        raise LayoutError(
            f"{layout.source}: all messages are authenticated, and an FMU has no keys; use a DBC "
            "with messages that are not, such as maplines.dbc"
        )
    if node == "sender" and layout.is_conditional:
        kind = "conditional on the pose error" if layout.scene is None else "whole scenes"
        raise LayoutError(
            f"{layout.source}: its records are {kind}, and this sender takes lines one by one; use "
            "a DBC with complete records, such as maplines.dbc"
        )


ABOUT = {
    "receiver": "Lines of a digital map with their uncertainty, received from a CAN bus",
    "sender": "Lines of a digital map with their uncertainty, sent on a CAN bus",
    "map_sender": "Lines around a pose of a car, computed with their uncertainty from a digital "
    "map, and sent on a CAN bus",
}


def rows_of(node: str, layout: Layout, route: SentRoute | None = None) -> list[Row]:
    """Return the variables of a node."""
    has_fd = any(messages.fd_can_id is not None for messages in layout.messages_of.values())
    rows = controller_rows(2_000_000 if has_fd else 0)
    if node == "receiver":
        return rows + receiver_rows()
    own = (
        line_rows() if route is None else pose_rows(route.window, route.map_error, route.max_sigma)
    )
    return rows + sender_rows(layout) + own


def described(variables: Sequence[Variable], layout: Layout) -> list[Variable]:
    """Return the variables that a DBC gives a meaning: of its slots, scenes and messages."""
    return [each for each in variables if _has_meaning(each, layout)]


def _has_meaning(variable: Variable, layout: Layout) -> bool:
    if variable.slot is not None and variable.slot not in layout.slots:
        return False
    start, _, end = variable.name.partition(".")
    if variable.row.choices is LeftOut or start in ("SCENE", "SCENE2"):
        return layout.scene is not None and (
            variable.slot is not None or start.lower() in layout.messages_of
        )
    if variable.slot is not None and end in CHECKS:  # of a message that has one line
        return layout.scene is None
    return layout.pose is not None or start not in ("scene", "lane")


def sources_of(
    node: str, layout: Layout, route: SentRoute | None = None
) -> tuple[dict[str, str], str]:
    """Return the C files of a node with the headers of FMI, and the instantiation token.

    The token is a hash of what the files contain.
    """
    build = roomy_build(layout)
    tables = tables_of(layout, TABLES, build)
    folder = core_folder() / "fmu"
    sources = {
        **headers(build),
        "maplines.c": source(build, "static" if route is None else ""),
        f"{TABLES}_dbc.h": tables.header,
        f"{TABLES}_dbc.c": tables.source,
    }
    own = OWN[kind_of(node, route)]
    for name in (*COMMON, *own):
        sources[name] = (folder / name).read_text(encoding="utf-8")
    sources["node.h"] = sources.pop(own[0])
    if route is not None:
        sources |= propagation_sources() | {"route.c": route_source(route)}
    for name in HEADERS:
        sources[name] = (_fmpy() / "c-code" / name).read_text(encoding="utf-8")
    listed = variables_of(rows_of(node, layout, route))
    declared = [text for name, text in sources.items() if name.endswith(".h")]
    declared.append(code.header(listed, len(POSITIONS), "", TABLES))
    sources["names.h"] = names_header(identifier_of(kind_of(node, route)), declared)
    digest = hashlib.sha256(code.source(listed, "").encode())
    for name, text in sorted(sources.items()):
        digest.update(f"{name}\n{text}\n".encode())
    token = _token(digest.digest())
    sources["variables.h"] = code.header(listed, len(POSITIONS), token, TABLES)
    sources["variables.c"] = code.source(listed, token)
    for name in sources:
        if name.endswith(".c"):
            sources[name] = '#include "names.h"\n' + sources[name]
    return sources, token


def _fmpy() -> Path:
    """Return the folder of fmpy."""
    found = util.find_spec("fmpy")
    if found is None or found.origin is None:
        raise missing_extra("the headers of FMI come from fmpy", "fmi")
    return Path(found.origin).parent


def _token(digest: bytes) -> str:
    """Return an instantiation token in the form of a GUID."""
    text = digest.hex()
    return f"{{{text[:8]}-{text[8:12]}-{text[12:16]}-{text[16:20]}-{text[20:32]}}}"


def written(fmu: Fmu) -> bytes:
    """Return an FMU as a zip file."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in sorted(fmu.files, key=lambda name: (name != "modelDescription.xml", name)):
            info = zipfile.ZipInfo(name, EPOCH)
            info.compress_type = zipfile.ZIP_DEFLATED
            info.create_system = 3
            info.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(info, fmu.files[name], compresslevel=6)
    return stream.getvalue()


_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_FUNCTION = re.compile(r"\b(maplines_\w+)(?=\()")
_CONSTANT = re.compile(r"\bextern const [\w ]+?\b(maplines_\w+)(?=[;\[])")
_MACRO = re.compile(r"^#define (maplines_\w+)", re.MULTILINE)


def names_header(identifier: str, headers: Iterable[str]) -> str:
    """Return ``names.h``, which each source includes first.

    Args:
        identifier: of the model.
        headers: all that declare functions and constants; those that they define as macros have a
            prefix by these, from ``MAPLINES_NAMESPACE``.
    """
    text = _COMMENT.sub("", "\n".join(headers))
    names = {*_FUNCTION.findall(text), *_CONSTANT.findall(text)} - {*_MACRO.findall(text)}
    defined = "".join(f"#define {name} MAPLINES_PREFIXED({name})\n" for name in sorted(names))
    return HEADER.format(identifier=identifier, names=defined)


HEADER = """\
/* Global names of this FMU: all begin with a prefix, so that several FMUs can be in one program.
 *
 * It is that of the functions of FMI, by the macros of fmi3Functions.h. A shared library is
 * compiled with FMI3_OVERRIDE_FUNCTION_PREFIX: functions of FMI have no prefix then, and the others
 * have the model identifier.
 */
#ifndef MAPLINES_NAMES_H
#define MAPLINES_NAMES_H

#ifndef FMI3_FUNCTION_PREFIX
#define FMI3_FUNCTION_PREFIX {identifier}_
#endif
#ifndef FMI3_OVERRIDE_FUNCTION_PREFIX
#define MAPLINES_NAMESPACE FMI3_FUNCTION_PREFIX
#elif defined(FMI3_ACTUAL_FUNCTION_PREFIX)
#define MAPLINES_NAMESPACE FMI3_ACTUAL_FUNCTION_PREFIX
#else
#define MAPLINES_NAMESPACE {identifier}_
#endif
#define MAPLINES_PREFIXED(name) MAPLINES_PREFIXED_BY(MAPLINES_NAMESPACE, name)
#define MAPLINES_PREFIXED_BY(prefix, name) MAPLINES_WITH_PREFIX(prefix, name)
#define MAPLINES_WITH_PREFIX(prefix, name) prefix##name

{names}
#endif
"""
