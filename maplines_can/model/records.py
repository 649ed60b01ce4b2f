"""Records: their checks, what their values mean, and how one is written from raw values."""

from __future__ import annotations

import math
from typing import NamedTuple

from ..values.line import VAGUE_SIGMA, Kind, Slot, Status
from ..wire.layout.message_layout import AnyLayout, Layout
from ..wire.layout.pose_layout import PoseLayout
from ..wire.layout.record_layout import bits_of
from ..wire.layout.record_signals import OWN_SIGNALS, PAGE_BYTES, PARAMETER_SIGNALS, Signal
from ..wire.layout.scene_layout import SceneLayout
from .covariance import code_of, decoded
from .e2e import checksum
from .matrices import Matrix, Vector, diagonal
from .signals import Raw, packed, physical, read

#: Layout of the records of lines, or of the pose error.
PagedLayout = Layout | PoseLayout
#: Statuses of lines without a covariance: it was not sent, or does not exist.
WITHOUT = (Status.UNKNOWN, Status.OUT_OF_RANGE)


class Line(NamedTuple):
    """A line: a Gaussian over y_off [m], beta [rad], c0 [1/m] and c1 [1/m^2]."""

    slot: Slot
    mean: Vector
    cov: Matrix
    kind: Kind
    x_min: float  #: [m]
    x_max: float  #: [m]
    age: float  #: from the pose to the sending [s]; infinite if the line is too old
    status: Status
    t_ns: int  #: time of its first frame
    components: tuple[Component, ...] = ()  #: of a mixture; else none


class Component(NamedTuple):
    """Content of a complete record: a line, or a component of its mixture."""

    line: Line
    place: int  #: of the component, from 0
    size: int  #: number of components of the line
    weight: float
    counter: int


class RawRecord(NamedTuple):
    """Content of a record that means something only with another one."""

    counter: int
    raw: Raw
    size: int = 1  #: such a line is no mixture


def signals_of(layout: AnyLayout, length: int) -> list[Signal]:
    """Return the signals of the first bytes of a record."""
    return [s for s in layout.signals.values() if max(bits_of(s)) < 8 * length]


def length_of(layout: PagedLayout, raw: Raw) -> int:
    """Return the length of a record of lines: without a covariance, of the pages before it."""
    return PAGE_BYTES * (layout.pages if raw.get("HasCovariance", 1) else layout.short_pages)


def intact(layout: AnyLayout, record: bytes, data_id: int) -> dict[str, int] | str:
    """Return the raw values of a record, or why it is damaged.

    All pages have their numbers and one transfer ID, the low bits of ``Counter``; and the checksum
    covers all other bytes and the data ID of the owner. A whole scene has no pages.
    """
    raw = {signal.name: read(signal, record) for signal in signals_of(layout, len(record))}
    is_intact = sealed(layout, record, data_id) == record
    if isinstance(layout, SceneLayout):
        return raw if is_intact else "CRC"
    pages = len(record) // PAGE_BYTES
    if len(record) % PAGE_BYTES or pages not in (layout.pages, layout.short_pages):
        return "LENGTH"
    transfer = raw["Counter"] % 2 ** layout["TransferId0"].length
    for page in range(pages):
        if (raw[f"Page{page}"], raw[f"TransferId{page}"]) != (page, transfer):
            return "MIXED"
    if not is_intact:
        return "CRC"
    return raw if length_of(layout, raw) == len(record) else "LENGTH"


def written(layout: PagedLayout, raw: Raw, data_id: int) -> bytes:
    """Return the record of raw values, with page numbers, transfer IDs and checksum."""
    all_raw, length = {**raw, "Crc": 0}, length_of(layout, raw)
    for page in range(length // PAGE_BYTES):
        all_raw |= {f"Page{page}": page, f"TransferId{page}": raw["Counter"]}
    return sealed(layout, packed(signals_of(layout, length), all_raw, length), data_id)


def sealed(layout: AnyLayout, record: bytes, data_id: int) -> bytes:
    """Return a record with its checksum."""
    place = layout.crc_offset
    crc = checksum(record, place, data_id).to_bytes(2, "little")
    return record[:place] + crc + record[place + 2 :]


def age_of(layout: AnyLayout, raw: Raw) -> float:
    """Return the age [s]: infinite for the greatest raw value, which means too old or unknown."""
    is_too_old = raw["Age"] >= layout["Age"].raw_max
    return math.inf if is_too_old else physical(layout, raw, "Age")[0] / 1000


def complete(layout: Layout, slot: Slot, raw: Raw, t_ns: int) -> Component | str:
    """Return the content of a record with a covariance of its own, or CONTENT.

    No sender sends unknown statuses or kinds, a component that is not one of the line's, a weight
    that is no share, or a range that is empty, except if the line is OUT_OF_RANGE.
    """
    x_min, x_max = physical(layout, raw, "XMin", "XMax")
    count, weight = physical(layout, raw, "ComponentCount", "ComponentWeight")
    is_known = raw["Status"] <= max(Status) and raw["Kind"] <= max(Kind)
    is_component = raw["ComponentIndex"] < count and 0 < weight <= 1
    if not (is_known and is_component and (x_min <= x_max or raw["Status"] == Status.OUT_OF_RANGE)):
        return "CONTENT"
    status, kind = Status(raw["Status"]), Kind(raw["Kind"])
    vague = diagonal(sigma * sigma for sigma in VAGUE_SIGMA)
    cov = vague if status in WITHOUT else decoded(code_of(layout), raw)
    mean, age = physical(layout, raw, *PARAMETER_SIGNALS), age_of(layout, raw)
    line = Line(slot, mean, cov, kind, min(x_min, x_max), x_max, age, status, t_ns)
    return Component(line, raw["ComponentIndex"], int(count), weight, raw["Counter"])


def conditional(layout: Layout, raw: Raw) -> RawRecord | str:
    """Return the content of a record that is conditional on the pose error, or CONTENT.

    No sender sends unknown kinds, an empty range, or levels beside a covariance.
    """
    x_min, x_max = physical(layout, raw, "XMin", "XMax")
    has_both = raw["HasCovariance"] and any(raw[name] for name in OWN_SIGNALS)
    is_possible = raw["Kind"] <= max(Kind) and x_min < x_max and not has_both
    return RawRecord(raw["Counter"], raw) if is_possible else "CONTENT"
