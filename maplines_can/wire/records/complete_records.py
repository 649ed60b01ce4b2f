"""Records that have a covariance of their own: their writers and their reader."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from ...values.line import Slot
from ..covariance import CovarianceCode
from ..layout.message_layout import Layout
from ..layout.packing import Packing
from ..reasons import Reason
from .components import MixtureWriter
from .line_writer import LineWriter
from .pose_records import ConditionalRecord, ConditionalRecords
from .reader import DecodedRecord, RecordReader
from .writer import RecordWriter


class CompleteRecords(NamedTuple):
    """Writers and reader of the records of a layout that are not conditional on the pose error."""

    writer: RecordWriter
    mixture_writer: MixtureWriter
    line_writer: LineWriter
    reader: RecordReader


def complete_records(layout: Layout, covariance: CovarianceCode) -> CompleteRecords | None:
    """Return the writers and the reader of a layout; None if its records are conditional."""
    if layout.is_conditional:
        return None
    packing = Packing(list(layout.signals.values()), layout.record_bytes)
    writer = RecordWriter(layout, packing, covariance)
    mixture_writer = MixtureWriter(writer)
    line_writer = LineWriter(writer, mixture_writer)
    return CompleteRecords(
        writer, mixture_writer, line_writer, RecordReader(layout, packing, covariance)
    )


def record_reading(
    layout: Layout, complete: CompleteRecords | None
) -> Callable[[bytes, Slot, int], DecodedRecord | ConditionalRecord | Reason]:
    """Return the function that reads the payload of a slot's record, received at a time [ns].

    ``complete`` is None if the records of the layout are conditional on the pose error.
    """
    if complete is None:
        conditional = ConditionalRecords(layout)
        return lambda payload, slot, _: conditional.read(payload, slot)
    reader = complete.reader
    data_ids = {slot: messages.data_id for slot, messages in layout.messages.items()}
    return lambda payload, slot, t_ns: reader.read_one(payload, slot, data_ids[slot], t_ns)
