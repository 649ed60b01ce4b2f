"""Scenes from a transmitter to a receiver on simulated time."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from support.fake_bus import FULL, GONE, FakeTime, map_line
from support.scene_streams import (
    COMPLETE,
    CONDITIONAL,
    authenticated_codec,
    road_scene,
)
from support.transmitter_bench import PERIOD

from maplines_can import (
    Gaussian,
    LeftOut,
    MapLine,
    Scene,
    Slot,
)
from maplines_can.bus.tx_queue import AHEAD, ALLOWANCE
from maplines_can.wire import POSE, E2EState, Encoder, ProfileStatus

SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.ROUTE)
BOTH = pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
ALL = pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE, "maplines-scene.dbc"])


@cache
def scene_of(slots: tuple[Slot, ...] = SLOTS) -> Scene:
    return road_scene(slots)


@BOTH
def test_the_pose_error_comes_first_in_each_period(make_bench: Any, dbc: str) -> None:
    """The lines follow at the phases of their slots, and each scene is complete."""
    bench = make_bench(dbc)
    bench.transmitter.publish(scene_of())
    for cycle in range(12):
        bench.transmitter.publish(scene_of())
        bench.run((cycle + 0.95) * PERIOD)
        assert bench.slots == SLOTS
    assert [owner for _, owner in bench.owners] == [POSE, *SLOTS] * 12
    for (time, owner), cycle in zip(bench.owners, np.repeat(range(12), 4), strict=True):
        phase = 0.0 if owner == POSE else owner / 8
        assert time == pytest.approx((cycle + phase) * PERIOD, abs=1e-6)
    assert bench.lost == 0
    assert not bench.decoder.counts
    assert bench.view().usable
    stats = bench.transmitter.stats()
    assert (stats.pose_errors, stats.lines, stats.overruns) == (12, 36, 0)


@BOTH
def test_a_pose_error_that_is_skipped_leaves_no_gap(make_bench: Any, dbc: str) -> None:
    """Neither it nor its lines are sent, and the counters go on; then scenes are complete again."""
    bench = make_bench(dbc)
    bench.transmitter.publish(scene_of())
    rng = np.random.default_rng(3)
    for _ in range(20):
        bench.run(bench.time + rng.uniform(1, 4) * PERIOD)
        bench.clock.now += rng.uniform(1.2, 5) * PERIOD  # the thread does not run
    bench.run(bench.time + 3 * PERIOD)
    sent = [owner for _, owner in bench.owners]
    assert sent.count(POSE) < bench.time / PERIOD - 20
    poses = [m for m in bench.messages if m.arbitration_id == 0x35C and m.data[7] >> 5 == 0]
    counters = [message.data[2] for message in poses]
    assert counters == [n % 256 for n in range(len(counters))]
    assert bench.decoder.checks[POSE].lost == 0
    assert bench.slots == SLOTS


def test_a_line_that_is_skipped_does_not_use_its_counter_again(make_bench: Any) -> None:
    """The pose error stated it: with the next counter, no line can join a wrong pose error."""
    bench = make_bench(CONDITIONAL)
    bench.transmitter.publish(scene_of())
    bench.run(2.5 * PERIOD)
    bench.clock.now = bench.start + 3.0 * PERIOD + 1e-6
    transfer = bench.transmitter._tx_queue.take(bench.clock.now)
    assert transfer is not None
    while transfer.owner != POSE:
        bench.transmitter._send(transfer)
        transfer = bench.transmitter._tx_queue.take(bench.clock.now)
        assert transfer is not None
    bench.transmitter._send(transfer)
    bench.receive()
    bench.clock.now = bench.start + 4.0 * PERIOD - 1e-4
    for _ in SLOTS:
        bench.transmitter._tx_queue._schedule.take(bench.clock.now)  # skipped
    bench.run(6.95 * PERIOD)
    assert bench.decoder.lost == 3
    assert bench.slots == SLOTS


@ALL
def test_a_retracted_line_is_in_no_scene(make_bench: Any, dbc: str) -> None:
    """Until a scene with its slot is published; then it is sent again, without a gap."""
    bench = make_bench(dbc)
    bench.transmitter.publish(scene_of())
    bench.run(3.95 * PERIOD)
    bench.transmitter.retract(Slot.EGO_RIGHT)
    bench.run(8.95 * PERIOD)
    assert bench.slots == (Slot.EGO_LEFT, Slot.ROUTE)
    for slot in scene_of().index:
        bench.transmitter.retract(slot)  # nothing but the pose error is left
    bench.run(10.95 * PERIOD)
    bench.transmitter.publish(scene_of())
    bench.run(14.95 * PERIOD)
    assert bench.slots == SLOTS
    assert bench.lost == 0


@BOTH
def test_slots_leave_and_come_back_at_any_time(make_bench: Any, dbc: str) -> None:
    """Also in the middle of a cycle; no line joins a wrong pose error."""
    bench = make_bench(dbc)
    rng = np.random.default_rng(5)
    plans = [SLOTS, SLOTS[:1], SLOTS[1:], SLOTS[::2]]
    at = 0.0
    for _ in range(80):
        plan = plans[rng.integers(len(plans))]
        bench.transmitter.publish(scene_of(plan))
        at += rng.choice([0.3, 1.0, 1.4, 2.2]) * PERIOD
        bench.run(at)
        scene = bench.view().scene
        assert scene is None or set(scene.index) <= set(SLOTS)
    bench.transmitter.publish(scene_of())
    bench.run((at // PERIOD + 3.95) * PERIOD)
    assert bench.slots == SLOTS
    decoder = bench.decoder
    assert decoder.checks[POSE].lost == 0


def test_lines_that_do_not_fit_the_message_are_retracted_and_counted(make_bench: Any) -> None:
    """By their reasons, each time that they are published; also of a scene that is prepared."""
    bench = make_bench(CONDITIONAL)
    bench.transmitter.publish(scene_of())
    bench.run(1.95 * PERIOD)
    full = scene_of()
    lines = [
        replace(line, gaussian=Gaussian([60.0, 0, 0, 0], line.gaussian.cov))
        if line.slot is Slot.EGO_RIGHT
        else line
        for line in full.lines
    ]
    beside = replace(full, lines=tuple(lines), left_out={Slot.CENTRE: LeftOut.ACROSS})
    bench.transmitter.publish(beside)
    bench.run(3.95 * PERIOD)
    assert bench.slots == (Slot.EGO_LEFT, Slot.ROUTE)
    bench.transmitter.publish(bench.codec.encoder().prepare_scene(beside))
    stats = bench.transmitter.stats()
    assert stats.left_out == {LeftOut.MEAN: 2, LeftOut.ACROSS: 2}
    assert stats.as_dict()["left_out"] == {"MEAN": 2, "ACROSS": 2}


def test_scenes_then_plain_lines_and_back(make_bench: Any) -> None:
    """The counters of the slots go on; a plain line is in no scene."""
    bench = make_bench(COMPLETE)
    end = 0.95 * PERIOD
    for round_ in range(6):
        bench.transmitter.publish(scene_of())
        bench.run(end := end + 3 * PERIOD)
        assert bench.slots == SLOTS
        cycles = bench.view()
        bench.transmitter.publish([map_line(slot, y=9.0 + round_) for slot in SLOTS])
        bench.run(end := end + 5 * PERIOD)
        view = bench.view()
        assert view.scene is cycles.scene  # no newer one
        assert view.stale
        for slot in SLOTS:
            line = bench.decoder.latest(slot, bench.now_ns).line
            assert line is not None
            assert line.gaussian.mean[0] == 9.0 + round_
    assert bench.lost == 0


@ALL
@pytest.mark.parametrize("lateness", [0.0, 0.003, 0.04])
def test_the_age_is_not_too_small(make_bench: Any, dbc: str, lateness: float) -> None:
    """However late the thread is; nor greater than that by more than the lateness allows."""
    bench = make_bench(dbc, lateness=lateness)
    published, checked = 0.0, 0
    bench.transmitter.publish(scene_of())
    for now in np.arange(0.0, 1.5, 0.007):
        bench.run(now)
        if now > published + PERIOD:
            published = bench.time
            bench.transmitter.publish(scene_of())
        view = bench.view()
        if view.scene is not None and np.isfinite(view.age):
            checked += 1
            assert view.age >= bench.time - published - 1e-6
            # one publication may be on its way
            assert view.age <= bench.time - published + 3 * PERIOD + 2 * lateness + 0.02
    assert checked > 100


def test_the_age_of_a_pose_and_of_its_lines_counts(
    make_bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By ``t_pose_ns``, or else the greatest age of the scene's lines."""
    monkeypatch.setattr("maplines_can.bus.transmitter.time", now := FakeTime())
    scene = scene_of()
    lines = [
        MapLine(line.slot, line.gaussian, x_min=line.x_min, x_max=line.x_max, age=0.03 * i)
        for i, line in enumerate(scene.lines)
    ]
    aged = Scene(tuple(lines), scene.cov, scene.pose_error, scene.fit_ranges)
    for t_pose_ns, age in ((None, 0.06), (now.ns - 100_000_000, 0.096)):
        bench = make_bench(CONDITIONAL)
        bench.transmitter.publish(aged, t_pose_ns)
        bench.run(0.95 * PERIOD)
        assert bench.view().age == pytest.approx(age + 2 * ALLOWANCE + bench.time, abs=0.0081)


