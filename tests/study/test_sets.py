"""Sets of Gaussians: chunks that repeat, the fixed scenarios, and poses that see a map."""

from typing import Any

import numpy as np
import pytest

from maplines_can.propagation import Quadrature, Refit, SigmaPoints
from maplines_can.simulation.scenarios import SCENARIOS
from maplines_can.study.files import read_map
from maplines_can.study.roads import paper_refit
from maplines_can.study.sets import DrawnSet, MapView, drawn_chunk, line_set
from maplines_can.values.errors import StudyError
from maplines_can.values.gaussian import Gaussian


@pytest.mark.parametrize("name", ["paper", "road", "adversarial"])
def test_a_chunk_depends_only_on_set_seed_index_and_size(name: str) -> None:
    """It repeats; a chunk of another set, seed, index or size has no Gaussian in common with it."""
    first, again = (drawn_chunk(name, 7, 3, 60) for _ in range(2))

    assert np.array_equal(first.mean, again.mean)
    assert np.array_equal(first.cov, again.cov)
    assert len(first.mean) == 60
    others = (
        drawn_chunk(name, 8, 3, 60),
        drawn_chunk(name, 7, 4, 60),
        drawn_chunk("paper", 7, 2, 60),
    )
    for other in others:
        assert not np.isclose(first.mean, other.mean).all(axis=1).any()


def test_the_first_chunk_begins_with_the_fixed_scenarios() -> None:
    """It has all their lines in their order."""
    example = SCENARIOS["highway"]
    means, covs = SigmaPoints().moments(paper_refit(example), example.ego)
    chunk = drawn_chunk("paper", 0, 0, 100)

    assert np.array_equal(chunk.mean[: len(means)], means)
    assert np.array_equal(chunk.cov[: len(means)], covs)


def test_the_last_chunk_is_the_remainder() -> None:
    """25 Gaussians make two chunks of 10 and one of 5."""
    assert DrawnSet("road").sizes(25, 10) == [10, 10, 5]


def test_an_unknown_set_is_refused() -> None:
    """The message lists the sets."""
    with pytest.raises(StudyError, match="sets are paper, road, adversarial"):
        line_set("moon")


@pytest.mark.parametrize(
    ("name", "transform"), [("sigma-points", SigmaPoints()), ("quadrature", Quadrature())]
)
def test_poses_see_the_lines_of_their_map(name: str, transform: Any, drive: Any) -> None:
    """They see the lines near the road, as ``Refit`` and the transform give them."""
    path = str(drive / "drive.csv")
    given_set = line_set(path, MapView(drive / "map.csv", transform=name))  # type: ignore[arg-type]
    chunks = [chunk() for chunk in given_set.chunks(1, 2, 0)]
    lines, _ = read_map(drive / "map.csv")
    refit = Refit(lines[0], [50.0, 0.0, 0.0], (-20.0, 80.0))
    mean, cov = transform.moments(refit, Gaussian([50.0, 0.0, 0.0], np.diag([0.3, 0.1, 0.01]) ** 2))

    assert given_set.sizes(1, 2) == [2, 1]
    assert [len(chunk.mean) for chunk in chunks] == [4, 2]
    assert chunks[0].mean[0] == pytest.approx(mean)
    assert chunks[0].cov[0] == pytest.approx(cov)


def test_poses_need_a_map(drive: Any) -> None:
    """The message names the option."""
    with pytest.raises(StudyError, match="give the lines of their map with --map"):
        line_set(str(drive / "drive.csv"))
