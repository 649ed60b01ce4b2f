"""Messages of a slot: their payload lengths."""

import pytest
from can.util import CAN_FD_DLC

from maplines_can.wire.message.slot_messages import FD_LENGTHS, fd_length


def test_the_payload_lengths_of_can_fd() -> None:
    """Those of python-can."""
    assert list(FD_LENGTHS) == CAN_FD_DLC


@pytest.mark.parametrize(("length", "padded"), [(0, 0), (8, 8), (9, 12), (48, 48), (49, 64)])
def test_a_payload_is_padded_to_the_next_length(length: int, padded: int) -> None:
    """A length of CAN FD itself needs no padding."""
    assert fd_length(length) == padded
