"""Settings of a decoder."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.dbcs import default_codec, edited

from maplines_can.values.line import MapLine, Slot
from maplines_can.wire import Codec, E2EConfig, ProfileStatus, Reason


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        pytest.param(-1, ValueError, "stale_cycles must be 0 or more", id="negative"),
        pytest.param(float("nan"), ValueError, "stale_cycles must be 0 or more", id="nan"),
        pytest.param("3", TypeError, "must be real number, not str", id="text"),
        pytest.param(None, TypeError, "must be real number, not NoneType", id="none"),
    ],
)
def test_a_wrong_number_of_stale_cycles_raises(
    wrong: Any, error: type[Exception], message: str
) -> None:
    """NaN would never be stale; so for the scene, before the first one."""
    decoder = default_codec().decoder()
    with pytest.raises(error, match=message):
        decoder.latest(Slot.EGO_LEFT, 0, stale_cycles=wrong)
    with pytest.raises(error, match=message):
        decoder.latest_scene(0, stale_cycles=wrong)
    assert decoder.latest(Slot.EGO_LEFT, 0, stale_cycles=float("inf")).stale  # there is no line


LATEST_NS = 4 * 10**18


@pytest.mark.parametrize(
    ("given", "t_ns"),
    [
        pytest.param(7.0, 7, id="float"),
        pytest.param(np.int64(-7), -7, id="int64"),
        pytest.param(np.float64(7), 7, id="float64"),
        pytest.param(True, 1, id="bool"),
        pytest.param(LATEST_NS, LATEST_NS, id="latest"),
        pytest.param(LATEST_NS + 1, LATEST_NS, id="beyond"),
        pytest.param(-LATEST_NS - 1, -LATEST_NS, id="before"),
        pytest.param(np.uint64(2**64 - 1), LATEST_NS, id="uint64"),
        pytest.param(10**400, LATEST_NS, id="huge"),
        pytest.param(1e30, LATEST_NS, id="huge-float"),
    ],
)
def test_times_are_integers_within_a_range(given: Any, t_ns: int) -> None:
    """Of frames, of questions and of the end of a time-out."""
    decoder = default_codec().decoder()
    line = MapLine.mean_only(Slot.EGO_LEFT, np.zeros(4), age=0.01)
    frames = default_codec().encoder().encode(line)
    *_, answer = [decoder.feed(frame.can_id, frame.data, given) for frame in frames]
    assert not isinstance(answer, Reason)
    (received,) = answer
    assert (received.t_ns, type(received.t_ns)) == (t_ns, int)
    view = decoder.latest(Slot.EGO_LEFT, given)
    assert (type(view.age), view.age, view.stale) == (float, received.age, False)
    assert decoder.slots(given)[Slot.EGO_LEFT].ok == 1
    decoder.feed(frames[0].can_id, bytes(8), -LATEST_NS)
    decoder.expire(given)
    assert decoder.pending == (t_ns == -LATEST_NS)


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        pytest.param(1.5, ValueError, "must be whole \\[ns\\], got 1.5", id="fraction"),
        pytest.param(float("inf"), ValueError, "must be whole \\[ns\\], got inf", id="infinite"),
        pytest.param(float("nan"), ValueError, "must be whole \\[ns\\], got nan", id="nan"),
        pytest.param("1", TypeError, "'str' object cannot be interpreted", id="text"),
        pytest.param(None, TypeError, "'NoneType' object cannot be interpreted", id="none"),
    ],
)
def test_what_is_no_time_raises(wrong: Any, error: type[Exception], message: str) -> None:
    """Wherever a time is an argument, and nothing is counted."""
    decoder = default_codec().decoder()
    (frame, *_) = default_codec().encoder().encode(MapLine.mean_only(Slot.EGO_LEFT, np.zeros(4)))
    for ask in (
        lambda: decoder.feed(frame.can_id, frame.data, wrong),
        lambda: decoder.feed(frame.can_id, bytes(3), wrong),
        lambda: decoder.expire(wrong),
        lambda: decoder.latest(Slot.EGO_LEFT, wrong),
        lambda: decoder.latest_scene(wrong),
        lambda: decoder.slots(wrong),
        lambda: decoder.pose_error(wrong),
    ):
        with pytest.raises(error, match=message):
            ask()
    assert decoder.feed(0x7FF, frame.data, wrong) is Reason.FOREIGN  # not looked at
    assert decoder.feed(frame.can_id, frame.data, 0) is Reason.PENDING
    assert decoder.frames == decoder.pending + sum(decoder.counts.values()) == 2


def test_max_delta_counter_must_be_less_than_half_of_the_counters(tmp_path: Path) -> None:
    """A short counter reduces the default; with a given value it is an error."""
    narrow = [(rf"({name} m0 : 16\|)8@1\+ \(1,0\) \[0\|255\]", r"\g<1>4@1+ (1,0) [0|15]")
              for name in ("Counter",)]  # fmt: skip
    codec = Codec.from_dbc(edited(tmp_path, *narrow, (r"Counter : 16\|8@1\+", "Counter : 16|4@1+")))
    for counter, status in ((7, ProfileStatus.OKSOMELOST), (8, ProfileStatus.WRONGSEQUENCE)):
        decoder, line = codec.decoder(), MapLine.mean_only(Slot.EGO_LEFT, np.zeros(4))
        for i, own in enumerate((3, counter)):  # 4 is a quarter of the counter modulus
            (frames,) = codec.encoder().encode_lines([line], counters={Slot.EGO_LEFT: own})
            for frame in frames:
                decoder.feed(frame.can_id, frame.data, 5 * i * 50_000_000)
        assert decoder.lines == 2
        assert decoder.checks[Slot.EGO_LEFT].status is status
    with pytest.raises(ValueError, match=r"max_delta_counter must be less than 8.*got 16"):
        codec.decoder(e2e=E2EConfig())
    with pytest.raises(ValueError, match=r"max_delta_counter must be less than 8.*got 8"):
        codec.decoder(e2e=E2EConfig(max_delta_counter=8))
    assert codec.decoder(e2e=E2EConfig(max_delta_counter=7)).lines == 0
