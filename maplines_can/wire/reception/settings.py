"""Time-outs, cycle times and E2E windows of a decoder, by default from the DBC."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from ...values.arrays import number_text
from ..layout.message_layout import Layout
from ..layout.pose_layout import POSE, Owner
from ..layout.record_layout import RecordLayout
from ..layout.signals import TRANSFER_ID
from ..layout.slot_messages import MAX_MS, RecordMessages
from ..protection.e2e_state import E2EConfig

#: Cycle time if the DBC has none [ms].
DEFAULT_CYCLE_MS = 100.0
#: The first cycle without a record is declared missed this many cycles after the last record,
#: since the time of a record may jitter by half a cycle.
GRACE_CYCLES = 1.5


class RecordSettings(NamedTuple):
    """Settings of the reception of the records of one owner."""

    timeout_ns: int  #: longest time between the frames of a transfer [ns]
    cycle_ns: int  #: time between records [ns]
    e2e: E2EConfig  #: windows and bounds of the E2E state machine


def decoder_settings(
    layout: Layout,
    timeout_ms: float | None = None,
    cycle_ms: float | None = None,
    e2e: E2EConfig | None = None,
) -> dict[Owner, RecordSettings]:
    """Return the settings of each slot and of the pose error; see ``Codec.decoder``."""
    for name, value in (("timeout_ms", timeout_ms), ("cycle_ms", cycle_ms)):
        if value is not None and not 0 < value <= MAX_MS:
            raise ValueError(
                f"{name} must be more than 0 ms and at most an hour ({MAX_MS} ms), "
                f"got {number_text(value)}"
            )
    modulus = 2 ** layout["Counter"].length
    if e2e is not None and e2e.max_delta_counter >= modulus // 2:
        raise ValueError(
            f"max_delta_counter must be less than {modulus // 2}, half the counter modulus of "
            f"{layout.source}, got {e2e.max_delta_counter}"
        )
    of_slots = _within(E2EConfig(), layout) if e2e is None else e2e
    settings: dict[Owner, RecordSettings] = {
        slot: RecordSettings(*_times_ns(layout, messages, timeout_ms, cycle_ms), of_slots)
        for slot, messages in layout.messages.items()
    }
    if (pose := layout.pose) is not None:
        times = _times_ns(pose, pose.messages, timeout_ms, cycle_ms)
        settings[POSE] = RecordSettings(*times, _within(of_slots, pose))
    return settings


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


def _times_ns(
    layout: RecordLayout,
    messages: RecordMessages,
    timeout_ms: float | None,
    cycle_ms: float | None,
) -> tuple[int, int]:
    """Return the time-out and the cycle time [ns] of an owner with these messages."""
    dbc_ms = messages.cycle_ms or DEFAULT_CYCLE_MS
    chosen_ms = cycle_ms or dbc_ms
    derived_ms = min(max(dbc_ms / 2, timeout_cycles(layout) * chosen_ms), MAX_MS)
    return _whole_ns(timeout_ms or derived_ms), _whole_ns(chosen_ms)


def _whole_ns(ms: float) -> int:
    return max(1, int(1e6 * ms))


def _within(e2e: E2EConfig, layout: RecordLayout) -> E2EConfig:
    """Return settings whose step is at most a quarter of the counters of a layout."""
    most = min(e2e.max_delta_counter, 2 ** layout["Counter"].length // 4)
    return replace(e2e, max_delta_counter=most)
