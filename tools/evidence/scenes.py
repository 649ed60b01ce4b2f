"""Scenes over a bus: what of the lines is delivered, at what cost, and how right their joint is.

Scenes have the lines around a random pose on a map (the first four slots), or those of a random
road. Their frames pass the encoder and a decoder: as records that are conditional on the pose error
of maplines-pose.dbc, or as complete records of maplines.dbc. Of whole scenes, "maplines study maps"
shows the same.

lost        share of the given lines with 10 m ahead that are left out
frames      classic frames of a scene and its pose error over four for each line sent
overconfident, indefinite
            scenes whose decoded joint covariance does not cover the true one plus the squares of
            the errors of the means, or has no Cholesky factor; of some, in exact arithmetic
width, centre, direction
            sigma of the width of the ego lane, of its centre, and of the difference of the
            directions of its lines, at 0, 20 and 40 m: decoded over the true one with the
            resolution of 2 mm
y           the same of the lateral position of each line at 80 m, or at its end
KL of lines divergence of a line from the covered target (the covariance, the squares of the errors
            of the means and the resolution) to what is decoded
"""

from __future__ import annotations

from collections import Counter, defaultdict
from itertools import product
from typing import Any

import numpy as np

from maplines_can import Codec, Gaussian, MapError, Scene, Slot, map_scene
from maplines_can.study.scenes.random_scenes import RESOLUTION, noise_floor
from maplines_can.values.linalg import block_diagonal
from maplines_can.values.line import lateral_jacobian
from maplines_can.values.seen_lines import bases
from maplines_can.wire import POSE

from .exact import covers, is_positive_definite
from .figures import Share, quantiles
from .harness import evidence, progress
from .roads import SHAPES, maps_of, on_map, on_roads
from .transfer import codec_of, transferred
from .witness import POSES, Array, Poses

RECORDS = {"conditional": "maplines-pose.dbc", "complete": "maplines.dbc"}
#: Standard deviations of the points and of the offset of a map [m]; 0 for an exact one.
ERRORS = {"exact": 0.0, "5 cm": 0.05}
#: Lines with this much ahead must be sent [m].
AHEAD = 10.0
#: Where lanes are compared, and where single lines are [m].
LANE_AT, LINE_AT = (0.0, 20.0, 40.0), 80.0
#: Error of a coefficient of T_0 .. T_3 beyond which a line exceeds the message [m].
LARGEST_ROUNDING = 0.02
#: Slots of the ego lane.
LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
Values = defaultdict[str, list[float]]


@evidence
def scenes(
    n: int = 1000,
    maps: tuple[str, ...] = (),
    shapes: tuple[str, ...] = tuple(SHAPES),
    records: tuple[str, ...] = tuple(RECORDS),
    poses: tuple[str, ...] = tuple(POSES),
    errors: tuple[str, ...] = tuple(ERRORS),
    exact: int = 100,
    seed: int = 1,
) -> dict[str, Any]:
    """Send n scenes of each map and of random roads, for each kind of records, pose and error.

    Args:
        n: number of scenes.
        maps: folders and files of maps.
        shapes: of the random roads, with 2 to 8 lines.
        records: conditional on the pose error, or complete.
        poses: errors of the car's pose.
        errors: of the map.
        exact: scenes that are checked in exact arithmetic, too.
        seed: of the scenes.
    """
    sources = {name: on_map(found) for name, found in maps_of(maps).items()}
    sources |= {"random roads": on_roads(shapes)}
    kinds = [*product(records, sources, poses, errors)]
    result = {}
    for record, source, pose, error in progress(kinds, "scenes", len(kinds)):
        counts, values = Counter[str](overconfident=0, indefinite=0), Values(list)
        for number in range(n):
            rng = np.random.default_rng([seed, number])
            lines, mean = sources[source](number, rng)
            about, sigma = Poses.about(mean, POSES[pose], 0, rng), ERRORS[error]
            map_error = MapError(sigma, sigma) if sigma else None
            scene = map_scene(lines, Gaussian(mean, about.cov), map_error=map_error)
            received = passed(codec_of(RECORDS[record]), scene, counts, values)
            if received is not None and received.lines:
                truth = scene.subset([line.slot for line in received.lines])
                check(truth, received, counts, exactly=number < exact)
                compare(truth, received, values)
        given = counts["given with 10 m"]
        result[f"{record}, {source}, {pose}, {error}"] = {
            **dict(sorted(counts.items())),
            "lost": Share(counts["lost with 10 m"] / max(given, 1), given),
            **{name: quantiles(of, 0.5, 0.95, 0.99) for name, of in values.items()},
        }
    return result


