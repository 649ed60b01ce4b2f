"""Lines to frames and back: the guarantee, the flags, and the two paths that must agree."""

import cantools
import numpy as np
import pytest
from dbcs import DBC, default_codec, edited
from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can.errors import EncodeError, LayoutError
from maplines_can.gaussian import Gaussian
from maplines_can.line import VAGUE_SIGMA, Kind, MapLine, Slot, Status
from maplines_can.study import adversarial, evaluate, paper, road
from maplines_can.wire import Codec, Reason

LIMITS = np.array([32.0, 0.5, 0.125, 0.03125])


def check_guarantee(codec, means, covs):
    """Never overconfident, always definite; returns the batch and the verdict."""
    payloads = codec.encode_batch(means, covs)
    batch = codec.decode_batch(payloads)
    assert batch.accepted.all()
    stated = batch.status != Status.OUT_OF_RANGE
    verdict = evaluate(means, covs, batch.mean, batch.cov, codec.resolution)
    assert verdict.positive_definite.all()
    assert not verdict.overconfident[stated].any()
    return batch, verdict


def test_a_hundred_thousand_hostile_covariances(codec):
    """Sigmas over the whole range, condition to 1e10, exactly singular, means at the limits."""
    batch, _ = check_guarantee(codec, *adversarial(100_000, seed=1))
    assert (batch.status == Status.OUT_OF_RANGE).mean() < 0.01
    assert set(np.unique(batch.status)) <= {Status.FULL, Status.SATURATED, Status.OUT_OF_RANGE}


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.floats(-40, 40), min_size=4, max_size=4),
    st.lists(st.floats(-3, 3), min_size=16, max_size=16),
    st.lists(st.floats(-12, 3), min_size=4, max_size=4),
    st.integers(0, 4),
)
def test_any_covariance_is_covered_or_says_so(mean, entries, log_sigma, rank):
    """Any square of any matrix, any rank, any scale, any mean."""
    root = np.array(entries).reshape(4, 4) * 10.0 ** np.array(log_sigma)[:, None]
    root[:, rank:] = 0
    cov = root @ root.T
    check_guarantee(default_codec(), np.array([mean]) * LIMITS / 32, ((cov + cov.T) / 2)[None])


@pytest.mark.parametrize("make", [paper, road])
def test_the_sets_stay_within_the_bounds_of_the_design(codec, make):
    """KL, saturation, lateral error and sigma ratio on pose error alone and with map error."""
    means, covs = make(4000, seed=11)
    batch, verdict = check_guarantee(codec, means, covs)
    assert verdict.kl_covered.mean() <= 5e-3
    assert np.quantile(verdict.kl_covered, 0.99) <= 1.2e-2
    assert (batch.status == Status.SATURATED).mean() <= 5e-3
    assert np.abs(verdict.lateral_error).max() <= 5e-3
    assert np.quantile(verdict.sigma_ratio, 0.99, axis=0).max() <= 1.06
    assert verdict.sigma_ratio.min() >= 1


def test_kl_of_the_rounding_is_what_the_theory_says(codec):
    """With the inflation taken out: sum of D^2/24 for ratios, (D ln 2)^2/12 for pivots."""
    rng = np.random.default_rng(4)
    n = 40_000
    root = rng.standard_normal((n, 4, 4)) * [0.5, 0.02, 1e-3, 1e-4] + 0
    covs = np.einsum("nki,nkj->nij", root, root)
    means = np.zeros((n, 4))
    batch = codec.decode_batch(codec.encode_batch(means, covs))
    names = [f.name for f in codec.layout.signals.values()]
    pivots = [codec.layout[name].factor for name in names if name.startswith("Pivot")]
    ratios = [codec.layout[name].factor for name in names if name.startswith("Ratio")]
    theory = sum((p * np.log(2)) ** 2 / 12 for p in pivots) + sum(r**2 / 24 for r in ratios)
    raw = codec._reader._packing.unpack(codec.encode_batch(means, covs))
    inflation = 2.0 ** codec.layout["Inflation"].physical(raw["Inflation"])
    plain = batch.cov / inflation[:, None, None]
    keep = batch.status == Status.FULL
    measured = evaluate(means, covs, means, plain, codec.resolution).kl_covered[keep].mean()
    # An error of n samples of a divergence whose spread is about its mean: 1 / sqrt(n) = 0.5 %.
    assert measured == pytest.approx(theory, rel=0.03)


