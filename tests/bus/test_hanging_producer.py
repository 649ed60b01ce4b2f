"""A producer that hangs: the line is no longer usable after a stated time.

The tests run on simulated time. The thread wakes up late, the bus takes its time, and frames
are lost, all at random.
"""

from typing import Any

import numpy as np
import pytest
from answers import one
from support.dbcs import new_codec
from support.fake_bus import FULL, Clock, FakeOpener, map_line
from support.transmitter_bench import PERIOD

from maplines_can import Codec, Link, MapLine, Motion, Slot, Transmitter, predict_to
from maplines_can.bus.tx_queue import ALLOWANCE
from maplines_can.values.line import Status
from maplines_can.wire import E2EState
from maplines_can.wire.reception.views import STALE_CYCLES

DBC, SLOT = "maplines.dbc", Slot.EGO_LEFT
SPEED, BETA, Y0 = 20.0, 0.09, -20.0  #: the car changes lanes: y grows by 1.8 m/s
SIGMA = [0.05, 0.003, 1e-4, 1e-5]
#: Longest time that a frame spends on the bus in these tests [s].
TRANSIT = 0.003


def true_line(t: float, age: float = 0.0) -> MapLine:
    """Return the line of a pose at time t [s]."""
    return MapLine.with_sigma(SLOT, [Y0 + SPEED * np.tan(BETA) * t, BETA, 0, 0], SIGMA, age=age)


@pytest.mark.parametrize("seed", range(4))
def test_item_1_a_hanging_producer_leaves_no_usable_line(
    make_bench: Any, codec: Codec, seed: int
) -> None:
    """At every moment a usable line is as old as it says, and predicts the truth."""
    rng = np.random.default_rng(seed)
    lateness = rng.choice([0, 0.002, 0.02])
    bench = make_bench(DBC, lateness=lateness, loss=0.05, transit=TRANSIT, seed=seed + 4)
    hang = rng.uniform(1.0, 2.0)
    pose, produced, used, motion = 0.0, 0.0, 0, Motion(SPEED, 0.0)
    bound = codec.layout.max_age + STALE_CYCLES * PERIOD
    for now in np.arange(0.0, 8.0, 0.005):
        bench.run(now)
        if now >= produced and now < hang:
            pose = now - rng.uniform(0, 0.06)
            bench.transmitter.publish(true_line(pose, age=bench.time - pose))
            produced += PERIOD
        view = bench.decoder.latest(SLOT, bench.now_ns)
        if not view.usable:
            continue
        used += 1
        assert bench.time - hang < bound + TRANSIT
        assert view.line is not None
        published = (view.line.gaussian.mean[0] - Y0) / (SPEED * np.tan(BETA))
        true_age = bench.time - published
        assert true_age - TRANSIT - 1e-3 <= view.age <= bound
        predicted = predict_to(view.line, bench.now_ns, motion, time_sigma=0.005)
        assert abs(predicted.y(0.0) - true_line(bench.time).y(0.0)) < 3 * predicted.y_sigma(0.0)
    assert used > 100
    view = bench.decoder.latest(SLOT, bench.now_ns)
    assert (view.state, view.stale, view.two_senders) == (E2EState.VALID, False, False)
    assert (view.usable, view.age) == (False, np.inf)
    stats = bench.transmitter.stats()
    assert stats.lines - stats.expired < 60
    assert stats.expired > 100
    assert bench.decoder.slots(bench.now_ns)[SLOT].ok > 100  # the ECU is known to be alive


def test_item_1_a_line_published_again_is_usable_again(make_bench: Any) -> None:
    """The next good line is enough: the slot stayed VALID."""
    bench = make_bench(DBC)
    bench.transmitter.publish(map_line())
    bench.run(2.0)
    assert not bench.decoder.latest(SLOT, bench.now_ns).usable
    bench.transmitter.publish(map_line())
    bench.run(2.11)
    assert bench.decoder.latest(SLOT, bench.now_ns).usable


