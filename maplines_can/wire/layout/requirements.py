"""Requirements on the signals of a record, without which a codec would give wrong results.

``REQUIREMENTS`` has those of single signals, ``RELATIONS`` those of several signals together. A
covariance code states the requirements on its own signals in the same way, and checks them with
``check``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import numpy as np

from ...values.errors import LayoutError
from ...values.line import Kind, Slot, Status
from .packing import pieces_of
from .requirement import (
    BYTES,
    DISTANCE,
    EXACT,
    EXACT_BITS,
    FINITE,
    INTEGER,
    LEVEL,
    NUMBER,
    POSITIVE,
    QUANTITY,
    SOME_RANGE,
    SPACING,
    UNSIGNED,
    WHOLE_METRES,
    WHOLE_RANGE,
    Relation,
    Requirement,
    check,
    holds,
    in_dbc,
    length,
    unit,
)
from .signals import (
    FINE,
    FINE_SIGNALS,
    PAGE,
    PAGE_BYTES,
    SLOT_SIGNALS,
    TRANSFER_ID,
    Signal,
    slot_title,
)

__all__ = [
    "CONDITIONAL_REQUIREMENTS",
    "EXACT",
    "MIN_FRESHNESS_BYTES",
    "POSITIVE",
    "QUANTITY",
    "RELATIONS",
    "REQUIREMENTS",
    "SLOT_COUNTER",
    "Relation",
    "Requirement",
    "bits_of",
    "check",
    "check_record",
    "holds",
    "in_dbc",
    "pages_of",
    "unit",
]

#: Least bits of the counter; with fewer, lost records cannot be told from late ones.
MIN_COUNTER_BITS = 4
#: Least bytes of the freshness value: 3 bytes of microseconds repeat after 16.8 s, 2 after 65 ms.
MIN_FRESHNESS_BYTES = 3
#: Least bits of the counter of a slot in the pose error: eight cycles can be told apart.
MIN_SLOT_COUNTER_BITS = 3
#: Name in ``REQUIREMENTS`` of the counters of slots in the pose error, such as ``EgoLeftCounter``.
SLOT_COUNTER = "*Counter"


def _weights_add_up(signal: Signal) -> bool:
    steps = round(1 / signal.factor)
    exact = np.array([1 / steps, 1.0] if steps else [0.0])
    raw = signal.raw(exact)
    in_range = (signal.limited(raw) == raw).all()
    decoded = signal.physical(raw)
    return bool(in_range and decoded[-1] == 1 and np.abs(decoded - exact).max() < 1e-12)


#: Requirements of each signal of a record and of an authenticated message, by name.
REQUIREMENTS: Mapping[str, Sequence[Requirement]] = {
    "Crc": (
        *NUMBER,
        length(16),
        Requirement("Intel byte order", lambda s: not s.big_endian, "write @1"),
        Requirement("a byte boundary", lambda s: s.start % 8 == 0, "start it at a multiple of 8"),
        WHOLE_RANGE,
    ),
    "Counter": (
        *NUMBER,
        WHOLE_RANGE,
        Requirement(
            f"{MIN_COUNTER_BITS} bits or more",
            lambda s: s.length >= MIN_COUNTER_BITS,
            "widen it, since with fewer bits lost and late records look the same",
        ),
    ),
    TRANSFER_ID: (*NUMBER, WHOLE_RANGE),
    PAGE: NUMBER,
    "YOff": (*QUANTITY, unit("m")),
    "Beta": (*QUANTITY, unit("rad")),
    "C0": (*QUANTITY, unit("1/m")),
    "C1": (*QUANTITY, unit("1/m^2")),
    "YOffFine": (*QUANTITY, POSITIVE, unit("m"), holds(0, 0)),
    "BetaFine": (*QUANTITY, POSITIVE, unit("rad"), holds(0, 0)),
    "C0Fine": (*QUANTITY, POSITIVE, unit("1/m"), holds(0, 0)),
    "C1Fine": (*QUANTITY, POSITIVE, unit("1/m^2"), holds(0, 0)),
    "Status": (*NUMBER, holds(0, max(Status), ", all values of Status")),
    "Kind": (*NUMBER, holds(0, max(Kind), ", all values of Kind")),
    "XMin": (*QUANTITY, POSITIVE, unit("m")),
    "XMax": (*QUANTITY, POSITIVE, unit("m")),
    "Age": (
        *QUANTITY,
        POSITIVE,
        unit("ms"),
        Requirement(
            "0 ms or more for any bits",
            lambda s: s.reach[0] >= 0,
            "make it unsigned, with offset 0",
        ),
        Requirement(
            'at least three values in its range: two ages, and "too old"',
            lambda s: s.raw_max - s.raw_min >= 2,
            "widen the signal and its range [min|max]",
        ),
    ),
    "ComponentIndex": (*NUMBER, holds(0, 0)),
    "ComponentCount": (
        *(INTEGER, UNSIGNED, EXACT, FINITE, SOME_RANGE),
        Requirement(
            "factor 1 and a whole offset",
            lambda s: s.factor == 1 and s.offset.is_integer(),
            "write (1,1), for counts from 1",
        ),
        holds(1, 1),
    ),
    "ComponentWeight": (
        *QUANTITY,
        POSITIVE,
        unit("1", "-"),
        Requirement(
            "a factor of 1/n for a whole number n, and values from 1/n to exactly 1",
            _weights_add_up,
            "take a power of two, such as (0.03125,0.03125) with 5 bits",
        ),
    ),
    "HasCovariance": (*NUMBER, holds(0, 1)),
    "OwnLateral": LEVEL,
    "OwnPoints": LEVEL,
    "OwnShape": SPACING,
    "Quartic": (*QUANTITY, POSITIVE, unit("m")),
    "FitBehind": DISTANCE,
    "FitAhead": DISTANCE,
    "CorrelationTime": LEVEL,
    "MapOffset": LEVEL,
    "MapHeading": LEVEL,
    SLOT_COUNTER: (
        *NUMBER,
        WHOLE_RANGE,
        Requirement(
            f"{MIN_SLOT_COUNTER_BITS} bits or more",
            lambda s: s.length >= MIN_SLOT_COUNTER_BITS,
            "widen it, since with fewer bits lines of other cycles look as if they belonged to it",
        ),
    ),
    "KeyId": BYTES,
    "Freshness": (
        *BYTES,
        unit("us"),
        Requirement(
            f"{MIN_FRESHNESS_BYTES} bytes or more",
            lambda s: s.length >= 8 * MIN_FRESHNESS_BYTES,
            "widen it, since 2 bytes of microseconds repeat after 65 ms, 3 bytes after 16.8 s",
        ),
    ),
    "Mac": BYTES,
}
#: Requirements that a record which is conditional on the pose error has in addition.
CONDITIONAL_REQUIREMENTS: Mapping[str, Sequence[Requirement]] = {
    "XMin": (WHOLE_METRES,),
    "XMax": (WHOLE_METRES,),
}
_PAGE_OF = re.compile(rf"{PAGE}(\d+)")


def pages_of(names: Iterable[str]) -> list[int]:
    """Return the numbers of the pages of a record, from its signals, in ascending order."""
    return sorted(int(match[1]) for match in map(_PAGE_OF.fullmatch, names) if match)


def _each(signals: Mapping[str, Signal], name: str) -> list[Signal]:
    """Return the signals of this name of all pages, in the order of the pages."""
    return [signals[f"{name}{page}"] for page in pages_of(signals)]


def _named(signals: Mapping[str, Signal], name: str) -> list[Signal]:
    """Return the signals that the requirements of this name apply to."""
    if name in (PAGE, TRANSFER_ID):
        return _each(signals, name)
    names = [name]
    if name in SLOT_SIGNALS:
        names += [f"{slot_title(slot)}{name}" for slot in Slot]
    elif name == SLOT_COUNTER:
        names = [f"{slot_title(slot)}Counter" for slot in Slot]
    return [signals[name] for name in names if name in signals]


def _most_components(signals: Mapping[str, Signal]) -> float:
    return signals["ComponentCount"].physical_range[1] if "ComponentCount" in signals else 1


def _in_its_page(signals: Mapping[str, Signal], name: str) -> bool:
    return all(
        bits <= set(range(page * 8 * PAGE_BYTES, (page + 1) * 8 * PAGE_BYTES))
        for page, bits in enumerate(map(bits_of, _each(signals, name)))
    )


def _refines(signals: Mapping[str, Signal], fine: str) -> bool:
    """Return whether the range of a fine signal is one step of the signal that it is added to."""
    signal, coarse = signals[fine], signals.get(fine.removesuffix(FINE))
    if coarse is None:
        return True
    values = signal.raw_max - signal.raw_min + 1
    is_step = math.isclose(signal.factor * values, abs(coarse.factor), rel_tol=1e-9)
    return is_step and signal.length + coarse.length <= EXACT_BITS


def _same_in_all_slots(signals: Mapping[str, Signal], name: str) -> bool:
    of_slots = _named(signals, name)
    return len({(s.factor, s.offset, s.unit, s.raw_min, s.raw_max) for s in of_slots}) == 1


#: Requirements on several signals of a record.
RELATIONS: Sequence[Relation] = (
    Relation(
        PAGE,
        "the same bits in each page, and enough bits to number all pages",
        lambda signals: (
            _in_its_page(signals, PAGE)
            and len({(s.start % 64, s.length, s.big_endian) for s in _each(signals, PAGE)}) == 1
            and len(pages_of(signals)) - 1 <= signals[f"{PAGE}0"].raw_max
        ),
        "place it as in page 0",
    ),
    Relation(
        TRANSFER_ID,
        "to lie in its page (in page 0, it may be the low bits of Counter)",
        lambda signals: _in_its_page(signals, TRANSFER_ID),
        f"move {TRANSFER_ID}1 to page 1, and so on, and Counter to page 0",
    ),
    Relation(
        TRANSFER_ID,
        "the same length in each page",
        lambda signals: len({s.length for s in _each(signals, TRANSFER_ID)}) == 1,
        f"give {TRANSFER_ID}1, {TRANSFER_ID}2, ... the same number of bits",
    ),
    Relation(
        TRANSFER_ID,
        "values for two lines of the most components: 2^bits >= 2 x greatest ComponentCount",
        lambda signals: 2 ** signals[f"{TRANSFER_ID}0"].length >= 2 * _most_components(signals),
        "widen it in each page, or narrow the range of ComponentCount",
    ),
    Relation(
        "Counter",
        f"at least as many bits as {TRANSFER_ID}",
        lambda signals: signals["Counter"].length >= signals[f"{TRANSFER_ID}0"].length,
        f"widen it, or shorten {TRANSFER_ID}",
    ),
    Relation(
        "XMax",
        "an end above the start of XMin, or no valid range could be stated",
        lambda signals: signals["XMax"].physical_range[1] > signals["XMin"].physical_range[0],
        "correct their factors, offsets and ranges",
    ),
    Relation(
        "ComponentIndex",
        "a range up to the greatest ComponentCount minus 1",
        lambda signals: signals["ComponentIndex"].raw_max >= _most_components(signals) - 1,
        "widen it, or narrow the range of ComponentCount",
    ),
    Relation(
        "ComponentWeight",
        "at least as many steps as the greatest ComponentCount",
        lambda signals: round(1 / signals["ComponentWeight"].factor) >= _most_components(signals),
        "give it a smaller factor, or narrow the range of ComponentCount",
    ),
    *(
        Relation(
            name,
            f"a range that is one step of {name.removesuffix(FINE)}, and at most {EXACT_BITS} bits "
            "together with it",
            partial(_refines, fine=name),
            "with n bits, give it the factor of that signal divided by 2^n",
        )
        for name in FINE_SIGNALS
    ),
    *(
        Relation(
            name,
            "the same factor, offset, unit and range for all slots",
            partial(_same_in_all_slots, name=name),
            "change it for all slots",
        )
        for name in SLOT_SIGNALS
    ),
)


def check_record(
    signals: Mapping[str, Signal],
    source: str,
    more: Mapping[str, Sequence[Requirement]] | None = None,
) -> None:
    """Check the signals of a record, one by one and together.

    Args:
        signals: of the record, by name.
        source: name of the DBC.
        more: requirements by signal, in addition to ``REQUIREMENTS``.

    Raises:
        LayoutError: a requirement is not met, two signals overlap, or one is not in the record.
    """
    for name, requirements in REQUIREMENTS.items():
        for signal in _named(signals, name):
            check(signal, (*requirements, *(more or {}).get(name, ())), source)
    for relation in RELATIONS:
        if _named(signals, relation.name) and not relation.met(signals):
            has = "; ".join(f"{s.name} is {in_dbc(s)}" for s in _named(signals, relation.name))
            raise LayoutError(
                f"{source}: signal {relation.name} needs {relation.needs}, but {has}; "
                f"{relation.cure}"
            )
    owner: dict[int, str] = {}
    record = set(range(8 * PAGE_BYTES * len(pages_of(signals))))
    for name, signal in signals.items():
        bits = bits_of(signal)
        if bits - record:
            raise LayoutError(f"{source}: signal {name} must lie in the record's pages of 8 bytes")
        if name == f"{TRANSFER_ID}0" and bits <= bits_of(signals["Counter"]):
            continue  # the low bits of the counter
        for bit in bits:
            if owner.setdefault(bit, name) != name:
                raise LayoutError(f"{source}: signals {owner[bit]} and {name} overlap; move one")


def bits_of(signal: Signal) -> set[int]:
    """Return the bits of a signal in the record, numbered from the first byte's lowest bit."""
    bits = set()
    for word, shift, n, _ in pieces_of(signal):
        for bit in range(shift, shift + n):
            byte, place = divmod(bit, 8)
            bits.add(64 * word + 8 * (7 - byte if signal.big_endian else byte) + place)
    return bits
