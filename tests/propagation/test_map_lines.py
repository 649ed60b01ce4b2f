"""Lines of a map, seen from an uncertain pose."""

from typing import Any

import numpy as np
import pytest

from maplines_can import (
    Gaussian,
    Kind,
    MapError,
    Mixture,
    Polyline,
    Quadrature,
    Refit,
    SigmaPoints,
    Slot,
    map_lines,
)
from maplines_can.scenarios import SCENARIOS

SCENE = SCENARIOS["street-turn"]
ROAD = Polyline([[x, 1.75] for x in range(-30, 100, 2)])  # type: ignore[arg-type]


@pytest.mark.parametrize("scene", SCENARIOS.values(), ids=SCENARIOS)
def test_a_line_is_the_transform_of_its_refit(scene: Any) -> None:
    """To the last bit, with slot, kind and extent of the line."""
    lines = map_lines(scene.lines, scene.ego, scene.window)
    for line, source in zip(lines, scene.lines, strict=True):
        refit = Refit(source.polyline, scene.ego.mean, scene.window)
        expected = SigmaPoints()(refit, scene.ego)
        assert np.array_equal(line.gaussian.mean, expected.mean)
        assert np.array_equal(line.gaussian.cov, expected.cov)
        assert (line.slot, line.kind) == (source.slot, source.kind)
        assert [line.x_min, line.x_max] == refit.x_range.tolist()


def test_components_for_each_line() -> None:
    """One component is a single Gaussian, more are the mixture of the refit."""
    one, three = map_lines(SCENE.lines[:2], SCENE.ego, SCENE.window, components=[1, 3])
    refit = Refit(SCENE.lines[1].polyline, SCENE.ego.mean, SCENE.window)
    expected = Mixture(3)(refit, SCENE.ego)
    assert one.mixture is None
    assert np.array_equal(three.mixture.weights, expected.weights)  # type: ignore[union-attr]
    assert np.array_equal(three.mixture.means, expected.means)  # type: ignore[union-attr]
    assert np.array_equal(three.mixture.covs, expected.covs)  # type: ignore[union-attr]


def test_transform_and_map_error_are_used() -> None:
    """Another transform gives another covariance, a map error a larger one."""
    (default,) = map_lines(SCENE.lines[:1], SCENE.ego, SCENE.window)
    (other,) = map_lines(SCENE.lines[:1], SCENE.ego, SCENE.window, transform=Quadrature(5))
    (wider,) = map_lines(SCENE.lines[:1], SCENE.ego, SCENE.window, map_error=MapError(0.1, 0.1))
    assert not np.array_equal(default.gaussian.cov, other.gaussian.cov)
    assert np.linalg.eigvalsh(wider.gaussian.cov - default.gaussian.cov)[-1] > 0


def test_lines_are_plain_tuples() -> None:
    """No scene is needed."""
    ego = Gaussian([0, 0, 0], np.diag([0.3, 0.1, 0.01]) ** 2)  # type: ignore[arg-type]
    (line,) = map_lines([(Slot.EGO_LEFT, Kind.SOLID, ROAD)], ego, (-20.0, 80.0))
    assert line.gaussian.mean[0] == pytest.approx(1.75, abs=1e-3)
    assert map_lines([], ego, (-20.0, 80.0)) == []


@pytest.mark.parametrize("components", [[1], [1, 1, 1]])
def test_the_number_of_components_must_fit_the_lines(components: Any) -> None:
    """One number for each line."""
    with pytest.raises(ValueError, match="one for each of 2 lines"):
        map_lines(SCENE.lines[:2], SCENE.ego, SCENE.window, components=components)
