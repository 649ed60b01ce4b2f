"""What every command has: its parser, types for the values of options, notes and progress bars.

Notes go to standard error; standard output is for results only.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from difflib import get_close_matches
from typing import Any, NoReturn, TypeVar


class Parser(argparse.ArgumentParser):
    """Argument parser whose error messages do not repeat a secret key.

    Options cannot be abbreviated: ``--key`` does not stand for ``--key-file``. An unknown option is
    an error of the command that it was given to. Subparsers are of the same class.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse arguments; report unknown ones with the usage of this command.

        argparse would report them with the usage of the whole program.
        """
        arguments, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}{self._hint(unknown)}")
        return arguments, unknown

    def _hint(self, unknown: list[str]) -> str:
        """Return the closest option to the first unknown one, as the end of a sentence."""
        word = next((word for word in unknown if word.startswith("-")), "").partition("=")[0]
        like = get_close_matches(word, self._option_string_actions, 1)
        return f"; did you mean {like[0]}?" if like else f"; '{self.prog} --help' lists all options"

    def error(self, message: str) -> NoReturn:
        """Print the message as one line, with anything that may be a key hidden, and exit.

        The usage, which argparse would print before it, has all options of the command.
        """
        from ..bus.keys import without_keys  # imports most of wire, which --help does not need

        if choice := re.search(r"invalid choice: '(.+)' \(choose from (.+)\)", message):
            like = get_close_matches(choice[1], re.findall(r"[\w-]+", choice[2]), 1)
            message += "".join(f"; did you mean {name}?" for name in like)
        if "did you mean" not in message and "--help" not in message:
            message += f"; see '{self.prog} --help'"
        self.exit(2, f"{self.prog}: error: {' '.join(without_keys(message).split())}\n")


#: Titles of the groups of options in the help of a command, in their order.
GROUPS = ("scenario", "bus", "message", "output")


def option_group(parser: argparse.ArgumentParser, title: str) -> argparse._ArgumentGroup:
    """Return the group of options with one of the titles ``GROUPS``.

    The help leaves out empty groups. The first call for a parser makes all of them, in this order.
    """
    known = parser._action_groups  # noqa: SLF001 - argparse has no public way to find them
    groups = {one.title: one for one in known}
    if title not in groups:
        groups |= {name: parser.add_argument_group(name) for name in GROUPS}
    return groups[title]


def add_json(parser: argparse.ArgumentParser, what: str = "the result") -> None:
    """Add ``--json``."""
    option_group(parser, "output").add_argument(
        "--json", action="store_true", help=f"print {what} as JSON"
    )


def add_command(
    commands: Any,
    name: str,
    run: Callable[[argparse.Namespace], int],
    description: str,
    example: str,
) -> argparse.ArgumentParser:
    """Add a command to the subparsers of ``maplines`` and return its parser.

    Line breaks of the description are kept. The example, a command line, ends the help; several
    are given with their title.
    """
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        description=description,
        epilog=example if example.startswith("examples:") else f"example: {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def add_group(
    commands: Any,
    name: str,
    description: str,
    title: str,
    members: Mapping[str, tuple[Callable[[Any], object], str]],
    example: str,
) -> None:
    """Add a command that has commands of its own.

    Args:
        commands: subparsers of ``maplines``.
        name: of the command.
        description: of all of them.
        title: over their list in the help, and the name of the argument.
        members: function that adds each, and one line of help.
        example: a command line.
    """
    width = max(map(len, members)) + 2
    rows = "".join(f"\n  {member:<{width}}{text}" for member, (_, text) in members.items())
    parser = commands.add_parser(
        name,
        description=f"{description}\n\n{title}:{rows}",
        epilog=f"example: {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    group = parser.add_subparsers(required=True, metavar=title.removesuffix("s").upper())
    for add, _ in members.values():
        add(group)


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
positive = number(float, 1e-300, 1e300)
seconds = number(float, 1e-3, 1e6)


T = TypeVar("T")

#: Progress bar: takes the unit of the work, and yields a function to call with the work done
#: and the total.
Bar = Callable[[str], AbstractContextManager[Callable[[float, float], None]]]


def note(text: str) -> None:
    """Print one line at once; nobody can be told that this is not possible."""
    with suppress(OSError):
        print(f"maplines: {text}", file=sys.stderr, flush=True)


@contextmanager
def progress_bar(unit: str, **settings: Any) -> Iterator[Callable[[float, float], None]]:
    """Show a progress bar with further settings of tqdm; yields a function as ``Bar`` says."""
    from tqdm import tqdm

    with tqdm(total=1, unit=unit, disable=not sys.stderr.isatty(), **settings) as bar:

        def progress(done: float, total: float) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield progress


def with_progress(items: Iterable[T], unit: str) -> Iterable[T]:
    """Return the items, counted by a progress bar while they are used.

    There is no bar if the results go to a terminal, where it would overwrite them.
    """
    if sys.stdout.isatty() or not sys.stderr.isatty():
        return items
    from tqdm import tqdm

    return tqdm(items, unit=unit)
