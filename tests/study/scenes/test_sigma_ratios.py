"""Ratios of standard deviations: against sampling, and what counts as wider or left out."""

import math
from dataclasses import replace

import numpy as np
import pytest

from maplines_can import Codec, PoseError, Scene
from maplines_can.maps import town_path
from maplines_can.study.scenes.map_scenes import DrawnScene, drawn_scenes, maps_of
from maplines_can.study.scenes.random_scenes import random_scene
from maplines_can.study.scenes.sigma_ratios import (
    LANE_AT,
    TARGETS,
    WIDER,
    Ratios,
    excess,
    measured,
    merged,
    places_of,
    sigma_ratios,
)
from maplines_can.values.line import lateral
from maplines_can.wire import default_dbc_path


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(4, np.random.default_rng(3)).scene


@pytest.fixture(scope="module")
def codec() -> Codec:
    return Codec.from_dbc(default_dbc_path("maplines-scene.dbc"))


def test_ratios_are_those_of_decoded_and_computed_positions(scene: Scene, codec: Codec) -> None:
    """Of all lines at all places, and of width and centre; the scene as received is returned."""
    found = Ratios()
    decoded = found.add_scene(codec, scene)
    assert decoded is not None

    assert (found.lines, found.left_out_share) == (4, 0)
    rng = np.random.default_rng(0)
    x = 20.0
    covs = [of.lines[0].gaussian.cov for of in (decoded, scene)]
    draws = [rng.multivariate_normal(decoded.means[0], cov, 200_000) for cov in covs]
    samples = [lateral(drawn, x).std() for drawn in draws]
    assert found.ratios["y", x][0] == pytest.approx(samples[0] / samples[1], rel=0.02)
    width = decoded.width(x).sigma / scene.width(x).sigma
    assert 1 < found.ratios["width", x][0] <= width * 1.01
    assert found.ratios["centre", x][0] == pytest.approx(
        decoded.centre(x).sigma / scene.centre(x).sigma, rel=1e-3
    )
    assert all(len(found.ratios["centre", at]) == 1 for at in LANE_AT)


def test_a_line_is_wider_if_one_of_its_places_is(scene: Scene, codec: Codec) -> None:
    found = Ratios()
    found.add_scene(codec, scene)
    by_line = np.array([values for (what, _), values in found.ratios.items() if what == "y"])
    assert found.wider == (by_line > WIDER).any(axis=0).sum()


def test_without_a_pose_error_that_fits_no_line_is_sent(scene: Scene, codec: Codec) -> None:
    found = Ratios()
    far = PoseError(1e6 * scene.pose_error.cov)
    assert found.add_scene(codec, replace(scene, pose_error=far, cov=1e6 * scene.cov)) is None
    assert (found.left_out, found.left_out_share) == ({"POSE": 4}, 1)


def test_the_last_place_is_the_end_of_a_line_that_is_shorter() -> None:
    """If that is beyond the place before."""
    assert places_of(-20, 90)[1].tolist() == [0, 20, 40, 80]
    names, x = places_of(5, 60)
    assert (names, x.tolist()) == ([20.0, 40.0, 80.0], [20, 40, 60])
    assert places_of(-10, 30)[0] == [0, 20]


def test_figures_of_kinds_are_merged(scene: Scene, codec: Codec) -> None:
    drawn = [
        DrawnScene("a", "production", "exact", scene),
        DrawnScene("a", "poor", "exact", scene),
        DrawnScene("b", "poor", "exact", scene),
    ]
    found = measured(codec, drawn)
    assert {key: ratios.lines for key, ratios in merged(found, 0).items()} == {"a": 8, "b": 4}
    assert Ratios.sum(found.values()).as_dict()["lines"] == 12


def test_excess_is_1_where_each_figure_is_at_its_target() -> None:
    """A share of lines left out counts, too; without a figure it is infinite."""
    at_target = Ratios(lines=100)
    for what, (median, tail) in TARGETS.items():
        at_target.ratios[what, 0.0] = [median] * 96 + [tail] * 4
    assert excess(at_target) == pytest.approx(1, abs=0.02)
    at_target.left_out["RANGE"] = 1
    assert excess(at_target) == pytest.approx(2, abs=0.02)
    assert excess(Ratios()) == math.inf
    assert sigma_ratios(np.eye(2), 4 * np.eye(2), np.eye(2)).tolist() == [2, 2]


def test_whole_scenes_are_nearly_as_certain_as_computed(codec: Codec) -> None:
    """Of the town and of random roads: hardly a line is left out, and medians are near 1."""
    found = merged(measured(codec, drawn_scenes(maps_of([town_path()]), 60, 1)), 0)
    for ratios in found.values():
        assert ratios.lines > 150
        assert ratios.left_out_share <= 0.02
        for (what, x), values in ratios.ratios.items():
            most = {"y": 1.012, "centre": 1.015, "width": 1.08}[what]
            assert np.median(values) <= most, (what, x)
