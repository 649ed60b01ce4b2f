"""Pages to lines: what the streams of the model do not say of the records that they send."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from support.dbcs import default_codec
from support.e2e_streams import MS, feed, frames

from maplines_can.values.errors import LayoutError
from maplines_can.values.line import MapLine, Slot
from maplines_can.wire import Codec


def test_memory_does_not_grow(codec: Any) -> None:
    """A slot holds as many transfers as there are numbers, whatever comes."""
    decoder = codec.decoder()
    for i in range(5000):
        page = frames(i % 40)[i % 4]
        decoder.feed(page.can_id, page.data, i * MS)
    assert decoder.pending <= 4 * 16


@cache
def standing(n: int) -> Any:
    """Frames of n transfers of one line that stands still."""
    codec, mean = default_codec(), [[1.75, 0.0, 0.0, 0.0]] * n
    payloads = codec.batch.encode(mean, [np.diag([1e-2, 1e-4, 1e-8, 1e-12])] * n)
    return [codec.encoder().frames(payload, Slot.EGO_LEFT) for payload in payloads]


def test_a_line_that_stands_still_is_no_duplicate_of_itself(codec: Any) -> None:
    """Its pages are those of the transfer one round of IDs before, whatever page comes first."""
    decoder = codec.decoder(timeout_ms=200)
    for i, transfer in enumerate(standing(60)):
        assert isinstance(feed(decoder, transfer[::-1], t_ns=2 * i * MS), MapLine)
    assert decoder.counts == {}


def test_a_counter_in_two_pages_is_refused(codec: Any) -> None:
    """No page alone would say to which record it belongs."""
    layout = codec.layout
    signals = dict(layout.signals)
    signals["Counter"] = replace(layout["Counter"], start=58, big_endian=True)
    signals["Status"] = replace(layout["Status"], start=59)
    signals["Kind"] = replace(layout["Kind"], start=16)
    signals["TransferId0"] = replace(layout["TransferId1"], name="TransferId0", start=19)
    signals["C0"] = replace(layout["C0"], start=72, length=11, raw_min=-1024, raw_max=1023)
    with pytest.raises(LayoutError, match=r"signal Counter is .* needs to be within a page"):
        Codec(replace(layout, signals=signals)).decoder()
