"""Raw values of a signal over time: fixed, in turn, counting, swept, or from a script."""

from __future__ import annotations

import math
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..values.errors import RestbusError
from .fields import Field, Raw
from .toml_tables import Table, nearest

#: Raw value of a signal at a time since the start [s], in the transmission of this number.
Value = Callable[[float, int], Raw]
#: Longest period of a sweep [s].
MAX_PERIOD = 1e6


def value_of(name: str, values: object, field: Field, folder: Path) -> Value:
    """Return the values of a signal as the configuration describes them.

    Args:
        name: of message and signal.
        values: a number, the name of a value, a list of them, or a table with one of the keys
            ``count``, ``ramp``, ``sine`` and ``script``.
        field: the signal.
        folder: where the files of scripts are.

    Raises:
        RestbusError: the description is wrong, or the signal cannot have such a value.
    """
    if isinstance(values, list) and values:
        raws = [field.raw(name, value) for value in values]
        return lambda _t, n: raws[n % len(raws)]
    if not isinstance(values, dict):
        raw = field.raw(name, values)
        return lambda _t, _n: raw
    table = Table(values, name)
    if "script" in table:
        value = _scripted(name, table.text("script"), field, folder)
    elif "count" in table:
        value = _counting(name, table, field)
    else:
        value = _swept(name, table, field)
    table.end("count", "ramp", "sine", "script")
    return value


def script(name: str, text: str, folder: Path, function: str | None = None) -> Callable[..., Any]:
    """Return a function of a Python file, ``FILE:FUNCTION``, which is run.

    Raises:
        RestbusError: the file cannot be run, or has no such function.
    """
    file, _, called = text.rpartition(":") if ":" in text[2:] else (text, "", function or "")
    if not file or not called:
        raise RestbusError(f'{name} must be "FILE.py:FUNCTION", got {text!r}')
    try:
        names = runpy.run_path(str(folder / file))
    except FileNotFoundError:
        raise RestbusError(f"{name}: there is no file {folder / file}") from None
    except Exception as error:  # of the user's script
        raise RestbusError(
            f"{name}: {folder / file} fails: {type(error).__name__}: {error}"
        ) from error
    found = names.get(called)
    if not callable(found):
        functions = [key for key, value in names.items() if callable(value) and key[0] != "_"]
        hint = nearest(called, functions, "its functions are")
        raise RestbusError(f"{name}: {folder / file} has no function {called!r}{hint}")
    result: Callable[..., Any] = found
    return result


def _scripted(name: str, text: str, field: Field, folder: Path) -> Value:
    function = script(f"{name}: script", text, folder)

    def value(t: float, _n: int) -> Raw:
        try:
            result = function(t)
        except Exception as error:
            kind = type(error).__name__
            raise RestbusError(f"{name}: {text} fails at {t:g} s: {kind}: {error}") from error
        return field.raw(f"{name}: {text} at {t:g} s", result)

    return value


def _counting(name: str, table: Table, field: Field) -> Value:
    ends = _Ends(name, "count", table, field)
    span = abs(ends.last - ends.first)
    # Steps between the raw values would count a page twice.
    least = abs(field.signal.scale) if field.pages else 1e-12
    unit, default = field.signal.unit or "", min(1.0, span)
    step = table.number("step", least, max(span, least), unit, max(default, least))
    whole = isinstance(span, int) and step == int(step)  # exact beyond 53 bits, too
    step = int(step) if whole else step
    values = span // step + 1 if whole else math.floor(span / step + 1e-9) + 1
    sign = step if ends.last >= ends.first else -step

    def value(_t: float, n: int) -> Raw:
        return ends.between(ends.first + sign * (n % values))

    for n in range(min(values, len(field.pages) + 1) if field.pages else 0):
        field.page(f"{name}: count", value(0.0, n))
    return value


def _swept(name: str, table: Table, field: Field) -> Value:
    kinds = [kind for kind in ("ramp", "sine") if kind in table]
    if not kinds:
        for key in ("period_s", "phase_deg"):
            table.take(key)
        table.end("count", "ramp", "sine", "script")
        raise RestbusError(
            f"{name} needs count, ramp, sine or script, such as {{ sine = [-1, 1], period_s = 10 }}"
        )
    ends = _Ends(name, kinds[0], table, field)
    low, high = ends.first, ends.last
    period = table.number("period_s", 1e-3, MAX_PERIOD, "s")
    phase = table.number("phase_deg", -360, 360, "deg", 0.0) / 360
    if field.pages:
        for raw in range(int(ends.least), int(ends.most) + 1):
            field.page(f"{name}: {kinds[0]}", raw)

    if kinds[0] == "ramp":
        return lambda t, _n: ends.between(low + (high - low) * ((t / period + phase) % 1.0))
    middle, half = (low + high) / 2, (high - low) / 2
    return lambda t, _n: ends.between(middle + half * math.sin(2 * math.pi * (t / period + phase)))


class _Ends:
    """First and last value of a signal that changes, ``[FIRST, LAST]``."""

    def __init__(self, name: str, kind: str, table: Table, field: Field) -> None:
        values = table.take(kind)
        if not isinstance(values, list) or len(values) != 2:
            raise RestbusError(f"{name}: {kind} must be [FIRST, LAST], got {values!r}")
        raws = [field.raw(f"{name}: {kind}", value) for value in values]
        self.first, self.last = (
            field.physical(raw) if isinstance(value, str) else value
            for raw, value in zip(raws, values, strict=True)
        )
        self._field = field
        self.least, self.most = sorted(raws)

    def between(self, value: float) -> Raw:
        """Return the raw value of a physical one, which was rounded and may be just outside."""
        return min(max(self._field.nearest_raw(value), self.least), self.most)
