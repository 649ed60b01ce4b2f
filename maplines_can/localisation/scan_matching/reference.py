"""Surfaces of a map that a lidar sees: walls of buildings and poles, as segments and as points."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...maps import Landmark, Map
from ...values.polyline import Polyline

Array = NDArray[np.float64]

#: Spacing of the points of a surface [m].
SPACING = 0.1
#: Radius of a pole [m], and the number of sides by which it is drawn.
POLE_RADIUS, POLE_SIDES = 0.15, 8


class ScanReference:
    """Surfaces that a horizontal lidar sees, with a point every 10 cm.

    Args:
        road_map: the map; its buildings and landmarks are used.

    Raises:
        ValueError: the map has neither buildings nor landmarks.
    """

    def __init__(self, road_map: Map) -> None:
        from scipy.spatial import cKDTree

        outlines = [*road_map.buildings, *map(_pole, road_map.landmarks)]
        if not outlines:
            raise ValueError(
                f"the map {road_map.name!r} has neither buildings nor landmarks to match scans with"
            )
        begin = np.concatenate([outline.points[:-1] for outline in outlines])
        end = np.concatenate([outline.points[1:] for outline in outlines])
        #: (k, 2, 2) begin and end of each segment [m].
        self.segments = np.stack([begin, end], axis=1)
        self.points, self.normals, row = _sampled(self.segments)
        self._objects = np.repeat(
            np.arange(len(outlines)), [len(outline.points) - 1 for outline in outlines]
        )[row]
        self._tree = cKDTree(self.points)
        self._middles = cKDTree(self.segments.mean(axis=1))
        self._longest = float(np.hypot(*(end - begin).T).max())

    def near(self, position: Array, reach: float) -> tuple[Array, Array]:
        """Return (m, 2) points within a distance [m] of a position, and their (m, 2) normals."""
        rows = self._tree.query_ball_point(position, reach)
        return self.points[rows], self.normals[rows]

    def objects_at(self, points: Array) -> NDArray[np.intp]:
        """Return the (m,) numbers of the houses and poles that are nearest to (m, 2) points."""
        return np.asarray(self._objects[self._tree.query(points)[1]])

    def ranges(self, pose: Array, bearings: Array, most: float) -> Array:
        """Return the (b,) distances to the nearest surface along (b,) bearings [m].

        Args:
            pose: (3,) of the lidar: x [m], y [m], heading [rad].
            bearings: (b,) from the heading [rad].
            most: largest distance [m]; NaN beyond it.
        """
        rows = self._middles.query_ball_point(pose[:2], most + self._longest / 2)
        segments = self.segments[rows]
        angle = pose[2] + bearings
        ray = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]  # (b, 1, 2)
        start = segments[:, 0] - pose[:2]  # (k, 2)
        along = segments[:, 1] - segments[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            across = _cross(ray, along)
            distance = _cross(start, along) / across  # (b, k)
            share = _cross(start, ray) / across
            hit = (distance > 0) & (distance <= most) & (share >= 0) & (share <= 1)
        nearest = np.where(hit, distance, np.inf).min(axis=1, initial=np.inf)
        return np.where(np.isfinite(nearest), nearest, np.nan)


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _pole(landmark: Landmark) -> Polyline:
    angle = 2 * math.pi * np.arange(POLE_SIDES + 1) / POLE_SIDES
    circle = POLE_RADIUS * np.column_stack([np.cos(angle), np.sin(angle)])
    return Polyline(circle + np.array([landmark.x, landmark.y]))


def _sampled(segments: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """Return points on segments, at most ``SPACING`` apart, their normals and their segments."""
    step = segments[:, 1] - segments[:, 0]
    length = np.hypot(*step.T)
    counts = np.maximum(1, np.ceil(length / SPACING)).astype(int)
    row = np.repeat(np.arange(len(segments)), counts)
    share = (np.arange(len(row)) - np.repeat(counts.cumsum() - counts, counts) + 0.5) / counts[row]
    points = segments[row, 0] + share[:, None] * step[row]
    normals = np.column_stack([-step[:, 1], step[:, 0]]) / length[:, None]
    return points, normals[row], row


# Settings of the lidar, by keyword alone.
def simulated_scan(
    reference: ScanReference,
    pose: Array,
    rng: np.random.Generator,
    *,
    rays: int = 720,
    most: float = 50.0,
    sigma: float = 0.03,
    false_share: float = 0.05,
) -> Array:
    """Return the (m, 2) points of a lidar scan in the ego frame, with white noise of the range.

    Args:
        reference: surfaces that there are.
        pose: (3,) true pose of the lidar.
        rng: random numbers.
        rays: number of rays of a turn.
        most: largest range [m].
        sigma: of the range [m].
        false_share: share of rays that hit something that the map does not have, before it.
    """
    bearings = 2 * math.pi * np.arange(rays) / rays
    distance = reference.ranges(pose, bearings, most)
    free = np.where(np.isfinite(distance), distance, most)
    blocked = rng.random(rays) < false_share
    distance = np.where(blocked, free * rng.uniform(0.05, 1.0, rays), distance)
    distance = distance + sigma * rng.standard_normal(rays)
    points = distance[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    return points[np.isfinite(distance)]
