"""Scenes over a bus: what of the lines is delivered, at what cost, and how right their joint is.

Each scene has the lines around a random pose on a map (the first four slots), or 2 to 8 lines of a
random road. The frames of a scene pass the encoder and a decoder, with two kinds of records: those
that are conditional on the pose error, of maplines-pose.dbc, and the complete records of
maplines.dbc with levels in the Pose message.

given       lines of map_scene; of the others, the reason
sent        with levels, with all entries, or left out by the encoder, with its reason
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
KL, KL of lines
            divergence of a scene, or of a line, from the covered target (the covariance, the
            squares of the errors of the means and the resolution) to what is decoded
error       95 % of the errors of decoded usable lines, 20 m ahead within their valid ranges: what
            poses drawn from the stated error see of the points of the line, less what is decoded
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from maplines_can import Codec, Gaussian, MapError, MapLine, Scene, Slot, map_scene
from maplines_can.study.scenes.random_scenes import RESOLUTION, noise_floor
from maplines_can.values.linalg import block_diagonal
from maplines_can.values.line import lateral_jacobian
from maplines_can.values.seen_lines import bases
from maplines_can.wire import POSE, default_dbc_path

from .exact import covers, is_positive_definite
from .figures import Share, quantiles
from .harness import evidence, progress
from .roads import SHAPES, Draw, maps_of, on_map, on_roads
from .witness import POSES, Array, Poses, crossings, near_points

RECORDS = {"conditional": "maplines-pose.dbc", "complete": "maplines.dbc"}
#: Standard deviations of the points and of the offset of a map [m]; 0 for an exact one.
ERRORS = {"exact": 0.0, "5 cm": 0.05}
#: Lines with this much ahead must be sent [m].
AHEAD = 10.0
#: Where lanes are compared, where single lines are, and where their errors are [m].
LANE_AT, LINE_AT, ERROR_AT = (0.0, 20.0, 40.0), 80.0, 20.0
#: Error of a coefficient of T_0 .. T_3 beyond which a line exceeds the message [m].
LARGEST_ROUNDING = 0.02
#: Slots of the ego lane.
LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)


class Figures(NamedTuple):
    """Counts and values by name."""

    counts: Counter[str]
    values: defaultdict[str, list[float]]

    def shown(self) -> dict[str, Any]:
        """Return the figures by name."""
        counts, values = self
        given = counts["given with 10 m"]
        return {
            **{name: counts[name] for name in ("overconfident", "indefinite", "not received")},
            **dict(sorted(counts.items())),
            "lost": Share(counts["lost with 10 m"] / max(given, 1), given),
            **{name: quantiles(of, 0.5, 0.95, 0.99) for name, of in values.items()},
        }


@evidence(n=14, exact=2, poses=("production",), errors=("5 cm",))
def scenes(
    n: int = 1000,
    maps: tuple[str, ...] = (),
    shapes: tuple[str, ...] = tuple(SHAPES),
    records: tuple[str, ...] = tuple(RECORDS),
    poses: tuple[str, ...] = tuple(POSES),
    errors: tuple[str, ...] = tuple(ERRORS),
    exact: int = 100,
    draws: int = 10,
    seed: int = 1,
) -> dict[str, Any]:
    """Send n scenes of each map and of random roads, for each kind of records, pose and error.

    Args:
        n: number of scenes.
        maps: folders and files of maps.
        shapes: of the random roads.
        records: conditional on the pose error, or complete.
        poses: errors of the car's pose.
        errors: of the map.
        exact: scenes that are checked in exact arithmetic, too.
        draws: poses drawn for each scene.
        seed: of the scenes.
    """
    sources = {name: on_map(found) for name, found in maps_of(maps).items()}
    sources |= {"random roads": on_roads(shapes)}
    kinds = [*product(records, sources, poses, errors)]
    result = {}
    for record, source, pose, error in progress(kinds, "scenes", len(kinds)):
        codec = Codec.from_dbc(default_dbc_path(RECORDS[record]))
        figures = Figures(Counter(), defaultdict(list))
        for number in range(n):
            rng = np.random.default_rng([seed, number])
            one = Passage(sources[source], number, POSES[pose], ERRORS[error], draws, rng)
            one.measure(codec, figures, exactly=number < exact)
        result[f"{record}, {source}, {pose}, {error}"] = figures.shown()
    return result


class Passage:
    """A random scene, and what a receiver gets of it."""

    def __init__(
        self, draw: Draw, number: int, sigma: Any, error: float, draws: int, rng: Any
    ) -> None:
        self.lines, mean = draw(number, rng)
        self.poses = Poses.about(mean, sigma, draws, rng)
        map_error = MapError(error, error) if error else None
        self.scene = map_scene(self.lines, Gaussian(mean, self.poses.cov), map_error=map_error)

    def measure(self, codec: Codec, figures: Figures, *, exactly: bool) -> None:
        """Send the scene, and add its figures."""
        figures.counts["scenes"] += 1
        figures.counts.update(f"not given, {why.name}" for why in self.scene.left_out.values())
        received = self.passed(codec, figures)
        if received is None or not received.lines:
            return
        truth = self.scene.subset([line.slot for line in received.lines])
        check(truth, received, figures.counts, exactly=exactly)
        compare(truth, received, figures.values)
        for line in received.lines:
            self.errors(line, figures.values["error"])

    def passed(self, codec: Codec, figures: Figures) -> Scene | None:
        """Return a scene as received, with the counts of its lines; None if no line is sent."""
        counts, values, started = figures.counts, figures.values, time.perf_counter()
        prepared = codec.encoder().prepare_scene(self.scene)
        values["encode [ms]"].append(1000 * (time.perf_counter() - started))
        far = [line.slot for line in self.scene.lines if line.x_max >= AHEAD]
        counts["given"] += len(self.scene.lines)
        counts["given with 10 m"] += len(far)
        counts["lost with 10 m"] += sum(slot not in prepared.sent_slots for slot in far)
        counts.update(f"not sent, {why.name}" for why in prepared.unfit.values())
        if not prepared.sent_slots:
            return None
        frames = codec.encoder().encode_scene(prepared)
        of_lines = [len(own) for owner, own in frames.items() if owner != POSE]
        whole = codec.layout.pages
        counts["all entries"] += codec.layout.is_conditional * of_lines.count(whole)
        counts["levels"] += len(of_lines) - codec.layout.is_conditional * of_lines.count(whole)
        sent = sum(map(len, frames.values()))
        values["frames"].append(sent / (4 * len(of_lines)))
        decoder, t_ns = codec.decoder(), 0
        for frame in (frame for own in frames.values() for frame in own):
            answer = decoder.feed(frame.can_id, frame.data, t_ns)
            if isinstance(answer, MapLine):
                counts[f"received, {answer.status.name}"] += 1
            t_ns += 250_000
        started = time.perf_counter()
        received = decoder.scene()
        values["decode [ms]"].append(1000 * (time.perf_counter() - started))
        members = len(prepared.members)
        counts["not received"] += received is None or len(received.scene.lines) < members
        return None if received is None else received.scene

    def errors(self, line: Any, into: list[float]) -> None:
        """Add the errors of a line at ``ERROR_AT``, if it is valid there."""
        if line.is_usable and line.x_min <= ERROR_AT <= line.x_max:
            near, s = near_points(self.lines[line.slot].points, self.poses.mean)
            y = crossings(self.poses.see(near), s, ERROR_AT)
            into += np.abs(y[np.isfinite(y)] - float(line.y(ERROR_AT))).tolist()


def check(truth: Scene, received: Scene, counts: Counter[str], *, exactly: bool) -> None:
    """Count whether a joint covariance is indefinite or overconfident."""
    K = scale_of(received)
    d = (truth.means - received.means).ravel()
    counts["checked"] += 1
    if exactly:
        counts["checked exactly"] += 1
        definite = is_positive_definite(received.cov.tolist())
        covered = covers(received.cov, received.means.ravel(), truth.cov, truth.means.ravel())
        counts["indefinite"] += not definite
        counts["overconfident"] += not covered
        return
    try:
        L = np.linalg.cholesky(K @ received.cov @ K.T)
    except np.linalg.LinAlgError:
        counts["indefinite"] += 1
        return
    error = K @ (truth.cov + np.outer(d, d)) @ K.T
    counts["overconfident"] += int(whitened(L, error)[-1] > 1)


def compare(truth: Scene, received: Scene, values: defaultdict[str, list[float]]) -> None:
    """Add the divergence of a scene and of its lines, and the ratios of standard deviations."""
    K, d = scale_of(received), (truth.means - received.means).ravel()
    floor = noise_floor(received.means, received.fit_ranges, RESOLUTION)
    true, target = truth.cov + floor, truth.cov + floor + np.outer(d, d)
    values["KL"].append(divergence(K @ target @ K.T, K @ received.cov @ K.T))
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
