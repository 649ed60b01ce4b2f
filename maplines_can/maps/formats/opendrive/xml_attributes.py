"""Attributes of OpenDRIVE elements, checked."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TypeVar

from ....values.arrays import LARGEST
from ...road_map import Skipped
from ..xml_tree import Element, number_in
from .profiles import CubicPiece

T = TypeVar("T")


class UnusableError(ValueError):
    """An element that cannot be used; ``skipped`` says where it is, and why."""

    def __init__(self, element: Element, why: str) -> None:
        self.skipped = Skipped(element.place, why)
        super().__init__(str(self.skipped))


def attempt(
    read: Callable[[Element], T], elements: Iterable[Element], skipped: list[Skipped]
) -> list[T]:
    """Return what is read from the elements, and list those that cannot be used."""
    found = []
    for element in elements:
        try:
            found.append(read(element))
        except UnusableError as error:
            skipped.append(error.skipped)
    return found


def number(
    element: Element,
    name: str,
    default: float | None = None,
    least: float = -LARGEST,
    most: float = LARGEST,
) -> float:
    """Return an attribute as a finite number.

    Raises:
        UnusableError: it is missing and has no default, is not a finite number, or is not from
            ``least`` to ``most``.
    """
    text = element.attributes.get(name)
    if text is None:
        if default is None:
            raise UnusableError(element, f"{name} is missing")
        return default
    value = number_in(text)
    if least <= value <= most:
        return value
    if not math.isfinite(value):
        raise UnusableError(element, f"{name} must be a finite number, got {text[:40]!r}")
    raise UnusableError(element, f"{name} must be from {least:g} to {most:g}, got {value:g}")


def integer(element: Element, name: str) -> int:
    """Return an attribute as an integer.

    Raises:
        UnusableError: it is missing, or is not an integer.
    """
    value = number(element, name)
    if value != int(value):
        raise UnusableError(element, f"{name} must be an integer, got {value:g}")
    return int(value)


def cubic(element: Element, start: str, origin: float = 0.0) -> CubicPiece:
    """Return the attributes a, b, c and d, with the start as an offset from ``origin`` [m].

    Raises:
        UnusableError: one of them is not a finite number.
    """
    a, b, c, d = (number(element, name, 0.0) for name in "abcd")
    return CubicPiece(origin + number(element, start, 0.0), a, b, c, d)


def cubics(
    elements: Iterable[Element],
    start: str,
    stretch: tuple[float, float],
    skipped: list[Skipped],
) -> tuple[CubicPiece, ...]:
    """Return the functions of elements that apply in a stretch of s, by their starts.

    One that never applies, as another one begins at the same s or it begins after the end, may be
    unusable; it is listed then.

    Args:
        elements: with a, b, c and d.
        start: name of the attribute of the start, as an offset from that of the stretch.
        stretch: its start and its end [m].
        skipped: list that gets what is not used.

    Raises:
        UnusableError: a start, or a number of a function that applies, is not finite.
    """
    origin, end = stretch
    by_start: dict[float, Element] = {}
    rest = []
    for element in elements:
        s = origin + number(element, start, 0.0)
        rest += [by_start[s]] if s in by_start else []
        by_start[s] = element
    starts = sorted(by_start)
    applied = [s for s in starts if s < end] or starts[:1]
    rest += [by_start[s] for s in starts[len(applied) :]]
    for element in rest:
        try:
            cubic(element, start)
        except UnusableError as error:
            why = f"{error.skipped.why}; it never applies"
            skipped.append(Skipped(error.skipped.where, why))
    return tuple(cubic(by_start[s], start, origin) for s in applied)