def passed(codec: Codec, scene: Scene, counts: Counter[str], values: Values) -> Scene | None:
    """Return a scene as received, with the counts of its lines; None if no line is sent."""
    counts["scenes"] += 1
    prepared = codec.encoder().prepare_scene(scene)
    far = [line.slot for line in scene.lines if line.x_max >= AHEAD]
    counts["given with 10 m"] += len(far)
    counts["lost with 10 m"] += sum(slot not in prepared.sent_slots for slot in far)
    if not prepared.sent_slots:
        return None
    frames = codec.encoder().encode_scene(prepared)
    sent = sum(map(len, frames.values()))
    values["frames"].append(sent / (4 * len(frames.keys() - {POSE})))
    received = transferred(codec, prepared)
    counts["not received"] += received is None or len(received.lines) < len(prepared.members)
    return received


def check(truth: Scene, received: Scene, counts: Counter[str], *, exactly: bool) -> None:
    """Count whether a joint covariance is indefinite or overconfident."""
    counts["checked"] += 1
    if exactly:
        means = received.means.ravel(), truth.means.ravel()
        counts["indefinite"] += not is_positive_definite(received.cov.tolist())
        counts["overconfident"] += not covers(received.cov, means[0], truth.cov, means[1])
        return
    K, d = scale_of(received), (truth.means - received.means).ravel()
    try:
        L = np.linalg.cholesky(K @ received.cov @ K.T)
    except np.linalg.LinAlgError:
        counts["indefinite"] += 1
        return
    error = K @ (truth.cov + np.outer(d, d)) @ K.T
    counts["overconfident"] += int(whitened(L, error)[-1] > 1)


def compare(truth: Scene, received: Scene, values: Values) -> None:
    """Add the divergence of the lines of a scene, and the ratios of standard deviations."""
    K, d = scale_of(received), (truth.means - received.means).ravel()
    floor = noise_floor(received.means, received.fit_ranges, RESOLUTION)
    true, target = truth.cov + floor, truth.cov + floor + np.outer(d, d)
    for i, line in enumerate(truth.lines):
        own = np.s_[4 * i : 4 * i + 4]
        k, T, C = K[own, own], target[own, own], received.cov[own, own]
        if np.abs(k @ d[own]).max() <= LARGEST_ROUNDING:
            values["KL of lines"].append(divergence(k @ T @ k.T, k @ C @ k.T))
            g = lateral_jacobian(received.means[i], min(LINE_AT, line.x_max))
            values["y"].append(float(np.sqrt((g @ C @ g) / (g @ true[own, own] @ g))))
    if [line.slot for line in received.lines[:2]] == [*LANE]:
        low, high = received.x_range(LANE)
        for x in (x for x in LANE_AT if low <= x <= high):
            for what, g in directions(received.means[:2], x).items():
                ratio = (g @ received.cov[:8, :8] @ g) / (g @ true[:8, :8] @ g)
                values[what].append(float(np.sqrt(ratio)))


def scale_of(scene: Scene) -> Array:
    """Return the matrix from the parameters of all lines to metres."""
    return block_diagonal(np.asarray(np.linalg.inv(bases(scene.means, scene.fit_ranges))))


def whitened(L: Any, cov: Array) -> Array:
    """Return the eigenvalues of a covariance in units of another one's Cholesky factor."""
    half = np.linalg.solve(L, cov)
    return np.asarray(np.linalg.eigvalsh(np.linalg.solve(L, half.T)))


def divergence(target: Array, cov: Array) -> float:
    """Return the KL divergence from one covariance to another one, of equal means [nat]."""
    try:
        values = whitened(np.linalg.cholesky(cov), target)
    except np.linalg.LinAlgError:
        return float("inf")
    return float((values - 1 - np.log(values)).sum() / 2)


def directions(means: Array, x: float) -> dict[str, Array]:
    """Return the (8,) derivatives of width, centre and difference of directions of two lines."""
    left, right = lateral_jacobian(means, x)
    slopes = [[0, 1 + np.tan(mean[1]) ** 2, x, x * x / 2] for mean in means]
    return {
        "width": np.r_[left, -right],
        "centre": np.r_[left, right] / 2,
        "direction": np.r_[slopes[0], -np.array(slopes[1])],
    }
