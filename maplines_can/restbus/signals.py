"""Values of a signal over time: fixed, counting, swept, or from a script."""

from __future__ import annotations

import math
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cantools.database.can import Signal

from ..values.errors import RestbusError
from .tables import Table, nearest, number

#: Value of a signal at a time since the start [s], in the transmission of this number.
Value = Callable[[float, int], float]
#: Longest period of a sweep [s].
MAX_PERIOD = 1e6


def limits(signal: Signal) -> tuple[float, float]:
    """Return the physical values that a signal can have: by its bits, and by the DBC's range."""
    bits = signal.length
    if signal.is_float:
        low, high = -3.4028235e38 if bits < 64 else -1.7e308, 3.4028235e38 if bits < 64 else 1.7e308
    elif signal.is_signed:
        low, high = -(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1
    else:
        low, high = 0.0, 2.0**bits - 1
    ends = sorted(signal.offset + raw * signal.scale for raw in (low, high))
    if signal.minimum is not None:
        ends[0] = max(ends[0], float(signal.minimum))
    if signal.maximum is not None:
        ends[1] = min(ends[1], float(signal.maximum))
    return ends[0], ends[1]


def initial(signal: Signal) -> float:
    """Return the start value in the DBC (GenSigStartValue), else 0 or what is nearest to it."""
    low, high = limits(signal)
    value = signal.initial if isinstance(signal.initial, int | float) else 0.0
    return float(min(max(value, low), high))


def fixed(name: str, value: object, signal: Signal) -> float:
    """Return a value that a signal can have: a number, or the name of one of its values."""
    if isinstance(value, str):
        choices = {str(text): raw for raw, text in (signal.choices or {}).items()}
        if value not in choices:
            hint = nearest(value, choices, "its named values are")
            raise RestbusError(f"{name} must be a number or a named value, got {value!r}{hint}")
        return float(signal.offset + choices[value] * signal.scale)
    if isinstance(value, bool):
        value = int(value)
    return number(name, value, *limits(signal), signal.unit or "")


def value_of(name: str, values: object, signal: Signal, folder: Path) -> Value:
    """Return the values of a signal as the configuration describes them.

    Args:
        name: of message and signal.
        values: a number, the name of a value, or a table with one of the keys ``count``,
            ``ramp``, ``sine`` and ``script``.
        signal: of the DBC.
        folder: where the files of scripts are.

    Raises:
        RestbusError: the description is wrong, or the signal cannot have such a value.
    """
    if not isinstance(values, dict):
        constant = fixed(name, values, signal)
        return lambda _t, _n: constant
    table = Table(values, name)
    if "script" in table:
        value = _scripted(name, table.text("script"), signal, folder)
    elif "count" in table:
        value = _counting(name, table, signal)
    else:
        value = _swept(name, table, signal)
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


def _scripted(name: str, text: str, signal: Signal, folder: Path) -> Value:
    function, (low, high) = script(f"{name}: script", text, folder), limits(signal)

    def value(t: float, _n: int) -> float:
        try:
            result = function(t)
        except Exception as error:
            kind = type(error).__name__
            raise RestbusError(f"{name}: {text} fails at {t:g} s: {kind}: {error}") from error
        return number(f"{name}: {text} at {t:g} s", result, low, high, signal.unit or "")

    return value


def _counting(name: str, table: Table, signal: Signal) -> Value:
    first, last = _ends(name, "count", table, signal)
    span = abs(last - first)
    step = table.number("step", 1e-12, max(span, 1e-12), signal.unit or "", min(1.0, span) or 1e-12)
    values = math.floor(span / step + 1e-9) + 1
    sign = math.copysign(step, last - first)
    return lambda _t, n: first + sign * (n % values)


def _swept(name: str, table: Table, signal: Signal) -> Value:
    kinds = [kind for kind in ("ramp", "sine") if kind in table]
    if not kinds:
        table.end("count", "ramp", "sine", "script", "period_s", "phase_deg")
        raise RestbusError(
            f"{name} needs count, ramp, sine or script, such as {{ sine = [-1, 1], period_s = 10 }}"
        )
    low, high = _ends(name, kinds[0], table, signal)
    period = table.number("period_s", 1e-3, MAX_PERIOD, "s")
    phase = table.number("phase_deg", -360, 360, "deg", 0.0) / 360

    if kinds[0] == "ramp":
        return lambda t, _n: low + (high - low) * ((t / period + phase) % 1.0)
    middle, half = (low + high) / 2, (high - low) / 2
    return lambda t, _n: middle + half * math.sin(2 * math.pi * (t / period + phase))


def _ends(name: str, kind: str, table: Table, signal: Signal) -> tuple[float, float]:
    values = table.take(kind)
    if not isinstance(values, list) or len(values) != 2:
        raise RestbusError(f"{name}: {kind} must be [FIRST, LAST], got {values!r}")
    first, last = (fixed(f"{name}: {kind}", value, signal) for value in values)
    return first, last
