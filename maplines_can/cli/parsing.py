"""Argument parsing: the parser of the commands, and types for the values of options."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, NoReturn


class Parser(argparse.ArgumentParser):
    """Argument parser whose error messages do not repeat a secret key.

    Options cannot be abbreviated: ``--key`` does not stand for ``--key-file``.
    Subparsers are of the same class.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)

    def error(self, message: str) -> NoReturn:
        """Print usage and message, with anything that may be a key hidden, and exit."""
        from ..bus.keys import without_keys  # imports python-can, which --help does not need

        super().error(without_keys(message))


def add_command(
    commands: Any,
    name: str,
    run: Callable[[argparse.Namespace], int],
    description: str,
    example: str,
) -> argparse.ArgumentParser:
    """Add a command to the subparsers of ``maplines`` and return its parser.

    Line breaks of the description are kept. The example, a command line, ends the help.
    """
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        description=description,
        epilog=f"example: {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def number(
    kind: type[int] | type[float], least: float, most: float, word: str | None = None
) -> Callable[[str], float | str]:
    """Return an argparse type for numbers from ``least`` to ``most``, or one ``word`` instead.

    A whole number may also be written as 1e7; its bounds are less than 2^53.

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


natural = number(int, 1, 10**9)
seconds = number(float, 1e-3, 1e6)
