"""Design of records of whole scenes: the fields that tell most of a scene in one frame.

The frame has 64 bytes, or 51 of a record that is authenticated, and the bits of all lines are
alike. So bits are exchanged: one field has one less, another one of the same line or of the pose
error one more. The ranges of levels move, too, and steps of the pose error and of the mean double
or halve over more or less of a range. Of all changes that lower the loss, the best is taken, until
there is none.

The loss is what decoded standard deviations of y, width and centre are above the computed ones, in
units of the targets, see ``excess``; each map counts as much. It is measured: scenes of the maps,
and of random roads, go through the DBC and the codec. The decoded joint covariance is definite and
covers the computed one with any widths.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ...generation.dbc.dbc_writer import DbcWriter, SceneSpec, SignalSpec, write_dbc
from ...generation.dbc.record_spec import CONDITIONAL, POSE, WHOLE_SCENES
from ...values.errors import LayoutError
from ...values.text_table import aligned, markdown, percent
from ...wire import Codec
from ...wire.layout.record_signals import OCTAVE, OWN_SIGNALS, PARAMETER_SIGNALS
from ..scenes.map_scenes import DrawnScene
from ..scenes.sigma_ratios import LANE_AT, LINE_AT, Ratios, excess, headings, measured, merged
from .planner import INFLATION

#: Least bits of a field.
MIN_BITS = 2
#: Share of its octaves by which an end of a range of levels moves.
END = 1 / 12
#: Least relative improvement; smaller ones are noise of the scenes.
MIN_GAIN = 2e-3
#: Fields whose bits others may get in a round.
CHEAPEST = 2
#: Changes that are tried together in a round, the best ones.
TRIED = 12
#: Lines that a frame may be designed for.
LINES = (3, 6)
#: Bytes of a frame of CAN FD, and those of an authenticated one after its record.
FRAME_BYTES, TRAILER_BYTES = 64, 13
#: Fields, by name.
Fields = Mapping[str, SignalSpec]


@dataclass(frozen=True)
class WholeSceneDesign:
    """Fields of records of whole scenes, and what they do."""

    fields: Fields
    lines: int
    #: figures of each map, of the search and of scenes that it has not seen, by the fields
    figures: Mapping[str, Mapping[str, Mapping[str, Ratios]]]
    losses: Mapping[str, Mapping[str, float]]  #: of the same
    a_bit_less: Mapping[str, float]  #: loss of a bit less in each field; NaN if it has no fewer

    @property
    def writer(self) -> DbcWriter:
        """Writer of the DBC."""
        return writer_of(self.fields, self.lines)

    def text(self) -> str:
        """Return the figures and the fields as text."""
        return "\n".join([self._about(), "", *self._tables(lambda rows: aligned(rows, left=1))])

    def _about(self) -> str:
        scene = scene_of(self.writer)
        pose = sum(spec.bits for spec in scene.head) - sum(spec.bits for spec in scene.head[:2])
        return (
            f"{FRAME_BYTES} bytes: {self.lines} lines of {8 * scene.stride_bytes} bits, "
            f"{pose} bits of the pose error; authenticated: {scene.secured_places} lines in "
            f"{scene.record_bytes(scene.secured_places)} bytes"
        )

    def _tables(self, table: Callable[[Sequence[Sequence[str]]], str]) -> Iterator[str]:
        for scenes, by_fields in self.figures.items():
            rows = [("", "left out", "wider", "loss", *headings(PLACES))]
            for name, of_maps in by_fields.items():
                every = Ratios.sum(of_maps.values())
                rows.append((f"{name}", *_cells(every, self.losses[scenes][name])))
            for source, ratios in by_fields[FOUND].items():
                rows.append((f"  {source}", *_cells(ratios, excess(ratios))))
            yield f"{scenes}: median and 99 % of sigma, decoded over computed"
            yield table(rows)
            yield ""
        before = {TODAY: todays(), SHIPPED: fields_of(WHOLE_SCENES)}
        head = ("field", "bits", *before, "step", "range", "loss with a bit less")
        yield table(
            [
                head,
                *(
                    (
                        name,
                        str(spec.bits),
                        *(str(fields[name].bits) for fields in before.values()),
                        f"{spec.factor:.6g}",
                        f"{spec.range[0]:.6g} .. {spec.range[1]:.6g} {spec.unit}".rstrip(),
                        f"{self.a_bit_less[name]:+.3f}",
                    )
                    for name, spec in self.fields.items()
                ),
            ]
        )

    def as_dict(self) -> dict[str, Any]:
        """Return all figures and fields, for JSON."""
        return {
            "lines": self.lines,
            "fields": {
                name: {"bits": spec.bits, "factor": spec.factor, "offset": spec.offset}
                for name, spec in self.fields.items()
            },
            "losses": {scenes: dict(losses) for scenes, losses in self.losses.items()},
            "figures": {
                scenes: {
                    name: {source: ratios.as_dict() for source, ratios in of_maps.items()}
                    for name, of_maps in by_fields.items()
                }
                for scenes, by_fields in self.figures.items()
            },
            "a_bit_less": dict(self.a_bit_less),
        }

    def write(self, path: str | Path, command: str) -> tuple[Path, Path]:
        """Write the DBC, and its page with the same name and the suffix ``.md``."""
        tables = "\n".join(self._tables(lambda rows: "\n" + markdown(rows, left=1)))
        text = (
            f"{self._about()}.\n\nDesigned by\n\n    {command}\n\n{tables}\n"
            f"## The record\n\n{self.writer.table()}\n"
        )
        return write_dbc(self.writer, path, lambda name: f"# {name}\n\n{text}")


#: What is compared, and where [m].
PLACES = (
    *(("y", x) for x in LINE_AT),
    *((what, x) for what in ("width", "centre") for x in LANE_AT),
)
#: Names of fields: as of maplines-pose.dbc, as of maplines-scene.dbc, and as found.
TODAY, SHIPPED, FOUND = "maplines-pose.dbc", "maplines-scene.dbc", "found"


def _cells(ratios: Ratios, loss: float) -> list[str]:
    """Return the cells of figures."""
    shares = ratios.left_out_share, ratios.wider_share
    return [*map(percent, shares), f"{loss:.2f}", *ratios.cells(PLACES)]


# ---- fields -------------------------------------------------------------------------------------


def scene_of(writer: DbcWriter) -> SceneSpec:
    """Return the messages of whole scenes of a DBC.

    Raises:
        ValueError: it has none.
    """
    if writer.scene is None:
        raise ValueError("the DBC has no messages of whole scenes")
    return writer.scene


def fields_of(writer: DbcWriter) -> dict[str, SignalSpec]:
    """Return the fields that are designed: of the pose error, and of a line."""
    scene = scene_of(writer)
    starts = ("Pivot", "Ratio", "Map", *OWN_SIGNALS, *PARAMETER_SIGNALS, INFLATION)
    specs = (*scene.head, *scene.line, *scene.tails)
    return {spec.name: spec for spec in specs if spec.name.startswith(starts)}


def todays() -> dict[str, SignalSpec]:
    """Return the fields with the widths of maplines-pose.dbc."""
    pages = (*CONDITIONAL.pages[: -CONDITIONAL.optional_pages], *POSE.pages)
    known = {spec.name: spec for page in pages for spec in page}
    fields = fields_of(WHOLE_SCENES)
    return {name: known.get(name, spec) for name, spec in fields.items()}


def writer_of(fields: Fields, lines: int) -> DbcWriter:
    """Return the writer of the DBC with other fields, and so many lines in a frame."""
    shipped = scene_of(WHOLE_SCENES)

    def changed(specs: tuple[SignalSpec, ...]) -> tuple[SignalSpec, ...]:
        return tuple(fields.get(spec.name, spec) for spec in specs)

    scene = replace(
        shipped,
        head=changed(shipped.head),
        line=changed(shipped.line),
        tails=changed(shipped.tails),
        places=lines,
        secured_places=lines,
    )
    room = FRAME_BYTES - TRAILER_BYTES - scene.head_bytes
    scene = replace(scene, secured_places=min(lines, room // scene.stride_bytes))
    return replace(WHOLE_SCENES, scene=scene)


def resized(spec: SignalSpec, more: int) -> SignalSpec:
    """Return a field with more or fewer bits over the same range."""
    return replace(spec.finer(more), why=_why(spec))


def _why(spec: SignalSpec) -> str:
    return spec.why if spec.why.startswith("found") else f"found by maplines design ({spec.why})"


# ---- search -------------------------------------------------------------------------------------


def design_whole_scenes(
    drawn: Sequence[DrawnScene],
    held_out: Sequence[DrawnScene],
    *,
    lines: int = 4,
    rounds: int = 10,
    progress: Callable[[float, float], object] = lambda _done, _total: None,
) -> WholeSceneDesign:
    """Find the fields of records of whole scenes that fill a frame best.

    Args:
        drawn: scenes for the search.
        held_out: scenes for the figures.
        lines: of a frame.
        rounds: of the search, at most; 0 to only measure the fields of maplines-scene.dbc.
        progress: called with the work done and the total.

    Raises:
        ValueError: the number of lines is out of range.
    """
    if not LINES[0] <= lines <= LINES[1]:
        raise ValueError(f"lines must be {LINES[0]} to {LINES[1]}, as a frame holds, got {lines!r}")
    search = _Search(drawn, lines, progress)
    found = search.filled(fields_of(WHOLE_SCENES))
    for _ in range(rounds):
        better = search.improved(found)
        if better is found:
            break
        found = better
    costs = search.costs(found, -1)
    now = search.loss(found)
    candidates = {FOUND: found}
    if search.fits(fields_of(WHOLE_SCENES)):
        candidates = {TODAY: todays(), SHIPPED: fields_of(WHOLE_SCENES), **candidates}
    figures, losses = {}, {}
    for name, scenes in (("scenes of the search", drawn), ("other scenes", held_out)):
        figures[name] = {key: search.figures(one, scenes) for key, one in candidates.items()}
        losses[name] = {key: loss_of(of_maps) for key, of_maps in figures[name].items()}
    progress(1.0, 1.0)
    less = {name: costs.get(name, math.nan) - now for name in found}
    return WholeSceneDesign(found, lines, figures, losses, less)


def loss_of(figures: Mapping[str, Ratios]) -> float:
    """Return the loss of figures of maps."""
    return float(np.mean([excess(ratios) for ratios in figures.values()]))


class _Search:
    """Search for fields on some scenes."""

    def __init__(
        self,
        scenes: Sequence[DrawnScene],
        lines: int,
        progress: Callable[[float, float], object],
    ) -> None:
        self._scenes, self._lines, self._progress = scenes, lines, progress
        self._left = 1.0
        self._losses: dict[object, float] = {}
        scene = scene_of(WHOLE_SCENES)
        self._of_line = {spec.name for spec in scene.line}
        ends = max(spec.bits for spec in (*scene.tails, scene.slot))
        fixed = sum(spec.bits for spec in scene.line) + ends
        fixed -= sum(spec.bits for spec in fields_of(WHOLE_SCENES).values() if self._is_own(spec))
        room = 8 * ((FRAME_BYTES - scene.head_bytes) // lines)
        #: Bits of the designed fields of a line, and of the pose error.
        self._room = {True: room - fixed, False: self._bits(fields_of(WHOLE_SCENES), of_line=False)}

    def _is_own(self, spec: SignalSpec) -> bool:
        return spec.name in self._of_line

    def _bits(self, fields: Fields, *, of_line: bool) -> int:
        return sum(spec.bits for spec in fields.values() if self._is_own(spec) == of_line)

    def fits(self, fields: Fields) -> bool:
        """Whether the fields fit into the frame."""
        return all(self._bits(fields, of_line=of) <= room for of, room in self._room.items())

    def figures(self, fields: Fields, scenes: Sequence[DrawnScene]) -> dict[str, Ratios]:
        """Send scenes with these fields, and return the figures of each map.

        Fields that are too many for the lines of a frame are sent with fewer lines in it, and so
        with more in the second frame: what is decoded is the same.
        """
        writer = writer_of(fields, self._lines)
        for lines in range(self._lines - 1, LINES[0] - 1, -1):
            scene = scene_of(writer)
            if scene.record_bytes(scene.places) > FRAME_BYTES:
                writer = writer_of(fields, lines)
        codec = Codec(writer.layout())
        return merged(measured(codec, scenes), 0)

    def loss(self, fields: Fields) -> float:
        """Return the loss of fields; infinite if a DBC may not have them."""
        key = tuple((spec.bits, spec.factor, spec.offset) for spec in fields.values())
        if key not in self._losses:
            self._left *= 0.99  # the number of steps is unknown: each is a share of the rest
            self._progress(1 - self._left, 1.0)
            try:
                self._losses[key] = loss_of(self.figures(fields, self._scenes))
            except LayoutError:
                self._losses[key] = math.inf
        return self._losses[key]

    def costs(self, fields: Fields, more: int) -> dict[str, float]:
        """Return the losses with more or fewer bits in one of the fields, as far as it can."""
        found = {}
        for name, spec in fields.items():
            # Inflation shares its place with other signals of the record, all of one width.
            if name != INFLATION and spec.bits + more >= MIN_BITS:
                found[name] = self.loss({**fields, name: resized(spec, more)})
        return found

    def filled(self, fields: Fields) -> Fields:
        """Return fields that fill the frame: bit after bit, where it costs least or gains most.

        A bit costs about as much whatever other fields have: it is measured again when it is next.

        Raises:
            ValueError: the least bits are too many.
        """
        more = 1 if self.fits(fields) else -1
        now, costs = self.loss(fields), self.costs(fields, more)
        costs = {name: cost - now for name, cost in costs.items() if name in self._of_line}
        while costs if more > 0 else not self.fits(fields):
            if not costs:
                raise ValueError(
                    f"lines must be fewer than {self._lines}: even with {MIN_BITS} bits a field "
                    f"they do not fit into {FRAME_BYTES} bytes"
                )
            name = min(costs, key=lambda name: costs[name])
            other = {**fields, name: resized(fields[name], more)}
            if more > 0 and not self.fits(other):
                return fields
            cost = self.loss(other) - self.loss(fields)
            costs[name] = cost
            if cost <= min(costs.values()):
                fields = other
                if fields[name].bits + more < MIN_BITS:
                    del costs[name]
        return fields

    def improved(self, fields: Fields) -> Fields:
        """Return fields with the changes of a round; the same ones if none is better."""
        changes = [*self._moved(fields), *self._exchanged(fields)]
        changes.sort(key=lambda change: self.loss({**fields, **change}))
        best = fields
        for change in changes[:TRIED]:
            other = {**best, **change}
            if self.loss(other) < self.loss(best) * (1 - MIN_GAIN):
                best = other
        return best

    def _exchanged(self, fields: Fields) -> Iterator[Fields]:
        """Yield changes of a bit, from the fields that need theirs least, to any other one."""
        less = self.costs(fields, -1)
        for of_line in (True, False):
            own = [name for name in less if (name in self._of_line) == of_line]
            for a, b in product(sorted(own, key=lambda name: less[name])[:CHEAPEST], own):
                if a != b:
                    yield {a: resized(fields[a], -1), b: resized(fields[b], 1)}

    def _moved(self, fields: Fields) -> Iterator[Fields]:
        """Yield changes of the ends of a range, and of steps."""
        for name, spec in fields.items():
            if name != INFLATION and spec.unit == OCTAVE:
                for low, high in ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, 1)):
                    yield {name: _moved_ends(spec, low * END, high * END)}
            else:
                for share in (0.7, 1.4) if name == INFLATION else (0.5, 2.0):
                    yield {name: replace(spec, factor=spec.factor * share, why=_why(spec))}


def _moved_ends(spec: SignalSpec, low: float, high: float) -> SignalSpec:
    """Return levels with other ends, in shares of their octaves; in decimals to be read."""
    octaves = spec.factor * 2**spec.bits
    factor = float(f"{spec.factor * (1 + high - low):.3g}")
    offset = round(spec.offset + low * octaves, 2)
    return replace(spec, factor=factor, offset=offset, why=_why(spec))
