"""Ages, counters and records that a caller gives to an encoder."""

from typing import Any

import numpy as np
import pytest
from support.scene_streams import COMPLETE, CONDITIONAL, new_codec, road_scene

from maplines_can import EncodeError, Slot
from maplines_can.wire import POSE, Frame


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
@pytest.mark.parametrize(
    ("age", "message"),
    [
        pytest.param(-1.0, "age must be 0 s or more", id="negative"),
        pytest.param(-1e-300, "age must be 0 s or more", id="hardly-negative"),
        pytest.param(float("-inf"), "age must be 0 s or more", id="minus-infinite"),
        pytest.param(float("nan"), "age must be 0 s or more", id="nan"),
        pytest.param(None, "age must be 0 s or more", id="none"),
        pytest.param(1e100, "age must be 0 s or more", id="beyond"),
        pytest.param(10**400, "numbers from -1.8e.308 to", id="beyond-the-floats"),
        pytest.param("x", "could not convert", id="text"),
        pytest.param({}, "age must be one for all .*'pose' has none", id="no-record"),
        pytest.param(dict.fromkeys((POSE, *Slot), -1.0), "0 s or more", id="of-the-pose"),
        pytest.param(
            dict.fromkeys((POSE, *Slot), -1.0) | {POSE: 0.1},
            "0 s or more",
            id="of-lines-not-of-the-pose",
        ),
    ],
)
def test_a_wrong_age_of_a_scene_raises(age: Any, message: str, dbc: str) -> None:
    """A negative one is not sent as 0."""
    with pytest.raises(ValueError, match=message):
        new_codec(dbc).encoder().encode_scene(road_scene(), age=age)


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_counters_may_be_of_any_kind_of_integer(dbc: str) -> None:
    """What is no integer raises."""
    slot, expected = Slot.EGO_LEFT, dict[Any, list[Frame]]()
    counter: Any
    wrong: Any
    encoder = new_codec(dbc).encoder()
    for counter in (3, np.int64(3), np.uint8(3), 3 + 2**40):
        sent = encoder.encode_scene(road_scene(), counters={slot: counter, POSE: counter})
        expected = expected or sent
        assert sent == expected
    for wrong in (1.5, "3", None):
        with pytest.raises(TypeError):
            encoder.encode_scene(road_scene(), counters={slot: wrong})


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize(("dbc", "lengths"), [(COMPLETE, [32]), (CONDITIONAL, [16, 32])])
def test_a_record_of_another_length_is_refused(dbc: str, lengths: list[int], fd: bool) -> None:
    """It would be that of another DBC."""
    encoder, slot = new_codec(dbc).encoder(), Slot.EGO_LEFT
    for length in range(70):
        record = np.zeros(length, np.uint8)
        if length in lengths:
            assert sum(len(frame.data) for frame in encoder.frames(record, slot, fd=fd)) >= length
            continue
        with pytest.raises(EncodeError, match=f"of {' or '.join(map(str, lengths))} bytes, got"):
            encoder.frames(record, slot, fd=fd)
