"""Writer of records: what a clipped value costs, and scenes at their own times."""

from typing import Any

import numpy as np
import pytest
from scene_streams import COMPLETE, codec_of, feed, road_scene

from maplines_can.line import MapLine, Slot, Status
from maplines_can.wire import POSE


@pytest.mark.parametrize("y", [0.0, np.pi / 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_clipped_beta_is_covered_by_the_difference_of_the_tangents(sign: int, y: float) -> None:
    """Of the decoded and the true line, in first order; by this and the rounding, and not more."""
    codec, cov = codec_of(COMPLETE), np.diag([1e-4, 1e-8, 1e-12, 1e-16])
    batch = codec.decode_batch(codec.encode_batch([[y, sign * 0.7, 0, 0]], cov[None]))
    decoded = batch.mean[0, 1]
    needed = (np.tan(sign * 0.7) - np.tan(decoded)) * np.cos(decoded) ** 2
    assert batch.status[0] == Status.SATURATED
    assert 1 <= batch.cov[0, 1, 1] / (needed**2 + cov[1, 1]) < 1.2


def test_each_record_of_a_scene_has_its_own_age() -> None:
    """The pose error and each line are sent at their own times."""
    codec, scene = codec_of(COMPLETE), road_scene()
    ages: Any = {POSE: 0.016, Slot.EGO_LEFT: 0.024, Slot.EGO_RIGHT: 0.032}
    decoder = codec.decoder()
    answers, _ = feed(decoder, codec.encode_scene(scene, age=ages, counters={}), 0)
    received = decoder.scene()
    assert received is not None
    assert received.age == pytest.approx(0.016)
    assert [one.age for one in answers if isinstance(one, MapLine)] == [0.024, 0.032]
