"""Reader of records: values that have no meaning."""

import re
from typing import Any

import numpy as np
import pytest
from dbc_alterations import original
from support.dbcs import changed_record

from maplines_can.values.line import MapLine, Slot
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