@ALL
def test_a_scene_that_is_not_published_again_becomes_unusable(make_bench: Any, dbc: str) -> None:
    """The age is stated as too old within ``max_age``, while the senders stays VALID."""
    max_age = 0.12
    bench = make_bench(dbc, settings={"max_age": max_age})
    hang = 1.0
    usable = []
    for now in np.arange(0.0, 2.0, 0.005):
        if now < hang and round(now / 0.005) % 10 == 0:
            bench.transmitter.publish(scene_of())
        bench.run(now)
        if bench.view().usable:
            usable.append(now)
    assert len(usable) > 100
    assert max(usable) <= hang + max_age
    view = bench.view()
    assert (view.state, view.stale, view.age) == (E2EState.VALID, False, np.inf)
    assert bench.transmitter.stats().expired > 10
    bench.transmitter.publish(scene_of())
    bench.run(bench.time + 1.2 * PERIOD)
    assert bench.view().usable


@BOTH
def test_a_late_transfer_keeps_its_counter(make_bench: Any, dbc: str) -> None:
    """Each record that is encoded again has the counter and content it had, but for the age."""
    bench = make_bench(dbc)
    bench.transmitter.publish(scene_of())
    queue = bench.transmitter._tx_queue
    for cycle in range(5):
        for slot in (POSE, *SLOTS):
            phase = 0 if slot == POSE else slot / 8
            bench.clock.now = bench.start + (cycle + phase) * PERIOD + 1e-6
            transfer = queue.take(bench.clock.now)
            assert transfer is not None
            assert transfer.owner == slot
            late = queue.renew(transfer, bench.clock.now + 0.02)
            assert late.latest >= bench.clock.now + 0.02
            assert late.frames[0].data[2] == transfer.frames[0].data[2] == cycle
            bench.clock.now += 0.02
            bench.transmitter._send(transfer)
            bench.receive()
    assert bench.lost == 0
    assert not bench.decoder.counts


