"""Ways by which a consumer gets lines, and what it then has of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

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
from maplines_can.values.errors import EncodeError, MaplinesError

from .sums import Given
from .witness import WINDOW, Array

COMPONENTS = 3
#: The motion of --by predicted: time [s], speed [m/s], and sigmas [m/s, rad/s].
SECONDS, SPEED, MOTION_SIGMA = 1.0, 12.0, (0.3, 0.01)
#: Largest yaw rate of that motion [rad/s].
MAX_YAW_RATE = 0.6
#: From a line, the true poses with the mean one, and random numbers to what a consumer has.
Carry = Callable[[MapLine, Array, np.random.Generator], tuple[MapLine | None, Array]]


class Case(NamedTuple):
    """Lines of a map around a car whose pose is uncertain."""

    lines: Mapping[Slot, Polyline]  #: as the product gets them
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


def distribution(line: MapLine) -> tuple[Array, Array, Array]:
    """Return the shares, means and covariances of the components of a line."""
    if line.mixture is None:
        return np.ones(1), line.gaussian.mean[None], line.gaussian.cov[None]
    return line.mixture.weights, line.mixture.means, line.mixture.covs


def lines_by(carry: Carry, components: int, case: Case) -> Result:
    """Return the lines of ``map_lines`` that ``carry`` brings to a consumer, one by one."""
    lines = map_lines(
        case.lines, case.ego, window=WINDOW, map_error=case.error, components=components
    )
    result = Result([], [], [], 0)
    for line in lines:
        got, drawn = carry(line, np.vstack([case.drawn, case.ego.mean]), case.rng)
        if got is None:
            result = result._replace(lost=result.lost + 1)
            continue
        result.slots.append([line.slot])
        result.given.append(given_of(got))
        result.poses.append(drawn)
    return result


def given_of(line: MapLine) -> Given:
    """Return what a consumer has of a single line."""
    shares, means, covs = distribution(line)
    return Given(shares, means[:, None], covs, np.array([[line.x_min, line.x_max]]))


def over_the_wire(codec: Codec, line: MapLine) -> MapLine | None:
    """Return a line as a receiver gets it; None if it is not usable."""
    decoder, received = codec.decoder(), None
    for frame in codec.encoder().encode(line):
        received = decoder.feed(frame.can_id, frame.data, t_ns=0)
    return received if isinstance(received, MapLine) and received.is_usable else None


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


def scene_of(case: Case) -> Scene:
    """Return the scene of all lines."""
    return map_scene(case.lines, case.ego, window=WINDOW, map_error=case.error)


def scenes_by(carry: Callable[[Scene], Scene], case: Case) -> Result:
    """Return the joint distribution of the lines of a scene that ``carry`` brings."""
    scene = scene_of(case)
    got = carry(scene)
    slots, lost = [line.slot for line in got.lines], len(scene.lines) - len(got.lines)
    if not slots:
        return Result([], [], [], lost)
    joint = got.joint(slots)
    ranges = np.array([[line.x_min, line.x_max] for line in got.lines])
    given = Given(np.ones(1), joint.mean.reshape(1, -1, 4), joint.cov[None], ranges)
    return Result([slots], [given], [np.vstack([case.drawn, case.ego.mean])], lost)


def scene_sent(scene: Scene) -> Scene:
    """Return a scene as a receiver gets it, without the lines that do not fit."""
    by = codec("maplines-pose.dbc")
    decoder = by.decoder()
    try:
        messages = by.encoder().encode_scene(scene)
    except EncodeError:
        return scene.subset([])
    for frames in messages.values():
        for frame in frames:
            decoder.feed(frame.can_id, frame.data, t_ns=0)
    received = decoder.scene()
    return scene.subset([]) if received is None else received.scene


def mixtures_of_scene(case: Case) -> Result:
    """Return the lines of a scene as mixtures that a receiver makes of it."""
    scene, result = scene_of(case), Result([], [], [], 0)
    for line in scene.lines:
        found = scene_mixture(scene, line.slot, COMPONENTS)
        result.slots.append([line.slot])
        result.given.append(given_of(replace(line, gaussian=found.overall, mixture=found)))
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