def test_zero_covariance_is_legal(codec):
    """An exactly known line decodes to the resolution of the grid, not to zero."""
    batch, _ = check_guarantee(codec, np.array([[1.75, 0.01, 1e-3, 1e-5]]), np.zeros((1, 4, 4)))
    assert batch.status[0] == Status.FULL
    assert np.linalg.eigvalsh(batch.cov[0])[0] > 0


@pytest.mark.parametrize("state", range(4))
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_mean_beyond_its_range_is_covered_or_out_of_range(codec, state, sign):
    """Just over the limit the covariance grows; far over it the line says OUT_OF_RANGE."""
    near, far = np.zeros((2, 1, 4))
    near[0, state] = sign * 1.02 * LIMITS[state]
    far[0, state] = sign * 1e6
    cov = np.diag([1e-2, 1e-4, 1e-8, 1e-12])[None]
    batch, _ = check_guarantee(codec, near, cov)
    assert batch.status[0] == Status.SATURATED
    assert np.sqrt(batch.cov[0, state, state]) >= 0.015 * LIMITS[state]
    batch, _ = check_guarantee(codec, far, cov)
    assert batch.status[0] == Status.OUT_OF_RANGE
    assert batch.cov[0].diagonal() == pytest.approx(np.square(VAGUE_SIGMA))


def test_a_sigma_beyond_the_range_is_out_of_range(codec):
    """A line that is known to a kilometre is not stated."""
    batch, _ = check_guarantee(codec, np.zeros((1, 4)), np.diag([1e6, 1e-4, 1e-8, 1e-12])[None])
    assert batch.status[0] == Status.OUT_OF_RANGE


def test_huge_numbers_do_not_overflow(codec):
    """1e150 and the like are out of range, without a warning."""
    batch = codec.decode_batch(codec.encode_batch(np.full((1, 4), 1e200), 1e300 * np.eye(4)[None]))
    assert batch.status[0] == Status.OUT_OF_RANGE
    assert np.isfinite(batch.cov).all()


def test_an_indefinite_covariance_is_repaired_upwards(codec):
    """What is decoded covers the matrix that was given, and says REPAIRED."""
    cov = np.diag([1e-2, 1e-4, 1e-8, 1e-12])
    cov[0, 1] = cov[1, 0] = 1.5e-3  # a correlation of 1.5
    batch, _ = check_guarantee(codec, np.zeros((1, 4)), cov[None])
    assert batch.status[0] == Status.REPAIRED


def test_rounding_of_a_singular_matrix_is_not_a_repair(codec):
    """A rank-one matrix with a correlation of 1 + 1e-15 is FULL."""
    root = np.array([[0.3], [0.01], [1e-4], [1e-6]])
    cov = root @ root.T
    cov[0, 1] = cov[1, 0] = cov[0, 1] * (1 + 1e-15)
    batch, _ = check_guarantee(codec, np.zeros((1, 4)), cov[None])
    assert batch.status[0] == Status.SATURATED  # the ratios of a singular matrix have no end


def test_the_three_data_structures_of_the_paper(codec):
    """Mean only, mean and standard deviations, mean and covariance."""
    mean = np.array([[1.75, 0.01, 1e-3, 1e-5]])
    root = np.array([[0.3, 0, 0, 0], [0.01, 0.02, 0, 0], [1e-4, 0, 1e-4, 0], [0, 0, 0, 1e-6]])
    cov = (root @ root.T)[None]
    bare = codec.decode_batch(codec.encode_batch(mean))
    assert bare.status[0] == Status.UNKNOWN
    assert bare.cov[0].diagonal() == pytest.approx(np.square(VAGUE_SIGMA))
    alone = codec.decode_batch(codec.encode_batch(mean, cov, status=Status.DIAGONAL))
    assert alone.status[0] == Status.DIAGONAL
    assert np.array_equal(alone.cov[0], np.diag(alone.cov[0].diagonal()))
    assert (alone.cov[0].diagonal() >= cov[0].diagonal()).all()
    assert alone.cov[0].diagonal() == pytest.approx(cov[0].diagonal(), rel=0.2)
    full = codec.decode_batch(codec.encode_batch(mean, cov))
    assert full.status[0] == Status.FULL
    for batch in (bare, alone, full):
        assert batch.mean == pytest.approx(mean, abs=1e-3)


