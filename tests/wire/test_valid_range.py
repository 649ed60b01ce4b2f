"""A decoded valid range never claims more than the given one."""

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.dbcs import changed_record, edited

from maplines_can import Codec, Slot
from maplines_can.values.line import Status
from maplines_can.wire import Reason

COV = np.diag([1e-2, 1e-4, 1e-8, 1e-12])
X_MIN, X_MAX = r"(SG_ XMin\b.*?)\(4,-20\) \[-20\|8\]", r"(SG_ XMax\b.*?)\(4,0\) \[0\|124\]"
#: Conversions of XMin and XMax; the last ones leave most ranges without a step inside.
DBCS = {
    "default": (),
    "finer": ((X_MIN, r"\1(2,-8) [-8|6]"), (X_MAX, r"\1(2,10) [10|72]")),
    "tenths": ((X_MIN, r"\1(0.1,0) [0|0.7]"), (X_MAX, r"\1(0.3,0) [0|9.3]")),
    "far": ((X_MIN, r"\1(8,40) [40|96]"), (X_MAX, r"\1(30,-500) [-500|430]")),
}
STATUSES = [None, *Status]
ENDS = st.one_of(
    st.floats(-1000, 1000),
    st.integers(-250, 250).map(lambda k: 4.0 * k),
    st.integers(-100, 100).map(lambda k: k / 10),
)


@pytest.fixture(scope="module", params=DBCS)
def ranged(request: Any, tmp_path_factory: Any) -> Any:
    """A codec with one of the conversions."""
    folder = tmp_path_factory.mktemp("dbc")
    return Codec.from_dbc(edited(folder, *DBCS[request.param]))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(st.lists(st.tuples(ENDS, ENDS), min_size=1, max_size=20), st.sampled_from(STATUSES))
def test_item_4_a_decoded_range_is_inside_the_given_one(
    ranged: Any, ends: Any, status: Any
) -> None:
    """Or the status is OUT_OF_RANGE, whatever status was requested; repaired lines, too."""
    x_min, x_max = np.sort(np.array(ends), axis=1).T
    n = len(x_min)
    for cov in (COV, np.where(np.eye(4), COV, 2 * np.sqrt(np.outer(*[COV.diagonal()] * 2)))):
        payloads = ranged.batch.encode(
            np.zeros((n, 4)), np.tile(cov, (n, 1, 1)), x_min=x_min, x_max=x_max, status=status
        )
        batch = ranged.batch.decode(payloads)
        stated = batch.status != Status.OUT_OF_RANGE
        assert batch.accepted.all()
        assert (x_min <= batch.x_min)[stated].all()
        assert (batch.x_min <= batch.x_max)[stated].all()
        assert (batch.x_max <= x_max)[stated].all()
        # Where a step of each end lies inside, and the steps are in order, the range is stated.
        if status is not Status.OUT_OF_RANGE:
            first, last = ranged.layout["XMin"], ranged.layout["XMax"]
            starts = first.physical(np.arange(first.raw_min, first.raw_max + 1))
            stops = last.physical(np.arange(last.raw_min, last.raw_max + 1))
            for i in range(n):
                inside = starts[(starts >= x_min[i]) & (starts <= x_max[i])]
                possible = ((stops <= x_max[i]) & (stops >= inside.min(initial=np.inf))).any()
                assert stated[i] == possible


@pytest.mark.parametrize("status", STATUSES)
@pytest.mark.parametrize("ends", [(50, 80), (300, 400), (-400, -300), (4.5, 7.5), (8.5, 100)])
def test_item_4_a_range_that_cannot_be_stated_is_out_of_range(
    codec: Any, ends: Any, status: Any
) -> None:
    """Beyond an end of XMin or XMax, or shorter than a step: never a longer range."""
    payload = codec.batch.encode([[0.0] * 4], [COV], x_min=ends[0], x_max=ends[1], status=status)
    assert codec.batch.decode(payload).status[0] == Status.OUT_OF_RANGE
    assert not codec.batch.decode_one(payload[0].tobytes(), Slot.EGO_LEFT).is_usable


@pytest.mark.parametrize("status", list(Status))
def test_item_4_a_received_range_that_ends_before_it_starts_is_rejected(
    codec: Any, status: Any
) -> None:
    """By the batch and by one record alike, unless the status is OUT_OF_RANGE."""
    record = codec.batch.encode([[0.0] * 4], [COV], x_min=8, x_max=8, status=status)[0]
    payload = changed_record(codec, record.tobytes(), XMax=1)  # 4 m
    batch = codec.batch.decode(np.frombuffer(payload, np.uint8)[None])
    one = codec.batch.decode_one(payload, Slot.EGO_LEFT)
    if status is Status.OUT_OF_RANGE:
        assert batch.accepted[0]
        assert (one.x_min, one.x_max) == (batch.x_min[0], batch.x_max[0]) == (4, 4)
    else:
        assert batch.rejects == {Reason.CONTENT: 1}
        assert one is Reason.CONTENT
