"""Tables of a DBC for the core: the members of ``maplines_dbc_t``, and which DBCs it can hold."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import chain, count
from pathlib import PurePath
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core import ffi, lib
from ..core.memory import pointer, pointers, structure
from ..values.elementary import exp2
from ..values.errors import LayoutError
from ..values.line import Slot
from .layout.cholesky import CholeskyCode
from .layout.message_layout import POSE_CONDITIONAL, WHOLE_SCENE, Layout
from .layout.pose_layout import SCENES, PoseLayout, number_of
from .layout.record_layout import RecordLayout, bits_of
from .layout.record_signals import (
    FINE,
    FINE_SIGNALS,
    OCTAVE,
    PAGE,
    PAGE_BYTES,
    PARAMETER_SIGNALS,
    POSE_ROWS,
    SLOT,
    TRANSFER_ID,
    Signal,
    slot_title,
)
from .layout.scene_layout import SceneLayout
from .layout.signal import place_of
from .layout.slot_messages import RecordMessages

#: Covariance codes of the core, by their names in the DBC's attribute CovarianceCode.
CODES = (CholeskyCode.name, POSE_CONDITIONAL, WHOLE_SCENE)
#: Order of the rows of the covariance of a line of a whole scene.
ORDER = ("C1", "C0", "YOff", "Beta")
#: Most bits of a counter in C.
MAX_COUNTER_BITS = 32
#: Most spacings that an encoder of scenes searches, and ratios of the shape to the points.
MAX_SPACINGS, SHAPE_RATIOS = 256, 6
#: Most bits of a signal of the mean with its finer one: both together are an int64_t.
MAX_MEAN_BITS = 62
#: Most values of a signal whose powers of 2 are tabled: 512 kB.
MAX_TABLE = 1 << 16


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


def limits_of(layouts: Sequence[Layout]) -> Limits:
    """Return the least limits that suffice for all of these DBCs.

    Raises:
        LayoutError: a DBC has no C; see ``check``.
    """
    for layout in layouts:
        check(layout)
    return Limits(*map(max, zip(*map(_own_limits, layouts), strict=True)))


def check_code(layout: Layout) -> None:
    """Check that the core has the covariance code of a DBC.

    Raises:
        LayoutError: it has not.
    """
    if layout.covariance_code not in CODES:
        raise LayoutError(
            f"{layout.source}: the covariance code {layout.covariance_code!r} is none of the core, "
            f"which has {' and '.join(CODES)}; take a DBC with one of these, such as maplines.dbc, "
            "or for the codes of the study maplines_can.study.comparison.codec_for"
        )


def check(layout: Layout) -> None:
    """Check that there is C for a DBC.

    Raises:
        LayoutError: its covariance code has no C, or it has more pages, transfer IDs, components
            or counters than the C can hold.
    """
    check_code(layout)
    _check_sizes(layout)


def _check_sizes(layout: Layout) -> None:
    """Raise LayoutError if a DBC has more of something than the C can hold."""
    for record in _records(layout):
        if record.pages > MAX_LIMITS.pages:
            raise LayoutError(
                f"{layout.source}: a record has {record.pages} pages, but in C it has at most "
                f"{MAX_LIMITS.pages}; shorten its signals"
            )
        _check_bits(record, "Counter", MAX_COUNTER_BITS)
        if not record.pages:
            continue
        _check_bits(record, f"{TRANSFER_ID}0", MAX_LIMITS.transfer_ids.bit_length() - 1)
        if len({bit // (8 * PAGE_BYTES) for bit in bits_of(record["Counter"])}) > 1:
            raise record.error(record["Counter"], "to be within a page to have C", "move it")
    if layout.covariance_code == POSE_CONDITIONAL:
        for name in PARAMETER_SIGNALS:  # an encoder adds the steps of the finer signal
            _check_bits(layout, name, MAX_MEAN_BITS - layout[f"{name}{FINE}"].length)
    elif not layout.is_conditional:
        _check_bits(layout, "ComponentCount", MAX_LIMITS.components.bit_length() - 1)


# ---- what the tables hold ---------------------------------------------------------------------

#: Values of a structure by member, or of an array by index. None is left out: 0 in C.
Members: TypeAlias = Mapping[Any, "Value"]
Value: TypeAlias = Members | Signal | NDArray[np.float64] | bool | int | float | str | None


def tables_of(layout: Layout) -> Any:
    """Return the tables of a DBC, a ``maplines_dbc_t *``.

    If the core does not have the covariance code of the DBC, decoded covariances mean nothing.

    Raises:
        LayoutError: the core cannot hold the DBC; see ``check``.
    """
    tables = structure("maplines_dbc_t", _plain(content_of(layout)))
    if not lib.maplines_check_tables(tables):
        raise LayoutError(f"{layout.source}: the core takes its tables for those of no DBC")
    return tables


class LineTables(NamedTuple):
    """What the core needs for complete records. Powers of 2 are pointers to a table of each pivot,
    by row, and of the inflation; NULL for a signal of more than MAX_TABLE values.
    """

    dbc: Any  #: ``maplines_dbc_t *``
    variance_powers: Any
    sigma_powers: Any  #: the same, but for the inflation: its square roots

    @classmethod
    def of(cls, layout: Layout) -> LineTables:
        """Return the tables of a DBC, for whole scenes without powers; raises as ``tables_of``."""
        if layout.scene is not None:
            return cls(tables_of(layout), ffi.NULL, ffi.NULL)
        covariance = CholeskyCode(layout)
        pivots = [_powers_of_two(signal) for signal in covariance.factor.pivots]
        inflation = covariance.inflation
        return cls(
            tables_of(layout),
            pointers([*pivots, _powers_of_two(inflation)]),
            pointers([*pivots, _powers_of_two(inflation, 0.5)]),
        )


def _powers_of_two(signal: Signal, share: float = 1.0) -> NDArray[np.float64] | None:
    """Return the powers of 2 of all values of a signal; None if there are too many."""
    low, high = signal.all_raw
    return (
        exp2(signal.physical(np.arange(low, high + 1)) * share) if high - low < MAX_TABLE else None
    )


def _plain(value: Any) -> Any:
    """Return content as C has it: signals by their members, arrays in single precision.

    Each signal has a scale of its own.
    """
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, Signal):
        return {"scale": np.array((value.factor, value.offset)), **place_of(value)}
    return np.ascontiguousarray(value, np.float32) if isinstance(value, np.ndarray) else value


def content_of(layout: Layout) -> dict[str, Value]:
    """Return the members of ``maplines_dbc_t``; see ``tables_of``.

    Raises:
        LayoutError: the DBC has more of something than the C can hold.
    """
    _check_sizes(layout)
    limits, pose = _own_limits(layout), layout.pose
    content: dict[str, Value] = {
        "name": PurePath(layout.source).name,
        "max_components": limits.components,
        "is_conditional": layout.is_conditional,
        "has_pose": pose is not None,
        "messages": {number_of(owner): _messages(own) for owner, own in layout.messages_of.items()},
        "line": None if layout.scene else _record(layout),
        "pose": None if pose is None else _record(pose),
        "scene": None if layout.scene is None else _places(layout.scene),
        "mean": _indexed(layout[name] for name in PARAMETER_SIGNALS),
        **{member: layout[name] for member, name in _SIGNALS.items()},
        "covariance": _covariance(layout),
    }
    if not layout.is_conditional:
        content |= {member: layout[name] for member, name in _COMPLETE_SIGNALS.items()}
    else:
        content["levels"] = _levels(layout, "")
    if layout.covariance_code == POSE_CONDITIONAL:
        content["has_covariance"] = layout["HasCovariance"]
        content["fine"] = _indexed(layout[name] for name in FINE_SIGNALS)
    if pose is not None:
        content |= {**_pose_content(pose), **_spacings(layout, pose)}
        content["straight"] = _straight(content)
    return content


def _spacings(layout: Layout, pose: RecordLayout) -> Members:
    """Return the members of the spacings that an encoder searches: all, or at equal distances."""
    shapes = [f"{slot_title(slot)}OwnShape" for slot in Slot]
    of_first = next((name for name in shapes if name in pose.signals), shapes[0])
    shape = layout["OwnShape"] if layout.is_conditional else pose[of_first]
    values = shape.raw_max + 1 - shape.raw_min
    # By the remainder of the raw value, each spacing has another ratio.
    step = next(n for n in count(-(-values // MAX_SPACINGS)) if math.gcd(n, SHAPE_RATIOS) == 1)
    return {"spacings": len(range(0, values, step)), "spacing_step": step}


def _straight(content: Mapping[str, Value]) -> NDArray[np.float64]:
    """Return the (S, 11) covariances of a straight line at the spacings, in single precision."""
    tables = structure("maplines_dbc_t", _plain(content))
    found = np.empty((tables.spacings, 11), np.float32)
    lib.maplines_straight_levels(tables, pointer(found))
    return found.astype(float)


_SIGNALS = {"kind": "Kind", "x_min": "XMin", "x_max": "XMax"}
_COMPLETE_SIGNALS = {
    "status": "Status",
    "age": "Age",
    "component_index": "ComponentIndex",
    "component_count": "ComponentCount",
    "component_weight": "ComponentWeight",
}
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
    "tilt": "OwnTilt",
    "quartic": "Quartic",
    "fit_behind": "FitBehind",
    "fit_ahead": "FitAhead",
}


def _pose_content(pose: PoseLayout | SceneLayout) -> dict[str, Value]:
    """Return the members of ``maplines_dbc_t`` of the records of the pose error."""
    content: dict[str, Value] = {
        **{member: pose[name] for member, name in _POSE_SIGNALS.items()},
        "pose_covariance": _cholesky(CholeskyCode(pose, POSE_ROWS)),
    }
    if isinstance(pose, SceneLayout):
        return content
    slots = [slot for slot in pose.counters if f"{slot_title(slot)}OwnShape" in pose.signals]
    return content | {
        "slot_counter": {number_of(slot): signal for slot, signal in pose.counters.items()},
        "slot_levels": {number_of(slot): _levels(pose, slot_title(slot)) for slot in slots} or None,
    }


def _record(layout: Layout | PoseLayout | SceneLayout) -> Members:
    """Return the members of ``maplines_record_t``."""
    secured = layout.secured
    members: dict[str, Value] = {
        "pages": eights_of(layout),
        "short_pages": eights_of(layout) if isinstance(layout, SceneLayout) else layout.short_pages,
        "crc_byte": layout.crc_offset,
        "fd_authentic": secured.authentic_bytes if secured else 0,
        "fd_freshness": secured.freshness_bytes if secured else 0,
        "fd_mac": secured.mac_bytes if secured else 0,
        "counter": layout["Counter"],
    }
    if layout.pages:
        later = f"{TRANSFER_ID}1"
        members["page"] = layout[f"{PAGE}0"]
        members["transfer_id"] = {
            0: layout[f"{TRANSFER_ID}0"],
            1: _in_page(layout[later]) if later in layout.signals else None,
        }
    return members


def eights_of(layout: RecordLayout) -> int:
    """Return the length of a record in pages of 8 bytes, also of one that has none."""
    return -(-layout.record_bytes // PAGE_BYTES)


def _places(scene: SceneLayout) -> Members:
    """Return the members of ``maplines_places_t``."""
    fixed = [scene.fixed.get(owner, ()) for owner in SCENES]
    return {
        "places": scene.places,
        "secured_places": scene.secured_places,
        "stride": scene.stride_bytes,
        "fixed": _indexed(
            _indexed(0 if slot is None else slot + 1 for slot in slots) for slots in fixed if slots
        ),
        "slot": scene.line.get(SLOT),
        "join": scene["SceneCounter"],
    }


def _messages(messages: RecordMessages) -> Members:
    """Return the members of ``maplines_messages_t``."""
    return {
        "is_present": True,
        "has_classic": messages.can_id is not None,
        "has_fd": messages.fd_can_id is not None,
        "has_secured": messages.secured_can_id is not None,
        **{name: value for name, value in vars(messages).items() if name != "name"},
    }


def _cholesky(code: CholeskyCode) -> Members:
    """Return the members of ``maplines_cholesky_t``."""
    factor = code.factor
    return {
        "rows": len(factor.order),
        "order": dict(enumerate(factor.order)),
        "pivot": _indexed(factor.pivots),
        "ratio": _indexed(chain(*factor.ratios)),
        "inflation": code.inflation,
        "reachable": _indexed(map(float, code.reachable)),
    }


def _covariance(layout: Layout) -> Members:
    """Return the members of ``maplines_cholesky_t`` of lines."""
    if layout.covariance_code == WHOLE_SCENE:  # only the order of the rows of what is computed
        return {"rows": len(ORDER), "order": _indexed(map(PARAMETER_SIGNALS.index, ORDER))}
    if layout.covariance_code in CODES:
        return _cholesky(CholeskyCode(layout))
    return _any_covariance(layout["Status"])


def _any_covariance(signal: Signal) -> Members:
    """Return the code of a positive definite covariance of the bits of another signal."""
    return {
        "rows": 4,
        "order": dict(enumerate(range(4))),
        "pivot": _indexed([signal] * 4),
        "ratio": _indexed([signal] * 6),
        "inflation": signal,
    }


def _levels(layout: RecordLayout, prefix: str) -> Members:
    """Return the members of ``maplines_levels_t``."""
    return {
        **{member: layout.signals.get(prefix + name) for member, name in _LEVELS.items()},
        "shape_is_octave": layout[f"{prefix}OwnShape"].unit == OCTAVE,
    }


def _records(layout: Layout) -> list[RecordLayout]:
    if layout.scene is not None:
        return [layout.scene]
    return [layout] if layout.pose is None else [layout, layout.pose]


def _own_limits(layout: Layout) -> Limits:
    records = _records(layout)
    ids = [record[f"{TRANSFER_ID}0"].length for record in records if record.pages]
    return Limits(
        pages=max(map(eights_of, records)),
        transfer_ids=2 ** max(ids, default=0),
        components=1 if layout.is_conditional else 2 ** layout["ComponentCount"].length,
    )


def _check_bits(layout: RecordLayout, name: str, most: int) -> None:
    """Raise LayoutError if a signal is longer than the C can hold."""
    if (signal := layout[name]).length > most:
        raise layout.error(signal, f"at most {most} bits to have C", "shorten it")


def _in_page(signal: Signal) -> Signal:
    """Return a signal of a later page with its place in the page."""
    page = signal.start // (8 * PAGE_BYTES)
    return replace(signal, start=signal.start - 8 * PAGE_BYTES * page)


def _indexed(values: Iterable[Value]) -> Members:
    return dict(enumerate(values))
