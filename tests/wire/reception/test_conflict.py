"""Two senders on one slot: what the diagnostic is for."""

from dbcs import default_codec

from maplines_can.line import MapLine, Slot
from maplines_can.wire import E2EState, Monitor

SLOT, CYCLE_NS = Slot.EGO_LEFT, 50_000_000
OURS, THEIRS = 1.75, -1.75


def payload(y_off: float, counter: int) -> bytes:
    """Return the record of a line."""
    codec = default_codec()
    return codec.encode_batch([[y_off, 0, 0, 0]], slot=SLOT, counter=counter)[0]


def test_a_second_sender_that_is_slightly_ahead_is_valid_but_not_usable() -> None:
    """Its records pass the E2E check as lost records do: only the diagnostic prevents their use.

    This is why ``SlotView.usable`` depends on it.
    """
    codec = default_codec()
    monitor = Monitor(codec.decoder())
    seen = []
    for cycle in range(200):
        records = [(OURS, cycle)]
        if cycle % 10 == 9:
            records.append((THEIRS, cycle + 2))
        for y_off, counter in records:
            for frame in codec.frames(payload(y_off, counter % 256), SLOT, fd=True):  # type: ignore[arg-type]
                monitor.feed(frame.can_id, frame.data, cycle * CYCLE_NS)
        view = monitor.latest(SLOT, cycle * CYCLE_NS)
        seen.append((view.state, view.usable, round(float(view.line.gaussian.mean[0]), 2)))  # type: ignore[union-attr]

    wrong = [usable for state, usable, y in seen if state is E2EState.VALID and y == THEIRS]
    assert len(wrong) > 15  # delivered while VALID, from the first to the last
    assert not any(wrong[-8:])  # and not usable, once the conflicts prove a second sender
    assert seen[0][2] == OURS
    assert isinstance(view.line, MapLine)
