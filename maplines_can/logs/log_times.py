"""Times of the rows of a text log, whose stamps are times or differences."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise

from .log_summary import LogSummary, Times

#: Stamps that decide the kind of the others.
MAX_ROWS = 100
#: Longest time that a row of a pipe waits for this decision [s].
MAX_WAIT = 2.0
#: Smaller time stamps are relative to the start of the log or to the previous frame [ns].
MIN_ABSOLUTE_NS = 10**8 * 10**9
#: Rows of several channels may be in another order than their stamps by up to this time [ns].
MAX_DISORDER_NS = 10**8
#: Numbers of the kinds for the parsers in C.
KINDS: dict[str, int] = {"absolute": 0, "zero": 1, "delta": 2}
_MEANINGS = {
    "absolute": "as absolute times",
    "zero": "as times from the start of the log (candump -t z)",
    "delta": "as differences (candump -t d)",
}


def kind_of(stamps: Sequence[int]) -> str:
    """Return the kind of time stamps: "absolute", "zero" or "delta".

    Times rise, but for frames of other channels that are late, and for a recording that begins
    again. Differences rise and fall alike, or are all the same after the first one:

        zero   0.01 0.01 0.06 0.11 0.11   0.00 0.29 0.12 0.50 0.61   0.00 0.05 0.10 0.00 0.05
        delta  0.00 0.05 0.05 0.05 0.05   0.00 0.29 0.12 0.21 0.11   0.00 0.01 0.04 0.01 0.04

    Args:
        stamps: the first ones of a log [ns].
    """
    if max(stamps, default=0) >= MIN_ABSOLUTE_NS:
        return "absolute"
    if len(set(stamps)) < 2:  # frames of one moment: no recorder writes the first difference
        return "zero"
    rest = stamps[1:] if len(stamps) > 2 else stamps  # the first difference can be any number
    rises = sum(a < b for a, b in pairwise(rest))
    falls = sum(a > b for a, b in pairwise(rest))
    if 10 * falls <= rises > 0:
        return "zero"
    # The share of pairs in order, minus that of those in disorder (Kendall's tau), is 1 for times,
    # 1/2 for two recordings of the same length, 0 +- 0.07 for 100 differences without an order.
    pairs = len(rest) * (len(rest) - 1) // 2
    order = sum((a < b) - (a > b) for a, b in combinations(rest, 2)) / pairs
    is_rising = order >= 0.3 + 2 / len(rest) and 10 * falls <= 7 * rises
    return "zero" if is_rising or order >= 0.9 else "delta"


class LogTimes:
    """Times of rows from their stamps, of a kind that is stated or found.

    Times are the stamps themselves, but for differences, which are added up. Where a recording ends
    and another one begins, times from the start begin again.

    Args:
        times: kind of the stamps, or "auto".
        summary: of the log; it gets the kind, and what was assumed.
    """

    def __init__(self, times: Times, summary: LogSummary) -> None:
        self._summary = summary
        self._is_stated_by_user = times != "auto"
        self._seen: list[int] = []  # stamps before the kind is known
        self._sum = self._high = 0  # sum, or highest one, of the stamps of the recording [ns]
        self._begins_again = False
        #: Kind of the stamps; empty until it is known.
        self.kind = ""
        if self._is_stated_by_user:
            self._take(times)

    @property
    def rows_to_see(self) -> int:
        """Number of stamps that decide the kind and have not been seen; 0 if it is known.

        It is also 0 as long as both kinds give the same time: up to the first stamp that is not 0.
        """
        if self.kind or (not any(self._seen) and len(self._seen) < MAX_ROWS):
            return 0
        return max(1, MAX_ROWS - len(self._seen))

    def find(self, stamps: Sequence[int]) -> None:
        """Decide on the stamps so far and those of the next rows [ns]; nothing changes it later."""
        seen = [*self._seen, *stamps]
        kind = kind_of(seen)
        self._take(kind)
        if kind == "delta" or seen != sorted(seen):
            self._summary.notices.append(
                f"the time stamps are taken {_MEANINGS[kind]}; "
                "--times absolute|zero|delta states the kind"
            )

    def state(self, kind: str) -> None:
        """Take the kind that the log states, unless the user has stated one."""
        if not self._is_stated_by_user:
            self._take(kind)

    def state_by(self, stamp: int) -> None:
        """Take the kind by the first stamp of a log that has no differences."""
        if not self.kind:
            self.state("absolute" if stamp >= MIN_ABSOLUTE_NS else "zero")

    def t_ns(self, stamp: int, line: int) -> int:
        """Return the time of the next row.

        Args:
            stamp: of the row [ns].
            line: number of the row.
        """
        if not self.kind:
            if stamp < MIN_ABSOLUTE_NS:
                self._seen.append(stamp)
                self._summary.times = "zero"
                return stamp
            self._take("absolute")
        if self.kind == "delta":
            self._sum += stamp
            return self._sum
        if self.kind == "zero":
            if self._high - stamp > MAX_DISORDER_NS and 2 * stamp < self._high:
                self._begin_again(line)
            if stamp > self._high:
                self._high = stamp
        return stamp

    @property
    def in_c(self) -> tuple[int, int, int]:
        """Number of the kind, sum of the stamps and highest stamp [ns], for C."""
        return KINDS[self.kind], self._sum, self._high

    @in_c.setter
    def in_c(self, state: tuple[int, int, int]) -> None:
        _, self._sum, self._high = state

    def _take(self, kind: str) -> None:
        if kind == self.kind:
            return
        if kind == "delta":
            self._sum = self._high + sum(self._seen)
        elif kind == "zero":
            self._high = max(self._seen, default=0)
        self._seen = []
        self.kind = self._summary.times = kind

    def _begin_again(self, line: int) -> None:
        if not self._begins_again:
            self._summary.notices.append(
                f"the time stamps begin again in line {line}, as of another recording, "
                "and the times with them"
            )
        self._begins_again, self._high = True, 0
