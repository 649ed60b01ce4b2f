"""Layouts of the project's DBCs, and records of any raw values."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

from maplines_can.dbc_files.parser import default_dbc_path
from maplines_can.model.records import written
from maplines_can.wire import Layout
from maplines_can.wire.layout.pose_layout import Owner, PoseLayout, slot_of

#: DBC with records that are conditional on the pose, and DBC with complete records beside it.
CONDITIONAL, COMPLETE = "maplines-pose.dbc", "maplines.dbc"


@lru_cache
def layout_of(dbc: str) -> Layout:
    """Return the layout of one of the project's DBCs."""
    return Layout.from_dbc(default_dbc_path(dbc))


@lru_cache
def pose_layout_of(dbc: str) -> PoseLayout:
    """Return the layout of the Pose message of one of the project's DBCs."""
    pose = layout_of(dbc).pose
    if isinstance(pose, PoseLayout):
        return pose
    raise ValueError(f"{dbc} has no Pose message")


def raw_record(
    layout: Layout | PoseLayout, owner: Owner, counter: int, raw: Mapping[str, int]
) -> bytes:
    """Return the record of raw values, which the specification writes."""
    own = layout.messages if isinstance(layout, PoseLayout) else layout.messages[slot_of(owner)]
    return written(layout, {**raw, "Counter": counter}, own.data_id)
