"""Code of the pose error: definite for any bits, covering, and rounded as documented."""

import math
from typing import Any

import numpy as np
import pytest
from exact import covers, is_positive_definite
from hypothesis import assume, given
from hypothesis import strategies as st
from pose_bits import POSE, POSE_NAMES, PRODUCTION, any_bits
from scene_layouts import scene_code, scene_encoder
from strategies import covariances

from maplines_can import MapError, PoseError, Scene

CODE, ENCODER = scene_code(), scene_encoder()


def pose_of(cov: Any, error: MapError | None = None, time: float = math.inf) -> Scene:
    """A scene without lines."""
    return Scene((), np.zeros((0, 0)), PoseError(cov, time), np.zeros((0, 2)), error)


@given(st.integers(0, 2**32))
def test_any_bits_of_a_pose_are_definite(seed: int) -> None:
    pose = CODE.decode_pose(any_bits(POSE, POSE_NAMES, np.random.default_rng(seed)))
    assert is_positive_definite(pose.cov.tolist())
    assert pose.correlation_time > 0
    assert 0 <= pose.offset_sigma < 1
    assert 0 <= pose.heading_sigma < 1


@pytest.mark.parametrize(
    ("time", "raw", "decoded"),
    [
        (math.inf, 0, math.inf),
        (1e-6, 1, 2**-1.5),
        (2**-1.5, 1, 2**-1.5),
        (1.0, 4, 1.0),
        (1.18, 4, 1.0),
        (1.2, 5, 2**0.5),
        (2.0, 6, 2.0),
        (1e6, 15, 2**5.5),
    ],
)
def test_the_correlation_time_is_rounded_to_the_nearest_level(
    time: float, raw: int, decoded: float
) -> None:
    sent = ENCODER.encode(pose_of(PRODUCTION, time=time))
    assert sent.pose["CorrelationTime"] == raw
    assert CODE.decode_pose(sent.pose).correlation_time == pytest.approx(decoded)


@pytest.mark.parametrize(
    ("sigma", "offset", "heading"),
    [
        (0.0, 0, 0),
        (1e-9, 1, 1),
        (2**-11.875, 1, 1),
        (2**-11.87, 1, 2),
        (2**-9.5, 1, 20),
        (2**-9.49, 1, 21),
        (2**-7.875, 1, 31),
        (2**-7.5, 4, 31),
        (2**-7.49, 5, 31),
        (2**-3.5, 36, 31),
        (1e9, 63, 31),
    ],
)
def test_the_levels_of_the_map_error(sigma: float, offset: int, heading: int) -> None:
    """Both are rounded up: no level of a line has the shape of a shift along it or a rotation."""
    sent = ENCODER.encode(pose_of(PRODUCTION, MapError(0.0, sigma, sigma)))
    assert (sent.pose["MapOffset"], sent.pose["MapHeading"]) == (offset, heading)
    pose = CODE.decode_pose(sent.pose)
    assert pose.offset_sigma >= min(sigma, 2**-0.125) * (1 - 1e-6)
    assert pose.heading_sigma >= min(sigma, 2**-8.125) * (1 - 1e-6)


@given(covariances(3))
def test_the_decoded_pose_error_covers_and_costs_little(cov: Any) -> None:
    """Of a production pose with any correlations: 7 % of the variance, and the resolution."""
    scale = np.sqrt(np.where(cov.diagonal() > 0, cov.diagonal(), 1.0))
    root = np.sqrt(PRODUCTION.diagonal())
    cov = cov / scale / scale[:, None] * root * root[:, None]
    empty = pose_of(cov)
    decoded = CODE.decode_pose(ENCODER.encode(empty).pose).cov
    assert covers(decoded, np.zeros(3), empty.pose_error.cov, np.zeros(3))
    eigenvalues = np.linalg.eigvalsh(cov / root / root[:, None])
    assume(eigenvalues[0] > 0.1)
    excess = (decoded.diagonal() + 1e-12) / (cov.diagonal() + 2.0**-24)
    assert excess.max() <= 1.15
