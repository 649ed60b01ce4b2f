"""Covariance codes: their guarantees, and agreement with the signals that cantools reads."""

from dataclasses import replace
from functools import cache
from typing import Any

import cantools
import numpy as np
import pytest

from maplines_can import Gaussian, MapLine, Slot, Status
from maplines_can.generation.dbc.record_spec import SERVICE
from maplines_can.model.records import written
from maplines_can.study import adversarial, evaluate, paper, road
from maplines_can.study.code_dbcs import covariance_signals, dbc_writer_for
from maplines_can.study.codes import CODES
from maplines_can.study.codes.integer_cholesky import ORDER, UNIT
from maplines_can.study.comparison import codec_for, transmit
from maplines_can.study.sweep import plan
from maplines_can.values.errors import LayoutError
from maplines_can.wire import Layout, Reason

MS = 1_000_000
WITH_WIDTHS = [name for name in CODES if name not in ("Float16", "Float32", "MeanOnly")]


@cache
def database_of(name: Any) -> Any:
    """The DBC of a code as cantools reads it from its text."""
    writer = replace(dbc_writer_for(name), slots=tuple(Slot)[:4])
    return cantools.database.load_string(writer.dbc(), "dbc")


@cache
def codec_of(name: Any) -> Any:
    return codec_for(Layout.from_dbc(database_of(name)))


def check_covered(codec: Any, means: Any, covs: Any, batch: Any) -> Any:
    """Check the lines that are in range; return their figures, and which they are."""
    usable = batch.status != Status.OUT_OF_RANGE
    evaluation = evaluate(
        means[usable], covs[usable], batch.mean[usable], batch.cov[usable], codec.resolution
    )
    code = CODES[codec.covariance.name]
    assert batch.accepted.all() or not code.covering
    assert not (code.covering and evaluation.overconfident.any())
    assert evaluation.positive_definite.all() or not (code.covering or code.positive_definite)
    return evaluation, usable


@cache
def lines_of(which: Any) -> Any:
    return {"paper": paper, "road": road}[which](400, seed=5)


def received(name: Any, means: Any, covs: Any) -> Any:
    return transmit(codec_of(name), means, covs)


@pytest.mark.parametrize("name", CODES)
def test_every_code_has_a_dbc_that_names_it(name: Any) -> None:
    database = database_of(name)
    assert database.dbc.attributes["CovarianceCode"].value == name
    assert codec_of(name).covariance.name == name
    names = {signal.name for message in database.messages for signal in message.signals}
    assert {spec.name for spec in (*SERVICE, *covariance_signals(name))} <= names


@pytest.mark.parametrize("which", ["paper", "road"])
@pytest.mark.parametrize("name", CODES)
def test_a_code_keeps_its_guarantees(name: Any, which: str) -> None:
    """A covering code is never overconfident, and its decoded covariances are definite."""
    means, covs = lines_of(which)
    code, batch = CODES[name], received(name, means, covs)
    assert batch.accepted.all()
    _, usable = check_covered(codec_of(name), means, covs, batch)
    assert usable.mean() > 0.99
    best = getattr(code, "status", Status.FULL)
    assert set(batch.status[usable].tolist()) <= {best, Status.SATURATED}


@pytest.mark.parametrize("name", [name for name in CODES if CODES[name].covering])
def test_a_covering_code_covers_adversarial_covariances_or_says_that_it_cannot(name: Any) -> None:
    means, covs = adversarial(1500, seed=11)
    check_covered(codec_of(name), means, covs, received(name, means, covs))


@pytest.mark.parametrize("name", CODES)
def test_any_bits_decode_to_a_definite_line_or_a_reason(name: Any) -> None:
    """One by one, as in a receiver: an indefinite covariance is repaired or refused."""
    codec, rng = codec_of(name), np.random.default_rng(3)
    decoder = codec.decoder()
    messages = codec.layout.messages[Slot.EGO_LEFT]
    answers = []
    for counter in range(120):
        raw = {
            signal.name: int(rng.integers(signal.raw_min, signal.raw_max, endpoint=True))
            for signal in codec.layout.signals.values()
        }
        raw |= {"Status": Status.FULL, "ComponentIndex": 0, "ComponentCount": 0, "Kind": 0}
        record = written(codec.layout, raw | {"Counter": counter % 256}, messages.data_id)
        for start in range(0, len(record), 8):
            answer = decoder.feed(messages.can_id, record[start : start + 8], counter * 50 * MS)
        answers.append(answer)
    lines = [line for answer in answers if not isinstance(answer, Reason) for line in answer]
    assert {answer for answer in answers if isinstance(answer, Reason)} <= {Reason.CONTENT}
    assert len(lines) + decoder.counts[Reason.CONTENT] // codec.layout.pages == 120
    for line in lines:
        sigma = line.gaussian.sigma
        np.linalg.cholesky(line.gaussian.cov / np.outer(sigma, sigma))
    assert lines


