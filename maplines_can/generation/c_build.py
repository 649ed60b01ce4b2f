"""What a library in C has, and its sizes: the macros of ``maplines.h``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, cast

from ..values.errors import LayoutError
from ..values.line import Slot
from ..wire.core_tables import Members, Value, content_of, limits_of
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import POSE, SCENES, Owner, number_of
from ..wire.protection.e2e_state import E2EConfig

#: Epochs that lines may join: those of the 3 cycles by which one may be late, and one more.
EPOCHS = 4
#: Longest window of an E2E state machine that has room in a word.
WINDOW = 32
#: Members of ``maplines_dbc_t`` that a library has only with scenes, with a sender of them, or with
#: records of a line each or of whole scenes.
_OF_SCENES = {
    "has_covariance", "fine", "levels", "pose", "pose_age", "correlation_time", "map_offset",
    "map_heading", "pose_covariance", "slot_counter", "slot_levels",
}  # fmt: skip
_OF_SENT_SCENES = {"spacings", "spacing_step", "straight"}
_OF_LINE_RECORDS = {
    "line", "status", "age", "component_index", "component_count", "component_weight",
    "has_covariance", "fine", "slot_counter", "slot_levels",
}  # fmt: skip
_OF_SCENE_RECORDS = {"scene"}


class Features(NamedTuple):
    """What a program needs of the library in C; all of it if nothing else is said."""

    receiver: bool = True
    sender: bool = True
    scenes: bool = True  #: lines with the error of their pose
    mixtures: bool = True
    secoc: bool = True  #: authenticated frames
    slots: int = len(Slot)  #: of the lines, the first ones of ``Slot``
    single: bool = False  #: a receiver computes with float


#: All of it.
ALL = Features()


class Build(NamedTuple):
    """Values of the macros of ``maplines.h``, by their names without ``MAPLINES_``."""

    receiver: int
    sender: int
    scenes: int
    line_records: int
    scene_records: int
    secoc: int
    float: int
    slots: int
    max_pages: int
    max_transfer_ids: int
    max_components: int
    transfers: int  #: of a slot that are remembered: those of two lines
    history: int  #: records of a slot that are remembered: twice the most that count as lost
    epochs: int
    window: int

    @property
    def macros(self) -> dict[str, int]:
        """The values by the names of the macros."""
        return {f"MAPLINES_{name.upper()}": value for name, value in self._asdict().items()}

    def has(self, condition: str) -> bool:
        """Return whether a condition of the sources holds, such as ``MAPLINES_SCENES``."""
        values = self.macros | {"MAPLINES_MIXTURES": int(self.max_components > 1)}
        return all(values[name] for name in condition.split(" && "))

    def content(self, layout: Layout) -> Members:
        """Return the members of ``maplines_dbc_t`` that the library has."""
        content = content_of(layout)
        without = set() if self.scenes else {*_OF_SCENES, *_OF_SENT_SCENES}
        without |= set() if self.sender else _OF_SENT_SCENES
        without |= set() if self.line_records else _OF_LINE_RECORDS
        without |= set() if self.scene_records else _OF_SCENE_RECORDS
        found = {name: value for name, value in content.items() if name not in without}
        found["max_components"] = min(cast(int, content["max_components"]), self.max_components)
        found["has_pose"] = bool(self.scenes and content["has_pose"])
        for name in () if self.sender else ("covariance", "pose_covariance"):
            if isinstance(members := found.get(name), Mapping):
                found[name] = {key: value for key, value in members.items() if key != "reachable"}
        for name in ("messages", "slot_counter", "slot_levels"):
            members = found.get(name)
            if isinstance(members, Mapping):
                found[name] = dict(self._kept(members)) or None
        return found

    def _kept(self, members: Members) -> Iterator[tuple[Any, Value]]:
        """Yield the members of the owners that the library has."""
        owners = {number_of(owner) for owner in self._owners}
        yield from ((number, value) for number, value in members.items() if number in owners)

    @property
    def _owners(self) -> Iterator[Owner]:
        if self.line_records:
            yield from list(Slot)[: self.slots]
            yield from [POSE] if self.scenes else []
        if self.scene_records:
            yield from SCENES


def build_of(layouts: Mapping[str, Layout], features: Features = ALL) -> Build:
    """Return the library for these DBCs with these features.

    Args:
        layouts: of the DBCs, by the names of their tables.
        features: that the program needs.

    Raises:
        LayoutError: a DBC has no C, or needs a feature that is left out.
        ValueError: neither a receiver nor a sender is left, or the slots are none of 1 to 8.
    """
    if not (features.receiver or features.sender):
        raise ValueError("a library has a receiver, a sender or both; leave out one of the two")
    if not 1 <= features.slots <= len(Slot):
        raise ValueError(f"slots must be from 1 to {len(Slot)}, got {features.slots}")
    for layout in layouts.values():
        if layout.is_conditional and not features.scenes:
            raise LayoutError(
                f"{layout.source}: its records are conditional on the pose error, so a library "
                "without scenes has no line of it; leave out --no-scenes, or take a DBC with "
                "complete records such as maplines.dbc"
            )
        if not any(slot < features.slots for slot in layout.slots):
            raise LayoutError(
                f"{layout.source}: it has no line of the first {features.slots} slots; give more "
                "with --slots"
            )
    limits = limits_of(list(layouts.values()))
    components = limits.components if features.mixtures else 1
    return Build(
        receiver=int(features.receiver),
        sender=int(features.sender),
        scenes=int(features.scenes),
        line_records=int(any(layout.scene is None for layout in layouts.values())),
        scene_records=int(any(layout.scene is not None for layout in layouts.values())),
        secoc=int(features.secoc),
        float=int(features.single),
        slots=features.slots,
        max_pages=limits.pages,
        max_transfer_ids=limits.transfer_ids,
        max_components=components,
        transfers=min(limits.transfer_ids, 2 * _power_of_two(components)),
        history=2 * E2EConfig().max_delta_counter * _power_of_two(components),
        epochs=EPOCHS,
        window=WINDOW,
    )


def roomy_build(layout: Layout) -> Build:
    """Return the library for a DBC with all features, which remembers as much as Python does."""
    build = build_of({"": layout})
    sizes = {"transfers": build.max_transfer_ids, "history": 256, "epochs": 8, "window": 255}
    return build._replace(line_records=1, **sizes)  # with them lines are kept, not only records


def _power_of_two(least: int) -> int:
    """Return the least power of 2 that is not less."""
    return 1 << (least - 1).bit_length()