def test_diagonal_stays_diagonal_where_a_value_meets_its_end(codec):
    """Who sent sigmas alone is not taken for one who sent correlations."""
    cov = np.diag([0.09, 4e-4, 1e-6, 1e-10])[None]
    payload = codec.encode_batch([[33.0, 0, 0, 0]], cov, status=Status.DIAGONAL, x_min=30.0)
    assert codec.decode_batch(payload).status[0] == Status.DIAGONAL


def test_age_is_never_younger_than_it_is(codec):
    """Rounded up to the step; the top value means this or more."""
    ages = np.array([0.0, 0.001, 0.008, 0.0081, 0.247, 0.249, 9.0])
    batch = codec.decode_batch(codec.encode_batch(np.zeros((7, 4)), age=ages))
    assert batch.age.tolist() == [0.0, 0.008, 0.008, 0.016, 0.248, 0.248, 0.248]


def test_single_precision_is_welcome(codec):
    """J P J^T worked in float32 is symmetric and definite to float32's rounding."""
    rng = np.random.default_rng(8)
    root = (rng.standard_normal((300, 4, 3)) * [[0.3], [0.02], [1e-3], [1e-5]]).astype(np.float32)
    covs = np.einsum("nik,njk->nij", root, root)
    batch = codec.decode_batch(codec.encode_batch(np.zeros((300, 4), np.float32), covs))
    assert not (batch.status == Status.REPAIRED).any()
    assert Gaussian(np.zeros(4, np.float32), covs[0]).dimension == 4


def test_unknown_stays_unknown_with_a_mean_out_of_range(codec):
    """A mean that was cut has nothing to cover it where no covariance is sent."""
    batch = codec.decode_batch(codec.encode_batch([[1.75, 0, 0, 0], [40.0, 0, 0, 0]]))
    assert batch.status.tolist() == [Status.UNKNOWN, Status.OUT_OF_RANGE]


def test_cantools_reads_what_we_write_and_writes_what_we_read(codec):
    """Each page of each carrier, raw bits and physical values."""
    database = cantools.database.load_file(DBC)
    means, covs = paper(40, seed=3)
    payloads = codec.encode_batch(means, covs, slot=Slot.NEXT_LEFT, kind=Kind.DASHED, age=0.024)
    batch = codec.decode_batch(payloads, Slot.NEXT_LEFT)
    for i, payload in enumerate(payloads):
        signals = {}
        for frame in codec.frames(payload, Slot.NEXT_LEFT):
            message = database.get_message_by_frame_id(frame.can_id)
            page = message.decode(frame.data, decode_choices=False)
            assert message.encode(page) == frame.data
            signals |= page
        (fd,) = codec.frames(payload, Slot.NEXT_LEFT, fd=True)
        record = database.get_message_by_frame_id(fd.can_id).decode(fd.data, decode_choices=False)
        assert {k: record[k] for k in signals if k != "Page"} == {
            k: v for k, v in signals.items() if k != "Page"
        }
        assert [signals[name] for name in ("YOff", "Beta", "C0", "C1")] == batch.mean[i].tolist()
        assert (signals["XMin"], signals["XMax"]) == (batch.x_min[i], batch.x_max[i])
        assert (signals["Kind"], signals["Age"]) == (Kind.DASHED, 24)
        assert covariance_by_hand(signals) == pytest.approx(batch.cov[i], rel=1e-12)


def covariance_by_hand(signals):
    """The decoding as a reader of the DBC's page would do it, from cantools' values."""
    names = ["C1", "C0", "YOff", "Beta"]
    L = np.zeros((4, 4))
    for i, row in enumerate(names):
        L[i, i] = 2.0 ** signals[f"Pivot{row}"]
        for j, column in enumerate(names[:i]):
            L[i, j] = signals[f"Ratio{row}{column}"] * L[i, i]
    S = 2.0 ** signals["Inflation"] * L @ L.T
    back = [names.index(name) for name in ("YOff", "Beta", "C0", "C1")]
    return S[np.ix_(back, back)]


