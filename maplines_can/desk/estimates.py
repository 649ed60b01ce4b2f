"""Numbers of facts with their standard deviations; ``page/facts.js`` computes the same."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.line import PARAMETERS, are_within, lateral, lateral_jacobian
from .facts import Facts, triangle

#: Lines of the ego lane.
LANE = ("EGO_LEFT", "EGO_RIGHT")


class Known(NamedTuple):
    """A number with its standard deviation; None if that is not known."""

    value: float
    sigma: float | None


def place_at(line: Facts, x: float) -> Known | None:
    """Return the lateral position of a line at x [m]; None outside of its valid range.

    >>> line = {"x": [0.0, 50.0], "mean": [1.8, 0.0, 0.0, 0.0]}
    >>> line["cov"] = [0.04, 0, 0, 0, 1e-6, 0, 0, 0, 0, 0]
    >>> place_at(line, 0.0), place_at(line, 60.0)
    (Known(value=1.8, sigma=0.2), None)
    """
    least, most = line["x"]
    if not are_within(-math.inf if least is None else least, math.inf if most is None else most, x):
        return None
    mean = _array(line["mean"])
    return Known(float(lateral(mean, x)), _spread(line["cov"], lateral_jacobian(mean, x)))


def parameter(line: Facts, k: int) -> Known:
    """Return a parameter of a line."""
    row = np.zeros(len(PARAMETERS))
    row[k] = 1.0
    return Known(_float(line["mean"][k]), _spread(line["cov"], row))


def correlations(line: Facts, k: int = 0) -> list[float]:
    """Return the correlations of a parameter with those after it; NaN if there are none."""
    cov = _full(line["cov"], len(PARAMETERS))
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        sigma = np.sqrt(np.diag(cov))
        row = cov[k, k + 1 :] / (sigma[k] * sigma[k + 1 :])
    return [float(value) for value in row]


def lane_at(facts: Facts, x: float) -> tuple[Known, Known] | None:
    """Return width and centre of the ego lane at x [m], with sigmas of the joint covariance.

    They are None without it. None if a line of the lane is not usable, or not valid there.
    """
    lines = [facts["slots"].get(name, {}) for name in LANE]
    if not all(own.get("usable") and own["line"] for own in lines):
        return None
    ends = [place_at(own["line"], x) for own in lines]
    if ends[0] is None or ends[1] is None:
        return None
    left, right = ends[0].value, ends[1].value
    return (
        Known(left - right, _joint_spread(facts, x, (1.0, -1.0))),
        Known((left + right) / 2, _joint_spread(facts, x, (0.5, 0.5))),
    )


def _joint_spread(facts: Facts, x: float, weights: tuple[float, float]) -> float | None:
    """Return the standard deviation of a weighted sum of the places of the lane's lines."""
    scene = facts["scene"]
    if scene is None or not scene["usable"] or not set(LANE) <= set(scene["slots"]):
        return None
    row = np.zeros((len(scene["slots"]), len(PARAMETERS)))
    for name, weight in zip(LANE, weights, strict=True):
        mean = _array(facts["slots"][name]["line"]["mean"])
        row[scene["slots"].index(name)] = weight * lateral_jacobian(mean, x)
    return _spread(scene["joint"], row.ravel())


def _spread(upper: Sequence[float | None], row: NDArray[np.float64]) -> float | None:
    """Return sqrt(row C row') of an upper triangle; None if it is not known."""
    with np.errstate(invalid="ignore", over="ignore"):
        variance = float(row @ _full(upper, len(row)) @ row)
    return math.sqrt(max(0.0, variance)) if math.isfinite(variance) else None


def _full(upper: Sequence[float | None], n: int) -> NDArray[np.float64]:
    """Return the matrix of an upper triangle, (n, n)."""
    full = np.empty((n, n))
    rows, columns = triangle(n)
    full[rows, columns] = full[columns, rows] = _array(upper)
    return full


def _array(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array(values, dtype=float)  # None becomes NaN


def _float(value: float | None) -> float:
    return math.nan if value is None else float(value)
