"""Attributes of records, and weights of mixtures: defaults and ends of their ranges."""

from typing import Any

import numpy as np
import pytest
from support.scene_streams import COMPLETE, codec_of

from maplines_can.values.line import Slot

COV = np.diag([1e-2, 1e-4, 1e-8, 1e-12])


@pytest.mark.parametrize(
    ("counter", "counters"), [(None, [0, 1, 2, 3]), (9, [9, 10, 9, 10]), ([5, 255], [5, 6, 255, 0])]
)
def test_the_counters_of_components(counter: Any, counters: list[int]) -> None:
    """They go on from that of the line; without one, from the line before."""
    codec = codec_of(COMPLETE)
    payloads = codec.batch.encode_mixtures(
        np.full((2, 2), 0.5), np.zeros((2, 2, 4)), np.tile(COV, (2, 2, 1, 1)),
        counter=counter, slot=[Slot.CENTRE, Slot.ROUTE],
    )  # fmt: skip
    batch = codec.batch.decode(payloads.reshape(4, 32), np.repeat([Slot.CENTRE, Slot.ROUTE], 2))
    assert batch.accepted.all()
    assert batch.counter.tolist() == counters
    assert batch.component_index.tolist() == [0, 1, 0, 1]
    assert batch.component_count.tolist() == [2] * 4


@pytest.mark.parametrize(("total", "accepted"), [(9e-6, True), (1.1e-5, False)])
@pytest.mark.parametrize("sign", [1, -1])
def test_weights_add_up_to_1_but_for_rounding(total: float, accepted: bool, sign: int) -> None:
    """Single precision is accepted; in each row."""
    weights = np.array([[0.5, 0.5], [0.5, 0.5 + sign * total]])
    arguments = weights, np.zeros((2, 2, 4)), np.tile(COV, (2, 2, 1, 1))
    if accepted:
        assert codec_of(COMPLETE).batch.encode_mixtures(*arguments).shape == (2, 2, 32)
    else:
        with pytest.raises(ValueError, match="weights must be positive and each row of sum 1"):
            codec_of(COMPLETE).batch.encode_mixtures(*arguments)