@pytest.mark.parametrize("length", [0, 1, 31, 33, 64])
def test_a_record_of_another_length_is_none(length):
    """Whatever else is in it."""
    assert default_codec().decode_one(bytes(length), Slot.ROUTE) is Reason.LENGTH


@settings(max_examples=300, deadline=None)
@given(st.binary(min_size=32, max_size=32), st.booleans(), st.sampled_from(list(Slot)))
def test_both_readers_say_the_same_of_any_bytes(data, honest, slot):
    """decode_one and decode_batch agree to the last bit, or on the reason."""
    codec = default_codec()
    if honest:  # make the bytes pass: the right pages, transfers and checksum
        raw = codec._reader._packing.unpack_one(data)
        raw |= {f"Page{p}": p for p in range(4)} | {
            f"TransferId{p}": raw["Counter"] for p in range(4)
        }
        data = codec._writer._sealed_one(raw, codec.layout.channels[slot].data_id)
    batch = codec.decode_batch(np.frombuffer(data, dtype=np.uint8)[None], slot)
    one = codec.decode_one(data, slot)
    if isinstance(one, Reason):
        assert not batch.accepted[0]
        assert batch.rejects == {one: 1}
    else:
        assert batch.accepted[0]
        assert np.array_equal(one.gaussian.mean, batch.mean[0])
        assert np.array_equal(one.gaussian.cov, batch.cov[0])
        assert (one.status, one.kind, one.age) == (batch.status[0], batch.kind[0], batch.age[0])
        assert (one.x_min, one.x_max) == (batch.x_min[0], batch.x_max[0])
        part = codec.read_record(data, slot)
        assert (part.index, part.count, part.weight) == (
            batch.component_index[0],
            batch.component_count[0],
            batch.component_weight[0],
        )
    if honest:
        assert batch.rejects.keys() <= {Reason.CONTENT}
    np.linalg.cholesky(batch.cov)  # whatever the bytes, a definite matrix


def test_both_writers_write_the_same(codec):
    """encode, encode_lines and encode_batch give the same bytes."""
    means, covs = road(50, seed=5)
    lines = [
        MapLine(Slot(i % 8), Gaussian(m, S), Kind(i % 8), -20, 60 + i, 0.008 * (i % 9))
        for i, (m, S) in enumerate(zip(means, covs, strict=True))
    ]
    payloads = codec.encode_batch(
        means,
        covs,
        slot=[line.slot for line in lines],
        counter=np.arange(50) // 8,
        kind=[line.kind for line in lines],
        x_min=-20,
        x_max=[line.x_max for line in lines],
        age=[line.age for line in lines],
    )
    fresh = Codec.from_dbc()
    one_by_one = [b"".join(frame.data for frame in fresh.encode(line)) for line in lines]
    together = [b"".join(f.data for f in frames) for frames in Codec.from_dbc().encode_lines(lines)]
    assert one_by_one == together == [payload.tobytes() for payload in payloads]


def test_extents_never_claim_too_much(codec):
    """x_min is rounded up and x_max down; what still claims too much is flagged."""
    cov = np.diag([1e-2, 1e-4, 1e-8, 1e-12])[None]
    ends = np.array([[-20.0, 80.0], [-19.9, 83.9], [24.0, 252.0], [-31.0, 3.9], [0.1, 400.0]])
    for x_min, x_max in ends:
        batch = codec.decode_batch(
            codec.encode_batch(np.zeros((1, 4)), cov, x_min=x_min, x_max=x_max)
        )
        assert batch.x_min[0] >= x_min
        assert batch.x_max[0] <= x_max
        assert batch.status[0] == Status.FULL
    beyond = codec.decode_batch(codec.encode_batch(np.zeros((1, 4)), cov, x_min=30.0))
    assert beyond.status[0] == Status.SATURATED


