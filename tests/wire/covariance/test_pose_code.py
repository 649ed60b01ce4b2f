"""Code of the pose error: definite for any bits, covering, and rounded as documented."""

import math
import re
from functools import cache
from typing import Any

import numpy as np
import pytest
from evidence.exact import covers, is_positive_definite
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pose_bits import POSE, POSE_NAMES, PRODUCTION, any_bits
from scene_layouts import COMPLETE, CONDITIONAL, scene_code, scene_encoder
from scene_streams import feed, new_codec, road_scene
from strategies import covariances

from maplines_can import MapError, PoseError, Scene
from maplines_can.values.elementary import exp2
from maplines_can.values.errors import LayoutError
from maplines_can.wire import Layout
from maplines_can.wire.covariance import SceneCode, SceneEncoder
from maplines_can.wire.layout.dbc_reader import default_dbc_path

CODE, ENCODER = scene_code(), scene_encoder()


def level(octave: float) -> float:
    """Power of 2 as the wire has it."""
    return float(exp2(octave))


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
        (5e-324, 1, level(-1.5)),
        (level(-1.5), 1, level(-1.5)),
        (math.nextafter(level(-1.5), 1), 2, 0.5),
        (1.0, 4, 1.0),
        (math.nextafter(1.0, 2), 5, level(0.5)),
        (1.18, 5, level(0.5)),
        (8.0, 10, 8.0),
        (8.1, 11, level(3.5)),
        (level(5.5), 15, level(5.5)),
        (math.nextafter(level(5.5), 99), 0, math.inf),
        (60.0, 0, math.inf),
        (1.7e308, 0, math.inf),
    ],
)
def test_the_correlation_time_is_rounded_up(time: float, raw: int, decoded: float) -> None:
    """To the next level, below the least one to that, and beyond the greatest one to unknown."""
    sent = ENCODER.encode(pose_of(PRODUCTION, time=time))
    assert sent.pose["CorrelationTime"] == raw
    assert CODE.decode_pose(sent.pose).correlation_time == decoded


TIME = "CorrelationTime"
TIME_SIGNAL = re.compile(rf'({TIME} (?:m1 )?: \d+\|4@1\+) \(0.5,-2\) \[-2\|5.5\] "octave"')


@cache
def altered(law: str) -> Layout:
    """The layout of a DBC whose correlation time has another factor, offset and range."""
    text, n = TIME_SIGNAL.subn(rf"\1 {law}", default_dbc_path(CONDITIONAL).read_text())
    assert n == 3
    return Layout.from_text(text)


@pytest.mark.parametrize(
    ("law", "greatest"),
    [
        ('(0.5,-2) [-2|5.5] "octave"', 2**5.5),
        ('(0.5,-2) [-2|5.5] ""', 2**5.5),
        ('(0.1,1.03) [1.03|2.53] "octave"', 2**2.53),
        ('(3,-20) [-20|25] "octave"', 2.0**25),
        ('(12,20) [20|200] "octave"', 2.0**200),
    ],
)
@settings(max_examples=25)
@given(octaves=st.floats(-40, 210))
def test_no_decoded_correlation_time_is_too_short(
    law: str, greatest: float, octaves: float
) -> None:
    """Whatever the signal of the DBC: less than a step longer, or unknown; sent again, the same."""
    layout, time = altered(law), 2.0**octaves
    assert layout.pose is not None
    code, signal = SceneCode(layout.pose, layout), layout.pose[TIME]
    encoder = SceneEncoder(code)

    def decoded(time: float) -> float:
        sent = encoder.encode(pose_of(PRODUCTION, time=time)).pose
        assert signal.raw_min <= sent[TIME] <= signal.raw_max
        return code.decode_pose(sent).correlation_time

    received = decoded(time)
    assert received >= time
    assert decoded(received) == received
    if time > greatest * (1 + 1e-12):
        assert received == math.inf
    elif time <= greatest * (1 - 1e-12):
        least = 2.0 ** signal.physical_one(1)
        assert received <= max(least, time * 2**signal.factor * (1 + 1e-12))


def test_a_correlation_time_in_seconds_is_refused() -> None:
    """Its factor would be taken for one of octaves."""
    with pytest.raises(LayoutError, match=f'{TIME}.*"octave"'):
        altered('(5,0) [0|75] "s"')


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
@pytest.mark.parametrize(
    ("time", "received"), [(8.0, 8.0), (8.1, level(3.5)), (60.0, math.inf), (1000.0, math.inf)]
)
def test_a_consumer_gets_the_rounded_correlation_time(
    dbc: str, time: float, received: float
) -> None:
    """Through the frames of a codec."""
    codec = new_codec(dbc)
    decoder = codec.decoder()
    feed(decoder, codec.encoder().encode_scene(road_scene(correlation_time=time)), 0)
    scene = decoder.scene()
    assert scene is not None
    assert scene.scene.pose_error.correlation_time == received


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
