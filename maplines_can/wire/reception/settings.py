"""Time-outs, cycle times and E2E windows of a decoder, by default from the DBC."""

from __future__ import annotations

from ...values.arrays import number_text
from ...values.line import Slot
from ..layout.message_layout import Layout
from ..layout.pose_layout import PoseLayout
from ..layout.record_layout import RecordLayout
from ..layout.signals import TRANSFER_ID
from ..layout.slot_messages import MAX_MS
from ..protection.e2e_state import E2EConfig
from .deadline import GRACE_CYCLES

#: Cycle time if the DBC has none [ms].
DEFAULT_CYCLE_MS = 100.0


def decoder_settings(
    layout: Layout,
    timeout_ms: float | None = None,
    cycle_ms: float | None = None,
    e2e: E2EConfig | None = None,
) -> tuple[dict[Slot, int], dict[Slot, int], E2EConfig]:
    """Return time-outs [ns], cycle times [ns] and E2E windows; see ``Codec.decoder``."""
    for name, value in (("timeout_ms", timeout_ms), ("cycle_ms", cycle_ms)):
        if value is not None and not 0 < value <= MAX_MS:
            raise ValueError(
                f"{name} must be more than 0 ms and at most an hour ({MAX_MS} ms), "
                f"got {number_text(value)}"
            )
    timeouts_ms, cycles_ms = dict[Slot, float](), dict[Slot, float]()
    for slot, messages in layout.messages.items():
        dbc_ms = messages.cycle_ms or DEFAULT_CYCLE_MS
        cycles_ms[slot] = cycle_ms or dbc_ms
        derived_ms = max(dbc_ms / 2, timeout_cycles(layout) * cycles_ms[slot])
        timeouts_ms[slot] = timeout_ms or derived_ms
    modulus = 2 ** layout["Counter"].length
    if e2e is None:
        e2e = E2EConfig(max_delta_counter=min(E2EConfig().max_delta_counter, modulus // 4))
    elif e2e.max_delta_counter >= modulus // 2:
        raise ValueError(
            f"max_delta_counter must be less than {modulus // 2}, half the counter modulus of "
            f"{layout.source}, got {e2e.max_delta_counter}"
        )
    return _in_ns(timeouts_ms), _in_ns(cycles_ms), e2e


def pose_settings(
    layout: PoseLayout, timeout_ms: float | None = None, cycle_ms: float | None = None
) -> tuple[int, int]:
    """Return the time-out and the cycle time [ns] of the pose error; see ``Codec.decoder``."""
    dbc_ms = layout.messages.cycle_ms or DEFAULT_CYCLE_MS
    chosen_ms = cycle_ms or dbc_ms
    derived_ms = max(dbc_ms / 2, timeout_cycles(layout) * chosen_ms)
    return int(1e6 * (timeout_ms or derived_ms)), int(1e6 * chosen_ms)


def timeout_cycles(layout: RecordLayout) -> float:
    """Return the default time-out of a transfer [cycles].

    A transfer ID is used again after (transfer IDs / components) cycles at the earliest: when each
    line has the greatest number of components. Half a cycle is subtracted, since the sender may be
    early. The result is at most ``GRACE_CYCLES``, because a cycle counts as missed after that, and
    at least half a cycle.

    >>> timeout_cycles(Layout.from_dbc())  # min(16 transfer IDs / 8 components - 0.5, 1.5)
    1.5
    """
    transfer_ids = 2 ** layout[f"{TRANSFER_ID}0"].length
    components = 1.0
    if "ComponentCount" in layout.signals:
        components = max(components, layout["ComponentCount"].physical_range[1])
    return max(0.5, min(transfer_ids / components - 0.5, GRACE_CYCLES))


def _in_ns(times_ms: dict[Slot, float]) -> dict[Slot, int]:
    return {slot: int(1e6 * ms) for slot, ms in times_ms.items()}
