"""Which lines of two logs are the same record: by slot and counter, and by their times.

A counter wraps, with most DBCs at 256: at 20 Hz a line has the counter of a line 12.8 s before.
So the offset of the clocks is found first, by votes::

    line of the shorter log      slot, counter 17            t = 3.2 s
    lines of the other log       slot, counter 17            t = 41.6 s  54.4 s  67.2 s ...
    votes for an offset of       38.4 s  51.2 s  64.0 s ...  more for lines with a like mean

Each line is then matched with the one of its slot and counter that is nearest in time, if each is
the nearest one of the other. A straight line through the differences of their times gives offset
and drift.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

#: Lines of the shorter log that vote, and the most votes of each.
VOTERS, MAX_VOTES = 256, 4096
#: Share of the lines of the time of both logs that counters must match.
MIN_SHARE = 0.5
#: What a difference of the mean costs a vote, in units of the spread of the means.
_SHARPNESS = 100.0
#: Lines from which a drift is told; the least one, in standard errors, and over the logs [s].
MIN_FOR_DRIFT, _MIN_DRIFT_ERRORS, _MIN_DRIFTED = 16, 4.0, 1e-6


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines of a log as far as alignment needs them; n lines.

    Args:
        stream: (n,) int64, number of channel and slot.
        counter: (n,) int64.
        t: (n,) time from the first line on [s].
        mean: (n, 4).
        begin_ns: time of the first line [ns].
        period: of the counter, such as 256.
        cycle: time of one count [s].
        has_time: whether the times are those of the log; else they follow from the order.
    """

    stream: Array
    counter: Array
    t: Array
    mean: Array
    begin_ns: int
    period: int
    cycle: float
    has_time: bool = True

    def keys(self, period: int) -> Array:
        """Return what a match has in common: stream and counter, of a period."""
        return self.stream * period + self.counter % period


class Alignment(NamedTuple):
    """Which lines of two logs are the same, and how their clocks differ.

    Args:
        method: "counters", or "times" if the counters of both have nothing in common, or "nothing".
        a: places of matched lines in A, ascending.
        b: of the same lines in B.
        offset: time of B minus that of A for the first line of A [s].
        drift: by which the clock of B is faster.
        rest: median and 99th percentile of what is left of the differences of times [s].
        has_time: whether offset and drift are of times; else they are of the order of lines.
    """

    method: str
    a: Array
    b: Array
    offset: float
    drift: float
    rest: tuple[float, float]
    has_time: bool


def align(a: Lines, b: Lines) -> Alignment:
    """Return which lines of two logs are the same record."""
    period = min(a.period, b.period)
    cycle = max(a.cycle, b.cycle)
    keys = a.keys(period), b.keys(period)
    offset = _offset(a, b, keys, period * cycle / 8)
    found = None if offset is None else _fitted(a, b, keys, offset, period * cycle / 4, "counters")
    if found is None or _share(found, a, b) < MIN_SHARE:
        here = [0.0, -_between(a, b)]
        offsets = here if offset is None else [offset, *here]
        streams = a.stream, b.stream
        tries = [_fitted(a, b, streams, one, cycle / 2, "times") for one in offsets]
        best = max(tries, key=lambda one: float(_likeness(a, b, one.a, one.b).sum()))
        if found is None or len(best.a) > len(found.a):
            found = best
    return found if len(found.a) else found._replace(method="nothing")


def _offset(a: Lines, b: Lines, keys: tuple[Array, Array], width: float) -> float | None:
    """Return the offset of the times of B from those of A that most lines vote for.

    Args:
        a: the lines of one log.
        b: of the other.
        keys: of the lines of each.
        width: time within which votes are for the same offset [s].
    """
    is_swapped = len(a.t) > len(b.t)
    short, long = (b, a) if is_swapped else (a, b)
    own, other = keys[::-1] if is_swapped else keys
    if not len(own) or not len(other):
        return None
    voters = np.unique(np.linspace(0, len(own) - 1, min(VOTERS, len(own))).astype(int))
    order = np.argsort(other, kind="stable")
    ordered = other[order]
    low, high = (np.searchsorted(ordered, own[voters], side) for side in ("left", "right"))
    votes = np.minimum(high - low, MAX_VOTES)
    if not votes.sum():
        return None
    first = np.repeat(low - np.cumsum(votes) + votes, votes)
    chosen = order[first + np.arange(len(first))]
    voter = np.repeat(voters, votes)
    offsets = (short.t[voter] - long.t[chosen]) * (1.0 if is_swapped else -1.0)
    pair = (chosen, voter) if is_swapped else (voter, chosen)
    weights = _likeness(a, b, *pair)
    order = np.argsort(offsets, kind="stable")
    offsets, weights = offsets[order], weights[order]
    sums = np.concatenate([[0.0], np.cumsum(weights)])
    ends = np.searchsorted(offsets, offsets + width, "right")
    scores = sums[ends] - sums[:-1]
    best = np.flatnonzero(scores >= scores.max() * (1 - 1e-9))
    begin = best[np.abs(offsets[best]).argmin()]
    inside = slice(begin, ends[begin])
    half = np.cumsum(weights[inside])
    return float(offsets[inside][np.searchsorted(half, half[-1] / 2)])


