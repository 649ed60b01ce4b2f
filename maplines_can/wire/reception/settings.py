"""Time-outs, cycle times and E2E windows of a decoder, by default from the DBC."""

from __future__ import annotations

from ...arrays import number_text
from ...line import Slot
from ..message.layout import Layout
from ..message.slot_messages import LONGEST_MS
from ..protection.e2e_state import E2EConfig

#: Time-out of a transfer if the DBC has no cycle time [ms].
DEFAULT_TIMEOUT_MS = 50.0


def decoder_settings(
    layout: Layout,
    timeout_ms: float | None = None,
    cycle_ms: float | None = None,
    e2e: E2EConfig | None = None,
) -> tuple[int, dict[Slot, int], E2EConfig]:
    """Return the time-out [ns], cycle times [ns] and E2E windows; see ``Codec.decoder``."""
    cycles = {slot: messages.cycle_ms for slot, messages in layout.messages.items()}
    if timeout_ms is None:
        timeout_ms = max(cycles.values()) / 2 or DEFAULT_TIMEOUT_MS
    for name, value in (("timeout_ms", timeout_ms), ("cycle_ms", cycle_ms)):
        if value is not None and not 0 < value <= LONGEST_MS:
            raise ValueError(
                f"{name} must be more than 0 ms and at most an hour ({LONGEST_MS} ms), "
                f"got {number_text(value)}"
            )
    cycles_ns = {
        slot: int(1e6 * (cycle_ms or own_ms or 2 * DEFAULT_TIMEOUT_MS))
        for slot, own_ms in cycles.items()
    }
    modulus = 2 ** layout["Counter"].length
    if e2e is None:
        e2e = E2EConfig(max_delta_counter=min(E2EConfig().max_delta_counter, modulus // 4))
    elif e2e.max_delta_counter >= modulus // 2:
        raise ValueError(
            f"max_delta_counter must be less than {modulus // 2}, half the counter modulus of "
            f"{layout.source}, got {e2e.max_delta_counter}"
        )
    return int(timeout_ms * 1e6), cycles_ns, e2e
