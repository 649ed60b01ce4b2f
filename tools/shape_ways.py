"""Ways by which a consumer gets lines, and what it then has of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from evidence_lines import over_the_wire
from line_witness import WINDOW, Array
from shape_figures import Given

from maplines_can import (
    Codec,
    Gaussian,
    MapError,
    MapLine,
    Motion,
    Polyline,
    Scene,
    Slot,
    map_lines,
    map_scene,
    predict_to,
    wire,
)
from maplines_can.propagation import scene_mixture
from maplines_can.propagation.map_lines import view_of
from maplines_can.propagation.map_scene import STEP
from maplines_can.propagation.misfit import coefficient_variances
from maplines_can.propagation.refit import MAX_MISFIT, Refit
from maplines_can.propagation.valid_range import longest_ranges
from maplines_can.values.errors import EncodeError, MaplinesError
from maplines_can.values.gaussian import block_diagonal, diagonal_blocks, nearest_covariance
from maplines_can.values.mixture import GaussianMixture
from maplines_can.values.polyline import stretches
from maplines_can.values.seen_lines import bases

COMPONENTS = 3
#: The motion of --by predicted: time [s], speed [m/s], and sigmas [m/s, rad/s].
SECONDS, SPEED, MOTION_SIGMA = 1.0, 12.0, (0.3, 0.01)
#: Largest yaw rate of that motion [rad/s].
MAX_YAW_RATE = 0.6
#: From a line, the true poses with the mean one, and random numbers to what a consumer has.
Carry = Callable[[MapLine, Array, np.random.Generator], tuple[MapLine | None, Array]]


class Case(NamedTuple):
    """Lines of a map around a car whose pose is uncertain."""

    lines: dict[Slot, Polyline]  #: as the product gets them
    ego: Gaussian
    drawn: Array  #: (D, 3) true poses
    error: MapError | None  #: that is stated
    rng: np.random.Generator


class Result(NamedTuple):
    """What a consumer has of a case: joint distributions of some of its lines."""

    slots: list[list[Slot]]
    given: list[Given]
    poses: list[Array]  #: (D + 1, 3) true poses and, last, the mean one, from which these are seen
    lost: int  #: lines that the transport or the prediction did not give


def excess_covs(case: Case, step: float) -> dict[Slot, Array]:
    """Return (4, 4): what each line has beyond a misfit in the variance of y_off alone.

    ``step`` is that of the ends of the ranges: 0 in ``map_lines``.
    """
    slots = [*case.lines]
    result = {slot: np.zeros((4, 4)) for slot in slots}
    view = view_of(case.ego, WINDOW, case.error)
    seen = stretches([*case.lines.values()], case.ego.mean, view.window, view.max_turn)
    if len(seen.given):
        fitted = longest_ranges(seen, MAX_MISFIT, view.room, step)
        mean = Refit(seen, case.ego.mean, room=view.room, step=step)(case.ego.mean[None])[0]
        point_sigma = 0.0 if case.error is None else case.error.point_sigma
        J, variances = bases(mean, fitted.x_range), coefficient_variances(seen, fitted, point_sigma)
        covs = np.einsum("lik,lk,ljk->lij", J, variances, J)
        covs[:, 0, 0] -= fitted.misfit**2
        result |= {slots[i]: cov for i, cov in zip(seen.given, covs, strict=True)}
    return result


def less(cov: Array, excess: Array) -> Array:
    """Return (..., n, n) covariances less a part of each, definite in spite of rounding."""
    if not excess.any():
        return cov
    rest = cov - excess
    rest = (rest + rest.swapaxes(-1, -2)) / 2
    diagonal = np.arange(rest.shape[-1])
    rest[..., diagonal, diagonal] = rest[..., diagonal, diagonal].clip(0)
    return nearest_covariance(rest)


def distribution(line: MapLine) -> tuple[Array, Array, Array]:
    """Return the shares, means and covariances of the components of a line."""
    if line.mixture is None:
        return np.ones(1), line.gaussian.mean[None], line.gaussian.cov[None]
    return line.mixture.weights, line.mixture.means, line.mixture.covs


def with_less(line: MapLine, excess: Array) -> MapLine:
    """Return a line with a part of its covariance taken off."""
    shares, means, covs = distribution(line)
    parts = [Gaussian(mean, less(cov, excess)) for mean, cov in zip(means, covs, strict=True)]
    if line.mixture is None:
        return replace(line, gaussian=parts[0])
    mixture = GaussianMixture(shares, parts)
    return replace(line, gaussian=mixture.overall, mixture=mixture)


def lines_by(carry: Carry, components: int, case: Case) -> Result:
    """Return the lines of ``map_lines`` that ``carry`` brings to a consumer, one by one."""
    lines = map_lines(
        case.lines, case.ego, window=WINDOW, map_error=case.error, components=components
    )
    excess = excess_covs(case, 0.0)
    result = Result([], [], [], 0)
    for line in lines:
        drawn = np.vstack([case.drawn, case.ego.mean])
        got, drawn = carry(line, drawn, case.rng)
        if got is None:
            result = result._replace(lost=result.lost + 1)
            continue
        reference, _ = carry(with_less(line, excess[line.slot]), drawn, np.random.default_rng(0))
        result.slots.append([line.slot])
        result.given.append(given_of(got, reference or got))
        result.poses.append(drawn)
    return result


def given_of(line: MapLine, reference: MapLine) -> Given:
    """Return what a consumer has of a single line."""
    shares, means, covs = distribution(line)
    return Given(
        shares,
        means[:, None],
        covs,
        distribution(reference)[2],
        np.array([[line.x_min, line.x_max]]),
    )


@cache
def codec(dbc: str | None = None) -> Codec:
    """Return the codec of a DBC of the package, the default one without a name."""
    return Codec.from_dbc() if dbc is None else Codec.from_dbc(wire.default_dbc_path(dbc))


def as_given(line: MapLine, drawn: Array, _: Any) -> tuple[MapLine | None, Array]:
    """Return a line as the sender has it."""
    return line, drawn


def sent(line: MapLine, drawn: Array, _: Any) -> tuple[MapLine | None, Array]:
    """Return a line as a receiver gets it."""
    return over_the_wire(codec(), line), drawn


def predicted(line: MapLine, drawn: Array, rng: Any) -> tuple[MapLine | None, Array]:
    """Return a line that is predicted, and the true poses of that time."""
    curvature = line.gaussian.mean[2] + line.gaussian.mean[3] * SPEED * SECONDS / 2
    yaw_rate = float(np.clip(SPEED * curvature, -MAX_YAW_RATE, MAX_YAW_RATE))
    motion = Motion.with_sigma(SPEED, yaw_rate, MOTION_SIGMA)
    rates = np.array([SPEED, yaw_rate]) + rng.standard_normal((len(drawn), 2)) * MOTION_SIGMA
    rates[-1] = SPEED, yaw_rate  # of the mean pose
    try:
        later = predict_to(replace(line, t_ns=0), round(SECONDS * 1e9), motion)
    except MaplinesError:
        return None, drawn
    return later, np.array([arc(*row) for row in np.column_stack([drawn, rates])])


def arc(x: float, y: float, heading: float, speed: float, yaw_rate: float) -> Array:
    """Return the pose after a motion along an arc for ``SECONDS``, by closed form."""
    end = heading + yaw_rate * SECONDS
    if abs(yaw_rate) < 1e-9:
        return np.array(
            [x + speed * SECONDS * np.cos(heading), y + speed * SECONDS * np.sin(heading), end]
        )
    r = speed / yaw_rate
    return np.array(
        [x + r * (np.sin(end) - np.sin(heading)), y - r * (np.cos(end) - np.cos(heading)), end]
    )


def scene_pair(case: Case) -> tuple[Scene, Scene]:
    """Return a scene, and the same with the misfit in the variance of y_off only."""
    scene = map_scene(case.lines, case.ego, window=WINDOW, map_error=case.error)
    by_slot = excess_covs(case, STEP)
    excess = np.array([by_slot[line.slot] for line in scene.lines])
    return scene, scene_with_less(scene, excess) if excess.any() else scene


def scenes_by(carry: Callable[[Scene], Scene], case: Case) -> Result:
    """Return the joint distribution of the lines of a scene that ``carry`` brings."""
    scene, reference = scene_pair(case)
    if not scene.lines:
        return Result([], [], [], 0)
    got, expected = carry(scene), carry(reference)
    slots = [line.slot for line in got.lines if line.slot in expected.index]
    lost = len(scene.lines) - len(got.lines)
    if not slots:
        return Result([], [], [], lost)
    joint, wanted = got.joint(slots), expected.joint(slots)
    ranges = np.array([[got.line(slot).x_min, got.line(slot).x_max] for slot in slots])
    given = Given(
        np.ones(1), joint.mean.reshape(1, -1, 4), joint.cov[None], wanted.cov[None], ranges
    )
    return Result([slots], [given], [np.vstack([case.drawn, case.ego.mean])], lost)


def scene_with_less(scene: Scene, excess: Array) -> Scene:
    """Return a scene with a part of what each line has of its own taken off."""
    cov = less(scene.cov, block_diagonal(excess))
    own = np.zeros_like(excess) if scene.own_covs is None else scene.own_covs
    lines = tuple(
        replace(line, gaussian=Gaussian(line.gaussian.mean, block))
        for line, block in zip(scene.lines, diagonal_blocks(cov, 4), strict=True)
    )
    return replace(scene, cov=cov, own_covs=less(own, excess), lines=lines)


def scene_sent(scene: Scene) -> Scene:
    """Return a scene as a receiver gets it, without the lines that do not fit."""
    by = codec("maplines-pose.dbc")
    decoder = by.decoder()
    try:
        messages = by.encode_scene(scene)
    except EncodeError:
        return scene.subset([])
    for frames in messages.values():
        for frame in frames:
            decoder.feed(frame.can_id, frame.data, t_ns=0)
    received = decoder.scene()
    return scene.subset([]) if received is None else received.scene


def mixtures_of_scene(case: Case) -> Result:
    """Return the lines of a scene as mixtures that a receiver makes of it."""
    scene, reference = scene_pair(case)
    result = Result([], [], [], 0)
    for line in scene.lines:
        found, wanted = (scene_mixture(of, line.slot, COMPONENTS) for of in (scene, reference))
        result.slots.append([line.slot])
        result.given.append(
            given_of(
                replace(line, gaussian=found.overall, mixture=found),
                replace(line, gaussian=wanted.overall, mixture=wanted),
            )
        )
        result.poses.append(np.vstack([case.drawn, case.ego.mean]))
    return result


#: What a consumer has of a case, by name.
WAYS: dict[str, Callable[[Case], Result]] = {
    "line": partial(lines_by, as_given, 1),
    "wire": partial(lines_by, sent, 1),
    "scene": partial(scenes_by, lambda scene: scene),
    "scene-wire": partial(scenes_by, scene_sent),
    "scene-mixture": mixtures_of_scene,
    "mixture": partial(lines_by, as_given, COMPONENTS),
    "predicted": partial(lines_by, predicted, 1),
}
