"""Records that have a covariance of their own: their writers and their reader."""

from __future__ import annotations

from typing import NamedTuple

from ..covariance import CovarianceCode
from ..layout.message_layout import Layout
from .complete_format import CompleteFormat
from .components import MixtureWriter
from .line_writer import LineWriter
from .writer import RecordWriter


class CompleteRecords(NamedTuple):
    """Format and writers of the records of a layout that are not conditional on the pose error."""

    format: CompleteFormat
    writer: RecordWriter
    mixture_writer: MixtureWriter
    line_writer: LineWriter


def complete_records(layout: Layout, covariance: CovarianceCode) -> CompleteRecords | None:
    """Return the format and the writers of a layout; None if its records are conditional."""
    if layout.is_conditional:
        return None
    form = CompleteFormat(layout, covariance)
    writer = RecordWriter(layout, form.packer, covariance)
    mixture_writer = MixtureWriter(writer)
    return CompleteRecords(form, writer, mixture_writer, LineWriter(writer, mixture_writer))
