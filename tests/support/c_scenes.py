"""Scenes as programs of the C core read them."""

import struct

import numpy as np

from maplines_can import Scene


def scene_input(scene: Scene, age: float = 0.0) -> bytes:
    """Return a scene as c/tests/scene_input.h reads it, with the age of all records [s]."""
    error, specific = scene.map_error, scene.specific_covs
    parts = [struct.pack("<B", len(scene.lines))]
    for line, fit_range, quartic in zip(scene.lines, scene.fit_ranges, scene.quartics, strict=True):
        values = (line.x_min, line.x_max, age, *line.gaussian.mean, *fit_range, quartic)
        parts.append(struct.pack("<3B10d", line.slot, line.kind, line.status, *values))
    parts.append(struct.pack("<B", specific is not None))
    arrays = (() if specific is None else specific, scene.cov, scene.pose_error.cov)
    parts += [np.asarray(array, dtype="<f8").tobytes() for array in arrays]
    of_map = (error.offset_sigma, error.heading_sigma) if error else (0.0, 0.0)
    parts.append(struct.pack("<4d", age, scene.pose_error.correlation_time, *of_map))
    return b"".join(parts)
