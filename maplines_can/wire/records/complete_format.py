"""Format of complete records: a line with a covariance of its own, or a part of its mixture."""

from __future__ import annotations

from ..covariance import CholeskyCode
from ..layout.message_layout import Layout
from ..layout.pose_layout import Owner
from .packer import RecordPacker


class CompleteFormat:
    """Format of complete records.

    Args:
        layout: of the records.
        covariance: code of the covariance.
    """

    def __init__(self, layout: Layout, covariance: CholeskyCode) -> None:
        self.packer = RecordPacker(layout)
        self.data_ids: dict[Owner, int]
        self.data_ids = {slot: messages.data_id for slot, messages in layout.messages.items()}
        self.covariance = covariance
