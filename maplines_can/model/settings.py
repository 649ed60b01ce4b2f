"""Time-outs, cycle times and windows of a receiver: by default those that the DBC implies."""

from __future__ import annotations

from typing import NamedTuple

from ..values.line import Slot
from ..wire.layout.message_layout import AnyLayout, Layout
from ..wire.layout.pose_layout import POSE, Owner
from .e2e import Windows
from .sequence import GRACE_CYCLES

#: Cycle time if the DBC has none, and the longest time-out [ms].
DEFAULT_CYCLE_MS, MAX_MS = 100.0, 3_600_000


class Settings(NamedTuple):
    """Settings of the records of one owner."""

    timeout_ns: int  #: longest time between the frames of a transfer
    cycle_ns: int  #: time between records
    windows: Windows


class Sizes(NamedTuple):
    """What a receiver has room for: by default, as much as the Python package."""

    slots: int = len(Slot)  #: the first ones
    scenes: bool = True  #: lines of one pose
    components: int = 64  #: of a mixture
    transfers: int = 256  #: of a slot that are remembered; those with more IDs share places
    history: int = 256  #: counters whose records are remembered
    epochs: int = 8  #: that lines may join
    lines: bool = True  #: newest line of each slot; else only the newest whole scenes

    def has(self, owner: Owner) -> bool:
        """Return whether the receiver has an owner of records."""
        return int(owner) < self.slots if isinstance(owner, Slot) else self.scenes


#: Those of the Python package.
ALL = Sizes()


def settings_of(
    layout: Layout,
    timeout_ms: float | None = None,
    cycle_ms: float | None = None,
    windows: Windows | None = None,
) -> dict[Owner, Settings]:
    """Return the settings of all owners; None for what the DBC implies."""
    of_lines = windows or limited(Windows(), layout.scene or layout)
    found: dict[Owner, Settings] = {}
    for owner, messages in layout.messages_of.items():
        own = layout.record_of(owner)
        implied_ms = messages.cycle_ms or DEFAULT_CYCLE_MS
        cycle = cycle_ms or implied_ms
        timeout = min(max(implied_ms / 2, timeout_cycles(own) * cycle), MAX_MS)
        timeout_ns, cycle_ns = (max(1, int(1e6 * ms)) for ms in (timeout_ms or timeout, cycle))
        bounds = limited(of_lines, own) if owner == POSE else of_lines
        found[owner] = Settings(timeout_ns, cycle_ns, bounds)
    return found


def limited(windows: Windows, layout: AnyLayout) -> Windows:
    """Return windows whose step is at most a quarter of the counters of a layout."""
    most = min(windows.max_delta_counter, 2 ** layout["Counter"].length // 4)
    return windows._replace(max_delta_counter=most)


def timeout_cycles(layout: AnyLayout) -> float:
    """Return the default time-out of a transfer [cycles].

    A transfer ID is used again after (transfer IDs / most components) cycles; half a cycle is for
    jitter. It is at most 1.5, since a cycle counts as missed then.
    """
    if not layout.pages:
        return GRACE_CYCLES  # each frame is a record, so nothing times out
    has_count = "ComponentCount" in layout.signals
    components = max(1.0, layout["ComponentCount"].physical_range[1]) if has_count else 1.0
    ids = 2 ** layout["TransferId0"].length
    return max(0.5, min(ids / components - 0.5, GRACE_CYCLES))
