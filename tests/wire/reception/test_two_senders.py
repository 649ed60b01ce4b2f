"""Two senders of scenes: what a consumer may use of them.

If the second sender sends at a tenth of the rate or faster, and no frame is lost, it is detected at
the latest nine of its records and 16 cycles after its first one. From then on nothing is usable.
Before, what holds anything of the second sender is usable only if its counter is that of the next
record of the first sender, and until this record comes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby, pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st
from support.scene_streams import COMPLETE, CONDITIONAL, FRAME_NS, PERIOD_NS, codec_of
from support.sender_pairs import SLOTS, Event, Sender, merged, senders_of, senders_of_line

from maplines_can import SceneView, Slot, SlotView
from maplines_can.wire import POSE, E2EConfig, E2EState

VALID = E2EState.VALID
MAX_DELTA = E2EConfig().max_delta_counter
#: Records of the second sender after which it is detected, and cycles in addition: it is not while
#: its records look like lost ones of the first.
DETECTION = 9, MAX_DELTA
#: Cycles after the last frame of one of two senders until the other one is usable again: 256
#: without evidence, which may come from a counter that is reused later, and 8 OKs.
RECOVERY = 256 + MAX_DELTA + 8

#: Longest time of the frames of a scene [cycles].
SCENE = 16 * FRAME_NS / PERIOD_NS
Seen = tuple[float, SceneView, list[SlotView]]


def detection(every: int) -> float:
    """Return the time until a second sender is detected, with a scene every so many cycles."""
    records, cycles = DETECTION
    return records * every + cycles


def views(dbc: str, events: Sequence[Event]) -> Iterator[Seen]:
    """Yield what a consumer sees after each frame and before the next one, with the time."""
    decoder = codec_of(dbc).decoder()
    for event, after in pairwise([*events, events[-1]._replace(t_ns=events[-1].t_ns + PERIOD_NS)]):
        decoder.feed(event.frame.can_id, event.frame.data, event.t_ns)
        for t_ns in sorted({event.t_ns, max(event.t_ns, after.t_ns - 1)}):
            lines = [decoder.latest(slot, t_ns) for slot in SLOTS]
            yield t_ns / PERIOD_NS, decoder.latest_scene(t_ns), lines


def used(seen: Seen) -> list[set[int]]:
    """Return the senders of each thing that is usable."""
    _, scene, lines = seen
    found = [senders_of_line(v.line) for v in lines if v.usable and v.line is not None]
    return [*found, *([senders_of(scene.scene)] if scene.usable and scene.scene else [])]


def first_counters(ahead: int | tuple[int, int, int], start: int) -> dict[Any, int]:
    """Return counters of a second sender that are ahead of those of the first one at its start."""
    each = (ahead,) * 3 if isinstance(ahead, int) else ahead
    return {owner: (start + n) % 256 for owner, n in zip((POSE, *SLOTS), each, strict=True)}


#: How far its counters are ahead: those of the pose error and of the slots together or by
#: themselves, anywhere or nearby.
AHEAD = st.one_of(
    st.integers(0, 255),
    st.integers(-3, 20),
    st.tuples(*3 * [st.integers(0, 255)]),
    st.tuples(*3 * [st.integers(-3, 20)]),
)


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
@settings(max_examples=6, phases=[Phase.explicit, Phase.generate])
@given(
    every=st.sampled_from([1, 3, 10]),
    phase=st.floats(0.01, 0.99),
    start=st.sampled_from([0, 8, 20]),
    ahead=AHEAD,
)
@example(every=3, phase=0.2, start=0, ahead=0)
@example(every=10, phase=0.2, start=0, ahead=5)
@example(every=3, phase=0.2, start=20, ahead=5)  # passes as lost records
@example(every=3, phase=0.2, start=20, ahead=1)  # the next record, but too early
@example(every=1, phase=0.99, start=20, ahead=(-1, 9, 0))
def test_two_senders_are_soon_unusable(
    dbc: str, every: int, phase: float, start: int, ahead: Any
) -> None:
    """Whatever their rates, phases and counters; and they are mixed for a cycle at most."""
    begin, end = start + phase, start + phase + detection(every)
    second = Sender(1, every, begin, counters=first_counters(ahead, start))
    events = merged(dbc, [Sender(0), second], end + 2 * every + 2)
    seen = [(one[0], used(one)) for one in views(dbc, events)]
    assert not [t for t, senders in seen if t > end and senders]
    for is_of_second, group in groupby(seen, lambda one: any(1 in senders for senders in one[1])):
        times = [t for t, _ in group]  # until the last record of the first sender's next scene
        assert not is_of_second or times[-1] - times[0] <= 1 + SCENE
    assert all(senders for t, senders in seen if 8 < t < begin)  # it was all usable before


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
@pytest.mark.parametrize(("every", "stops"), [(1, 0), (1, 1), (3, 1), (10, 1)])
def test_the_other_sender_is_usable_again(dbc: str, every: int, stops: int) -> None:
    """When one of the two has stopped; the one that goes on is usable until the end."""
    stop = 20 + detection(every)
    senders = [
        Sender(0, stop=stop if stops == 0 else np.inf),
        Sender(1, every, 20.3, stop=stop if stops == 1 else np.inf, counters={POSE: 7}),
    ]
    events = merged(dbc, senders, stop + RECOVERY + 20)
    seen = [(one[0], used(one)) for one in views(dbc, events)]
    assert not [t for t, senders in seen if stop < t < stop + 240 and senders]
    after = [senders for t, senders in seen if t > stop + RECOVERY]
    assert all(senders == 3 * [{1 - stops}] for senders in after)


def test_one_slot_that_is_not_valid_makes_its_scene_unusable() -> None:
    """The view says which; the scenes without the line are usable, as is the other line."""
    codec, period = codec_of(COMPLETE), PERIOD_NS
    decoder = codec.decoder()
    for event in merged(COMPLETE, [Sender(0)], 12):
        decoder.feed(event.frame.can_id, event.frame.data, event.t_ns)
    can_id = codec.layout.messages[Slot.EGO_RIGHT].can_id
    assert can_id is not None
    now_ns = 11 * period + 20 * FRAME_NS
    assert decoder.latest_scene(now_ns).usable
    for _ in range(3):  # frames of a wrong length: three errors of ten checks
        decoder.feed(can_id, b"", now_ns)
    view = decoder.latest_scene(now_ns)
    assert view.state is VALID
    assert view.slot_states == {Slot.EGO_LEFT: VALID, Slot.EGO_RIGHT: E2EState.INVALID}
    assert not view.usable
    assert decoder.latest(Slot.EGO_LEFT, now_ns).usable
    assert not decoder.latest(Slot.EGO_RIGHT, now_ns).usable
