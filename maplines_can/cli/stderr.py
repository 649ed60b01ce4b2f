"""Standard error: notes and progress bars; standard output is for results only."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, TypeVar

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
