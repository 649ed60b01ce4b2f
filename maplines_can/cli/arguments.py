"""What may stand after an option of a command: types for argparse."""

from __future__ import annotations

import argparse
from collections.abc import Callable

__all__ = ["number"]


def number(
    kind: type[int] | type[float], least: float, most: float, word: str | None = None
) -> Callable[[str], float | str]:
    """A number within bounds, both allowed, or a word; a whole one may be written as 1e7 too.

    Args:
        kind: int for whole numbers, which must be less than 2^53.
        least: the lower bound.
        most: the upper bound.
        word: what may stand there instead.

    Returns:
        A type for ``ArgumentParser.add_argument``.

    >>> number(int, 1, 10**9)("1e6"), number(float, 0, 1)("0.5"), number(int, 1, 8, "auto")("auto")
    (1000000, 0.5, 'auto')
    >>> number(int, 1, 8)("2.5")
    Traceback (most recent call last):
    ...
    argparse.ArgumentTypeError: must be a whole number from 1 to 8, got '2.5'
    """

    def parse(text: str) -> float | str:
        if text == word:
            return word
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not least <= value <= most or (kind is int and not value.is_integer()):
            what = "a whole number" if kind is int else "a number"
            raise argparse.ArgumentTypeError(
                f"must be {what} from {least:g} to {most:g}{f' or {word}' if word else ''}, "
                f"got {text!r}"
            )
        return kind(value)

    return parse
