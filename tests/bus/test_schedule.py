"""Deadlines do not drift, and lateness is counted."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.bus.schedule import LatenessHistogram, Schedule


@given(
    st.floats(0.001, 10), st.floats(0, 1e6), st.lists(st.floats(0, 30), min_size=1, max_size=100)
)
def test_deadlines_do_not_drift(period: float, t0: float, steps: Any) -> None:
    """Deadlines stay on one grid; each is served or skipped, and none is served twice."""
    schedule = Schedule[Any](period)
    now = t0
    schedule.add("key", 0.25, now)
    served = skipped = 0
    for step in steps:
        now += step * period
        while due := schedule.take(now):
            skipped += due.skipped
            assert due.deadline == pytest.approx(t0 + (served + skipped) * period, abs=1e-8)
            assert -1e-6 <= now - due.deadline < period * (1 + 1e-6) + 1e-6
            served += 1
        assert schedule.wait(now) <= period * (1 + 1e-6) + 1e-6  # type: ignore[operator]


def test_each_key_has_its_phase_and_its_count() -> None:
    schedule = Schedule[Any](1.0, count=2)
    schedule.add("b", 0.5, now=10.0)  # the first key sets the origin
    schedule.add("a", 0.0, now=10.0)
    seen: list[Any] = []
    while not schedule.over:
        now = 10.0 if not seen else seen[-1][1]
        now += schedule.wait(now)  # type: ignore[operator]
        due = schedule.take(now)
        seen.append((due.key, due.deadline))  # type: ignore[union-attr]

    assert seen == [("b", 10.0), ("a", 10.5), ("b", 11.0), ("a", 11.5)]
    assert schedule.take(99.0) is None


@given(st.lists(st.floats(1e-6, 1.0), min_size=1, max_size=300))
def test_lateness_is_within_5_percent(values: Any) -> None:
    histogram = LatenessHistogram()
    for value in values:
        histogram.add(value)
    summary = histogram.summary()

    inverted = {"method": "inverted_cdf"}
    assert summary.median == pytest.approx(np.quantile(values, 0.5, **inverted), rel=0.05)  # type: ignore[call-overload]
    assert summary.p99 == pytest.approx(np.quantile(values, 0.99, **inverted), rel=0.05)  # type: ignore[call-overload]
    assert summary.max == max(values)


@pytest.mark.parametrize(
    ("now", "expected"),
    [(9.0, 9.5), (10.0, 10.5), (10.4, 10.5), (10.5, 10.5), (10.6, 11.5),
     (10.5 + 2**-30, 10.5), (10.5 + 2e-6, 11.5)],
)  # fmt: skip
def test_the_first_deadline_is_the_next_one(now: float, expected: float) -> None:
    """One that is now is included, in spite of the rounding of a clock that runs for long."""
    schedule = Schedule[Any](1.0)
    schedule.add("a", 0.25, now=9.0)
    schedule.remove("a")
    schedule.add("b", 0.75, now=now)
    assert schedule.deadline("b") == expected


@pytest.mark.parametrize(
    ("now", "count", "expected"),
    [(7.75, None, (7.0, 2)), (8.0, None, (8.0, 3)), (8.0, 3, (7.0, 2)), (5.5, 1, (5.0, 0))],
)
def test_older_deadlines_are_skipped(now: float, count: int | None, expected: Any) -> None:
    """The newest one that has passed is met, but none beyond the count."""
    schedule = Schedule[Any](1.0, count)
    schedule.add("a", 0.0, now=5.0)
    due = schedule.take(now)
    assert due is not None
    assert (due.deadline, due.skipped) == expected
    assert schedule.take(now) is None
    assert schedule.over == (count is not None)


def test_a_lateness_below_a_tenth_of_a_microsecond_counts_as_that() -> None:
    """A deadline may be met early by rounding; before there is any, all are 0."""
    histogram = LatenessHistogram()
    assert histogram.summary() == (0.0, 0.0, 0.0)
    for value in (-1e-9, 0.0, 1.0):
        histogram.add(value)
    assert histogram.summary() == pytest.approx((1e-7, 1.0, 1.0), rel=0.05)


def test_a_key_that_is_unknown_or_removed_has_no_deadline() -> None:
    schedule = Schedule[Any](1.0)
    assert schedule.deadline("a") == math.inf
    schedule.add("a", 0.0, now=5.0)
    assert schedule.deadline("a") == 5.0
    schedule.remove("a")
    schedule.remove("a")
    assert schedule.deadline("a") == math.inf
    assert schedule.wait(now=5.0) is None
