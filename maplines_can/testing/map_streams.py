"""A stream of random maps and poses for the propagation of core and model.

Each step gives both the same lines of a map, and asks for the lines that a car with an uncertain
pose sees, for a scene of them, or for lines as functions of the pose. Many lines are short, noisy,
bent, across the road or elsewhere, and many poses are hardly known. The answers must be equal to
the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from ..model import propagation as model
from ..model.cubic_ranges import Limits
from ..model.refits import Refit as ModelRefit
from ..model.refits import is_across, line_at, refit
from ..model.stretches import Look, Path, Stretches, start_of
from ..propagation import Quadrature, Refit, SigmaPoints, map_lines, map_scene
from ..propagation.transform import Transform
from ..values.errors import MaplinesError
from ..values.gaussian import Gaussian
from ..values.line import LeftOut, MapLine, Slot
from ..values.polyline import INDEXED, Polyline
from ..values.scene import MapError
from .back_to_back import Difference, StreamComparison
from .sender_streams import bits

#: What is asked, in turn.
QUESTIONS = ("lines", "scene", "refit")
#: Steps between two questions whether it is over.
STEPS = 10
#: Kinds of lines; most are along the road.
KINDS = (
    *("straight", "arc", "clothoid", "wave", "kink", "hairpin", "slanted", "across", "behind"),
    *("short", "arc", "clothoid", "straight"),
)
#: Transforms of the pose.
TRANSFORMS: tuple[Transform, ...] = (
    SigmaPoints(),
    SigmaPoints(),
    SigmaPoints(alpha=0.5, beta=1.0),
    SigmaPoints(kappa=2.0),
    SigmaPoints(kappa=40.0),
    Quadrature(2),
    Quadrature(3),
)


class MapQuery(NamedTuple):
    """What core and model are asked."""

    question: str
    lines: list[Polyline]
    pose: Gaussian
    window: tuple[float, float]
    transform: Transform
    error: MapError | None
    max_misfit: float
    max_sigma: float
    #: of a refit: room, step and largest turn
    room: float
    step: float
    max_turn: float
    poses: Any  #: (N, 3) from which it is seen

    def __str__(self) -> str:
        """Return the query as text; the lines are too long for it."""
        rest = self._replace(lines=[], poses=0)._asdict() | {"pose": self.pose.mean.tolist()}
        return f"{len(self.lines)} lines of {[len(x.points) for x in self.lines]} points, {rest}"


def _choice(rng: np.random.Generator, *values: Any) -> Any:
    return values[rng.integers(len(values))]


def random_line(
    rng: np.random.Generator, car: np.ndarray[Any, Any], kinds: Sequence[str] = KINDS
) -> Polyline:
    """Return a line of a map about a car (x, y, heading)."""
    kind = _choice(rng, *kinds)
    spacing = float(_choice(rng, 0.1, 0.5, 1, 2, 2, 5, 5, 10, 25))
    back, ahead = rng.uniform(0, 150), rng.uniform(0, 250)
    if kind == "behind":
        back, ahead = 200.0, -rng.uniform(5, 150)
    elif kind == "short":
        back, ahead = rng.uniform(-3, 5), rng.uniform(-1, 8)
    count = max(2, int((back + ahead) / spacing) + 1)
    if rng.random() < 0.03:
        count = INDEXED + int(rng.integers(1, 500))
        spacing = (back + ahead) / count * float(_choice(rng, 1, 1, 20))
    s = spacing * (np.arange(count) + rng.uniform(-0.4, 0.4, count) * _choice(rng, 0, 1)) - back
    bend = rng.uniform(-1, 1) * _choice(rng, 1e-3, 1e-2, 5e-2, 0.2)
    turn = {
        "arc": bend * s,
        "clothoid": bend * 2e-2 * s**2,
        "wave": 30 * bend * np.sin(s / _choice(rng, 5, 20, 60)),
        "kink": np.where(s > rng.uniform(-10, 60), rng.uniform(-1.5, 1.5), 0.0),
        "hairpin": np.where(s > rng.uniform(0, 60), math.pi * np.tanh((s - 20) / 10), 0.0),
        "slanted": np.full(count, rng.uniform(-1.1, 1.1)),
        "across": np.full(count, _choice(rng, 1.0, 1.2, 1.57)),
    }.get(kind, np.zeros(count))
    turn = turn + car[2] + rng.uniform(-1, 1) * _choice(rng, 0, 0.05, 0.3)
    step = np.diff(s)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])[1:]
    points = np.vstack([[0.0, 0.0], np.cumsum(step, axis=0)])
    here = np.array([np.interp(0.0, s, column) for column in points.T])
    aside = rng.normal() * _choice(rng, 2, 5, 5, 30)
    normal = np.array([-math.sin(car[2]), math.cos(car[2])])
    points += car[:2] - here + aside * normal
    points += rng.normal(size=points.shape) * _choice(rng, 0, 0, 0.01, 0.05, 0.3)
    if rng.random() < 0.1:
        points = np.repeat(points, rng.integers(1, 3, count), axis=0)
    return Polyline(points[:: _choice(rng, 1, -1)])


def random_query(rng: np.random.Generator, question: str) -> MapQuery:
    """Return lines and a pose, which may be known to millimetres or hardly at all."""
    origin = rng.normal(size=2) * _choice(rng, 0, 10, 1e3, 1e6)
    car = np.array([*origin, rng.uniform(-4, 4) * _choice(rng, 0, 1, 1, 30)])
    B = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform([-2, -2, -4], [0.5, 0.3, -0.8])[:, None]
    B *= _choice(rng, 1, 1, 1, 0.1)
    B[2] *= _choice(rng, 1, 1, 1, 4)
    B[:, : rng.choice([0, 0, 0, 1, 2, 3])] = 0
    B = _choice(rng, B, B, np.diag(B.diagonal()))
    kinds: tuple[str, ...] = KINDS
    transform = _choice(rng, *TRANSFORMS)
    if rng.random() < 0.15:  # at some points of the pose, lines are no functions of x
        kinds, transform = ("slanted", "arc"), SigmaPoints(kappa=40.0)
        B = np.diag([0.1, 0.1, rng.uniform(0.07, 0.2)])
    error = MapError(
        point_sigma=float(_choice(rng, 0.0, 0.02, 0.1, 0.3)),
        offset_sigma=float(_choice(rng, 0.0, 0.05, 0.5)),
        heading_sigma=float(_choice(rng, 0.0, 1e-3, 0.02)),
    )
    return MapQuery(
        question,
        [random_line(rng, car, kinds) for _ in range(rng.choice([1, 1, 2, 2, 3, 4, 8]))],
        Gaussian(car, B @ B.T),
        _choice(rng, (-20.0, 80.0), (-20.0, 80.0), (-8.0, 60.0), (-30.0, 130.0), (5.5, 40.25)),
        transform,
        _choice(rng, None, error, error),
        float(_choice(rng, 0.1, 0.1, 0.1, 0.02, 0.5, math.inf)),
        float(_choice(rng, 3.0, 3.0, 1.0, 0.3, 0.1, math.inf)),
        float(_choice(rng, 0.0, 3.0)),
        float(_choice(rng, 0.0, 1.0, 0.5)),
        float(_choice(rng, model.MAX_TURN, 1.45, 0.5)),
        car + rng.uniform(-1, 1, (16, 3)) * [9, 9, _choice(rng, 0.4, 2)],
    )


# ---- the core ---------------------------------------------------------------------------------


def core_answer(query: MapQuery) -> Any:
    """Return the answer of the core; None if it refuses the query."""
    fit: dict[str, Any] = {"map_error": query.error, "max_misfit": query.max_misfit}
    rest: dict[str, Any] = fit | {
        "window": query.window, "transform": query.transform, "max_sigma": query.max_sigma
    }  # fmt: skip
    lines = dict(zip(Slot, query.lines, strict=False))
    try:
        if query.question == "lines":
            found = map_lines(lines, query.pose, **rest)
            return [[_line(line) for line in found], _names(found.left_out)]
        if query.question == "scene":
            scene = map_scene(lines, query.pose, **rest)
            parts = (scene.fit_ranges, scene.quartics, scene.specific_covs) if scene.lines else ()
            own = [_line(line) for line in scene.lines]
            return [own, scene.cov, scene.pose_error.cov, *parts, _names(scene.left_out)]
        fit |= {"max_turn": query.max_turn, "room": query.room, "step": query.step}
        refit = Refit(query.lines, query.pose.mean, query.window, **fit)
    except MaplinesError:
        return None
    try:
        moments = SigmaPoints().moments(refit, query.pose)
    except MaplinesError:  # a line has no value at a point
        moments = None
    return [
        *(refit.x_range, refit.misfit, refit.points, refit.is_across, refit.noise_cov),
        *(refit.quartic, refit(query.poses), moments),
    ]


def _line(line: MapLine) -> Any:
    return [line.slot, line.gaussian.mean, line.gaussian.cov, line.x_min, line.x_max]


def _names(left_out: Mapping[Slot, LeftOut]) -> Any:
    return {slot: reason.name for slot, reason in left_out.items()}


# ---- the model --------------------------------------------------------------------------------


def model_answer(query: MapQuery) -> Any:
    """Return the answer of the model; None if it refuses the query."""
    pose, cov = query.pose.mean.tolist(), query.pose.cov.tolist()
    asked = model.Query(pose, cov, query.window, query.max_misfit, query.max_sigma, query.error)
    if query.question == "refit":
        return _refits(query, asked)
    view = model.pose_view(asked)
    paths = paths_of(query.lines, view.look)
    found: Any
    if query.question == "lines":
        found = model.map_lines(paths, asked, _rule_of(query.transform, cov))
        if found is None:
            return None
        return [[[i, *line] for i, line in found[0].items()], found[1]]
    found = model.map_scene(paths, asked, _rule_of(query.transform, view.pose_cov))
    if found is None:
        return None
    scene, left_out = found
    if scene is None:
        return [[], [], view.pose_cov, left_out]
    given, S = [i for i in range(len(paths)) if i not in left_out], scene.cov
    blocks = [[row[i : i + 4] for row in S[i : i + 4]] for i in range(0, len(S), 4)]
    lines = [
        [i, mean, block, *ends]
        for i, mean, block, ends in zip(given, scene.means, blocks, scene.ranges, strict=True)
    ]
    fit_ranges = [[one.begin, one.end] for one in scene.refits]
    own = [one.noise for one in scene.refits]
    return [lines, S, view.pose_cov, fit_ranges, scene.quartics, own, left_out]


def paths_of(lines: Sequence[Polyline], look: Look) -> list[Path]:
    """Return lines for the model; of long ones what is near the car, which both get."""
    x, y, reach = start_of(look)
    near = [
        line.near(np.array([x, y]), reach) if len(line.points) > INDEXED else line for line in lines
    ]
    return [
        Path(line.points[:, 0].tolist(), line.points[:, 1].tolist(), line.distance.tolist())
        for line in near
    ]


def _rule_of(transform: Any, cov: Any) -> model.Rule:
    """Return the points of a transform; the nodes of a quadrature are NumPy's."""
    if isinstance(transform, SigmaPoints):
        return model.sigma_points(transform.alpha, transform.kappa, transform.beta)
    rule = transform.rule(Gaussian(np.zeros(3), cov))
    return model.Rule(rule.z.tolist(), rule.mean_weights.tolist(), rule.cov_weights.tolist())


