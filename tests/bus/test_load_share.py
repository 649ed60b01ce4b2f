"""Number of transfers within a share of the bus time."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.bus import bus_load, transfers_within
from maplines_can.wire import Frame


@given(st.floats(1e-4, 1), st.floats(1e-3, 1), st.sampled_from([125e3, 500e3, 1e6]), st.booleans())
def test_transfers_within_a_share(share: float, period: float, bitrate: Any, fd: bool) -> None:
    """They fit, and one more does not."""
    transfer = [Frame(0x100, bytes(32), is_fd=True)] if fd else [Frame(0x100, bytes(8))] * 4
    n = transfers_within(share, transfer, period, bitrate)
    assert bus_load(transfer * n, period, bitrate) <= share * (1 + 1e-9)
    assert bus_load(transfer * (n + 1), period, bitrate) > share


@pytest.mark.parametrize("n", [1, 3, 13, 64])
def test_a_share_filled_to_the_last_bit(n: int) -> None:
    """Rounding does not remove a transfer."""
    transfer = [Frame(0x100, bytes(8))] * 4
    assert transfers_within(bus_load(transfer * n, 0.1, 5e5), transfer, 0.1, 5e5) == n


def test_all_of_the_bus_time_may_be_used() -> None:
    """A classic frame of no data has 55 bits."""
    assert transfers_within(1.0, [Frame(0x100, b"")], 1.0, 110) == 2
    assert transfers_within(1.0, [Frame(0x100, b"")], 1.0, 109) == 1


@pytest.mark.parametrize("share", [0.0, -0.1, 1.01, float("nan")])
def test_invalid_share_raises(share: Any) -> None:
    """A share is more than 0 and at most 1."""
    with pytest.raises(ValueError, match="share must be more than 0 and at most 1"):
        transfers_within(share, [Frame(0x100, bytes(8))], 0.1, 5e5)
