"""Tables of a TOML file, whose errors name key, value, unit, allowed range and cure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import Any

from ..values.errors import RestbusError


def nearest(name: str, known: Iterable[str], what: str = "") -> str:
    """Return the end of a sentence about an unknown name: the nearest known one, or all.

    >>> nearest("cycle", ["cycle_ms", "start_ms"])
    "; did you mean 'cycle_ms'?"
    """
    known = list(known)
    like = get_close_matches(name, known, 1, 0.5)
    if like:
        return f"; did you mean {like[0]!r}?"
    return f"; {what or 'known'}: {', '.join(known) or 'none'}"


def listed(names: Iterable[str]) -> str:
    """Return names for a sentence; of many, only some.

    >>> listed(["A", "B"]), listed(f"M{n}" for n in range(40))
    ('A, B', 'M0, M1, M2, M3, M4, M5, M6, M7 and 32 more')
    """
    names = list(names)
    shown = ", ".join(names[:8] if len(names) > 9 else names)
    return f"{shown} and {len(names) - 8} more" if len(names) > 9 else shown


class Table:
    """Table whose keys are taken one after the other; `end` finds those that nobody knows.

    Args:
        values: of the table.
        name: for messages, such as ``lines``.

    >>> Table({"cycle": 20}, "message ESP").end("cycle_ms")
    Traceback (most recent call last):
    ...
    maplines_can.values.errors.RestbusError: message ESP: unknown key 'cycle'; did you mean \
'cycle_ms'?
    """

    def __init__(self, values: object, name: str) -> None:
        if not isinstance(values, Mapping):
            raise RestbusError(f"{name}: must be a table, got {values!r}")
        self._left, self.name = dict(values), name
        self._known: list[str] = []

    def __contains__(self, key: str) -> bool:
        return key in self._left

    def where(self, key: str) -> str:
        """Return a key with the name of its table, for messages."""
        return f"{self.name}: {key}" if self.name else key

    def take(self, key: str, default: Any = None) -> Any:
        """Return any value; the default if the key is missing."""
        self._known.append(key)
        return self._left.pop(key, default)

    def table(self, key: str) -> Table | None:
        """Return a table inside this one; None if the key is missing."""
        values = self.take(key)
        return None if values is None else Table(values, f"{self.name}.{key}".lstrip("."))

    def number(
        self,
        key: str,
        least: float,
        most: float,
        unit: str = "",
        default: float | None = None,
        *,
        whole: bool = False,
    ) -> float:
        """Return a number within limits."""
        value = self.take(key, default)
        if value is None:
            raise RestbusError(f"{self.where(key)} is missing; set {key} = ...{_unit(unit)}")
        return number(self.where(key), value, least, most, unit, whole=whole)

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text that is not empty."""
        value = self.take(key, default)
        if value is None:
            raise RestbusError(f'{self.where(key)} is missing; set {key} = "..."')
        if not isinstance(value, str) or not value:
            raise RestbusError(f'{self.where(key)} must be a text, such as "...", got {value!r}')
        return value

    def choice(self, key: str, known: Iterable[str], default: str | None = None) -> str:
        """Return one of several texts."""
        value, known = self.text(key, default), list(known)
        if value not in known:
            hint = nearest(value, known)
            raise RestbusError(f"{self.where(key)} must be {_or(known)}, got {value!r}{hint}")
        return value

    def flag(self, key: str, *, default: bool = False) -> bool:
        """Return true or false."""
        value = self.take(key, default)
        if not isinstance(value, bool):
            raise RestbusError(f"{self.where(key)} must be true or false, got {value!r}")
        return value

    def tables(self, key: str) -> list[Any]:
        """Return an array of tables; empty if the key is missing."""
        values = self.take(key, [])
        if not isinstance(values, list):
            raise RestbusError(
                f"{key} must be an array of tables, [[{key}]] with two brackets, got {values!r}"
            )
        return values

    def end(self, *known: str) -> None:
        """Raise an error if a key is left that was not taken."""
        for key in self._left:
            hint = nearest(key, [*self._known, *known], "there are")
            where = f"{self.name}: " if self.name else ""
            raise RestbusError(f"{where}unknown key {key!r}{hint}")


def number(
    name: str, value: object, least: float, most: float, unit: str = "", *, whole: bool = False
) -> float:
    """Return a number, checked against its limits."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    valid = is_number and least <= value <= most and abs(value) < math.inf  # type: ignore[operator,arg-type]
    if not valid or (whole and value != int(value)):  # type: ignore[call-overload]
        what = "a whole number" if whole else "a number"
        raise RestbusError(
            f"{name} must be {what} in [{least:.12g}, {most:.12g}]{_unit(unit)}, got {value!r}"
        )
    return int(value) if whole else float(value)  # type: ignore[call-overload,arg-type]


def _unit(unit: str) -> str:
    return f" {unit}" if unit else ""


def _or(words: list[str]) -> str:
    return ", ".join(words[:-1]) + f" or {words[-1]}" if len(words) > 1 else words[0]
