"""Records of whole scenes: the description of each signal, and its place."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from cantools.database.can import Signal

from ...values.line import Slot
from ...wire.layout.pose_layout import SCENE, SCENE2, SceneOwner
from ...wire.layout.signals import LINE, slot_title
from .record_pages import SignalSpec, cells_of, dbc_signal, table_head

#: Names of the messages, in the order in which they are sent.
MESSAGES: Mapping[SceneOwner, str] = {SCENE2: "Scene2", SCENE: "Scene"}


@dataclass(frozen=True)
class SceneSpec:
    """Messages of whole scenes: the pose error, and lines at equal distances of whole bytes.

    The last bits of a line without a fixed slot name its slot; those of the others have room for
    signals of the record.

    Args:
        head: signals before the lines, in the order of their bits.
        line: signals of each line, in the order of their bits.
        tails: signals of the record in the last bits of the first lines, which have a fixed slot.
        slot: signal in the last bits of lines without a fixed slot.
        fixed: slots of the first lines of each message; without Scene2 there is no such message.
        places: lines of a record.
        secured_places: lines of an authenticated record.
        first_can_id: of Scene2; Scene follows, then the authenticated messages.
        first_data_id: E2E data ID of Scene2; that of Scene follows, then their SecOC data IDs.

    Raises:
        ValueError: a tail is not in a line with a fixed slot of each record.
    """

    head: tuple[SignalSpec, ...]
    line: tuple[SignalSpec, ...]
    tails: tuple[SignalSpec, ...]
    slot: SignalSpec
    fixed: Mapping[SceneOwner, tuple[Slot, ...]]
    places: int = 4
    secured_places: int = 3
    first_can_id: int = 0x378
    first_data_id: int = 0x4D78

    def __post_init__(self) -> None:
        for owner, slots in self.fixed.items():
            if len(self.tails) > min(len(slots), self.secured_places):
                raise ValueError(
                    f"{MESSAGES[owner]} has {len(slots)} fixed slots and {self.secured_places} "
                    f"places if it is authenticated, but there are {len(self.tails)} tails"
                )

    @property
    def head_bytes(self) -> int:
        """Bytes before the lines."""
        return _whole_bytes(sum(spec.bits for spec in self.head))

    @property
    def stride_bytes(self) -> int:
        """Bytes from one line to the next."""
        tail = max(spec.bits for spec in (*self.tails, self.slot))
        return _whole_bytes(sum(spec.bits for spec in self.line) + tail)

    def record_bytes(self, places: int) -> int:
        """Bytes of a record of so many lines."""
        return self.head_bytes + self.stride_bytes * places

    def titles(self, owner: SceneOwner, places: int) -> list[str]:
        """Return the starts of the names of so many lines."""
        fixed = [*map(slot_title, self.fixed[owner])]
        return [*fixed, *(f"{LINE}{i + 1}" for i in range(len(fixed), places))][:places]

    def signals(self, owner: SceneOwner, places: int) -> list[Signal]:
        """Return the signals of a record of so many lines."""
        signals = [dbc_signal(spec, start) for spec, start in _in_row(self.head)]
        for place, title in enumerate(self.titles(owner, places)):
            first = 8 * (self.head_bytes + self.stride_bytes * place)
            for spec, start in _in_row(self.line):
                signals.append(dbc_signal(_of_line(spec, title), first + start))
            names_slot = place >= len(self.fixed[owner])
            tails = [_of_line(self.slot, title)] if names_slot else self.tails[place : place + 1]
            end = first + 8 * self.stride_bytes
            signals += [dbc_signal(tail, end - tail.bits) for tail in tails]
        return signals

    def table(self) -> str:
        """Return the fields as a Markdown table, for the page beside the DBC.

        Bits of a line, as ``*``, are counted from its first byte.
        """
        end = 8 * self.stride_bytes
        rows = [
            *(("", spec, start) for spec, start in _in_row(self.head)),
            *(("each line: ", _of_line(spec, "*"), start) for spec, start in _in_row(self.line)),
            *(
                (f"line {place}: ", spec, end - spec.bits)
                for place, spec in enumerate(self.tails, start=1)
            ),
            ("other lines: ", _of_line(self.slot, "*"), end - self.slot.bits),
        ]
        lines = [
            f"| {where}{start}..{start + spec.bits - 1} | {cells_of(spec)} |"
            for where, spec, start in rows
        ]
        return "\n".join([table_head("bits"), *lines])


def _whole_bytes(bits: int) -> int:
    return -(-bits // 8)


def _in_row(specs: tuple[SignalSpec, ...]) -> Iterator[tuple[SignalSpec, int]]:
    """Yield signals that follow each other, and their first bits."""
    start = 0
    for spec in specs:
        yield spec, start
        start += spec.bits


def _of_line(spec: SignalSpec, title: str) -> SignalSpec:
    return replace(spec, name=f"{title}{spec.name}")
