"""The codec: status, frames, and the readers and writers that must agree."""

from typing import Any

import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.dbcs import DBC, changed_record, default_codec
from support.lines import random_lines

from maplines_can.values.line import VAGUE_SIGMA, Kind, Slot, Status
from maplines_can.wire import Reason


def test_the_three_data_structures_of_the_paper(codec: Any) -> None:
    """Mean only, mean and standard deviations, or mean and covariance."""
    mean = np.array([[1.75, 0.01, 1e-3, 1e-5]])
    root = np.array([[0.3, 0, 0, 0], [0.01, 0.02, 0, 0], [1e-4, 0, 1e-4, 0], [0, 0, 0, 1e-6]])
    cov = (root @ root.T)[None]
    bare = codec.batch.decode(codec.batch.encode(mean))
    assert bare.status[0] == Status.UNKNOWN
    assert bare.cov[0].diagonal() == pytest.approx(np.square(VAGUE_SIGMA))
    alone = codec.batch.decode(codec.batch.encode(mean, cov, status=Status.DIAGONAL))
    assert alone.status[0] == Status.DIAGONAL
    assert np.array_equal(alone.cov[0], np.diag(alone.cov[0].diagonal()))
    assert (alone.cov[0].diagonal() >= cov[0].diagonal()).all()
    assert alone.cov[0].diagonal() == pytest.approx(cov[0].diagonal(), rel=0.2)
    full = codec.batch.decode(codec.batch.encode(mean, cov))
    assert full.status[0] == Status.FULL
    for batch in (bare, alone, full):
        assert batch.mean == pytest.approx(mean, abs=1e-3)


def test_age_is_rounded_up(codec: Any) -> None:
    """To the next step; the greatest raw value means "too old"."""
    ages = np.array([0.0, 0.001, 0.008, 0.0081, 0.239, 0.24, 0.2401, 0.248, 9.0, np.inf])
    batch = codec.batch.decode(codec.batch.encode(np.zeros((10, 4)), age=ages))
    assert batch.age.tolist() == [0.0, 0.008, 0.008, 0.016, 0.24, 0.24, *[np.inf] * 4]
    assert codec.layout.max_age == 0.24


def test_unknown_with_a_mean_out_of_range_is_out_of_range(codec: Any) -> None:
    """Without a covariance, nothing covers a clipped mean."""
    batch = codec.batch.decode(codec.batch.encode([[1.75, 0, 0, 0], [40.0, 0, 0, 0]]))
    assert batch.status.tolist() == [Status.UNKNOWN, Status.OUT_OF_RANGE]


def test_cantools_decodes_and_encodes_the_same_frames(codec: Any) -> None:
    """In each page of each frame format, the bytes and the physical values are the same."""
    database = cantools.database.load_file(DBC)
    means, covs = random_lines(40, seed=3)
    payloads = codec.batch.encode(means, covs, slot=Slot.NEXT_LEFT, kind=Kind.DASHED, age=0.024)
    batch = codec.batch.decode(payloads, Slot.NEXT_LEFT)
    for i, payload in enumerate(payloads):
        signals: dict[Any, Any] = {}
        for frame in codec.encoder().frames(payload, Slot.NEXT_LEFT):
            message = database.get_message_by_frame_id(frame.can_id)  # type: ignore[union-attr]
            page = message.decode(frame.data, decode_choices=False)
            assert message.encode(page) == frame.data
            signals |= page
        (fd,) = codec.encoder().frames(payload, Slot.NEXT_LEFT, fd=True)
        record = database.get_message_by_frame_id(fd.can_id).decode(fd.data, decode_choices=False)  # type: ignore[union-attr]
        assert {k: record[k] for k in signals if k != "Page"} == {
            k: v for k, v in signals.items() if k != "Page"
        }
        assert [signals[name] for name in ("YOff", "Beta", "C0", "C1")] == batch.mean[i].tolist()
        assert (signals["XMin"], signals["XMax"]) == (batch.x_min[i], batch.x_max[i])
        assert (signals["Kind"], signals["Age"]) == (Kind.DASHED, 24)
        assert covariance_by_hand(signals) == pytest.approx(batch.cov[i], rel=1e-12)