def _refits(query: MapQuery, asked: model.Query) -> Any:
    look = Look(asked.mean, *query.window, query.max_turn)
    found, _, left_out = model.seen_of(paths_of(query.lines, look), look)
    if left_out:
        return None
    stretches, limits = Stretches(found), Limits(query.max_misfit, query.room, query.step)
    refits = []
    for i in range(len(query.lines)):
        one = refit(stretches, i, asked.mean, limits, asked.error)
        if one is None:
            return None
        refits.append(one)
    has_noise = asked.error is not None or query.max_misfit < math.inf
    rule = model.sigma_points()
    points = model.rule_points(rule, asked.mean, asked.cov)
    values = [[line_at(one, pose) for one in refits] for pose in points]
    moments = None
    if all(line is not None for row in values for line in row):
        moments = _moments(refits, rule, values)
    return [
        [[one.begin, one.end] for one in refits],
        [one.misfit for one in refits],
        [[[u, v] for u, v in zip(one.x, one.y, strict=True)] for one in refits],
        [is_across(one) for one in refits],
        [one.noise for one in refits] if has_noise else None,
        [one.quartic for one in refits],
        [[line_at(one, pose) or [math.nan] * 4 for one in refits] for pose in query.poses.tolist()],
        moments,
    ]


def _moments(refits: list[ModelRefit], rule: model.Rule, values: Any) -> Any:
    means, covs = [], []
    for one, lines in zip(refits, zip(*values, strict=True), strict=True):
        mean, cov = model.weighted_moments(rule, [*lines])
        means.append(mean)
        covs.append((cov + one.noise).symmetric())
    return [means, covs]


