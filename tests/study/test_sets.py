"""Sets of Gaussians: chunks that repeat, lines of random roads, and poses that see a map."""

from typing import Any

import numpy as np
import pytest

from maplines_can.propagation import MapError, Quadrature, Refit, SigmaPoints
from maplines_can.simulation.scenarios import SCENARIOS, pose
from maplines_can.study.files import read_map
from maplines_can.study.roads import PAPER, lines_of_roads, paper_refit, random_roads
from maplines_can.study.sets import DrawnSet, MapView, drawn_chunk, line_set
from maplines_can.values.errors import StudyError
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.polyline import Polyline


@pytest.mark.parametrize("name", ["paper", "road", "adversarial"])
def test_a_chunk_depends_only_on_set_seed_index_and_size(name: str) -> None:
    """It repeats; a chunk of another set, seed, index or size has no Gaussian in common with it."""
    first, again = (drawn_chunk(name, 7, 3, 60) for _ in range(2))
    assert np.array_equal(first.mean, again.mean)
    assert np.array_equal(first.cov, again.cov)
    assert len(first.mean) == 60
    for other in ((name, 8, 3, 60), (name, 7, 4, 60), ("paper", 7, 2, 60)):
        assert not np.isclose(first.mean, drawn_chunk(*other).mean).all(axis=1).any()
    assert DrawnSet(name).sizes(25, 10) == [10, 10, 5]


def test_the_first_chunk_begins_with_the_fixed_scenarios() -> None:
    """It has all their lines in their order."""
    example = SCENARIOS["highway"]
    means, covs = SigmaPoints().moments(paper_refit(example), example.ego)
    chunk = drawn_chunk("paper", 0, 0, 100)
    assert np.array_equal(chunk.mean[: len(means)], means)
    assert np.array_equal(chunk.cov[: len(means)], covs)


@pytest.mark.parametrize("settings", [{}, PAPER], ids=["honest", "paper"])
@pytest.mark.parametrize("with_map_error", [False, True])
def test_each_road_has_the_pose_and_the_map_error_of_its_row(
    settings: Any, with_map_error: bool
) -> None:
    """Its line is that of ``Refit`` and ``SigmaPoints``; NaN if it is across the car."""
    roads = random_roads(30, np.random.default_rng(6), with_map_error=with_map_error)
    means, covs = lines_of_roads(roads, **settings)
    for i, n in enumerate(roads.number):
        error = None if roads.map_error is None else MapError(*roads.map_error[i])
        s_x, s_y, s_h = roads.sigma[i]
        ego = pose(s_x, s_y, np.degrees(s_h), roads.correlation[i])
        refit = Refit(Polyline(roads.points[i, :n]), ego.mean, (-1e3, 1e3), error, **settings)
        mean, cov = SigmaPoints().moments(refit, ego)
        sigma = np.sqrt(cov.diagonal())
        assert np.abs((means[i] - mean) / sigma).max() < 1e-6
        assert np.abs((covs[i] - cov) / np.outer(sigma, sigma)).max() < 1e-6
    roads.points[1] = roads.points[1][:, ::-1] * [0.01, 1.0]
    across, covs = lines_of_roads(roads, **settings)
    assert np.isnan(across[1]).all()
    assert np.isnan(covs[1]).all()
    assert np.array_equal(across[2], means[2])


@pytest.mark.parametrize(
    ("name", "transform"), [("sigma-points", SigmaPoints()), ("quadrature", Quadrature())]
)
def test_poses_see_the_lines_of_their_map(name: Any, transform: Any, drive: Any) -> None:
    """They see the lines near the road, as ``Refit`` and the transform give them."""
    path = str(drive / "drive.csv")
    given_set = line_set(path, MapView(drive / "map.csv", transform=name))
    chunks = [chunk() for chunk in given_set.chunks(1, 2, 0)]
    refit = Refit(read_map(drive / "map.csv")[0][0], [50.0, 0.0, 0.0], (-20.0, 80.0))
    mean, cov = transform.moments(refit, Gaussian([50.0, 0.0, 0.0], np.diag([0.3, 0.1, 0.01]) ** 2))
    assert given_set.sizes(1, 2) == [2, 1]
    assert [len(chunk.mean) for chunk in chunks] == [4, 2]
    assert chunks[0].mean[0] == pytest.approx(mean)
    assert chunks[0].cov[0] == pytest.approx(cov)


def test_what_is_no_set_is_refused(drive: Any) -> None:
    """The message lists the sets, or names the option."""
    with pytest.raises(StudyError, match="sets are paper, road, adversarial"):
        line_set("moon")
    with pytest.raises(StudyError, match="give the lines of their map with --map"):
        line_set(str(drive / "drive.csv"))
    with pytest.raises(StudyError, match="x_min < x_max"):
        MapView(drive / "map.csv", (1.0, 1.0))
