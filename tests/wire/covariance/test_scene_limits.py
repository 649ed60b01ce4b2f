"""Lines at the limit of what a cubic can be: after rounding, some are no functions of x."""

from typing import Any

import numpy as np
import pytest
from evidence.exact import covers
from pose_bits import PRODUCTION
from scene_layouts import COMPLETE, CONDITIONAL, scene_code, scene_encoder

from maplines_can import Gaussian, MapLine, PoseError, Scene, Slot
from maplines_can.values.errors import EncodeError, IllPosedError
from maplines_can.values.seen_lines import SeenLines

SIGMA = np.array([0.05, 2e-3, 1e-4, 3e-6])
ORDINARY = np.array([[1.75, 0.0, 1e-3, 0.0], [-1.75, 0.0, 1e-3, 0.0]])
RANGES = np.array([[-20.0, 60.0], [-10.0, 70.0], [0.0, 60.0]])


def is_function(mean: Any, fit_range: Any) -> bool:
    try:
        SeenLines(mean[None], fit_range[None])
    except IllPosedError:
        return False
    return True


def steepest(mean: Any, fit_range: Any) -> Any:
    """The line with the largest c1 beside this one that is a function of x, to the last bit."""
    low, high = mean.copy(), mean + np.array([0, 0, 0, 0.03])
    while low[3] < (middle := (low[3] + high[3]) / 2) < high[3]:
        at = np.append(mean[:3], middle)
        low, high = (at, high) if is_function(at, fit_range) else (low, at)
    return low


def scene_of(means: Any, ranges: Any) -> Scene:
    own = np.diag(SIGMA**2)
    lines = tuple(MapLine(Slot(i), Gaussian(mean, own)) for i, mean in enumerate(means))
    cov: Any = np.kron(np.eye(len(lines)), own)
    return Scene(lines, cov, PoseError(PRODUCTION), ranges)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_line_at_the_limit_is_sent_or_left_out(place: int, full: bool) -> None:
    """Some become steeper by the rounding; the others of the scene are sent as without them."""
    rng, left_out, n = np.random.default_rng(place), 0, 10
    code, encoder = scene_code(CONDITIONAL), scene_encoder(CONDITIONAL)
    for _ in range(n):
        fit_range = RANGES[place]
        mean = steepest(rng.uniform(-1, 1, 4) * [3, 0.1, 5e-3, 0], fit_range)
        assert is_function(mean, fit_range)
        scene = scene_of(np.insert(ORDINARY, place, mean, axis=0), RANGES)
        sent = encoder.encode(scene, full=full)
        others = [i for i in range(3) if i != place]
        assert [i for i in sent.lines if i != place] == others
        decoded = sent.decoded
        assert decoded is not None
        again = code.decode(code.decode_pose(sent.pose), [*sent.lines.values()])
        assert np.array_equal(again.cov, decoded.cov)
        if place not in sent.lines:
            left_out += 1
            alone = encoder.encode(scene.subset([Slot(i) for i in others]), full=full)
            assert [*sent.lines.values()] == [*alone.lines.values()]
        elif left_out == 1:  # exact arithmetic takes long
            truth = scene.joint([scene.lines[i].slot for i in sent.lines])
            assert covers(decoded.cov, decoded.means.ravel(), truth.cov, truth.mean)
    assert 0 < left_out < n


def test_a_scene_of_only_such_lines_may_be_empty() -> None:
    """It is sent as a pose error without lines."""
    encoder, sizes = scene_encoder(CONDITIONAL), set()
    rng = np.random.default_rng(5)
    for _ in range(12):
        mean = steepest(rng.uniform(-1, 1, 4) * [3, 0.1, 5e-3, 0], RANGES[0])
        sent = encoder.encode(scene_of(mean[None], RANGES[:1]))
        assert (sent.decoded is None) is (not sent.lines)
        sizes.add(len(sent.lines))
    assert sizes == {0, 1}


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_the_largest_pose_error_that_fits(dbc: str) -> None:
    """It is covered as decoded, up to where the encoder refuses it, in each of its directions."""
    code, encoder = scene_code(dbc), scene_encoder(dbc)
    empty = np.zeros((0, 0)), np.zeros((0, 2))
    rng = np.random.default_rng(1)
    for _ in range(5):
        A = rng.standard_normal((3, 3)) * np.array([[0.1], [0.2], [0.004]])
        fits, refused = 0.0, 40.0
        for _ in range(12):
            scale = (fits + refused) / 2
            P = 4.0**scale * A @ A.T
            try:
                scene = Scene((), empty[0], PoseError(P), empty[1])
                is_conditional = dbc == CONDITIONAL
                sent = encoder.encode(scene) if is_conditional else encoder.encode_levels(scene, [])
            except EncodeError:
                refused = scale
                continue
            fits = scale
            decoded = code.decode_pose(sent.pose).cov
            assert covers(decoded, np.zeros(3), P, np.zeros(3))
        assert 1.0 < fits < 20.0