# ---- both -------------------------------------------------------------------------------------


def queries(seed: int) -> Iterator[MapQuery]:
    """Yield the queries of a seed, which are the same ones on any machine."""
    rng = np.random.default_rng(seed)
    for i in count():
        yield random_query(rng, QUESTIONS[i % len(QUESTIONS)])


def compare_maps(seed: int, is_over: Callable[[], bool]) -> StreamComparison:
    """Compare core and model until it is over.

    Args:
        seed: of the queries.
        is_over: asked after every ten queries.
    """
    done = 0
    for query in queries(seed):
        core, answer = bits(core_answer(query)), bits(model_answer(query))
        if core != answer:
            shown = str(query), *first_difference(core, answer)
            return StreamComparison(
                done, "queries of maps", Difference(f"maps, seed {seed}", done, *shown)
            )
        done += 1
        if done % STEPS == 0 and is_over():
            break
    return StreamComparison(done, "queries of maps")


def first_difference(core: Any, answer: Any) -> tuple[str, str, str]:
    """Return where two answers differ first, and what both are there."""
    where = "the answer"
    while isinstance(core, list) and isinstance(answer, list) and len(core) == len(answer):
        i = next(i for i, x in enumerate(core) if x != answer[i])
        where, core, answer = f"{where}[{i}]", core[i], answer[i]
    return where, str(core), str(answer)
