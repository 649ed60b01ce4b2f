"""What the jobs say on standard error: notes, and how far they are."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

__all__ = ["note", "progress_bar", "watched"]


def note(text: str) -> None:
    """Say it in a line of its own, at once."""
    print(f"maplines: {text}", file=sys.stderr, flush=True)


def watched() -> bool:
    """Whether somebody sees a progress bar."""
    return sys.stderr.isatty()


@contextmanager
def progress_bar(unit: str) -> Iterator[Callable[[float, float], None]]:
    """A progress bar that is told how much of how much is done."""
    with tqdm(total=1, unit=unit, disable=not watched()) as bar:

        def progress(done: float, total: float) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield progress
