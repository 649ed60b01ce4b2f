"""Complete records: values without a meaning, what a clipped value costs, and scenes."""

import re
from typing import Any

import numpy as np
import pytest
from dbc_alterations import original
from support.dbcs import changed_record
from support.scene_streams import COMPLETE, codec_of

from maplines_can.values.line import MapLine, Slot, Status
from maplines_can.wire import Codec, Layout, Reason


@pytest.fixture(scope="module")
def roomy() -> Codec:
    """A codec whose signals hold values that have no meaning: such as a kind of 8."""
    text = re.sub(r"( Kind m4 : )\d+\|3@1(.*)\[0\|7\]", r"\g<1>16|4@1\2[0|15]", original())
    text = re.sub(r"( Kind : )\d+\|3@1(.*)\[0\|7\]", r"\g<1>272|4@1\2[0|15]", text)
    return Codec(Layout.from_text(text))


@pytest.mark.parametrize(
    ("change", "accepted"),
    [
        ({"Kind": 7}, True),
        ({"Kind": 8}, False),
        ({"Status": 5}, True),
        ({"Status": 6}, False),
        ({"ComponentWeight": 0}, True),
        ({"ComponentWeight": 31}, True),
        ({"ComponentIndex": 1, "ComponentCount": 1}, True),  # the second of two
        ({"ComponentIndex": 2, "ComponentCount": 1}, False),
        ({"Age": 30}, True),
        ({"Age": 31}, True),
    ],
)
def test_a_record_with_a_value_that_has_no_meaning_is_rejected(
    roomy: Codec, change: dict[str, Any], accepted: bool
) -> None:
    """By both readers, one beyond the last value that has one."""
    payload = roomy.batch.encode([[1.75, 0, 0, 0]], np.eye(4)[None] * 1e-4)[0].tobytes()
    data = changed_record(roomy, payload, **change)
    one = roomy.batch.decode_one(data, Slot.EGO_LEFT)
    batch = roomy.batch.decode(np.frombuffer(data, np.uint8)[None])
    assert batch.accepted[0] == accepted
    if not accepted:
        assert one is Reason.CONTENT
        assert batch.rejects == {Reason.CONTENT: 1}
        return
    assert isinstance(one, MapLine)
    too_old = change.get("Age") == 31
    assert one.age == batch.age[0] == (np.inf if too_old else 0.008 * change.get("Age", 0))


@pytest.mark.parametrize("y", [0.0, np.pi / 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_clipped_beta_is_covered_by_the_difference_of_the_tangents(sign: int, y: float) -> None:
    """Of the decoded and the true line, in first order; by this and the rounding, and not more."""
    codec, cov = codec_of(COMPLETE), np.diag([1e-4, 1e-8, 1e-12, 1e-16])
    batch = codec.batch.decode(codec.batch.encode([[y, sign * 0.7, 0, 0]], cov[None]))
    decoded = batch.mean[0, 1]
    needed = (np.tan(sign * 0.7) - np.tan(decoded)) * np.cos(decoded) ** 2
    assert batch.status[0] == Status.SATURATED
    assert 1 <= batch.cov[0, 1, 1] / (needed**2 + cov[1, 1]) < 1.2
