"""Tables of a DBC in C: the constant ``maplines_dbc_t`` that the core in ``c/`` works with."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import PurePath
from typing import NamedTuple

import numpy as np

from ..values.errors import LayoutError
from ..values.line import Slot
from ..wire.covariance import CholeskyCode
from ..wire.covariance.scene_code import SceneCode
from ..wire.layout.message_layout import PAGE, POSE_CONDITIONAL, TRANSFER_ID, Layout
from ..wire.layout.pose_layout import POSE, Owner, PoseLayout
from ..wire.layout.record_layout import RecordLayout, bits_of
from ..wire.layout.signals import (
    FINE,
    FINE_SIGNALS,
    OCTAVE,
    PAGE_BYTES,
    PARAMETER_SIGNALS,
    POSE_ROWS,
    Signal,
    slot_title,
)
from ..wire.layout.slot_messages import RecordMessages

#: Codes of the covariance that the core in C has.
C_CODES = (CholeskyCode.name, POSE_CONDITIONAL)
#: Most bits of a counter in C.
MAX_COUNTER_BITS = 32
#: Most bits of a signal of the mean with its finer one: both together are an int64_t.
MAX_MEAN_BITS = 62


class Limits(NamedTuple):
    """What sets the sizes of the structures in C: ``MAPLINES_MAX_PAGES`` and so on."""

    pages: int  #: of a record
    transfer_ids: int
    components: int  #: of a mixture

    @property
    def macros(self) -> dict[str, int]:
        """The limits by the names of their macros."""
        return {f"MAPLINES_MAX_{name.upper()}": value for name, value in self._asdict().items()}


#: Largest limits of a DBC that has C.
MAX_LIMITS = Limits(pages=16, transfer_ids=256, components=64)


class Tables(NamedTuple):
    """Tables of a DBC as C files."""

    header: str  #: NAME_dbc.h
    source: str  #: NAME_dbc.c


def limits_of(layouts: Sequence[Layout]) -> Limits:
    """Return the least limits that suffice for all of these DBCs.

    Raises:
        LayoutError: a DBC has no C; see ``check``.
    """
    for layout in layouts:
        check(layout)
    return Limits(*map(max, zip(*map(_own_limits, layouts), strict=True)))


def check(layout: Layout) -> None:
    """Check that there is C for a DBC.

    Raises:
        LayoutError: its covariance code has no C, or it has more pages, transfer IDs, components
            or counters than the C can hold.
    """
    if layout.covariance_code not in C_CODES:
        raise LayoutError(
            f"{layout.source}: the covariance code {layout.covariance_code!r} has no C, only "
            f"{' and '.join(C_CODES)} have; generate C for a DBC with one of these, such as "
            "maplines.dbc"
        )
    for record in _records(layout):
        if record.pages > MAX_LIMITS.pages:
            raise LayoutError(
                f"{layout.source}: a record has {record.pages} pages, but in C it has at most "
                f"{MAX_LIMITS.pages}; shorten its signals"
            )
        _check_bits(record, f"{TRANSFER_ID}0", MAX_LIMITS.transfer_ids.bit_length() - 1)
        _check_bits(record, "Counter", MAX_COUNTER_BITS)
        if len({bit // (8 * PAGE_BYTES) for bit in bits_of(record["Counter"])}) > 1:
            raise record.error(record["Counter"], "to be within a page to have C", "move it")
    if layout.is_conditional:
        for name in PARAMETER_SIGNALS:  # an encoder adds the steps of the finer signal
            _check_bits(layout, name, MAX_MEAN_BITS - layout[f"{name}{FINE}"].length)
    else:
        _check_bits(layout, "ComponentCount", MAX_LIMITS.components.bit_length() - 1)


def identifier_of(dbc: str) -> str:
    """Return the start of the names of the tables of a DBC file.

    >>> identifier_of("dbc/maplines-pose.dbc"), identifier_of("3.dbc")
    ('maplines_pose', 'dbc_3')
    """
    name = re.sub(r"\W", "_", PurePath(dbc).stem, flags=re.ASCII)
    return name if name[:1].isalpha() else f"dbc_{name.lstrip('_')}"


def tables_of(layout: Layout, name: str = "maplines") -> Tables:
    """Return the tables of a DBC: the constant ``<name>_dbc``.

    They do not depend on the folder of the DBC or on the machine.

    Raises:
        LayoutError: the DBC has no C; see ``check``.
    """
    limits = limits_of([layout])
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
        " * A signal is {factor, offset, raw_min, raw_max, first, length, is_motorola, is_signed}.",
        " */",
        f'#include "{name}_dbc.h"',
        "",
        "/* An array of negative size is an error: maplines.h is that of another DBC. */",
        *(
            f"typedef char {name}_dbc_{limit}[MAPLINES_MAX_{limit.upper()} >= {value} ? 1 : -1];"
            for limit, value in limits._asdict().items()
        ),
        "",
        *_straight(layout),
        f"const maplines_dbc_t {name}_dbc =",
        *_initializer(_content(layout, limits)),
    ]
    source[-1] += ";"
    return Tables("\n".join([*header, ""]), "\n".join([*source, ""]))


# ---- what the tables hold ---------------------------------------------------------------------

#: Initializer of an array or a structure, by ``[index]`` or ``.member``; None is left out.
Members = Mapping[str, "Value"]
Value = Members | Signal | bool | int | float | str | None


def _content(layout: Layout, limits: Limits) -> Members:
    """Return the members of ``maplines_dbc_t``."""
    pose = layout.pose
    content: dict[str, Value] = {
        ".name": _string(PurePath(layout.source).name),
        ".max_components": limits.components,
        ".is_conditional": layout.is_conditional,
        ".has_pose": pose is not None,
        ".messages": {
            _index(owner): _messages(messages) for owner, messages in layout.messages_of.items()
        },
        ".line": _record(layout),
        ".pose": None if pose is None else _record(pose),
        ".mean": _array(layout[name] for name in PARAMETER_SIGNALS),
        **{f".{member}": layout[name] for member, name in _SIGNALS.items()},
        ".covariance": _cholesky(CholeskyCode(layout)),
    }
    own = _CONDITIONAL_SIGNALS if layout.is_conditional else _COMPLETE_SIGNALS
    content |= {f".{member}": layout[name] for member, name in own.items()}
    if layout.is_conditional:
        content[".fine"] = _array(layout[name] for name in FINE_SIGNALS)
        content[".levels"] = _levels(layout, "")
    if pose is not None:
        content |= _pose_content(pose)
        searched = SceneCode(pose, layout).levels.searched
        content |= {
            ".spacings": len(searched),
            ".spacing_step": int(np.diff(searched[:2], append=searched[:1] + 1)[0]),
            ".straight": "straight",
        }
    return content


def _straight(layout: Layout) -> Iterator[str]:
    """Yield the table of the covariances of a straight line, for the search for levels."""
    if layout.pose is not None:
        yield "static const float straight[][11] = {"
        for row in SceneCode(layout.pose, layout).levels.straight.T.tolist():
            yield f"    {{{', '.join(f'{_literal(value)}f' for value in row)}}},"
        yield from ("};", "")


_SIGNALS = {"kind": "Kind", "x_min": "XMin", "x_max": "XMax"}
_COMPLETE_SIGNALS = {
    "status": "Status",
    "age": "Age",
    "component_index": "ComponentIndex",
    "component_count": "ComponentCount",
    "component_weight": "ComponentWeight",
}
_CONDITIONAL_SIGNALS = {"has_covariance": "HasCovariance"}
_POSE_SIGNALS = {
    "pose_age": "Age",
    "correlation_time": "CorrelationTime",
    "map_offset": "MapOffset",
    "map_heading": "MapHeading",
}
_LEVELS = {
    "lateral": "OwnLateral",
    "points": "OwnPoints",
    "shape": "OwnShape",
    "quartic": "Quartic",
    "fit_behind": "FitBehind",
    "fit_ahead": "FitAhead",
}


def _pose_content(pose: PoseLayout) -> Members:
    """Return the members of ``maplines_dbc_t`` of the records of the pose error."""
    slots = [slot for slot in pose.counters if f"{slot_title(slot)}OwnShape" in pose.signals]
    return {
        **{f".{member}": pose[name] for member, name in _POSE_SIGNALS.items()},
        ".pose_covariance": _cholesky(CholeskyCode(pose, POSE_ROWS)),
        ".slot_counter": {_index(slot): signal for slot, signal in pose.counters.items()},
        ".slot_levels": {_index(slot): _levels(pose, slot_title(slot)) for slot in slots} or None,
    }


def _record(layout: Layout | PoseLayout) -> Members:
    """Return the members of ``maplines_record_t``."""
    secured = layout.secured
    later = f"{TRANSFER_ID}1"
    return {
        ".pages": layout.pages,
        ".short_pages": layout.short_pages,
        ".crc_byte": layout.crc_offset,
        ".fd_authentic": secured.authentic_bytes if secured else 0,
        ".fd_freshness": secured.freshness_bytes if secured else 0,
        ".fd_mac": secured.mac_bytes if secured else 0,
        ".page": layout[f"{PAGE}0"],
        ".transfer_id": {
            "[0]": layout[f"{TRANSFER_ID}0"],
            "[1]": _in_page(layout[later]) if later in layout.signals else None,
        },
        ".counter": layout["Counter"],
    }


def _messages(messages: RecordMessages) -> Members:
    """Return the members of ``maplines_messages_t``."""
    return {
        ".is_present": True,
        ".has_classic": messages.can_id is not None,
        ".has_fd": messages.fd_can_id is not None,
        ".has_secured": messages.secured_can_id is not None,
        ".is_extended": messages.is_extended,
        ".fd_is_extended": messages.fd_is_extended,
        ".secured_is_extended": messages.secured_is_extended,
        ".fd_length": messages.fd_length,
        ".data_id": messages.data_id,
        ".secured_data_id": messages.secured_data_id,
        ".can_id": messages.can_id,
        ".fd_can_id": messages.fd_can_id,
        ".secured_can_id": messages.secured_can_id,
        ".cycle_ms": messages.cycle_ms,
    }


def _cholesky(code: CholeskyCode) -> Members:
    """Return the members of ``maplines_cholesky_t``."""
    factor = code.factor
    return {
        ".rows": len(factor.order),
        ".order": f"{{{', '.join(map(str, factor.order))}}}",
        ".pivot": _array(factor.pivots),
        ".ratio": _array(chain(*factor.ratios)),
        ".inflation": code.inflation,
        ".reachable": _array(map(float, code.reachable)),
    }


def _levels(layout: RecordLayout, prefix: str) -> Members:
    """Return the members of ``maplines_levels_t``."""
    signals = {member: layout.signals.get(prefix + name) for member, name in _LEVELS.items()}
    return {
        **{f".{member}": signal for member, signal in signals.items()},
        ".shape_is_octave": layout[f"{prefix}OwnShape"].unit == OCTAVE,
    }


def _records(layout: Layout) -> list[Layout | PoseLayout]:
    return [layout] if layout.pose is None else [layout, layout.pose]


def _own_limits(layout: Layout) -> Limits:
    records = _records(layout)
    return Limits(
        pages=max(record.pages for record in records),
        transfer_ids=2 ** max(record[f"{TRANSFER_ID}0"].length for record in records),
        components=1 if layout.is_conditional else 2 ** layout["ComponentCount"].length,
    )


def _check_bits(layout: RecordLayout, name: str, most: int) -> None:
    """Raise LayoutError if a signal is longer than the C can hold."""
    if (signal := layout[name]).length > most:
        raise layout.error(signal, f"at most {most} bits to have C", "shorten it")


def _in_page(signal: Signal) -> Signal:
    """Return a signal of a later page with its place in the page."""
    page = signal.start // (8 * PAGE_BYTES)
    return Signal(**{**vars(signal), "start": signal.start - 8 * PAGE_BYTES * page})


# ---- as text ----------------------------------------------------------------------------------


def _initializer(members: Members, indent: str = "") -> Iterator[str]:
    """Yield the lines of an initializer."""
    yield f"{indent}{{"
    for name, value in members.items():
        if isinstance(value, Mapping):
            yield f"{indent}    {name} ="
            *lines, last = _initializer(value, f"{indent}    ")
            yield from [*lines, f"{last},"]
        elif isinstance(value, Signal):
            yield f"{indent}    {name} = {_signal(value)}, // {value.name}"
        elif value is not None:
            yield f"{indent}    {name} = {_literal(value)},"
    yield f"{indent}}}"


def _array(values: Iterable[Value]) -> Members:
    return {f"[{i}]": value for i, value in enumerate(values)}


def _index(owner: Owner) -> str:
    """Return the designator of an owner: a slot or the pose error."""
    return "[MAPLINES_POSE]" if owner == POSE else f"[MAPLINES_{Slot(owner).name}]"


def _signal(signal: Signal) -> str:
    """Return the initializer of ``maplines_signal_t``."""
    first = signal.start
    if signal.big_endian:
        first = first // 8 * 8 + 7 - first % 8
    numbers = [signal.factor, signal.offset, signal.raw_min, signal.raw_max, first, signal.length]
    values = [*map(_literal, numbers), _literal(signal.big_endian), _literal(signal.signed)]
    return f"{{{', '.join(values)}}}"


def _literal(value: float | str) -> str:
    """Return a number, a truth value or a literal as C."""
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