def _likeness(a: Lines, b: Lines, in_a: Array, in_b: Array) -> Array:
    """Return how alike the means of pairs of lines are, from 0 to 1."""
    spread = a.mean.std(axis=0) + b.mean.std(axis=0) + 1e-12
    away = np.abs(b.mean[in_b] - a.mean[in_a]) / spread
    return 1 / (1 + _SHARPNESS * away.mean(axis=1))


def _fitted(
    a: Lines, b: Lines, keys: tuple[Array, Array], offset: float, reach: float, method: str
) -> Alignment:
    """Return the alignment by keys, near an offset of the times, with its drift.

    Args:
        a: the lines of one log.
        b: of the other.
        keys: of the lines of each.
        offset: of the times of B [s].
        reach: greatest difference of the times of a pair [s].
        method: by which the keys are.
    """
    drift, rest = 0.0, np.zeros(1)
    for _ in range(3):
        moved = a.t * (1 + drift) + offset
        in_a, in_b = matched(keys[0], moved, keys[1], b.t, reach)
        if not len(in_a):
            break
        offset, drift = _line_through(a.t[in_a], b.t[in_b] - a.t[in_a])
        rest = np.abs(b.t[in_b] - a.t[in_a] * (1 + drift) - offset)
    quantiles = float(np.median(rest)), float(np.quantile(rest, 0.99))
    has_time = a.has_time and b.has_time
    return Alignment(method, in_a, in_b, offset + _between(a, b), drift, quantiles, has_time)


def _line_through(t: Array, difference: Array) -> tuple[float, float]:
    """Return offset and slope of differences of times; a slope that is noise is none."""
    rest = difference - np.median(difference)
    near = np.abs(rest) <= 5 * _deviation(rest) + 1e-6
    centred = t[near] - t[near].mean()
    square, slope = float(centred @ centred), 0.0
    if near.sum() >= MIN_FOR_DRIFT and square > 0:
        slope = float(centred @ rest[near]) / square
        left = rest[near] - rest[near].mean() - slope * centred
        error = np.sqrt(left @ left / (len(left) - 2) / square)
        if abs(slope) < _MIN_DRIFT_ERRORS * error or abs(slope) * np.ptp(centred) < _MIN_DRIFTED:
            slope = 0.0
    return float(np.median(difference - slope * t)), slope


def _deviation(values: Array) -> float:
    """Return a standard deviation that outliers do not change."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def matched(
    keys_a: Array, t_a: Array, keys_b: Array, t_b: Array, reach: float
) -> tuple[Array, Array]:
    """Return pairs of like keys, each of which is the nearest in time of the other.

    >>> keys, t = np.array([5, 7, 5]), np.array([0.0, 1.0, 12.8])
    >>> matched(keys, t, keys[1:], t[1:] + 0.1, reach=3.2)
    (array([1, 2]), array([0, 1]))

    Args:
        keys_a: (n,) integers.
        t_a: (n,) times [s].
        keys_b: (m,) integers.
        t_b: (m,) times on the same clock [s].
        reach: greatest difference of the times [s].

    Returns:
        places of the pairs in A, ascending, and in B.
    """
    n = len(keys_a)
    keys, t = np.concatenate([keys_a, keys_b]), np.concatenate([t_a, t_b])
    order = np.lexsort((t, keys))
    keys, t = keys[order], t[order]
    is_b = order >= n
    to_b, to_a = _nearest(keys, t, is_b), _nearest(keys, t, ~is_b)
    here = np.flatnonzero(~is_b & (to_b >= 0))
    there = to_b[here]
    is_mutual = (to_a[there] == here) & (np.abs(t[there] - t[here]) <= reach)
    in_a, in_b = order[here[is_mutual]], order[there[is_mutual]] - n
    by_a = np.argsort(in_a, kind="stable")
    return in_a[by_a], in_b[by_a]


def _nearest(keys: Array, t: Array, is_one: Array) -> Array:
    """Return for each row the nearest one of some with its key, or -1; rows are in order."""
    place = np.arange(len(keys))
    before = np.maximum.accumulate(np.where(is_one, place, -1))
    after = np.minimum.accumulate(np.where(is_one, place, len(keys))[::-1])[::-1]
    has_before = (before >= 0) & (keys[before] == keys)
    safe = np.minimum(after, len(keys) - 1)
    has_after = (after < len(keys)) & (keys[safe] == keys)
    away = np.where(has_before, t - t[before], np.inf), np.where(has_after, t[safe] - t, np.inf)
    nearest = np.where(away[0] <= away[1], before, safe)
    return np.where(has_before | has_after, nearest, -1)


def _share(found: Alignment, a: Lines, b: Lines) -> float:
    """Return the share of the lines of the time of both logs that are matched."""
    moved = a.t * (1 + found.drift) + found.offset - _between(a, b)
    low, high = max(moved.min(), b.t.min()), min(moved.max(), b.t.max())
    in_a, in_b = (int(((t >= low) & (t <= high)).sum()) for t in (moved, b.t))
    return len(found.a) / max(min(in_a, in_b), 1)


def _between(a: Lines, b: Lines) -> float:
    """Return the time from the begin of A to that of B by their clocks [s]."""
    return (b.begin_ns - a.begin_ns) / 1e9 if a.has_time and b.has_time else 0.0
