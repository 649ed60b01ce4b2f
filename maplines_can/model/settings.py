"""Time-outs, cycle times and windows of a receiver: by default those that the DBC implies."""

from __future__ import annotations

from typing import NamedTuple

from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import POSE, Owner
from ..wire.layout.slot_messages import RecordMessages
from .e2e import Windows
from .records import AnyLayout
from .sequence import GRACE_CYCLES

#: Cycle time if the DBC has none, and the longest time-out [ms].
DEFAULT_CYCLE_MS, MAX_MS = 100.0, 3_600_000


class Settings(NamedTuple):
    """Settings of the records of one owner."""

    timeout_ns: int  #: longest time between the frames of a transfer
    cycle_ns: int  #: time between records
    windows: Windows


def settings_of(
    layout: Layout,
    timeout_ms: float | None = None,
    cycle_ms: float | None = None,
    windows: Windows | None = None,
) -> dict[Owner, Settings]:
    """Return the settings of all slots and of the pose error; None for what the DBC implies."""
    given = timeout_ms, cycle_ms, windows or Windows()
    of_all: dict[Owner, Settings] = {}
    for slot, messages in layout.messages.items():
        # Windows that were chosen are taken as they are, by default a step is limited.
        of_all[slot] = _settings(layout, messages, *given, is_limited=windows is None)
    if layout.pose is not None:
        of_all[POSE] = _settings(layout.pose, layout.pose.messages, *given, is_limited=True)
    return of_all


def timeout_cycles(layout: AnyLayout) -> float:
    """Return the default time-out of a transfer [cycles].

    A transfer ID is used again after (transfer IDs / most components) cycles; half a cycle is for
    jitter. It is at most 1.5, since a cycle counts as missed then.
    """
    components = 1.0
    if "ComponentCount" in layout.signals:
        components = max(1.0, layout["ComponentCount"].physical_range[1])
    ids = 2 ** layout["TransferId0"].length
    return max(0.5, min(ids / components - 0.5, GRACE_CYCLES))


def _settings(
    layout: AnyLayout,
    messages: RecordMessages,
    timeout_ms: float | None,
    cycle_ms: float | None,
    windows: Windows,
    *,
    is_limited: bool,
) -> Settings:
    of_dbc_ms = messages.cycle_ms or DEFAULT_CYCLE_MS
    chosen_ms = cycle_ms or of_dbc_ms
    implied_ms = min(max(of_dbc_ms / 2, timeout_cycles(layout) * chosen_ms), MAX_MS)
    if is_limited:  # a step is at most a quarter of the counters
        most = min(windows.max_delta_counter, 2 ** layout["Counter"].length // 4)
        windows = windows._replace(max_delta_counter=most)
    return Settings(_whole_ns(timeout_ms or implied_ms), _whole_ns(chosen_ms), windows)


def _whole_ns(ms: float) -> int:
    return max(1, int(1e6 * ms))
