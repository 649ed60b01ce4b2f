"""The covariance code at the ends of its signals, and what it needs of a DBC."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq
from support.dbcs import changed_record

from maplines_can import Status
from maplines_can.values.errors import LayoutError
from maplines_can.wire import Codec
from maplines_can.wire.layout.cholesky import CholeskyCode
from maplines_can.wire.layout.packing import Packing
from maplines_can.wire.layout.record_layout import RecordLayout
from maplines_can.wire.layout.signal import Signal

CODEC = Codec.from_dbc()
LAYOUT = CODEC.layout


def coded(covs: Any) -> tuple[Any, dict[str, Any]]:
    """Return the decoded lines of a mean of 0, and the raw values of their covariances."""
    records = CODEC.batch.encode(np.zeros((len(covs), 4)), covs)
    packing = Packing(CODEC.covariance.signals, LAYOUT.record_bytes)
    return CODEC.batch.decode(records), packing.unpack(records)


def with_raw(raw: dict[str, Any]) -> Any:
    """Return the covariances of other raw values."""
    n = len(raw["Inflation"])
    rows: list[Any] = [{name: int(v[i]) for name, v in raw.items()} for i in range(n)]
    record = CODEC.batch.encode(np.zeros((1, 4)), np.eye(4)[None] * 1e-6)[0].tobytes()
    data = b"".join(changed_record(CODEC, record, **row, Status=1) for row in rows)
    return CODEC.batch.decode(np.frombuffer(data, np.uint8).reshape(len(rows), -1)).cov


def test_a_covariance_that_cannot_be_covered_is_encoded_as_the_widest() -> None:
    """Too large in one state, or in all: the record has no narrower covariance than the DBC can."""
    narrow = np.eye(4) * 1e-6
    huge = narrow.copy()
    huge[0, 0] = 1e12
    batch, raw = coded([narrow, huge, 1e12 * np.eye(4), 1e300 * np.eye(4)])
    assert [Status(status).name for status in batch.status] == ["FULL", *["OUT_OF_RANGE"] * 3]
    signals = {signal.name: signal for signal in CODEC.covariance.signals}
    for name, values in raw.items():
        signal = signals[name]
        widest = signal.raw(0.0) if name.startswith("Ratio") else signal.raw_max
        assert values[1:].tolist() == [widest] * 3
    assert (np.diagonal(batch.cov[0]) < 1e-2).all()


def test_the_inflation_is_the_least_that_covers() -> None:
    """To 4e-6: with a step less, the decoded covariance would not cover the target.

    Another algorithm's rounding, of a millionth, does not make it fall short.
    """
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(2000, 4, 4)) * np.array([0.1, 1e-2, 1e-3, 1e-5])[:, None]
    covs = roots @ roots.swapaxes(1, 2)
    batch, raw = coded(covs)
    checked = (batch.status == Status.FULL) & (raw["Inflation"] > 0)
    raw = {name: values[checked] for name, values in raw.items()}

    def largest_ratio(steps: int) -> Any:
        """The most variance of the target in any direction, as a multiple of the decoded one."""
        cov = with_raw({**raw, "Inflation": raw["Inflation"] - steps})
        whitening = np.linalg.inv(np.linalg.cholesky(cov))
        target = whitening @ covs[checked] @ whitening.swapaxes(1, 2)
        return np.linalg.eigvalsh(target)[:, -1]

    assert checked.sum() > 1000
    assert (largest_ratio(0) <= 1 - 1e-6).all()
    assert (largest_ratio(1) > 1 - 4e-6).all()


def pose_signal(name: str, length: int, factor: float, offset: float, unit: str) -> Signal:
    """A signal of a code with three rows."""
    raw_max = 2**length - 1
    return Signal(name, 0, length, False, False, factor, offset, unit, 0, raw_max)


def pose_layout(*ratios: str, step: float = 1 / 32) -> RecordLayout:
    """Signals of the covariance of a pose error, with ratios of these rows and columns."""
    signals = [
        *(pose_signal(f"Pivot{row}", 9, 0.04, -12, "octave") for row in ("Along", "Across")),
        pose_signal("PivotHeading", 9, 0.034, -18, "octave"),
        *(pose_signal(f"Ratio{names}", 8, step, -128 * step, "") for names in ratios),
        pose_signal("Inflation", 4, 0.0062, 0, "octave"),
    ]
    return RecordLayout(signals={signal.name: signal for signal in signals}, source="pose.dbc")


@pytest.mark.parametrize(
    ("ratios", "order"),
    [
        (("AcrossAlong", "HeadingAlong", "HeadingAcross"), [0, 1, 2]),
        (("AcrossHeading", "AlongHeading", "AlongAcross"), [2, 1, 0]),
    ],
)
def test_ratios_order_the_rows(ratios: tuple[str, ...], order: list[int]) -> None:
    """With RatioAcrossAlong, the row of Across comes after that of Along."""
    code = CholeskyCode(pose_layout(*ratios), rows=("Along", "Across", "Heading"))
    assert code.factor.order == order
    assert code.reachable.shape == (3,)


def test_the_rows_that_lack_an_order_are_named() -> None:
    """The rows are those of the code."""
    with pytest.raises(LayoutError, match="RatioAcrossHeading or RatioHeadingAcross"):
        CholeskyCode(
            pose_layout("AcrossAlong", "HeadingAlong"), rows=("Along", "Across", "Heading")
        )


def condition(step: float) -> float:
    """Return the largest trace of an inverse correlation matrix, with ratios of 128 steps."""
    traces = []
    for signs in product([-1, 1], repeat=3):
        factor = np.eye(3)
        factor[np.tril_indices(3, -1)] = 128 * step * np.array(signs)
        cov = factor @ factor.T
        sigma = np.sqrt(cov.diagonal())
        traces.append(np.trace(np.linalg.inv(cov / np.outer(sigma, sigma))))
    return float(max(traces))


def test_ratios_that_are_too_large_are_refused() -> None:
    """Beyond a condition of 1e13, with the worst signs: double precision holds three digits of it.

    The limit is for all ratios together.
    """
    names, rows = ("AcrossAlong", "HeadingAlong", "HeadingAcross"), ("Along", "Across", "Heading")
    limit = brentq(lambda step: np.log10(condition(step)) - 13, 1, 100)
    CholeskyCode(pose_layout(*names, step=limit * (1 - 1e-3)), rows)
    with pytest.raises(LayoutError, match=r"could have the condition number 1e\+13"):
        CholeskyCode(pose_layout(*names, step=limit * (1 + 1e-3)), rows)
