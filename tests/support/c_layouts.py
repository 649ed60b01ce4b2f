"""Layouts that a DBC may have and those of the project do not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from scene_layouts import layout_of

from maplines_can import Slot
from maplines_can.wire.layout.message_layout import Layout
from maplines_can.wire.layout.pose_layout import PoseLayout
from maplines_can.wire.layout.record_signals import slot_title


def with_messages(layout: Layout, **changes: Any) -> Layout:
    """Return a layout in which the messages of all owners are changed."""
    messages = {slot: replace(own, **changes) for slot, own in layout.messages.items()}
    pose = layout.pose
    if isinstance(pose, PoseLayout):
        pose = replace(pose, messages=replace(pose.messages, **changes))
    return replace(layout, messages=messages, pose=pose)


def with_signals(layout: Layout, **changes: Mapping[str, Any]) -> Layout:
    """Return a layout in which signals of the lines are changed; their ranges are all bits."""
    signals = dict(layout.signals)
    for name, change in changes.items():
        signal = replace(signals[name], **change)
        low, high = signal.all_raw
        signals[name] = replace(signal, raw_min=low, raw_max=high)
    return replace(layout, signals=signals)


def with_slots(layout: Layout, *slots: Slot) -> Layout:
    """Return a layout with the messages of some slots, which the pose error has no others of."""
    others = tuple(slot_title(slot) for slot in Slot if slot not in slots)
    pose = layout.pose
    if pose is not None:
        signals = {name: s for name, s in pose.signals.items() if not name.startswith(others)}
        pose = replace(pose, signals=signals)
    messages = {slot: layout.messages[slot] for slot in slots}
    return replace(layout, messages=messages, pose=pose)


def with_short_freshness(layout: Layout) -> Layout:
    """Return a layout whose freshness values cannot do without a clock."""
    assert layout.secured is not None
    assert layout.pose is not None
    assert layout.pose.secured is not None
    pose = replace(layout.pose, secured=replace(layout.pose.secured, freshness_bytes=3))
    return replace(layout, secured=replace(layout.secured, freshness_bytes=3), pose=pose)


def unusual_layouts() -> dict[str, Layout]:
    """Return layouts without what the project's DBCs have, by what is unusual of them."""
    complete, conditional, secured = map(
        layout_of, ("maplines.dbc", "maplines-pose.dbc", "maplines-secoc.dbc")
    )
    assert isinstance(secured.pose, PoseLayout)
    messages = replace(secured.pose.messages, secured_can_id=None)
    plain_pose = replace(secured.pose, messages=messages, secured=None)
    return {
        "no pose error": with_signals(
            with_messages(replace(complete, pose=None), cycle_ms=0),
            Beta={"length": 15},
            Status={"start": 55},
            Kind={"start": 58, "length": 4},
        ),
        "classic only": with_messages(conditional, fd_can_id=None),
        "FD only": with_messages(conditional, can_id=None),
        "short freshness": with_short_freshness(secured),
        "one slot": with_slots(complete, Slot.ROUTE),
        "the pose error is not authenticated": replace(secured, pose=plain_pose),
        "wide kinds": with_signals(
            conditional,
            Kind={"length": 4},
            HasCovariance={"start": 54},
            OwnShape={"start": 55, "length": 7},
        ),
        "short counter": with_signals(complete, Counter={"length": 4}),
    }
