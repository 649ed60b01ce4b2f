"""What a decoder answers to a frame, for tools and tests that expect one line at most."""

from __future__ import annotations

from collections.abc import Sequence

from maplines_can.values.line import MapLine
from maplines_can.wire import Reason


def one(answer: Sequence[MapLine] | Reason) -> MapLine | Reason:
    """Return the only line that a frame completes, or the reason why there is none."""
    if isinstance(answer, Reason):
        return answer
    (line,) = answer
    return line


def lines_of(answer: Sequence[MapLine] | Reason) -> Sequence[MapLine]:
    """Return the lines that a frame completes, or none."""
    return () if isinstance(answer, Reason) else answer
