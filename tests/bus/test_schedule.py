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


def test_a_key_that_is_unknown_or_removed_has_no_deadline() -> None:
    schedule = Schedule[Any](1.0)
    assert schedule.deadline("a") == math.inf
    schedule.add("a", 0.0, now=5.0)
    assert schedule.deadline("a") == 5.0
    schedule.remove("a")
    schedule.remove("a")
    assert schedule.deadline("a") == math.inf
    assert schedule.wait(now=5.0) is None
