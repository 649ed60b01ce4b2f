"""What a log has besides its data frames: its format, its kind of times, and what is skipped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Generic, Literal, TypeVar

from ..values.arrays import count_text

Record = TypeVar("Record")

#: Kind of the time stamps of a log, see ``read_log``.
Times = Literal["auto", "absolute", "zero", "delta"]


class Skipped(StrEnum):
    """Kind of a record that is no data frame on the bus."""

    REQUEST = "transmit request"  #: the frame that was sent has a record of its own
    REMOTE = "remote frame"
    ERROR = "error frame"
    STATE = "chip state"
    OTHER = "other event"


@dataclass(slots=True)
class LogSummary:
    """Properties of a log, as far as it has been read.

    Args:
        format: of the log, by its suffix, such as ".blf"; "candump", "savvycan" and "busmaster" for
            the output of those tools.
        times: kind of its time stamps: "absolute", "zero" or "delta", see ``read_log``; empty if it
            has none, or if none has been read.
        skipped: numbers of records that are no data frames, by kind.
        notices: what was assumed about the log, as sentences.
    """

    format: str = ""
    times: str = ""
    skipped: Counter[Skipped] = field(default_factory=Counter)
    notices: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Return the summary, for JSON."""
        skipped = {str(kind): n for kind, n in self.skipped.items()}
        rest = {"skipped": skipped, "notices": self.notices}
        return {"format": self.format, "times": self.times} | rest


class LogReader(Iterator[Record], Generic[Record]):
    """Iterator over the records of a log, with its summary so far.

    Args:
        records: of the log; a generator that fills the summary.
        summary: of the same log.
    """

    def __init__(self, records: Iterator[Record], summary: LogSummary) -> None:
        self._records, self.summary = records, summary

    def __next__(self) -> Record:
        return next(self._records)

    def close(self) -> None:
        """Close the file; any number of times."""
        close = getattr(self._records, "close", None)
        if close is not None:
            close()


def skipped_text(skipped: Mapping[Skipped, int]) -> str:
    """Return the numbers of records that are no data frames as text; empty without any.

    >>> skipped_text({Skipped.ERROR: 1, Skipped.REQUEST: 258})
    '1 error frame, 258 transmit requests'
    """
    return ", ".join(count_text(n, str(kind)) for kind, n in skipped.items() if n)