def covariance_by_hand(signals: Any) -> Any:
    """Decode the covariance as dbc/README.md describes it, from the values of cantools."""
    names = ["C1", "C0", "YOff", "Beta"]
    L = np.zeros((4, 4))
    for i, row in enumerate(names):
        L[i, i] = 2.0 ** signals[f"Pivot{row}"]
        for j, column in enumerate(names[:i]):
            L[i, j] = signals[f"Ratio{row}{column}"] * L[i, i]
    S = 2.0 ** signals["Inflation"] * L @ L.T
    back = [names.index(name) for name in ("YOff", "Beta", "C0", "C1")]
    return S[np.ix_(back, back)]


@settings(max_examples=100)
@given(st.binary(min_size=32, max_size=32), st.booleans(), st.sampled_from(list(Slot)))
def test_both_readers_agree_on_any_bytes(data: bytes, valid: bool, slot: Any) -> None:
    """batch.decode_one and batch.decode agree to the last bit, or on the reason."""
    codec = default_codec()
    if valid:  # correct page numbers, transfer IDs and checksum
        data = changed_record(codec, data, slot)
    batch = codec.batch.decode(np.frombuffer(data, dtype=np.uint8)[None], slot)
    one = codec.batch.decode_one(data, slot)
    if isinstance(one, Reason):
        assert not batch.accepted[0]
        assert batch.rejects == {one: 1}
    else:
        assert batch.accepted[0]
        assert np.array_equal(one.gaussian.mean, batch.mean[0])
        assert np.array_equal(one.gaussian.cov, batch.cov[0])
        assert (one.status, one.kind, one.age) == (batch.status[0], batch.kind[0], batch.age[0])
        assert (one.x_min, one.x_max) == (batch.x_min[0], batch.x_max[0])
    if valid:
        assert batch.rejects.keys() <= {Reason.CONTENT}
    np.linalg.cholesky(batch.cov)  # whatever the bytes, a definite matrix


LINE, COV = np.zeros((1, 4)), np.eye(4)[None] * 1e-4
RECORD = np.zeros((1, 32), dtype=np.uint8)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda c: c.decoder(timeout_ms=1e308), r"at most an hour \(3600000 ms\), got 1e\+308"),
        (lambda c: c.decoder(timeout_ms=3_600_001), "timeout_ms must be .* got 3600001"),
        (lambda c: c.decoder(cycle_ms=10**400), "cycle_ms must be .* integer of about 1e400"),
        (lambda c: c.batch.encode([[10**400, 0, 0, 0]], COV), "means must be numbers"),
        (lambda c: c.batch.encode(LINE, [[[10**400] * 4] * 4]), "covs must be numbers"),
        (lambda c: c.batch.encode(LINE, -COV + 1e308), "covs must be finite"),
        (lambda c: c.batch.encode(LINE, COV, x_min=-(10**400)), "x_min must be numbers"),
        (lambda c: c.batch.encode(LINE, COV, counter=10**400), "counter must be numbers"),
        (lambda c: c.batch.encode(LINE, COV, slot=np.inf), "slot must be from 0 to 7, got inf"),
        (lambda c: c.batch.encode(LINE, COV, slot=1e300), r"slot must be from 0 to 7, got 1e\+300"),
        (lambda c: c.batch.decode(RECORD, np.nan), "slot must be from 0 to 7, got nan"),
        (lambda c: c.batch.encode_mixtures([10**400], LINE, COV), "weights must be numbers"),
        (lambda c: c.batch.encode_mixtures([1.0], LINE, COV), r"weights must have shape \(N, k\)"),
        (
            lambda c: c.batch.encode_mixtures([[1.0]], LINE[None], COV[None], age=10**400),
            "age must be",
        ),
    ],
)
@pytest.mark.filterwarnings("error")
def test_extreme_numbers_raise_a_short_message(make: Any, words: str) -> None:
    """The message names the argument and its range, and there is no warning."""
    with pytest.raises(ValueError, match=words) as refusal:
        make(default_codec())
    assert len(str(refusal.value)) < 400
