"""The time on the clock of the stamps is known in spite of a backlog."""

import pytest

from maplines_can.bus.stamp_clock import StampClock


def test_a_backlog_does_not_set_the_time_back() -> None:
    """A process that was suspended reads old stamps; the time still follows our clock."""
    clock, second = StampClock(), 1_000_000_000
    clock.add(100 * second, 0)
    for i in range(50):  # 2.5 s of frames, read at once after 3 s
        clock.add(100 * second + i * second // 20, 3 * second + i * 10_000)
        assert clock.now(3 * second) >= 103 * second - 1_000_000


MS = 1_000_000


def test_a_backlog_at_the_start_is_not_taken_for_new() -> None:
    """Its frames are read at once; the clock settles when frames arrive at the pace of stamps."""
    clock = StampClock()
    for i in range(41):  # 2 s of frames in 4 ms; the last one has waited for 0.9 s
        clock.add(i * 50 * MS, i * MS // 10)
        assert not clock.is_settled
    for i in range(41, 60):  # then frames at the pace of their stamps, 3 s after the first
        at_ns = 3000 * MS + i * 50 * MS
        clock.add(at_ns + 2900 * MS, at_ns)
        assert clock.is_settled == (i >= 45)
        assert clock.now(at_ns) == at_ns + 2900 * MS


@pytest.mark.parametrize("ppm", [-200, 200])
def test_a_clock_that_drifts_stays_settled(ppm: int) -> None:
    """The quartz of an adapter drifts against ours for an hour."""
    clock = StampClock()
    for i in range(36_000):
        at_ns = i * 100 * MS
        clock.add(at_ns + at_ns * ppm // 10**6, at_ns)
        assert clock.is_settled == (i >= 2)


@pytest.mark.parametrize(
    ("gain_ns", "settled"), [(0, True), (50 * MS - 1, True), (50 * MS, False), (60 * MS, False)]
)
def test_how_much_less_waiting_shows_a_backlog(gain_ns: int, settled: bool) -> None:
    """50 ms or more within 0.2 s."""
    clock, start = StampClock(), 10**15  # a monotonic clock counts from anywhere
    clock.add(0, start)
    clock.add(200 * MS - 1 + gain_ns, start + 200 * MS - 1)
    assert not clock.is_settled
    clock.add(200 * MS + gain_ns, start + 200 * MS)
    assert clock.is_settled is settled


@pytest.mark.parametrize(("late_ns", "set_back"), [(20 * MS, True), (20 * MS - 1, False)])
@pytest.mark.parametrize(("after_ns", "over"), [(1000 * MS, False), (1000 * MS + 1, True)])
def test_a_clock_is_set_back_if_all_frames_are_late_for_more_than_a_second(
    late_ns: int, set_back: bool, after_ns: int, over: bool
) -> None:
    """Late is a wait of 20 ms or more; the least late frame then gives the time."""
    clock = StampClock()
    clock.add(0, 0)
    for at_ns, wait_ns in ((10, 50 * MS), (900 * MS, late_ns), (10 + after_ns, 70 * MS)):
        clock.add(at_ns - wait_ns, at_ns)
    assert clock.now(2000 * MS) == 2000 * MS - (late_ns if set_back and over else 0)
