"""The newest line of a slot, with its age and state."""

import numpy as np
import pytest
from support.dbcs import new_codec
from support.e2e_streams import CYCLE, MS, SLOT

from maplines_can import MapLine
from maplines_can.wire import E2EState

VALID, NODATA, INIT, INVALID = E2EState


def test_a_line_becomes_stale() -> None:
    """After three cycles; its age counts from its pose, and the state changes at 275 ms."""
    codec = new_codec()
    encoder = codec.encoder()
    decoder = codec.decoder()
    before = decoder.latest(SLOT, 0)
    assert before == (SLOT, None, np.inf, True, NODATA, None, False, None)
    for k in range(10):
        line = MapLine.mean_only(SLOT, [1.0 + k / 8, 0, 0, 0], age=0.04)
        for frame in encoder.encode(line):
            decoder.feed(frame.can_id, frame.data, k * CYCLE)
    last = 9 * CYCLE
    for waited_ms, stale, state in [
        (0, False, VALID),
        (150, False, VALID),
        (151, True, VALID),
        (274, True, VALID),
        (275, True, INVALID),
        (10**6, True, INVALID),
    ]:
        view = decoder.latest(SLOT, last + waited_ms * MS)
        assert view.line.gaussian.mean[0] == pytest.approx(1.0 + 9 / 8, abs=1e-3)  # type: ignore[union-attr]
        assert view.age == pytest.approx(0.04 + waited_ms / 1000)
        assert (view.stale, view.state) == (stale, state)
        assert view.usable == (not stale and state is VALID)
