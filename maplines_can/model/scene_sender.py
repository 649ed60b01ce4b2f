"""A scene as records: the pose error once, and what is specific to each line.

What a receiver decodes covers the joint covariance of the scene, and the errors of the decoded
means: the sender decodes what it encodes. P' covers P. D covers what is specific to the line, and
the error of its mean. If together they do not cover the scene, since the errors of all means are
one error, the D of the lines concerned are enlarged until they do.

A line is sent with levels, or with all entries of D if these cost too much; but not all lines of a
scene are if there is one that levels cover.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from ..values.line import MIN_RANGE
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import POSE, Owner, PoseLayout
from ..wire.layout.signals import (
    FINE,
    OWN_SIGNALS,
    PARAMETER_SIGNALS,
    POSE_ROWS,
    SLOT_SIGNALS,
    Signal,
)
from .covariance import Code, code_of, encode
from .elementary import exp2, log2
from .joint import block, divergence, factor_or_identity, largest_ratio, uncovered
from .level_search import LevelSearch, Wanted, scaled
from .levels import Levels, LevelSignals, level_covariance
from .lines import Curve, bases, is_function, points_of, sigma_points, spread
from .matrices import (
    Matrix,
    Row,
    added,
    cholesky,
    congruence,
    diagonal,
    eigen,
    inverse,
    lower_solution,
    outer,
    product,
    square,
    subtracted,
    transposed,
)
from .nearest_line import bounds, nearest_line, slope_error
from .records import RawRecord, cholesky_factor, order_of, written
from .rounding import above, below, limited, nearest
from .scenes import RESOLUTION, Pose, common_covariance, enlarged, pose_of
from .signals import of_slot
from .writer import Draft, clipped_mean, stated_range, write

#: Factor on the covariance of the pose error that is covered: a line that is rounded depends on the
#: pose a little differently.
POSE_SLACK = 1.002
#: Largest divergence that levels may cost a line [nat], and the largest ratio of a standard
#: deviation, with levels to without. Beyond them all entries are sent.
LEVELS_KL, LEVELS_RATIO = 0.01, 1.1
#: Repetitions of the enlargement of D, and the share of what the first one lacks; each next one
#: takes twice as much.
TRIALS, FIRST_SHARE = 12, 0.5
#: Order in which the parameters of a mean are rounded: C1, C0, YOff, Beta.
ORDER = (3, 2, 0, 1)
#: What is specific to a line counts up to about this standard deviation [m].
LARGEST_OWN = 2.0**-8


@dataclass(frozen=True)
class SceneDraft:
    """A scene to be sent."""

    lines: Sequence[Draft]
    cov: Matrix  #: (4 L, 4 L) joint covariance
    pose_cov: Matrix  #: positive definite
    correlation_time: float  #: [s]
    offset_sigma: float  #: of the map [m]
    heading_sigma: float  #: of the map [rad]
    fit_ranges: Sequence[tuple[float, float]]
    quartics: Sequence[float]
    specific: Sequence[Matrix] | None  #: line-specific covariances, if they are known


@dataclass
class _Part:
    """A line of a scene while it is encoded."""

    place: int  #: in the scene
    with_levels: dict[str, int]  #: raw values if D is sent as levels
    with_entries: dict[str, int]  #: and if all entries are sent
    mean: Row  #: of the scene
    due_to_pose: Matrix
    specific: Matrix  #: with the excess
    excess: Matrix  #: square of the error of a mean that exceeds the message
    is_full: bool = False  #: all entries are sent
    is_spared: bool = False  #: it has levels whatever they cost
    cost: float = 0.0  #: of levels; more than 1 is too much
    # What a receiver decodes, in the present form:
    curve: Curve = field(init=False)
    J: Matrix = field(default_factory=list)
    common: Matrix = field(default_factory=list)
    error: Matrix = field(default_factory=list)
    more: Matrix = field(default_factory=list)  #: by which D is enlarged
    spacings: list[int] = field(default_factory=list)
    raw: dict[str, int] = field(default_factory=dict)  #: of D
    is_covered: bool = True

    @property
    def known(self) -> Matrix:
        """What D has to cover, of this line alone."""
        return added(self.specific, self.error)

    @property
    def least(self) -> Matrix:
        """Covariance of the resolution of the mean."""
        return scaled(RESOLUTION**2, square(self.J))


class SceneSender:
    """Sender of scenes of a DBC with a message of the pose error."""

    def __init__(self, layout: Layout, pose: PoseLayout) -> None:
        self.layout, self.pose = layout, pose
        self.entries = code_of(layout) if layout.is_conditional else None
        slot = next(iter(layout.messages))
        names = OWN_SIGNALS if layout.is_conditional else [of_slot(slot, n) for n in OWN_SIGNALS]
        of_levels = layout if layout.is_conditional else pose
        self.signals = LevelSignals(*(of_levels[name] for name in names))
        self.search = LevelSearch(self.signals)
        self.own = {
            name: of_levels[name if layout.is_conditional else of_slot(slot, name)]
            for name in (SLOT_SIGNALS[:4] if layout.is_conditional else SLOT_SIGNALS)
        }
        self.mean = [layout[name] for name in PARAMETER_SIGNALS]
        self.range = layout["XMin"], layout["XMax"]

    # ---- records -------------------------------------------------------------------------------

    def records(
        self, scene: SceneDraft, counters: Mapping[Owner, int], age: float, *, full: bool = False
    ) -> dict[Owner, bytes] | None:
        """Return the records of the pose error and of the lines; None if the pose does not fit.

        A conditional line that does not fit is not sent. A complete one is, but belongs to no pose
        error.
        """
        pose_raw = self._raw_pose(scene)
        if pose_raw is None:
            return None
        parts = self._with_levels(scene) if self.entries is None else self._conditional(scene)
        for part in parts:
            part.is_full = full and self.entries is not None
        members = self._encoded(scene, self._decoded(pose_raw), parts)
        records: dict[Owner, bytes] = {}
        slots = {scene.lines[place].slot: raw for place, raw in members.items()}
        following = dict(counters)
        for line in scene.lines:
            counter = counters.get(line.slot, 0)
            if self.entries is None:
                record = write(self.layout, replace(line, age=age), counter)
            elif line.slot in slots:
                has_entries = int("Inflation" in slots[line.slot])
                raw = slots[line.slot] | {"Kind": line.kind, "Counter": counter}
                raw["HasCovariance"] = has_entries
                record = written(self.layout, raw, self.layout.messages[line.slot].data_id)
            else:
                continue
            records[line.slot] = record
            following[line.slot] = (counter + 1) % 2 ** self.layout["Counter"].length
        for slot, signal in self.pose.counters.items():
            then, modulus = following.get(slot, 0), 2**signal.length
            is_member = slot in slots
            pose_raw[signal.name] = (
                counters.get(slot, 0) % modulus if is_member else absent(then - 1, then, modulus)
            )
            if self.entries is None:
                levels = slots.get(slot, {})
                pose_raw |= {of_slot(slot, name): levels.get(name, 0) for name in SLOT_SIGNALS}
        signal = self.pose["Age"]
        pose_raw["Age"] = limited(signal, above(signal, 1000 * age))
        pose_raw["Counter"] = counters.get(POSE, 0)
        data_id = self.layout.messages_of[POSE].data_id
        return {POSE: written(self.pose, pose_raw, data_id)} | records

    def _raw_pose(self, scene: SceneDraft) -> dict[str, int] | None:
        """Return the raw values of the pose error that hold its covariance and its levels."""
        code = code_of(self.pose, tuple(POSE_ROWS))
        coded = encode(code, scaled(POSE_SLACK, scene.pose_cov), least_variances(code))
        if not coded.is_covered:
            return None
        offset, heading, time = (
            self.pose[name] for name in ("MapOffset", "MapHeading", "CorrelationTime")
        )
        long_enough = (
            raw
            for raw in range(1, time.raw_max + 1)
            if exp2(time.physical_one(raw)) >= scene.correlation_time
        )
        return coded.raw | {
            offset.name: level_above(offset, scene.offset_sigma),
            heading.name: level_above(heading, scene.heading_sigma),
            time.name: next(long_enough, 0),
        }

    def _decoded(self, raw: dict[str, int]) -> Pose:
        return pose_of(self.pose, RawRecord(0, raw | {"Age": 0}), 0)

    # ---- lines that can be stated --------------------------------------------------------------

    def _with_levels(self, scene: SceneDraft) -> list[_Part]:
        """Return the lines of complete records that may belong to the pose error.

        The levels are for the mean and the range as sent, without anything that is clipped.
        """
        parts = []
        for place, line in enumerate(scene.lines):
            raw_mean, is_clipped = clipped_mean(self.mean, line.mean)
            ends, _ = stated_range(self.layout, line.x_min, line.x_max)
            low, high = (s.physical_one(raw) for s, raw in zip(self.range, ends, strict=True))
            first, last = self.range
            is_cut = ends != (above(first, line.x_min), below(last, line.x_max)) or not low < high
            begin, end = scene.fit_ranges[place]
            curve = Curve(list(line.mean), begin, end, scene.quartics[place])
            if is_clipped or is_cut or not _is_function(curve):
                continue
            raw = dict(zip((*PARAMETER_SIGNALS, "XMin", "XMax"), (*raw_mean, *ends), strict=True))
            shapes = {"Quartic": curve.quartic, "FitBehind": low - begin, "FitAhead": end - high}
            raw |= {name: self._limited(name, x) for name, x in shapes.items()}
            parts.append(self._part(scene, place, curve, raw, raw))
        return parts

    def _conditional(self, scene: SceneDraft) -> list[_Part]:
        """Return the lines of which the message can state a part."""
        parts = []
        for place, line in enumerate(scene.lines):
            curve = self._stated(scene, place, line)
            if curve is None:
                continue
            part = self._part(scene, place, curve, {}, {})
            factor = rounding_factor(part.specific, bases(curve))
            coarse, fits = rounded_mean(self.mean, curve.mean, factor)
            signals = [refined(s, self.layout[f"{s.name}{FINE}"]) for s in self.mean]
            fine, fine_fits = rounded_mean(signals, curve.mean, factor)
            if not (fits and fine_fits):
                continue
            ends = (curve.begin, curve.end)
            common = {s.name: int(nearest(s, x)) for s, x in zip(self.range, ends, strict=True)}
            common["Quartic"] = self._limited("Quartic", curve.quartic)
            part.with_levels = coarse | common
            part.with_entries = self._split(fine) | common
            parts.append(part)
        return parts

    def _limited(self, name: str, value: float) -> int:
        return limited(self.own[name], nearest(self.own[name], value))

    def _split(self, fine: Mapping[str, int]) -> dict[str, int]:
        """Return raw values of both signals of each parameter."""
        raw = {}
        for signal in self.mean:
            finer = self.layout[f"{signal.name}{FINE}"]
            values = finer.raw_max - finer.raw_min + 1
            steps, rest = divmod(fine[signal.name] - finer.raw_min, values)
            raw[signal.name] = steps if signal.factor > 0 else -steps
            raw[finer.name] = rest + finer.raw_min
        return raw

    def _stated(self, scene: SceneDraft, place: int, line: Draft) -> Curve | None:
        """Return the part of a line that the message can state; None if there is none.

        Of a line with parameters beyond it, that near the car that another cubic follows.
        """
        (begin, end), mean, least = scene.fit_ranges[place], list(line.mean), 0.0
        if not _is_function(Curve(mean, begin, end, scene.quartics[place])):
            return None
        length = end - begin
        limits = [bounds(signal) for signal in self.mean]
        if not all(low <= x <= high for x, (low, high) in zip(mean, limits, strict=True)):
            least = MIN_RANGE + max(line.x_min - begin, 0.0) + max(end - line.x_max, 0.0)
            reach = [math.sqrt(x) for x in code_of(self.layout).reachable]
            near = nearest_line(self.mean, mean, (begin, end), least, reach)
            if near is None:
                return None
            mean, (begin, end) = near
        first, last = (signal.physical_range for signal in self.range)
        begin, end = max(float(math.ceil(begin)), first[0]), min(float(math.floor(end)), last[1])
        if begin > first[1] or end < last[0] or begin >= end or end - begin < least:
            return None
        shorter = (end - begin) / length
        squared = shorter * shorter
        return Curve(mean, begin, end, scene.quartics[place] * (squared * squared))

    def _part(
        self,
        scene: SceneDraft,
        place: int,
        curve: Curve,
        with_levels: dict[str, int],
        with_entries: dict[str, int],
    ) -> _Part:
        """Return a line with the parts of its covariance."""
        mean = list(scene.lines[place].mean)
        error = [x - y for x, y in zip(mean, curve.mean, strict=True)]
        error[1] = slope_error(mean[1], curve.mean[1])
        excess, J = outer(error), bases(curve)
        A = spread(curve._replace(mean=mean), sigma_points(scene.pose_cov))
        due_to_pose = square(A or [[0.0]] * 4)
        if scene.specific is not None:
            specific = scene.specific[place]
        else:
            rest = subtracted(block(scene.cov, place, place), due_to_pose)
            values, V = eigen(congruence(inverse(J), rest))
            roots = [math.sqrt(max(value, 0.0)) for value in values]
            specific = square(
                product(J, [[v * r for v, r in zip(row, roots, strict=True)] for row in V])
            )
        return _Part(
            place, with_levels, with_entries, mean, due_to_pose, added(specific, excess), excess
        )

    # ---- line-specific covariances -------------------------------------------------------------

    def _encoded(
        self, scene: SceneDraft, pose: Pose, parts: list[_Part]
    ) -> dict[int, dict[str, int]]:
        """Return the raw values of the lines that fit, by their places."""
        while parts:
            cheapest = min(parts, key=lambda part: part.cost)
            if all(part.is_full for part in parts) and 0 < cheapest.cost < math.inf:
                cheapest.is_full, cheapest.is_spared = False, True
            are_functions = [self._decode(pose, part) for part in parts]
            if not all(are_functions):
                parts = [part for part, one in zip(parts, are_functions, strict=True) if one]
                continue
            costs = self._cover(scene, pose, parts)
            if any(cost > 1 for cost in costs):  # all entries of these
                for part, cost in zip(parts, costs, strict=True):
                    part.cost = max(part.cost, cost)
                    part.is_full |= cost > 1
                continue
            if all(part.is_covered for part in parts):
                return {part.place: self._raw_of(part) for part in parts}
            by_levels = [
                part
                for part in parts
                if not part.is_covered
                and part.is_full
                and not part.is_spared
                and math.isfinite(part.cost)
            ]
            for part in by_levels:  # entries have ranges; what levels stand for has none
                part.is_full, part.is_spared = False, True
            if not by_levels:
                parts = [part for part in parts if part.is_covered]
        return {}

    def _raw_of(self, part: _Part) -> dict[str, int]:
        if part.is_full:
            return part.with_entries | dict.fromkeys(OWN_SIGNALS, 0) | part.raw
        return part.with_levels | part.raw

    def _decode(self, pose: Pose, part: _Part) -> bool:
        """Set what a receiver decodes of a line without D; whether it is a function of x."""
        raw = part.with_entries if part.is_full else part.with_levels
        mean = [signal.physical_one(raw[signal.name]) for signal in self.mean]
        if part.is_full:
            fine = [self.layout[f"{name}{FINE}"] for name in PARAMETER_SIGNALS]
            mean = [x + s.physical_one(raw[s.name]) for x, s in zip(mean, fine, strict=True)]
        begin, end = (signal.physical_one(raw[signal.name]) for signal in self.range)
        if "FitBehind" in self.own:
            begin -= self.own["FitBehind"].physical_one(raw["FitBehind"])
            end += self.own["FitAhead"].physical_one(raw["FitAhead"])
        part.curve = Curve(mean, begin, end, self.own["Quartic"].physical_one(raw["Quartic"]))
        if not _is_function(part.curve):
            return False
        part.J = bases(part.curve)
        common = common_covariance(pose, part.curve)
        part.common = common if common is not None else diagonal([math.nan] * 4)
        part.error = outer([x - y for x, y in zip(part.mean, mean, strict=True)])
        return True

    def _cover(self, scene: SceneDraft, pose: Pose, parts: list[_Part]) -> list[float]:
        """Set the raw values of D, so that the lines are covered; return the costs of levels."""
        poses = sigma_points(pose.cov)
        of_pose = square([row for part in parts for row in spread(part.curve, poses) or []])
        d = [x - y for part in parts for x, y in zip(part.mean, part.curve.mean, strict=True)]
        keep = [4 * part.place + i for part in parts for i in range(4)]
        true = added([[scene.cov[i][j] for j in keep] for i in keep], outer(d))
        for n, part in enumerate(parts):
            for i in range(4):
                for j in range(4):
                    true[4 * n + i][4 * n + j] += part.excess[i][j]
            part.more = [[0.0] * 4 for _ in range(4)]
            if not part.is_full:
                known = part.known
                wanted = Wanted.of(known, part.common, added(known, part.least), part.J)
                part.spacings = self.search.spacings(wanted, part.curve)
        costs = [self._choose(part) for part in parts]
        for trial in range(TRIALS):
            for n, part in enumerate(parts if trial > 0 else ()):
                if part.is_full or not self._stays(part):
                    costs[n] = self._choose(part)
                else:
                    part.is_covered = True
            if any(cost > 1 for cost in costs) or not all(part.is_covered for part in parts):
                return costs
            own = [self._own(part) for part in parts]
            lacking = uncovered(true, of_pose, own, [part.J for part in parts])
            if lacking is None:
                return costs
            for part, lack in zip(parts, lacking, strict=True):
                part.is_covered = all(math.isfinite(x) for row in lack for x in row)
            if not all(part.is_covered for part in parts):
                return costs
            for part, lack in zip(parts, lacking, strict=True):
                part.more = added(part.more, scaled(FIRST_SHARE * 2.0**trial, lack))
        for part in parts:
            part.is_covered = False
        has_entries = self.entries is not None
        return [math.inf if has_entries and not part.is_full else 0.0 for part in parts]

    def _choose(self, part: _Part) -> float:
        """Set the raw values of D of a line; return what levels cost."""
        known, least = part.known, part.least
        if part.is_full and self.entries is not None:
            target = added(added(known, least), part.more)
            coded = encode(self.entries, target, least_variances(self.entries))
            part.raw, part.is_covered = coded.raw, coded.is_covered
            return 0.0
        wanted = Wanted.of(added(known, part.more), part.common, added(known, least), part.J)
        levels, part.is_covered = self.search.encode(wanted, part.curve, part.spacings)
        part.raw = dict(zip(OWN_SIGNALS, levels, strict=True))
        if self.entries is None:
            return 0.0
        if not part.is_covered:
            return math.inf
        if part.is_spared:
            return 0.0
        to_metres = inverse(part.J)
        decoded = added(level_covariance(self.signals, levels, part.curve), part.common)
        true = congruence(to_metres, added(part.specific, least))
        whole = congruence(to_metres, added(added(part.due_to_pose, known), least))
        due_to_pose = congruence(to_metres, part.due_to_pose)
        kl = divergence(whole, added(due_to_pose, decoded))
        return max(kl / LEVELS_KL, largest_ratio(decoded, true) / LEVELS_RATIO**2)

    def _stays(self, part: _Part) -> bool:
        """Whether the levels of a line still cover it."""
        target = added(part.known, part.more)
        levels = Levels(*(part.raw[name] for name in OWN_SIGNALS))
        return self.search.covered(levels, target, part.common, part.J, part.curve)

    def _own(self, part: _Part) -> Matrix:
        """Return D as a receiver decodes it."""
        if part.is_full:
            rows = order_of(self.layout, PARAMETER_SIGNALS)
            F = cholesky_factor(self.layout, PARAMETER_SIGNALS, part.raw)
            return square([F[rows.index(name)] for name in PARAMETER_SIGNALS])
        levels = Levels(*(part.raw[name] for name in OWN_SIGNALS))
        cov = added(level_covariance(self.signals, levels, part.curve), part.common)
        return square(product(part.J, cholesky(enlarged(cov))))


def _is_function(curve: Curve) -> bool:
    return curve.begin < curve.end and is_function(points_of(curve))


def least_variances(code: Code) -> Row:
    """Return the least variances that a code can decode to, for targets that are singular."""
    found = [0.0] * len(code.order)
    for state, pivot in zip(code.order, code.pivots, strict=True):
        found[state] = exp2(2 * pivot.physical_range[0])
    return found


def level_above(signal: Signal, sigma: float) -> int:
    """Return the raw value of the least level from sigma on, or the greatest; 0 for 0."""
    if sigma <= 0:
        return 0
    raw = math.ceil((log2(sigma) - signal.offset) / signal.factor - 1e-9)
    return min(max(raw, 1), signal.raw_max)


def absent(last: int, following: int, modulus: int) -> int:
    """Return what a pose error states for a slot without a record of its cycle.

    It is as far as possible from the counters of the records of other cycles: those up to ``last``,
    and those from ``following`` on.

    >>> absent(255, 256, 8), absent(7, 11, 8)  # the second: a mixture of 3 components
    (4, 1)
    """
    both = (last - following) % modulus  # steps ahead of ``following`` and behind ``last``
    if both + modulus <= 2 * (modulus - 1):
        both += modulus
    return (following + (both + 1) // 2) % modulus


# ---- rounding of means ------------------------------------------------------------------------


def rounding_factor(own: Matrix, J: Matrix) -> Matrix:
    """Return the Cholesky factor of what the rounding errors of a mean are to be like.

    An error is to be small where the line-specific covariance is the least: the covariance must
    cover the error, which would enlarge it most there. In metres, eigenvalues x of D are limited to
    x / (1 + x / LARGEST_OWN^2).
    """
    identity, most = diagonal([1.0] * 4), LARGEST_OWN**2
    in_metres = congruence(inverse(J), own)
    shares = [[x / most for x in row] for row in in_metres]
    root = lower_solution(factor_or_identity(added(identity, shares)), identity)
    limit = scaled(most + RESOLUTION**2, identity)
    cov = congruence(J, subtracted(limit, scaled(most, product(transposed(root), root))))
    return factor_or_identity([[cov[i][j] for j in ORDER] for i in ORDER])


def rounded_mean(signals: Sequence[Signal], mean: Row, L: Matrix) -> tuple[dict[str, int], bool]:
    """Return the raw values of a mean, and whether they fit.

    Each parameter is rounded to its conditional mean given the errors of those before it, so the
    error of the lateral position is small all over the range.
    """
    raw, fits, errors = dict[str, int](), True, list[float]()
    for row, state in enumerate(ORDER):
        signal, expected = signals[state], 0.0
        for column, error in enumerate(errors):
            expected += L[row][column] * error
        wanted = nearest(signal, mean[state] + expected)
        raw[signal.name] = limited(signal, wanted)
        fits = fits and wanted == raw[signal.name]
        error = signal.physical_one(raw[signal.name]) - mean[state]
        errors.append((error - expected) / L[row][row])
    return raw, fits


def refined(signal: Signal, fine: Signal) -> Signal:
    """Return one signal for the sum of two, with the steps of the finer one."""
    values = fine.raw_max - fine.raw_min + 1
    ends = (signal.raw_min, signal.raw_max)
    low, high = ends if signal.factor > 0 else (-ends[1], -ends[0])
    return replace(
        signal,
        factor=fine.factor,
        offset=signal.offset + fine.offset,
        raw_min=values * low + fine.raw_min,
        raw_max=values * high + fine.raw_max,
    )
