"""Points along lines, for formats that have no cubics."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.line import PARAMETERS, Status, lateral, lateral_jacobian
from ..line_tables import UPPER_TRIANGLE, Table

Array = NDArray[Any]


class LinePoints(NamedTuple):
    """Points of n lines, evenly spaced in x from ``x_min`` to ``x_max``.

    Args:
        x: (n, points) distances ahead of the car [m].
        y: (n, points) lateral positions [m]; nan for a line without values.
        sigma: (n, points) standard deviations of ``y`` for this x, to first order [m].
    """

    x: Array
    y: Array
    sigma: Array


def points_of(lines: Table, count: int) -> LinePoints:
    """Return as many points of each line of a table."""
    mean, cov = mean_of(lines)[:, None], cov_of(lines)
    begin, end = lines.columns["x_min"][:, None], lines.columns["x_max"][:, None]
    x = begin + (end - begin) * np.linspace(0, 1, count)
    J = lateral_jacobian(mean, x)
    sigma = np.sqrt(np.einsum("nki,nij,nkj->nk", J, cov, J).clip(0))
    return LinePoints(x, lateral(mean, x), sigma)


def covering_points_of(lines: Table, count: int, between: int = 4) -> LinePoints:
    """Return points whose polyline is nowhere more certain than the line.

    The standard deviations are such that their linear interpolation is at least the root of the
    sum of squares of the line's own and of its distance from the polyline: each is the largest of
    both segments at its point, found at ``between`` places of each.

    Args:
        lines: the table.
        count: of the points of a line, 2 or more.
        between: places in a segment; what is missed between them is less than 1 %.
    """
    fine = points_of(lines, (count - 1) * between + 1)
    y = fine.y[:, ::between]
    share = np.arange(between + 1) / between
    chord = y[:, :-1, None] * (1 - share) + y[:, 1:, None] * share
    places = np.arange(count - 1)[:, None] * between + np.arange(between + 1)
    each = np.hypot(fine.sigma[:, places], fine.y[:, places] - chord).max(axis=2)
    edge = np.zeros((len(y), 1))
    sigma = np.maximum(np.hstack([each, edge]), np.hstack([edge, each]))
    return LinePoints(fine.x[:, ::between], y, sigma)


def mean_of(lines: Table) -> Array:
    """Return the (n, 4) means [m, rad, 1/m, 1/m^2]."""
    return np.stack([lines.columns[name] for name in PARAMETERS], axis=1)


def upper_triangle_of(lines: Table) -> Array:
    """Return the (n, 10) upper triangles of the covariances, row by row."""
    names = [f"cov_{PARAMETERS[i]}_{PARAMETERS[j]}" for i, j in UPPER_TRIANGLE]
    return np.stack([lines.columns[name] for name in names], axis=1)


def cov_of(lines: Table) -> Array:
    """Return the (n, 4, 4) covariances."""
    rows, columns = np.array(UPPER_TRIANGLE).T
    cov = np.empty((len(lines), 4, 4))
    cov[:, rows, columns] = cov[:, columns, rows] = upper_triangle_of(lines)
    return cov


def is_shown(lines: Table) -> Array:
    """Return the (n,) answers whether a controller might have used a line, as it arrived."""
    return lines.columns["usable"] & np.isfinite(lines.columns["y_off"])


def has_sigma(lines: Table) -> Array:
    """Return the (n,) answers whether a line was sent with a covariance."""
    return lines.columns["status"] != Status.UNKNOWN
