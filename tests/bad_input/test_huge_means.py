"""Means near the end of the floating-point range issue no warning."""

import contextlib

import numpy as np
import pytest

from maplines_can import Codec, GaussianMixture, MapLine, Motion, Slot, predict_to
from maplines_can.propagation import predict
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import Status


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [1e150, 1e300, -1.7e308])
@pytest.mark.parametrize("parameter", range(4))
def test_item_10_a_huge_mean_issues_no_warning(codec: Codec, size: float, parameter: int) -> None:
    """It is OUT_OF_RANGE on the wire, also in a mixture, and cannot be predicted."""
    mean = np.zeros(4)
    mean[parameter] = size
    cov = np.diag([1e-2, 1e-4, 1e-8, 1e-12])
    line = MapLine(Slot.EGO_LEFT, Gaussian(mean, cov), t_ns=0)
    line.y([0.0, 80.0])
    line.y_sigma([0.0, 80.0])
    payloads = codec.batch.encode([mean], [cov])
    mixture = codec.batch.encode_mixtures([[0.5, 0.5]], [[mean, np.zeros(4)]], [[cov, cov]])
    *_, sent = codec.encoder().encode(
        MapLine.of_mixture(line.slot, GaussianMixture([0.5, 0.5], [line.gaussian] * 2))
    )

    assert codec.batch.decode(payloads).status[0] == Status.OUT_OF_RANGE
    assert codec.batch.decode(mixture[0]).status[0] == Status.OUT_OF_RANGE
    assert sent.data
    for call in (
        lambda: predict(line.gaussian, Motion(20.0, 0.1).over(0.1), (0.0, 80.0)),
        lambda: predict_to(line, 100, Motion(20.0, 0.1)),
    ):
        with contextlib.suppress(ValueError):  # IllPosedError, too
            call()
    if abs(size) > 1e154:
        apart = GaussianMixture([0.5, 0.5], [line.gaussian, Gaussian(np.zeros(4), cov)])
        with pytest.raises(ValueError, match="cov must be finite"):
            MapLine.of_mixture(0, apart)  # type: ignore[arg-type]