@pytest.mark.parametrize("name", CODES)
def test_frames_say_what_arrays_say(name: Any) -> None:
    """Only an indefinite covariance is repaired: others keep their status and each bit.

    The physical values of all pages are those that cantools reads, and it packs the same bytes.
    """
    means, covs = (values[:30] for values in lines_of("road"))
    codec, batch = codec_of(name), received(name, means, covs)
    encoder, decoder, database = codec.encoder(), codec.decoder(), database_of(name)
    definite = 0
    for i, (mean, cov) in enumerate(zip(means, covs, strict=True)):
        signals: dict[Any, Any] = {}
        for frame in encoder.encode(MapLine(Slot.EGO_LEFT, Gaussian(mean, cov))):
            message = database.get_message_by_frame_id(frame.can_id)
            page = message.decode(frame.data, decode_choices=False)
            assert message.encode(page) == frame.data
            signals |= page
            answer = decoder.feed(frame.can_id, frame.data, i * 50 * MS)
        (line,) = answer
        assert [signals[state] for state in ("YOff", "Beta", "C0", "C1")] == batch.mean[i].tolist()
        assert line.gaussian.mean.tolist() == batch.mean[i].tolist()
        if name != "MeanOnly":
            assert covariance_by_hand(name, signals) == pytest.approx(batch.cov[i], rel=1e-9)
        sigma = np.sqrt(batch.cov[i].diagonal())
        if sigma.all() and np.linalg.eigvalsh(batch.cov[i] / np.outer(sigma, sigma))[0] > 1e-9:
            definite += 1
            assert line.status == batch.status[i]
            assert np.array_equal(line.gaussian.cov, batch.cov[i])
        else:
            assert line.status is Status.REPAIRED
    assert definite or name == "Float16"  # loses the variance of c1


def covariance_by_hand(name: Any, signals: Any) -> Any:
    """Return the covariance from cantools' values, as described in dbc/README.md."""
    states = ("YOff", "Beta", "C0", "C1")
    S = np.zeros((4, 4))
    for i, one in enumerate(states):
        for j, other in enumerate(states):
            a, b = sorted((i, j))
            pair = states[a] + states[b]
            if name in ("Linear", "LinearNearest", "Float32"):
                S[i, j] = signals[f"Cov{pair}"]
            elif name == "Float16":
                S[i, j] = np.array(signals[f"Cov{pair}Half"], dtype=np.uint16).view(np.float16)
            elif name in ("LogCorrelation", "Sigmas"):
                correlation = 1.0 if i == j else signals.get(f"Corr{pair}", 0.0)
                S[i, j] = correlation * 2.0 ** (signals[f"Sigma{one}"] + signals[f"Sigma{other}"])
    if name == "IntegerCholesky":
        order = [states[i] for i in ORDER]
        R = (
            np.array(
                [[signals.get(f"Root{row}{column}", 0.0) for column in order] for row in order]
            )
            * 2.0 ** signals["ScaleExponent"]
        )
        S[np.ix_(ORDER, ORDER)] = R.T @ R
        S *= np.outer(UNIT, UNIT)
    if name in ("Cholesky", "LogCholesky"):
        rows = ["C1", "C0", "YOff", "Beta"]
        L = np.zeros((4, 4))
        for i, row in enumerate(rows):
            L[i, i] = 2.0 ** signals[f"Pivot{row}"]
            for j, column in enumerate(rows[:i]):
                L[i, j] = signals[f"Ratio{row}{column}"] * L[i, i]
        back = [rows.index(state) for state in states]
        S = (2.0 ** signals.get("Inflation", 0.0) * L @ L.T)[np.ix_(back, back)]
    return S


@pytest.mark.parametrize("name", WITH_WIDTHS)
def test_codes_work_with_other_widths(name: Any) -> None:
    means, covs = lines_of("road")
    for finer in (-1, 2):
        codec = plan.codec_of(plan.Plan(name, finer))
        check_covered(codec, means, covs, transmit(codec, means, covs))


def test_messages_name_the_alternatives() -> None:
    for name in ("Float16", "Float32", "MeanOnly"):
        with pytest.raises(ValueError, match="finer_bits must be 0"):
            dbc_writer_for(name, 1)
    with pytest.raises(ValueError, match="code must be one of Cholesky"):
        dbc_writer_for("Magic")
    with pytest.raises(ValueError, match="finer_bits cannot be -9"):
        dbc_writer_for("Cholesky", -9)
    text = dbc_writer_for("Sigmas").dbc().replace('"Sigmas"', '"LinearNearest"')
    with pytest.raises(LayoutError, match="CovYOffYOff"):
        codec_for(Layout.from_text(text))


def singular(n: int) -> Any:
    """Return covariances of rank 0 to 4 at many scales, all of which ``Gaussian`` accepts."""
    rng = np.random.default_rng(8)
    covs = []
    for k in range(n):
        root = rng.normal(size=(4, k % 5)) * 10.0 ** rng.uniform(-6, (0, 3, 5, 7)[k % 4], (4, 1))
        covs.append(Gaussian(np.zeros(4), root @ root.T).cov)
    return np.array(covs)


@pytest.mark.parametrize("name", CODES)
def test_item_10_no_gaussian_loses_its_batch(name: Any) -> None:
    """A covariance that is singular but for rounding has no factor; the others are as alone."""
    codec, covs = codec_of(name), singular(400)
    means = np.tile([1.0, 0.0, 0.0, 0.0], (len(covs), 1))
    batch = transmit(codec, means, covs)
    assert batch.accepted.all()
    for k in range(0, len(covs), 17):
        alone = transmit(codec, means[[k]], covs[[k]])
        np.testing.assert_array_equal(batch.cov[k], alone.cov[0])
    if CODES[name].covering:
        check_covered(codec, means, covs, batch)


def test_item_10_the_integer_factor_takes_what_rounding_left_indefinite() -> None:
    """A covariance for which numpy.linalg.cholesky raises."""
    root = np.array([[27.0], [5154.2], [-5.2], [1300.4]])
    gaussian = Gaussian(np.zeros(4), root @ root.T)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(gaussian.cov + 1e-12 * np.eye(4))
    record = codec_of("IntegerCholesky").encoder().encode(MapLine(Slot.EGO_LEFT, gaussian))
    assert len(record) == 4