@ALL
def test_a_full_queue_delays_a_transfer(make_bench: Any, dbc: str) -> None:
    """Of the pose error, too; each scene is received."""
    bench = make_bench(dbc, script=[FULL] * 3 + [None] * 7 + [FULL] * 3)
    bench.transmitter.publish(scene_of())
    bench.run(9.95 * PERIOD)
    view = bench.view()
    assert view.scene is not None
    assert tuple(view.scene.index) == SLOTS
    assert view.status is ProfileStatus.OK
    assert bench.transmitter.stats().retries == 6
    assert bench.lost == 0


@pytest.mark.parametrize("dbc", [CONDITIONAL, "maplines-secoc.dbc"])
@pytest.mark.parametrize("period", [PERIOD, 1.0, 30.0])
def test_authenticated_scenes_of_a_slow_sender(
    make_bench: Any, monkeypatch: pytest.MonkeyPatch, dbc: str, period: float
) -> None:
    """Frames are made at most 0.1 s ahead, so that their freshness values are in the window."""
    bench = make_bench(dbc, codec=authenticated_codec(dbc), period=period, settings={"fd": True})
    made: list[float] = []
    write = Encoder.encode_scene

    def encode_scene(*arguments: Any, **settings: Any) -> Any:
        made.append(bench.time)
        return write(*arguments, **settings)

    monkeypatch.setattr(Encoder, "encode_scene", encode_scene)
    bench.transmitter.publish(scene_of())
    bench.run(3.95 * period)
    assert bench.slots == SLOTS
    assert bench.lost == 0
    assert not bench.decoder.counts
    for time, _ in bench.owners:
        assert min(time - at for at in made if at <= time + 1e-6) < AHEAD


@pytest.mark.parametrize(
    ("lost", "counts"), [(POSE, (0, 1, 2)), (SLOTS[0], (1, 1, 1)), (SLOTS[1], (1, 1, 1))]
)
def test_only_what_is_sent_with_all_its_frames_is_counted(
    make_bench: Any, lost: Any, counts: tuple[int, int, int]
) -> None:
    """The interface goes with the last frame of the pose error or of a line.

    It is not yet back for the first line, which is due together with the pose error.
    """
    bench = make_bench(CONDITIONAL, period=1.0)
    bench.transmitter.publish(scene_of(SLOTS[:2]))
    queue = bench.transmitter._tx_queue
    for _ in range(3):
        bench.clock.now += queue.wait(bench.clock.now)
        transfer = queue.take(bench.clock.now)
        if transfer.owner == lost:
            bench.opener.script[:] = [None] * (len(transfer.frames) - 1) + [GONE]
        bench.transmitter._send(transfer)
    stats = bench.transmitter.stats()
    assert (stats.pose_errors, stats.lines, stats.down) == counts