@pytest.mark.parametrize(
    ("change", "words"),
    [
        pytest.param({"means": np.zeros(4)}, "means must have shape", id="one-mean"),
        pytest.param({"means": np.full((1, 4), np.nan)}, "row 0", id="nan-mean"),
        pytest.param({"covs": np.zeros((2, 4, 4))}, "covs must have shape", id="two-covs"),
        pytest.param({"covs": np.full((1, 4, 4), np.inf)}, "finite, but row 0", id="inf-cov"),
        pytest.param({"covs": -np.eye(4)[None]}, "variances of 0 or more", id="negative"),
        pytest.param({"covs": np.triu(np.ones((4, 4)))[None]}, "symmetric", id="asymmetric"),
        pytest.param({"age": np.nan}, "age must be finite", id="age"),
        pytest.param({"x_max": np.inf}, "x_max must be finite", id="x_max"),
        pytest.param({"slot": 8}, "no message for slot 8", id="slot"),
        pytest.param({"slot": -1}, "no message for slot -1", id="negative-slot"),
        pytest.param({"kind": 9}, "Kind: .* whole number from 0 to 7", id="kind"),
        pytest.param({"status": 6}, "Status: .* whole number from 0 to 5", id="status"),
        pytest.param({"component_count": 9}, "ComponentCount", id="count"),
        pytest.param({"component_index": 1}, "below component_count", id="index"),
        pytest.param({"component_weight": 0.0}, "component_weight must be in", id="weight"),
        pytest.param({"age": -0.1}, "age must be 0 s or more", id="negative-age"),
        pytest.param({"x_min": 50.0, "x_max": 10.0}, "x_min must be x_max or less", id="extent"),
        pytest.param({"slot": 0.9}, "no message for slot 0.9", id="half-a-slot"),
        pytest.param({"counter": 1.5}, "Counter: .* whole number", id="half-a-counter"),
        pytest.param({"covs": None, "status": 1}, "covs must be given", id="no-covs"),
    ],
)
def test_a_callers_mistake_raises_at_once(codec, change, words):
    """The message names the value, the row or signal, and what is allowed."""
    good = {"means": np.zeros((1, 4)), "covs": np.zeros((1, 4, 4))}
    with pytest.raises((ValueError, EncodeError), match=words):
        codec.encode_batch(**{**good, **change})


@pytest.mark.parametrize(
    "payloads",
    [np.zeros((1, 31), np.uint8), np.zeros(32, np.uint8), np.zeros((1, 32), np.int64)],
)
def test_payloads_of_another_shape_raise(codec, payloads):
    """Bytes may be anything, but they must be bytes, 32 a row."""
    with pytest.raises(ValueError, match="payloads must"):
        codec.decode_batch(payloads)


def test_no_records_at_all(codec):
    """Empty in, empty out."""
    payloads = codec.encode_batch(np.zeros((0, 4)), np.zeros((0, 4, 4)))
    assert payloads.shape == (0, 32)
    assert codec.decode_batch(payloads).mean.shape == (0, 4)
    assert codec.encode_lines([]) == []


# ---- the DBC is the only truth ---------------------------------------------------------


@pytest.mark.parametrize(
    ("edit", "coarser"),
    [
        pytest.param((r"(YOff[^(]*)\(0.0009765625,0\)(.*)\[-32\|31.9990234375\]",
                      r"\1(0.001953125,0)\2[-64|63.998046875]"), "mean", id="factor-of-y_off"),
        pytest.param((r"(RatioYOffC1[^(]*)\(0.0390625,0\)(.*)\[-5\|4.9609375\]",
                      r"\1(0.078125,0)\2[-10|9.921875]"), "cov", id="factor-of-a-ratio"),
        pytest.param((r"(Inflation[^:]*: \d+\|)3(@1\+ )\([^)]*\) \[[^]]*\]",
                      r"\g<1>2\2(0.03,0) [0|0.09]"), "cov", id="width-of-the-inflation"),
    ],
)  # fmt: skip
def test_a_changed_dbc_changes_the_code(tmp_path, edit, coarser):
    """Another factor or width in a copy of the DBC, and the guarantee still holds."""
    codec, other = Codec.from_dbc(), Codec.from_dbc(edited(tmp_path, edit))
    means, covs = road(500, seed=6)
    first, second = codec.encode_batch(means, covs), other.encode_batch(means, covs)
    assert (first != second).any()
    _, a = check_guarantee(codec, means, covs)
    _, b = check_guarantee(other, means, covs)
    if coarser == "mean":
        assert np.abs(b.lateral_error[:, 0]).mean() > 1.8 * np.abs(a.lateral_error[:, 0]).mean()
    else:
        assert b.kl_covered.mean() > a.kl_covered.mean()


