"""Lines of random roads: each with its own pose and map error."""

from typing import Any

import numpy as np
import pytest

from maplines_can.propagation import MapError, Refit, SigmaPoints
from maplines_can.simulation.scenarios import pose
from maplines_can.study.roads import PAPER, lines_of_roads, random_roads
from maplines_can.values.polyline import Polyline


@pytest.mark.parametrize("settings", [{}, PAPER], ids=["honest", "paper"])
@pytest.mark.parametrize("with_map_error", [False, True])
def test_each_road_has_the_pose_and_the_map_error_of_its_row(
    settings: Any, with_map_error: bool
) -> None:
    """Its line is that of ``Refit`` and ``SigmaPoints`` for the ``scenarios.pose`` of the row."""
    roads = random_roads(30, np.random.default_rng(6), with_map_error=with_map_error)
    means, covs = lines_of_roads(roads, **settings)

    for i, n in enumerate(roads.number):
        error = MapError(*roads.map_error[i]) if with_map_error else None  # type: ignore[index]
        s_x, s_y, s_h = roads.sigma[i]
        ego = pose(s_x, s_y, np.degrees(s_h), roads.correlation[i])
        refit = Refit(Polyline(roads.points[i, :n]), ego.mean, (-1e3, 1e3), error, **settings)
        mean, cov = SigmaPoints().moments(refit, ego)
        sigma = np.sqrt(cov.diagonal())
        assert np.abs((means[i] - mean) / sigma).max() < 1e-6
        assert np.abs((covs[i] - cov) / np.outer(sigma, sigma)).max() < 1e-6


def test_a_road_across_the_car_gives_no_line() -> None:
    """``Refit`` refuses it; here its row is NaN."""
    roads = random_roads(3, np.random.default_rng(0), with_map_error=False)
    roads.points[1] = roads.points[1][:, ::-1] * [0.01, 1.0]
    means, covs = lines_of_roads(roads)

    assert np.isnan(means[1]).all()
    assert np.isnan(covs[1]).all()
    assert np.isfinite(means[[0, 2]]).all()
