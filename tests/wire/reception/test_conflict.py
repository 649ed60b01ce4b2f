"""Two senders on one slot: what the diagnostic is for."""

import numpy as np
import pytest
from support.dbcs import default_codec
from support.e2e_streams import MS, mixture_frames

from maplines_can.values.line import MapLine, Slot
from maplines_can.wire import E2EState

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


@pytest.mark.parametrize("k", [2, 8])
def test_two_senders_in_phase_get_no_usable_mixture(k: int) -> None:
    """Equal counters and components, and a third of the frames lost.

    Until a counter has come from both, nothing tells their components apart; then no line is
    usable.
    """
    rng, decoder, reused = np.random.default_rng(k), default_codec().decoder(), 0
    for cycle in range(480 // k):
        senders = [mixture_frames(cycle * k % 256, k, True, seed=sender) for sender in (0, 1)]
        for i, pair in enumerate(zip(*senders, strict=True)):
            came = rng.random(2) > 1 / 3
            for j in np.flatnonzero(came).tolist():
                t_ns = cycle * CYCLE_NS + (2 * i + j) * MS // 4
                decoder.feed(pair[j].can_id, pair[j].data, t_ns)
                reused += bool(j == 1 and came.all())
                assert not (reused and decoder.latest(SLOT, t_ns).usable)
    assert reused > 50
