"""Variables of an FMU: the one list that its description and its C code are written from.

In C, the values of a type stand in one array: ``values.reals[REAL_X + 1]`` is the variable
``x[2]``. A value reference is the first one of its type plus the index. Within a type, fixed
parameters come first, then tunable ones, inputs and outputs, so that ``access.c`` knows by the
index what may be set. Rows of slots stand slot after slot, as in
``reals[REAL_SLOTS + slot * SLOT_REALS + SLOT_REAL_AGE]``.

Each variable is a scalar, with indices in its name where it belongs to a vector, such as
``EGO_LEFT.mean[1]``: the naming convention "structured" of FMI. Tools that have no arrays, and
tables of columns, can take them; arrays of FMI would need their own calls in each.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from enum import Enum, IntEnum
from typing import NamedTuple

from ...values.line import Slot

#: Value references that no type has.
TIME, RX_DATA, TX_DATA, RX_CLOCK, TX_CLOCK = range(5)
#: Indices of the entries of a covariance: its lower triangle by rows.
ENTRIES = [f"{i},{j}" for i in range(1, 5) for j in range(1, i + 1)]


class Role(Enum):
    """What a variable is, in the order of the indices: causality and variability of FMI."""

    FIXED = ("parameter", "fixed")
    TUNABLE = ("parameter", "tunable")
    INPUT = ("input", None)
    OUTPUT = ("output", None)


class Store(Enum):
    """An array of values in C: its element of FMI, and its first value reference."""

    REAL = ("Float64", 100000)
    CHOICE = ("Enumeration", 200000)
    COUNT = ("UInt64", 300000)
    FLAG = ("Boolean", 400000)

    @property
    def plural(self) -> str:
        """The name of the array in C, in capitals."""
        return f"{self.name}S"


class Row(NamedTuple):
    """A variable, or the elements of a vector; of each slot, if its name begins with a dot."""

    store: Store
    symbol: str  #: in C, without the name of the store
    name: str
    role: Role
    about: str
    unit: str | None = None
    start: float | tuple[float, ...] = 0
    choices: type[IntEnum] | None = None
    indices: Sequence[object] = ()  #: of the elements; none of a scalar

    @property
    def is_of_slot(self) -> bool:
        """Whether each slot has one."""
        return self.name.startswith(".")


class Variable(NamedTuple):
    """A scalar variable with its value reference."""

    reference: int
    name: str
    row: Row
    start: float
    slot: Slot | None


def variables_of(rows: Iterable[Row]) -> list[Variable]:
    """Return the variables of some rows, by value reference."""
    rows, found = list(rows), list[Variable]()
    for store in Store:
        mine = [row for row in rows if row.store is store]
        if len({row.role for row in mine if row.is_of_slot}) > 1:
            raise AssertionError(f"rows of slots have different roles: {store}")
        at = store.value[1]
        for role in Role:
            for slot in (None, *Slot):
                for row in mine:
                    if row.role is role and row.is_of_slot is (slot is not None):
                        for name, start in _elements(row):
                            full = name if slot is None else f"{slot.name}{name}"
                            found.append(Variable(at, full, row, start, slot))
                            at += 1
    return found


def _elements(row: Row) -> Iterator[tuple[str, float]]:
    """Yield names and start values of the elements of a row."""
    names = [row.name]
    if row.indices:
        ends = [f".{i}" if str(i).isidentifier() else f"[{i}]" for i in row.indices]
        names = [f"{row.name}{end}" for end in ends]
    starts = row.start if isinstance(row.start, tuple) else (row.start,) * len(names)
    yield from zip(names, starts, strict=True)


# ---- as C ---------------------------------------------------------------------------------------


def header(variables: Sequence[Variable], positions: int, token: str, tables: str) -> str:
    """Return ``variables.h``; the tables are those of ``<tables>_dbc.h``."""
    lines = [
        "/* Variables of the FMU, written by maplines generate fmu. */",
        "#ifndef MAPLINES_VARIABLES_H",
        "#define MAPLINES_VARIABLES_H",
        "",
        f'#include "{tables}_dbc.h"',
        "",
        f"#define MAPLINES_DBC {tables}_dbc",
        f"#define MAPLINES_POSITIONS {positions} // at which lines are evaluated",
        f"#define MAPLINES_TOKEN_SIZE {len(token) + 1}",
        "",
        "enum {",
        f"    MAPLINES_TIME = {TIME},",
        f"    MAPLINES_RX_DATA = {RX_DATA},",
        f"    MAPLINES_TX_DATA = {TX_DATA},",
        f"    MAPLINES_RX_CLOCK = {RX_CLOCK},",
        f"    MAPLINES_TX_CLOCK = {TX_CLOCK},",
        "};",
        "",
    ]
    for store in Store:
        mine = [each for each in variables if each.row.store is store]
        lines += ["enum {", *_constants(store, mine), "};", ""]
    lines += [
        "extern const char maplines_token[MAPLINES_TOKEN_SIZE];",
        *(f"extern const {ctype} {name}[{size}];" for ctype, name, size, _ in _tables(variables)),
        "",
        "#endif",
    ]
    return "\n".join([*lines, ""])


def source(variables: Sequence[Variable], token: str) -> str:
    """Return ``variables.c``: start values, and the bounds of enumerations."""
    lines = [
        "/* Variables of the FMU, written by maplines generate fmu. */",
        '#include "variables.h"',
        "",
        f'const char maplines_token[MAPLINES_TOKEN_SIZE] = "{token}";',
    ]
    for ctype, name, size, values in _tables(variables):
        lines += ["", f"const {ctype} {name}[{size}] = {{"]
        lines += [f"    {value}, // {each.name}" for each, value in values]
        lines += ["};"]
    return "\n".join([*lines, ""])


def _constants(store: Store, variables: Sequence[Variable]) -> Iterator[str]:
    """Yield the constants of a type in C: indices, and the ends of groups."""
    first = store.value[1]
    roles = [each.row.role for each in variables]
    ends = {
        "FIXED": roles.count(Role.FIXED),
        "TUNABLE": roles.count(Role.FIXED) + roles.count(Role.TUNABLE),
        "SETTABLE": len(roles) - roles.count(Role.OUTPUT),
    }
    yield f"    MAPLINES_FIRST_{store.name} = {first},"
    yield f"    MAPLINES_{store.plural} = {len(variables)},"
    yield from (f"    MAPLINES_{name}_{store.plural} = {end}," for name, end in ends.items())
    slots = [each for each in variables if each.slot is not None]
    if slots:
        yield f"    {store.name}_SLOTS = {slots[0].reference - first},"
        yield f"    SLOT_{store.plural} = {len(slots) // len(Slot)},"
    seen = set()
    for each in variables:
        prefix = store.name if each.slot is None else f"SLOT_{store.name}"
        symbol = f"{prefix}_{each.row.symbol}"
        if symbol not in seen and each.slot in (None, Slot(0)):
            seen.add(symbol)
            start = first if each.slot is None else slots[0].reference
            yield f"    {symbol} = {each.reference - start},"


def _tables(
    variables: Sequence[Variable],
) -> Iterator[tuple[str, str, str, list[tuple[Variable, str]]]]:
    """Yield the constant arrays of what can be set: type, name, size, and the values as C."""
    types = {Store.REAL: "double", Store.CHOICE: "int64_t", Store.COUNT: "uint64_t",
             Store.FLAG: "bool"}  # fmt: skip
    for store, ctype in types.items():
        mine = [
            each
            for each in variables
            if each.row.store is store and each.row.role is not Role.OUTPUT
        ]
        size = f"MAPLINES_SETTABLE_{store.plural}"
        name = f"{store.plural.lower()}"
        yield ctype, f"maplines_start_{name}", size, [(v, _literal(v)) for v in mine]
        if store is Store.CHOICE:
            least = [(v, str(min(_choices(v)))) for v in mine]
            greatest = [(v, str(max(_choices(v)))) for v in mine]
            yield ctype, f"maplines_least_{name}", size, least
            yield ctype, f"maplines_greatest_{name}", size, greatest


def _choices(variable: Variable) -> list[int]:
    return [int(choice) for choice in variable.row.choices or ()]


def _literal(variable: Variable) -> str:
    """Return a start value as C."""
    if variable.row.store is Store.FLAG:
        return "true" if variable.start else "false"
    if variable.row.store is Store.REAL:
        return float(variable.start).hex()
    return str(int(variable.start))
