"""Two senders on one slot: what the diagnostic is for."""

from typing import Any

import numpy as np
import pytest
from answers import one
from dbcs import default_codec
from e2e_streams import MS, Received, mixture_frames

from maplines_can.values.line import Kind, MapLine, Slot
from maplines_can.wire import E2EState, Reason

SLOT, CYCLE_NS = Slot.EGO_LEFT, 50_000_000
OURS, THEIRS = 1.75, -1.75


def payload(y_off: float, counter: int) -> bytes:
    """Return the record of a line."""
    codec = default_codec()
    return codec.batch.encode([[y_off, 0, 0, 0]], slot=SLOT, counter=counter)[0]


def test_a_second_sender_that_is_slightly_ahead_is_valid_but_not_usable() -> None:
    """Its records pass the E2E check as lost records do: only the diagnostic prevents their use.

    This is why ``SlotView.usable`` depends on it.
    """
    codec = default_codec()
    decoder = codec.decoder()
    seen = []
    for cycle in range(200):
        records = [(OURS, cycle)]
        if cycle % 10 == 9:
            records.append((THEIRS, cycle + 2))
        for y_off, counter in records:
            for frame in codec.encoder().frames(payload(y_off, counter % 256), SLOT, fd=True):  # type: ignore[arg-type]
                decoder.feed(frame.can_id, frame.data, cycle * CYCLE_NS)
        view = decoder.latest(SLOT, cycle * CYCLE_NS)
        seen.append((view.state, view.usable, round(float(view.line.gaussian.mean[0]), 2)))  # type: ignore[union-attr]

    wrong = [usable for state, usable, y in seen if state is E2EState.VALID and y == THEIRS]
    assert len(wrong) > 15  # delivered while VALID, from the first to the last
    assert not any(wrong[-8:])  # and not usable, once the conflicts prove a second sender
    assert seen[0][2] == OURS
    assert isinstance(view.line, MapLine)


def sources(line: MapLine, cycle: int, k: int) -> set[int]:
    """Return the senders whose components are in a mixture."""
    found = set()
    for component in line.mixture.means:  # type: ignore[union-attr]
        for sender in (0, 1):
            alone, decoder = None, default_codec().decoder()
            for frame in mixture_frames(cycle * k % 256, k, True, seed=sender):
                alone = one(decoder.feed(frame.can_id, frame.data, 0))
            assert isinstance(alone, MapLine)
            if any(np.array_equal(component, own) for own in alone.mixture.means):  # type: ignore[union-attr]
                found.add(sender)
    return found


@pytest.mark.parametrize("k", [2, 3, 8])
@pytest.mark.parametrize("seed", range(4))
def test_two_senders_in_phase_get_no_mixture_of_both(seed: int, k: int) -> None:
    """Equal counters and components, and a third of the frames lost.

    Until a counter has come from both, nothing tells their components apart; then no mixture is of
    both, and no line is usable.
    """
    rng, decoder = np.random.default_rng([seed, k]), default_codec().decoder()
    reused = 0
    for cycle in range(480 // k):
        pairs = zip(
            *(mixture_frames(cycle * k % 256, k, True, seed=sender) for sender in (0, 1)),
            strict=True,
        )
        for i, pair in enumerate(pairs):
            came = rng.random(2) > 1 / 3
            for j, frame in enumerate(pair):
                if not came[j]:
                    continue
                t_ns = cycle * CYCLE_NS + (2 * i + j) * MS // 4
                answer = one(decoder.feed(frame.can_id, frame.data, t_ns))
                reused += bool(j == 1 and came.all())
                if reused and isinstance(answer, MapLine):
                    assert len(sources(answer, cycle, k)) == 1
                assert not (reused and decoder.latest(SLOT, t_ns).usable)
    assert reused > 50


@pytest.mark.parametrize("k", range(2, 9))
def test_the_first_mixture_may_be_of_both_until_a_counter_is_reused(k: int) -> None:
    """If just one component of the second sender arrives, and in place of that of the first."""
    ours, theirs = (mixture_frames(0, k, True, seed=sender) for sender in (0, 1))
    for place in range(k):
        decoder = default_codec().decoder()
        frames = [*ours[:place], theirs[place], *ours[place + 1 :], ours[place]]
        answers = [one(decoder.feed(f.can_id, f.data, i * MS // 4)) for i, f in enumerate(frames)]
        *_, line, late = answers
        assert isinstance(line, MapLine)
        assert sources(line, 0, k) == {0, 1}
        assert late is Reason.STALE
        assert not decoder.latest(SLOT, k * MS // 4).usable


@pytest.mark.parametrize(
    "other",
    [{"kind": max(Kind)}, {"x_min": -8.0}, {"x_max": 40.0}, {"age": 0.1}],
    ids=["kind", "x_min", "x_max", "age"],
)
def test_components_with_other_attributes_are_of_another_sender(other: Any) -> None:
    """What all components of a line share tells two senders apart from the first line on."""
    codec, decoder = default_codec(), default_codec().decoder()

    def component(index: int, **attributes: Any) -> Any:
        record = codec.batch.encode_mixtures(
            [[0.5, 0.5]], np.zeros((1, 2, 4)), np.tile(1e-2 * np.eye(4), (1, 2, 1, 1)),
            slot=SLOT, counter=[8], **attributes,
        )[0, index]  # fmt: skip
        return codec.encoder().frames(record, SLOT, fd=True)[0]

    first, second = component(0), component(1, **other)
    assert decoder.feed(first.can_id, first.data, 0) is Reason.PENDING
    assert decoder.feed(second.can_id, second.data, MS) is Reason.PENDING
    assert decoder.counts == {Reason.INCOMPLETE: 1}


@pytest.mark.parametrize(("records", "lines"), [(8, 20), (4, 40)])
def test_a_sender_that_restarts_at_standstill_is_not_two_senders(records: int, lines: int) -> None:
    """All lines are bit-identical, so those after the restart have come before: far behind."""
    slot = Received()
    for run in range(2):  # the second at once after the first
        for i in range(lines * records):
            t_ns = (run * lines + i // records) * CYCLE_NS
            slot.received(i, i, t_ns, records)
    assert (slot.check.state, slot.check.two_senders) == (E2EState.VALID, False)


@pytest.mark.parametrize("k", [1, 8])
@pytest.mark.parametrize("lost", [0, 1, 2, 5])
@pytest.mark.parametrize("jitter", [0.0, 0.2])
def test_lost_lines_are_no_second_sender(k: int, lost: int, jitter: float) -> None:
    """Of one sender whose lines come in their cycles, also after a gap."""
    slot = Received()
    for cycle in [*range(20), *range(20 + lost, 40)]:
        t_ns = round((cycle + jitter * (-1) ** cycle) * CYCLE_NS)
        for i in range(k):
            assert slot.received((cycle * k + i) % 256, cycle * k + i, t_ns, k) is None
            assert slot.has_one_sender(t_ns)


def test_lost_lines_that_a_queue_hides_are_suspected_until_the_next_line() -> None:
    """After a backlog without time stamps of its own, which ends with a gap."""
    slot = Received()
    seen = []
    for counter, cycle in [*((i, i) for i in range(10)), (15, 10), (16, 11), (17, 12)]:
        assert slot.received(counter, counter, cycle * CYCLE_NS) is None
        seen.append(slot.has_one_sender(cycle * CYCLE_NS))
    assert seen == [True] * 10 + [False, True, True]
    assert slot.check.state is E2EState.VALID