def test_a_coarse_inflation_is_made_up_by_wider_pivots(tmp_path):
    """Where the DBC leaves next to no inflation, the pivots are lifted instead."""
    starved = (r"(Inflation[^:]*: \d+\|3@1\+ )\([^)]*\) \[[^]]*\]", r"\1(0.001,0) [0|0.007]")
    codec = Codec.from_dbc(edited(tmp_path, starved))
    batch, _ = check_guarantee(codec, *road(2000, seed=7))
    assert (batch.status == Status.FULL).mean() > 0.9


def test_another_order_of_rows_is_in_the_names(tmp_path):
    """Renaming Ratio<row><column> and the pivots reorders the rows; still covered."""

    def edits():
        for name in ("Pivot", "RatioYOff", "RatioBeta"):
            yield f"{name}C1", f"{name}C0"
            yield f"{name}C0", f"{name}C1"
        yield "RatioC0C1", "RatioC1C0"

    text = DBC.read_text()
    table = dict(edits())
    for old in table:
        text = text.replace(f" {old} ", f" @{old} ")
    for old, new in table.items():
        text = text.replace(f" @{old} ", f" {new} ")
    path = tmp_path / "order.dbc"
    path.write_text(text)
    codec = Codec.from_dbc(path)
    assert [("YOff", "Beta", "C0", "C1")[i] for i in codec._reader._covariance.order] == [
        "C0", "C1", "YOff", "Beta",
    ]  # fmt: skip
    check_guarantee(codec, *road(500, seed=8))


def test_motorola_signals_work_alike(tmp_path):
    """Counter and Kind in Motorola order at the same bits: the same bytes, as cantools says."""
    path = edited(
        tmp_path,
        (r"SG_ Counter m0 : 16\|8@1\+", "SG_ Counter m0 : 23|8@0+"),
        (r"SG_ Counter : 16\|8@1\+", "SG_ Counter : 23|8@0+"),
        (r"SG_ Kind m0 : 59\|3@1\+", "SG_ Kind m0 : 61|3@0+"),
        (r"SG_ Kind : 59\|3@1\+", "SG_ Kind : 61|3@0+"),
    )
    codec, other = Codec.from_dbc(), Codec.from_dbc(path)
    message = cantools.database.load_file(path).get_message_by_name("EgoLeftFd")
    means, covs = road(20, seed=9)
    payloads = other.encode_batch(means, covs, kind=Kind.KERB)
    assert other.decode_batch(payloads).accepted.all()
    for i, payload in enumerate(payloads):
        witness = message.decode(payload.tobytes())
        assert (witness["Kind"], witness["Counter"]) == ("KERB", i)
    # Fields of whole bytes, or within one, lie where they lay: the order does not show.
    assert (payloads == codec.encode_batch(means, covs, kind=Kind.KERB)).all()


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        pytest.param((r"SG_ Beta m0", "SG_ Heading m0"), "Beta|Heading", id="mean-missing"),
        pytest.param((r' SG_ TransferId1 .*\n', ""), "TransferId", id="transfer-missing"),
        pytest.param((r' SG_ RatioBetaYOff.*\n', ""), "RatioBetaYOff|ratios", id="ratio-missing"),
        pytest.param((r'BA_ "MapLineSlot" .*\n', ""), "MapLineSlot", id="no-slots"),
        pytest.param((r'BA_ "MapLineSlot" BO_ 832 0', 'BA_ "MapLineSlot" BO_ 832 9'),
                     "0 to 7", id="slot-9"),
        pytest.param((r'BA_ "MapLineSlot" BO_ 833 1', 'BA_ "MapLineSlot" BO_ 833 0'),
                     "two messages", id="slot-twice"),
        pytest.param((r'BA_ "E2EDataId" BO_ 832 \d+', 'BA_ "E2EDataId" BO_ 832 1'),
                     "E2EDataId", id="data-id"),
        pytest.param((r'BA_ "CovarianceCode" ".*"', 'BA_ "CovarianceCode" "Magic"'),
                     "Magic", id="code"),
        pytest.param((r"SG_ Page M", "SG_ Page "), "overlapping", id="no-mux"),
        pytest.param((r"\(0.054,-32\)", "(-0.054,-4)"), "positive factor", id="negative-factor"),
        pytest.param((r"BO_ 832 EgoLeft: 8", "BO_ 832 EgoLeft: 7"), "EgoLeft", id="seven-bytes"),
        pytest.param((r"(RatioBetaC0[^(]*)\(0.0390625,0\) \[[^]]*\]", r"\1(64,0) [-1e6|1e6]"),
                     "double precision", id="ratio-too-wide"),
        pytest.param((r"Crc m0 : 0\|16@1", "Crc m0 : 0|15@1"), "differ|Crc", id="crc-width"),
    ],
)  # fmt: skip
def test_a_wrong_dbc_is_refused_with_its_reason(tmp_path, edit, words):
    """What is wrong is named, with the file."""
    path = edited(tmp_path, edit)
    with pytest.raises(LayoutError, match=words) as error:
        Codec.from_dbc(path)
    assert "edited.dbc" in str(error.value)


