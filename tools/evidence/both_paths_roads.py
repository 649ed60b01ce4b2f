"""Lines and scenes of maps by the C core, and by Python alone in the same process.

The differences are the largest ones, of means and covariances in standard deviations. C leaves what
is unusual to Python; this is counted, for there is nothing to compare.

    python tools/evidence both_paths_roads n=1e4 maps=DIR
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from maplines_can import Gaussian, Scene
from maplines_can.maps import load, town_path
from maplines_can.propagation import SigmaPoints, map_lines, map_scene
from maplines_can.propagation.in_c import CycleInC
from maplines_can.simulation.scenarios import SCENARIOS, STREETS

from .both_paths import tests
from .harness import bar, evidence
from .roads import SHAPES, maps_of, on_map, on_roads
from .witness import POSES, Poses

#: Fields of a line that are the same on both paths.
EXACT = ("slot", "kind", "age", "status", "t_ns", "mixture")
COUNTS = ("cases", "lines", "scenes", "refused", "left out", "left to Python", "different")
DIFFERENCES = ("mean [sigma]", "covariance [sigma^2]", "range [m]")


def _cases(n: int, maps: tuple[str, ...]) -> Iterator[tuple[str, int, Iterator[Any]]]:
    """Yield names, numbers and cases: lines, a pose, and other arguments of ``map_lines``."""
    of_tests = tests("test_native_propagation")
    errors, transforms = of_tests.MAP_ERRORS, of_tests.TRANSFORMS

    def drawn(draw: Any) -> Iterator[Any]:
        for number in range(n):
            rng = np.random.default_rng(number)
            lines, pose = draw(number, rng)
            cov = Poses.about(pose, POSES[list(POSES)[number % 2]], 0, rng).cov
            if lines:
                error = errors[rng.integers(len(errors))]
                yield dict(lines), Gaussian(pose, cov), {"map_error": error}

    given = [*SCENARIOS.values(), *STREETS.values()]
    kinds = [*product(given, errors, transforms)]
    yield (
        "scenarios",
        len(kinds),
        (
            (dict(one.lines), one.ego, {"window": one.window, "map_error": error, "transform": how})
            for one, error, how in kinds
        ),
    )
    tour = [*of_tests.tour()]
    yield (
        "town's tour",
        len(tour),
        ((*one, {"map_error": errors[i % 4]}) for i, one in enumerate(tour)),
    )
    yield "random roads", n, drawn(on_roads(tuple(SHAPES)))
    for name, road_map in ({"town": load(town_path())} | maps_of(maps)).items():
        yield name, n, drawn(on_map(road_map))


@evidence(n=20)
def both_paths_roads(n: int = 1000, maps: tuple[str, ...] = ()) -> dict[str, Any]:
    """Compare the lines and scenes of maps: n poses on random roads, in the town, on each map.

    The differences are the largest ones, of means and covariances in standard deviations.

    Args:
        n: number of poses on each map.
        maps: folders and files of maps.
    """
    on_both_paths = tests("test_native_propagation").on_both_paths
    rows: dict[str, Any] = {}
    for name, number, cases in _cases(n, maps):
        row: dict[str, Any] = dict.fromkeys((*COUNTS, *DIFFERENCES), 0)
        with bar(number, name) as shown:
            for lines, ego, rest in cases:
                for function in (map_lines, map_scene):
                    _add(row, *on_both_paths(partial(function, lines, ego, **rest)))
                row["left to Python"] += not _is_in_c(lines, ego, **rest)
                row["cases"] += 1
                shown.update()
        row["share in C"] = 1 - row["left to Python"] / max(1, row["cases"])
        rows[name] = row
    return rows


def _is_in_c(lines: Any, ego: Gaussian, **rest: Any) -> bool:
    """Return whether C computes both the lines and the scene."""
    settings: Any = {"window": (-20.0, 80.0), "max_misfit": 0.1, "max_sigma": 10.0}
    settings |= rest
    transform = settings.pop("transform", SigmaPoints())
    cycle = CycleInC.of(lines, ego, **settings)
    if cycle is None or cycle.map_lines(transform) is None:
        return False
    return cycle.map_scene(transform, 1.0) is not None


def _add(row: dict[str, Any], native: Any, python: Any) -> None:
    """Add what both paths have made of the same lines."""
    if isinstance(python, tuple) or isinstance(native, tuple):  # an error
        row["refused"] += 1
        row["different"] += native != python
        return
    pairs = [(native, python)] if isinstance(python, Scene) else []
    row["scenes"] += len(pairs)
    row["left out"] += len(python.left_out)
    found, expected = ([*getattr(one, "lines", one)] for one in (native, python))
    row["lines"] += len(expected)
    same = [*native.left_out.items()] == [*python.left_out.items()]
    row["different"] += not same or len(found) != len(expected)
    for one, other in zip(found, expected, strict=False):
        row["different"] += any(getattr(one, name) != getattr(other, name) for name in EXACT)
        sigma = other.gaussian.sigma
        _raise(row, "mean [sigma]", (one.gaussian.mean - other.gaussian.mean) / sigma)
        _raise(row, "range [m]", [one.x_min - other.x_min, one.x_max - other.x_max])
        pairs.append((one.gaussian, other.gaussian))
    for of_c, alone in pairs:
        if len(alone.cov):
            sigma = np.sqrt(alone.cov.diagonal())
            scaled = (of_c.cov - alone.cov) / sigma / sigma[:, None]
            _raise(row, "covariance [sigma^2]", scaled)


def _raise(row: dict[str, Any], name: str, difference: Any) -> None:
    """Raise the largest difference; it becomes NaN, which keeps no bound, if one is NaN."""
    row[name] = float(np.max([row[name], np.abs(difference).max()]))