@pytest.mark.parametrize("max_age", [0.06, 0.1, 0.24, None])
def test_item_1_max_age_is_the_greatest_age_that_is_sent(
    make_bench: Any, max_age: float | None
) -> None:
    """Beyond it the age is "too old"; such lines are counted."""
    bench = make_bench(DBC, settings={"max_age": max_age})
    bench.transmitter.publish(map_line(age=0.01))
    bench.run(1.0)
    ages = [line.age for line in bench.lines]
    limit = 0.24 if max_age is None else max_age
    assert ages == sorted(ages)
    assert max(age for age in ages if np.isfinite(age)) <= limit + 0.008
    stated = sum(0.01 + ALLOWANCE + PERIOD * k <= limit for k in range(20))
    assert [np.isfinite(age) for age in ages] == [k < stated for k in range(len(ages))]
    assert bench.transmitter.stats().expired == len(ages) - stated


@pytest.mark.parametrize("max_age", [0, -1, 0.241, np.inf, np.nan])
def test_item_1_a_max_age_that_the_dbc_cannot_state_is_refused(codec: Codec, max_age: Any) -> None:
    with (
        Link(FakeOpener()) as link,
        pytest.raises(ValueError, match=r"max_age must be above 0 s and at most 0\.24 s"),
    ):
        Transmitter(link, codec, max_age=max_age)


@pytest.mark.parametrize("full", [3, 10, 40])
def test_item_1_the_age_covers_the_wait_for_the_transmit_queue(
    make_bench: Any, monkeypatch: pytest.MonkeyPatch, full: int
) -> None:
    """A line that waits is encoded again before its first frame, with the same counter."""
    bench = make_bench(DBC, script=[None] * 4 + [FULL] * full)
    monkeypatch.setattr("maplines_can.bus.transmitter.time", sleeper := Sleeper(bench.clock))
    bench.transmitter.publish(map_line())
    for _ in range(3):
        bench.run(bench.time + PERIOD)
    waited = full * sleeper.step
    assert bench.lines[0].age == 0.008
    age = bench.lines[1].age
    assert PERIOD + waited <= age <= PERIOD + max(2 * waited, ALLOWANCE) + 0.008
    assert bench.decoder.slots(bench.now_ns)[SLOT].lost == 0
    assert bench.transmitter.stats()[2:6] == (0, 0, 4 * len(bench.lines), full)


class Sleeper:
    """Stands in for the module ``time``: a pause advances the clock."""

    step = 0.001

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def sleep(self, _: float) -> None:
        self.clock.now += self.step


@pytest.mark.parametrize("ages", [(0.04, 0.04, 0.04), (np.inf,) * 3, (0.04, np.inf, 0.04)])
def test_item_1_a_mixture_is_as_old_as_its_components(codec: Codec, ages: Any) -> None:
    """A line has one pose, so components of different ages are not of one line."""
    payloads = codec.batch.encode(
        np.zeros((3, 4)), np.tile(np.diag([1e-2, 1e-4, 1e-8, 1e-12]), (3, 1, 1)), age=ages,
        counter=range(3), component_index=range(3), component_count=3,
        component_weight=[0.25, 0.25, 0.5],
    )  # fmt: skip
    decoder = codec.decoder()
    answers = [
        one(decoder.feed(frame.can_id, frame.data, 10**6 * i))
        for i, payload in enumerate(payloads)
        for frame in codec.encoder().frames(payload, SLOT)
    ]
    lines = [answer for answer in answers if isinstance(answer, MapLine)]
    if len(set(ages)) > 1:
        assert not lines
        return
    (line,) = lines
    assert line.mixture is not None
    assert line.is_usable == np.isfinite(ages[0])
    assert (line.age, line.t_ns) == (ages[0], 0)


def test_item_1_a_line_out_of_range_is_never_usable(make_bench: Any) -> None:
    """It is sent and received, VALID and new."""
    bench = make_bench(DBC)
    for k in range(20):
        bench.transmitter.publish(map_line(y=1000.0))
        bench.run(PERIOD * k)
    view = bench.decoder.latest(SLOT, bench.now_ns)
    assert view.line is not None
    assert (view.state, view.stale, view.line.status) == (
        *(E2EState.VALID, False),
        Status.OUT_OF_RANGE,
    )
    assert not view.usable


def test_item_10_publish_after_stop_raises() -> None:
    """Nothing would be sent; there is nothing left to retract."""
    with Link(FakeOpener()) as link:
        transmitter = Transmitter(link, new_codec())
        transmitter.publish(map_line())  # before the start
        with transmitter:
            pass
        transmitter.retract(SLOT)
        with pytest.raises(RuntimeError, match="publish must come before stop"):
            transmitter.publish(map_line())
