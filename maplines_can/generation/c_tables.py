"""Tables of a DBC as C: the constant ``maplines_dbc_t`` that the core in ``c/`` works with."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from enum import IntEnum
from pathlib import PurePath
from typing import NamedTuple

import numpy as np

from ..wire.core_tables import Members, Value, limits_of
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import OwnerNumber
from ..wire.layout.signal import Signal, place_of
from .c_build import Build, build_of


class Tables(NamedTuple):
    """Tables of a DBC as C files."""

    header: str  #: NAME_dbc.h
    source: str  #: NAME_dbc.c


def identifier_of(dbc: str) -> str:
    """Return the start of the names of the tables of a DBC file.

    >>> identifier_of("dbc/maplines-pose.dbc"), identifier_of("3.dbc")
    ('maplines_pose', 'dbc_3')
    """
    name = re.sub(r"\W", "_", PurePath(dbc).stem, flags=re.ASCII)
    return name if name[:1].isalpha() else f"dbc_{name.lstrip('_')}"


def tables_of(layout: Layout, name: str = "maplines", build: Build | None = None) -> Tables:
    """Return the tables of a DBC: the constant ``<name>_dbc``.

    They do not depend on the folder of the DBC or on the machine.

    Args:
        layout: of the DBC.
        name: start of the names.
        build: of the library; that of this DBC with all features if there is none.

    Raises:
        LayoutError: the DBC has no C; see ``check``.
    """
    build = build_of({name: layout}) if build is None else build
    limits, content = limits_of([layout]), build.content(layout)
    if build.max_components == 1:  # mixtures are refused, not held
        limits = limits._replace(components=1)
    scales = list(dict.fromkeys(map(_scale, _signals(content))))
    guard = f"{name.upper()}_DBC_H"
    header = [
        "/* Tables of a DBC for maplines.h, written by maplines generate c. */",
        f"#ifndef {guard}",
        f"#define {guard}",
        "",
        '#include "maplines.h"',
        "",
        "#ifdef __cplusplus",
        'extern "C" {',
        "#endif",
        "",
        "/* The build is in its name, too: files that do not agree on it do not link. */",
        f"#define {name}_dbc MAPLINES_NAME({name}_dbc)",
        f"extern const maplines_dbc_t {name}_dbc;",
        "",
        "#ifdef __cplusplus",
        "}",
        "#endif",
        "",
        "#endif",
    ]
    source = [
        "/* Tables of a DBC for maplines.h, written by maplines generate c.",
        " *",
        " * A scale is {factor, offset}, a signal {scale, first, length, is_motorola, is_signed}.",
        " */",
        f'#include "{name}_dbc.h"',
        "",
        "/* An array of negative size is an error: maplines.h is that of another DBC. */",
        *(
            f"typedef char {name}_dbc_{limit}[MAPLINES_MAX_{limit.upper()} >= {value} ? 1 : -1];"
            for limit, value in limits._asdict().items()
        ),
        "",
        *_straight(content),
        "static const maplines_scale_t scales[] = {",
        *(f"    {{{_literal(factor)}, {_literal(offset)}}}," for factor, offset in scales),
        "};",
        "",
        f"const maplines_dbc_t {name}_dbc =",
        *_initializer(content, scales),
    ]
    source[-1] += ";"
    return Tables("\n".join([*header, ""]), "\n".join([*source, ""]))


def _straight(content: Mapping[str, Value]) -> Iterator[str]:
    """Yield the table of the covariances of a straight line, for the search for levels."""
    if isinstance(table := content.get("straight"), np.ndarray):
        yield "static const float straight[][11] = {"
        for row in table.tolist():
            yield f"    {{{', '.join(f'{_literal(value)}f' for value in row)}}},"
        yield from ("};", "")


def _signals(members: Members) -> Iterator[Signal]:
    """Yield all signals, in their order."""
    for value in members.values():
        if isinstance(value, Signal):
            yield value
        elif isinstance(value, Mapping):
            yield from _signals(value)


def _scale(signal: Signal) -> tuple[float, float]:
    """Return the values of ``maplines_scale_t``."""
    return float(signal.factor), float(signal.offset)


def _initializer(members: Members, scales: list[tuple[float, float]]) -> Iterator[str]:
    """Yield the lines of an initializer, whose signals have these scales."""
    yield "{"
    for key, value in members.items():
        name = _designator(key)
        if isinstance(value, Mapping) and all(type(one) is int for one in value.values()):
            yield f"    {name} = {{{', '.join(map(_literal, value.values()))}}},"
        elif isinstance(value, Mapping):
            yield f"    {name} ="
            *lines, last = _initializer(value, scales)
            yield from (f"    {line}" for line in [*lines, f"{last},"])
        elif isinstance(value, Signal):
            place = ", ".join(map(_literal, place_of(value).values()))
            scale = scales.index(_scale(value))
            yield f"    {name} = {{&scales[{scale}], {place}}}, // {value.name}"
        elif value is not None:
            yield f"    {name} = {_literal(value)},"
    yield "}"


def _designator(key: object) -> str:
    """Return the designator of a member, of an owner or of an index."""
    if isinstance(key, OwnerNumber) and key.name != "POSE":
        return f"[MAPLINES_{key.name} - MAPLINES_FIRST_OWNER]"
    if isinstance(key, IntEnum):
        return f"[MAPLINES_{key.name}]"
    return f".{key}" if isinstance(key, str) else f"[{key}]"


def _literal(value: object) -> str:
    """Return a number, a truth value, a text or the name of a table as C."""
    if isinstance(value, np.ndarray):
        return "straight"
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return re.sub(r"\.?0*p", "p", value.hex(), count=1)
    return str(value)


def _string(text: str) -> str:
    """Return a text as a string literal; what is not plain ASCII as octal numbers."""
    plain = [
        chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\?' else f"\\{byte:03o}"
        for byte in text.encode(errors="replace")
    ]
    return f'"{"".join(plain)}"'