def test_each_carrier_may_have_its_own_kind_of_id(tmp_path):
    """Classic with 11 bits, CAN FD with 29: frames and decoder agree."""
    fd_id = 0x80000000 | 0x18FF0048
    path = edited(tmp_path, (r"\b840\b", str(fd_id)))
    codec = Codec.from_dbc(path)
    (frame,) = codec.encode(MapLine.mean_only(Slot.EGO_LEFT, [1.0, 0, 0, 0]), fd=True)
    assert (frame.can_id, frame.is_extended) == (0x18FF0048, True)
    answer = codec.decoder().feed(frame.can_id, frame.data, 0, is_extended=True)
    assert isinstance(answer, MapLine)
    assert not codec.encode(MapLine.mean_only(Slot.EGO_LEFT, [1.0, 0, 0, 0]))[0].is_extended


@pytest.mark.parametrize("content", [None, b"", b"\xff\x00 not a DBC", b'VERSION "'])
def test_a_file_that_is_no_dbc(tmp_path, content):
    """Missing, empty, binary, cut off: one clear error."""
    path = tmp_path / "bad.dbc"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LayoutError, match=r"bad\.dbc"):
        Codec.from_dbc(path)


LINE, COV = np.zeros((1, 4)), np.eye(4)[None] * 1e-4
RECORD = np.zeros((1, 32), dtype=np.uint8)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda c: c.decoder(timeout_ms=1e308), r"at most an hour \(3600000 ms\), got 1e\+308"),
        (lambda c: c.decoder(timeout_ms=3_600_001), "timeout_ms must be .* got 3600001"),
        (lambda c: c.decoder(cycle_ms=10**400), "cycle_ms must be .* integer of about 1e400"),
        (lambda c: c.encode_batch([[10**400, 0, 0, 0]], COV), "means must be numbers"),
        (lambda c: c.encode_batch(LINE, [[[10**400] * 4] * 4]), "covs must be numbers"),
        (lambda c: c.encode_batch(LINE, -COV + 1e308), "covs must be finite"),
        (lambda c: c.encode_batch(LINE, COV, x_min=-(10**400)), "x_min must be numbers"),
        (lambda c: c.encode_batch(LINE, COV, counter=10**400), "counter must be numbers"),
        (lambda c: c.encode_batch(LINE, COV, slot=np.inf), "slot must be from 0 to 7, got inf"),
        (lambda c: c.encode_batch(LINE, COV, slot=1e300), r"slot must be from 0 to 7, got 1e\+300"),
        (lambda c: c.decode_batch(RECORD, np.nan), "slot must be from 0 to 7, got nan"),
        (lambda c: c.encode_mixtures([10**400], LINE, COV), "weights must be numbers"),
        (lambda c: c.encode_mixtures([1.0], LINE, COV), r"weights must have shape \(N, k\)"),
        (lambda c: c.encode_mixtures([[1.0]], LINE[None], COV[None], age=10**400), "age must be"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_odd_numbers_are_refused_in_words(make, words):
    """By name and range, in a message that one can read, and without a warning beside it."""
    with pytest.raises(ValueError, match=words) as refusal:
        make(default_codec())
    assert len(str(refusal.value)) < 400


def test_a_time_of_an_hour_is_allowed():
    """The bounds belong to the range."""
    assert default_codec().decoder(timeout_ms=3_600_000, cycle_ms=3_600_000).lines == 0
