#!/usr/bin/env python3
"""Write a random DBC that the codec accepts: anything that a DBC may choose is chosen at random.

    random_dbc.py SEED              print the DBC
    random_dbc.py SEED -o FILE      write it to a file

The base is one of the project's DBCs, in turn. Chosen are the order of the rows of the covariance,
widths, factors and offsets, the pages and the places of all signals, the byte order of each page,
where page and transfer numbers stand, CAN IDs of 11 and 29 bits, data IDs, slots and cycle times.

Seeds from 500 on are of whole scenes, of 1 to 8 lines in a message. Seeds from 1000 on are at the
limits of the C core: 256 transfer IDs, 64 components, and records of 9 to 16 pages, which are too
long for CAN FD.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from cantools.database.can import Message
from reporting import parser_of

from maplines_can.generation.dbc.cholesky_signals import pivot_signal, ratio_signal
from maplines_can.generation.dbc.dbc_writer import DbcWriter, PoseSpec, SceneSpec
from maplines_can.generation.dbc.record_pages import SignalSpec
from maplines_can.generation.dbc.record_spec import (
    CONDITIONAL,
    DEFAULT,
    SCENES,
    SECURED,
    WHOLE_SCENES,
)
from maplines_can.values.errors import LayoutError
from maplines_can.values.line import Slot
from maplines_can.wire import Codec
from maplines_can.wire.layout.message_layout import Layout
from maplines_can.wire.layout.pose_layout import SCENE, SCENE2, SceneOwner
from maplines_can.wire.layout.record_signals import (
    FINE,
    OF_SLOT,
    PAGE,
    PARAMETER_SIGNALS,
    POSE_PREFIX,
    POSE_ROWS,
    SLOT,
    TRANSFER_ID,
    slot_title,
)

BASES = (DEFAULT, CONDITIONAL, SECURED)
#: Ends of the ranges of pivots [octave], by row.
PIVOT_ENDS = {
    "YOff": (-12, 5), "Beta": (-18, -1), "C0": (-23, -3), "C1": (-32, -5),
    "Along": (-12, 8), "Across": (-12, 8), "Heading": (-18, -1),
}  # fmt: skip
#: Bytes of a page and of the checksum.
PAGE_BYTES, CRC_BYTES = 8, 2
#: Bytes of a frame of CAN FD, and least bits of a signal of a line in a whole scene.
FRAME_BYTES, MIN_BITS = 64, 3
#: Signals of which a DBC may not choose the bits, or need not.
FIXED_BITS = ("Crc", "Status", "Kind", "HasCovariance", "OwnTilt")
#: Bits of the page numbers of the pose error, and of those at the limits.
POSE_PAGE_BITS, LIMIT_PAGE_BITS = 3, 4
#: First seeds of DBCs of whole scenes, and of DBCs at the limits.
SCENE_SEED, LIMIT_SEED = 500, 1000
MAX_TRIES = 200

Specs = list[SignalSpec]


ByteOrder = Literal["little_endian", "big_endian"]
ORDERS: tuple[ByteOrder, ...] = ("little_endian", "big_endian")


class Place(NamedTuple):
    """Start of a signal in its page, and its byte order."""

    start: int
    byte_order: ByteOrder


def random_dbc(seed: int) -> str:
    """Return the text of the random DBC of a seed."""
    rng = np.random.default_rng(seed)
    for _ in range(MAX_TRIES):
        try:
            is_scene = SCENE_SEED <= seed < LIMIT_SEED
            text = _scene_text(rng) if is_scene else _text(rng, *_base(seed))
            Codec(Layout.from_text(text))
        except (LayoutError, StopIteration, ValueError):
            continue  # such as ratios that are too ill-conditioned together, or too many pages
        return text
    raise RuntimeError(f"no DBC of seed {seed} is accepted")


def _base(seed: int) -> tuple[DbcWriter, bool]:
    """Return the base of a seed, and whether it is driven to the limits."""
    if seed < LIMIT_SEED:
        return BASES[seed % len(BASES)], False
    without_mac = replace(BASES[seed % 2], first_secured_can_id=None)  # there is no room for one
    return without_mac, True


def _text(rng: np.random.Generator, base: DbcWriter, at_limits: bool) -> str:
    """Return the text of a random DBC, which the codec may refuse."""
    if base.pose is None:
        raise ValueError("the base needs a message of the pose error")
    component_bits, pose_bits = int(rng.integers(1, 4)), int(rng.integers(1, 4))
    transfer_bits = int(rng.integers(1 if base.optional_pages else component_bits + 1, 6))
    numbers_bytes, pose_page_bits = 1, POSE_PAGE_BITS
    room = 8 * (PAGE_BYTES - numbers_bytes)
    if at_limits:
        component_bits, pose_bits, transfer_bits = 6, 8, 8
        numbers_bytes, pose_page_bits = 2, LIMIT_PAGE_BITS
        room = int(rng.integers(21, 33))
    most = 4 if base.first_secured_can_id is not None else len(Slot)
    slots = tuple(sorted(rng.permutation(list(Slot))[: rng.integers(1, most + 1)].tolist()))
    titles = tuple(slot_title(Slot(slot)) for slot in slots)
    others = tuple(slot_title(slot) for slot in Slot if slot not in slots)
    of_pose = [spec for spec in _flat(base.pose.pages) if not spec.name.startswith(others)]
    lines = [_changed(rng, spec, component_bits) for spec in _flat(base.pages)]
    lines = _with_rows(rng, _with_fine(rng, lines), PARAMETER_SIGNALS)
    pose = _with_rows(rng, _same_of_slots(_all_changed(rng, of_pose), titles), POSE_ROWS)
    short = _in_pages(rng, [spec for spec in lines if not _is_long(base, spec)], room)
    long = _in_pages(rng, [spec for spec in lines if _is_long(base, spec)], room)
    if at_limits and not 8 < len(short) + len(long) <= 2**LIMIT_PAGE_BITS:
        raise ValueError("the record is not as long as it should be")
    ids = rng.choice(np.arange(0x100, 0x700, 0x10), 7, replace=False).tolist()
    pose_spec = PoseSpec(
        _in_pages(rng, pose, room),
        page_bits=pose_page_bits,
        transfer_id_bits=pose_bits,
        can_id=ids[3],
        fd_can_id=ids[4],
        secured_can_id=ids[5],
        data_id=0x8000 + ids[6],
    )
    writer = replace(
        base,
        pages=(*short, *long),
        slots=tuple(map(Slot, slots)),
        first_can_id=ids[0],
        first_fd_can_id=ids[1],
        first_secured_can_id=None if base.first_secured_can_id is None else ids[2],
        first_data_id=int(rng.integers(0, 0x7000)),
        cycle_ms=int(rng.choice([10, 20, 50, 100])),
        transfer_id_bits=transfer_bits,
        optional_pages=len(long),
        pose=pose_spec,
    )
    database = writer.database()
    page_bits = max(1, (len(writer.pages) - 1).bit_length())
    of_lines = _places(rng, writer.pages, (page_bits, transfer_bits), numbers_bytes)
    of_pose_error = _places(rng, pose_spec.pages, (pose_page_bits, pose_bits), numbers_bytes)
    for message in database.messages:
        _move(message, of_pose_error if message.name.startswith("Pose") else of_lines)
    database.refresh()
    return _extended(rng, str(database.as_dbc_string(sort_signals=None)), ids[0], len(Slot))


# ---- whole scenes ----------------------------------------------------------------------------


def _scene_text(rng: np.random.Generator) -> str:
    """Return the text of a random DBC of whole scenes, which the codec may refuse."""
    places = int(rng.choice([1, 2, 3, 4, 4, 4, 5, 8]))
    slots = [Slot(number) for number in rng.permutation(len(Slot))]
    fixed: dict[SceneOwner, tuple[Slot, ...]] = {
        owner: tuple(slots.pop() for _ in range(min(places, int(rng.integers(0, 4)))))
        for owner in ((SCENE2, SCENE) if rng.random() < 0.75 else (SCENE,))
    }
    secured_places = int(rng.integers(1, places + 1))
    inner = min(len(SCENES.tails), secured_places, *map(len, fixed.values()))
    in_lines = [spec.name for spec in SCENES.tails[: rng.integers(0, inner + 1)]]
    shared = _with_rows(rng, _all_changed(rng, [*SCENES.head, *SCENES.tails]), POSE_ROWS)
    head = [spec for spec in shared if spec.name not in in_lines]
    tails = [spec for spec in shared if spec.name in in_lines]
    tail_bits = max(spec.bits for spec in (*tails, SCENES.slot))
    room = (FRAME_BYTES - -(-sum(spec.bits for spec in head) // 8)) // places
    line = _narrowed(_all_changed(rng, [*SCENES.line]), 8 * room - tail_bits)
    is_secured, first_id = bool(rng.random() < 0.5), int(rng.integers(0x100, 0x700))
    scene = SceneSpec(
        tuple(head), tuple(line), tuple(tails), SCENES.slot, fixed, places, secured_places,
        first_can_id=first_id, first_data_id=int(rng.integers(0, 0x7000)),
    )  # fmt: skip
    writer = replace(
        WHOLE_SCENES,
        scene=scene,
        first_secured_can_id=first_id + len(fixed) if is_secured else None,
        freshness_bytes=int(rng.integers(3, 8)),
        mac_bytes=int(rng.integers(4, 9)),
        cycle_ms=int(rng.choice([10, 20, 50, 100])),
    )
    database = writer.database()
    bits = [(spec.name, spec.bits) for spec in head if spec.name != "Crc"]
    in_head = _in_row(rng, bits, 8 * CRC_BYTES, 8 * (scene.head_bytes - CRC_BYTES), _order(rng))
    bits = [*((spec.name, spec.bits) for spec in line), (SLOT, tail_bits)]
    in_line = _in_row(rng, bits, 0, 8 * scene.stride_bytes, _order(rng))
    for message in database.messages:
        owner = SCENE2 if message.name.startswith("Scene2") else SCENE
        found = in_head | {"Crc": Place(0, "little_endian")}
        for number, title in enumerate(scene.titles(owner, places)):
            first = 8 * (scene.head_bytes + scene.stride_bytes * number)
            own = {name: Place(first + start, order) for name, (start, order) in in_line.items()}
            found |= {f"{title}{name}": place for name, place in own.items()}
            found |= {spec.name: own[SLOT] for spec in tails[number : number + 1]}
        for signal in message.signals:
            place = found.get(signal.name)  # none of the trailer of an authenticated message
            signal.start, signal.byte_order = place or (signal.start, signal.byte_order)
    database.refresh()
    text = str(database.as_dbc_string(sort_signals=None))
    return _extended(rng, text, first_id, 2 * len(fixed))


def _narrowed(specs: Specs, bits: int) -> Specs:
    """Return signals whose bits are so many at most: the widest ones have fewer."""
    specs = [*specs]
    while sum(spec.bits for spec in specs) > bits:
        free = [spec for spec in specs if spec.name not in FIXED_BITS]
        widest = max(free, key=lambda spec: spec.bits)
        if widest.bits <= MIN_BITS:
            raise ValueError("the lines have no room")
        is_exact = widest.name in ("XMin", "XMax")
        fewer = replace(widest, bits=widest.bits - 1) if is_exact else widest.finer(-1)
        specs[specs.index(widest)] = fewer
    return specs


def _flat(pages: Sequence[Sequence[SignalSpec]]) -> Specs:
    return [spec for page in pages for spec in page]


def _is_long(base: DbcWriter, spec: SignalSpec) -> bool:
    """Return whether only a record with a covariance has a signal."""
    is_of_covariance = spec.name.startswith(("Pivot", "Ratio", "Inflation")) or FINE in spec.name
    return base.optional_pages > 0 and is_of_covariance


def _all_changed(rng: np.random.Generator, specs: Specs) -> Specs:
    return [_changed(rng, spec, 1) for spec in specs]


def _changed(rng: np.random.Generator, spec: SignalSpec, component_bits: int) -> SignalSpec:
    """Return a signal with another width, factor and offset, as far as it may have them."""
    name = spec.name
    more = int(rng.integers(0, 3))
    if name == "Counter":
        return replace(spec, bits=int(rng.integers(5, 11)))
    if name.endswith("Counter"):
        return replace(spec, bits=int(rng.integers(3, 5)))
    if name in FIXED_BITS:
        return spec
    if name == "ComponentIndex":
        return replace(spec, bits=component_bits + more)
    if name == "ComponentCount":
        return replace(spec, bits=component_bits)
    if name == "ComponentWeight":
        bits = component_bits + more + 1
        return replace(spec, bits=bits, factor=2.0**-bits, offset=2.0**-bits)
    if name == "Age":
        return replace(spec, bits=4 + more, factor=float(rng.choice([2, 8, 10.5])))
    if name in ("XMin", "XMax"):
        if spec.factor == 1:
            return replace(spec, bits=spec.bits + more, offset=spec.offset - 8 * more)
        factor = float(rng.choice([1, 2.5, 4, 5]))
        return replace(spec, bits=spec.bits + more, factor=factor, offset=spec.offset - 3 * more)
    if name.endswith(("FitBehind", "FitAhead")):
        return replace(spec, bits=spec.bits + more)
    if name.endswith(("CorrelationTime", "Quartic")):
        return spec.finer(more)
    if name in PARAMETER_SIGNALS:
        shift = float(rng.choice([0, 0, 37])) * spec.factor
        return replace(spec.finer(int(rng.integers(-1, 3))), offset=shift)
    return spec.finer(int(rng.integers(-1, 2)))


def _with_fine(rng: np.random.Generator, specs: Specs) -> Specs:
    """Return signals whose fine ones refine a step of the coarse ones."""
    coarse = {spec.name: spec for spec in specs}
    result = []
    for spec in specs:
        if spec.name.endswith(FINE):
            bits = int(rng.integers(2, 5))
            factor = coarse[spec.name.removesuffix(FINE)].factor / 2**bits
            spec = replace(spec, bits=bits, factor=factor, offset=0)
        result.append(spec)
    return result


def _same_of_slots(specs: Specs, titles: Sequence[str]) -> Specs:
    """Return signals in which all slots have the widths of the first one."""
    first = {spec.name: spec for spec in specs}
    result = []
    for spec in specs:
        for title in titles:
            own = spec.name.removeprefix(title)
            if own in OF_SLOT and own != spec.name:
                spec = replace(first[titles[0] + own], name=spec.name)
        result.append(spec)
    return result


def _with_rows(rng: np.random.Generator, specs: Specs, rows: Sequence[str]) -> Specs:
    """Return signals with a random Cholesky code of these rows in place of the one they have."""
    kept = [spec for spec in specs if not spec.name.startswith(("Pivot", "Ratio", "Inflation"))]
    inflation = next(spec for spec in specs if spec.name == "Inflation")
    order = [rows[i] for i in rng.permutation(len(rows))]
    code: Specs = []
    for i, row in enumerate(order):
        low, high = PIVOT_ENDS[row]
        bits = int(rng.integers(7, 11))
        code.append(pivot_signal(row, tuple(order[:i]), bits, (high - low) / 2**bits, low))
        for column in order[:i]:
            bits = int(rng.integers(6, 13))
            reach = float(rng.choice([1, 4, 32, 128]))
            zero = float(rng.choice([0.5, 0.5, 0.375, 0.75]))
            code.append(ratio_signal(row, column, bits, 2 * reach / 2**bits, zero))
    bits = int(rng.integers(2, 5))
    return [*kept, *code, replace(inflation, bits=bits, factor=float(rng.choice([0.0124, 0.03])))]


def _in_pages(
    rng: np.random.Generator, specs: Specs, room: int
) -> tuple[tuple[SignalSpec, ...], ...]:
    """Distribute signals to pages with so many bits at random; the first has checksum, counter."""
    head = [spec for spec in specs if spec.name in ("Crc", "Counter")]
    rest = [spec for spec in specs if spec.name not in ("Crc", "Counter")]
    pages: list[Specs] = [head] if head else []
    for i in rng.permutation(len(rest)):
        fitting = (page for page in pages if sum(s.bits for s in page) + rest[i].bits <= room)
        page = next(fitting, None)
        if page is None:
            pages.append(page := [])
        page.append(rest[i])
    return tuple(map(tuple, pages))


def _places(
    rng: np.random.Generator,
    pages: Sequence[Sequence[SignalSpec]],
    numbers_bits: tuple[int, int],
    numbers_bytes: int,
) -> dict[str, Place]:
    """Return random places of the signals of a record in their pages, by name.

    The numbers of page and transfer, with so many bits, are in the first or last bytes of a page.
    """
    numbers_byte = int(rng.choice([0, PAGE_BYTES - numbers_bytes]))
    numbers = [*zip((PAGE, TRANSFER_ID), numbers_bits, strict=True)]
    places = _in_row(rng, numbers, 8 * numbers_byte, 8 * numbers_bytes, _order(rng))
    for page in pages:
        first = 8 * numbers_bytes * (numbers_byte == 0)
        length = 8 * (PAGE_BYTES - numbers_bytes)
        signals = [(spec.name, spec.bits) for spec in page if spec.name != "Crc"]
        if len(signals) < len(page):
            length -= 8 * CRC_BYTES
            is_first = rng.random() < 0.5
            places["Crc"] = Place(first if is_first else first + length, "little_endian")
            first += 8 * CRC_BYTES * is_first
        places |= _in_row(rng, signals, first, length, _order(rng))
    return places


def _order(rng: np.random.Generator) -> ByteOrder:
    return ORDERS[rng.integers(len(ORDERS))]


def _in_row(
    rng: np.random.Generator,
    signals: list[tuple[str, int]],
    first: int,
    length: int,
    order: ByteOrder,
) -> dict[str, Place]:
    """Return places of signals in random order, with gaps, from a bit at a byte boundary on."""
    gaps = rng.multinomial(
        length - sum(bits for _, bits in signals), [1 / (len(signals) + 1)] * (len(signals) + 1)
    )
    places, begin = {}, first
    for gap, i in zip(gaps, rng.permutation(len(signals)), strict=False):
        name, bits = signals[i]
        begin += int(gap)
        start = begin if order == "little_endian" else begin // 8 * 8 + 7 - begin % 8
        places[name] = Place(start, order)
        begin += bits
    return places


def _move(message: Message, places: dict[str, Place]) -> None:
    """Move the signals of a message to their places."""
    for signal in message.signals:
        base = re.sub(rf"^(?:{POSE_PREFIX})?({PAGE}|{TRANSFER_ID})\d*$", r"\1", signal.name)
        if base not in places:
            continue  # of the trailer of an authenticated message
        start, order = places[base]
        page = 0 if message.length == PAGE_BYTES and not message.is_fd else signal.start // 64
        signal.start, signal.byte_order = 64 * page + start, order


def _extended(rng: np.random.Generator, text: str, first: int, count: int) -> str:
    """Return a DBC in which half of the classic messages, at random, have CAN IDs of 29 bits."""
    for can_id in range(first, first + count):
        if rng.random() < 0.5:
            wide = can_id << 16 | 0x80000000
            text = re.sub(
                rf"\b(BO_|SG_|SG_MUL_VAL_|VAL_|BO_TX_BU_) {can_id}\b", rf"\1 {wide}", text
            )
    return text


def main() -> int:
    """Write a random DBC; return the exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("seed", type=int, help="0 or more; another one gives another DBC")
    parser.add_argument("-o", "--out", type=Path, help="file to write; by default, print it")
    options = parser.parse_args()
    text = random_dbc(options.seed)
    if options.out is None:
        print(text, end="")
    else:
        options.out.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
