"""A scene as records: the pose error, and what is specific to each line.

What a receiver decodes covers the joint covariance of the scene, and the errors of the decoded
means: the sender decodes what it encodes. P' covers P. D covers what is specific to the line, and
the error of its mean. If together they do not cover the scene, since the errors of all means are
one error, the D of the lines concerned are enlarged until they do.

A line is sent with levels, or with all entries of D if these cost too much; but not all lines of a
scene are if there is one that levels cover. Whole scenes have levels only. They cover all lines of
a scene together, whether these have a place in one record, in two, or none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from ..values.line import MIN_RANGE, Slot
from ..wire.layout import record_signals as names
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import POSE, SCENE, SCENE2, Owner, PoseLayout
from ..wire.layout.record_signals import PARAMETER_SIGNALS, Signal
from ..wire.layout.scene_layout import SceneLayout
from .covariance import code_of, encode, least_variances, reachable
from .elementary import exp2, log2
from .joint import divergence, factor_or_identity, largest_ratio, uncovered
from .level_search import LevelSearch, Wanted, shortfall
from .levels import level_covariance
from .lines import Curve, bases, changes_of, is_line, spread
from .matrices import Matrix, Vector, diagonal, matrix
from .nearest_line import bounds, nearest_line, slope_error
from .places import Candidate, Places, chosen
from .records import RawRecord, written
from .scenes import (
    RESOLUTION,
    Pose,
    common_covariance,
    curve_of,
    own_covariance,
    pose_of,
    signals_of_slot,
)
from .signals import Raw, above, below, limited, nearest, nearest_limited, of_slot, value
from .whole_scenes import NONE, REASONS, joint_bits, write_whole
from .writer import Draft, clipped_mean, mean_signals, physical_range, stated_range, write

#: Factor on the covariance of the pose error that is covered: a line that is rounded depends on the
#: pose a little differently.
POSE_SLACK = 1.002
#: Largest divergence that levels may cost a line [nat], and the largest ratio of a variance, with
#: levels to without. Beyond them all entries are sent.
LEVELS_KL, LEVELS_RATIO = 0.01, 1.1 * 1.1
#: Repetitions of the enlargement of D, and the share of what the first one lacks; each next one
#: takes twice as much.
TRIALS, FIRST_SHARE = 12, 0.5
#: Order in which the parameters of a mean are rounded: C1, C0, YOff, Beta.
ORDER = (3, 2, 0, 1)
#: What is specific to a line counts up to about this standard deviation [m].
LARGEST_OWN = 2.0**-8
#: Largest mean and standard deviation of a line that is encoded: no D covers more.
LARGEST = 1e50
IDENTITY, UNBOUNDED = diagonal([1.0] * 4), Vector([math.inf] * 4)


@dataclass(frozen=True)
class SceneDraft:
    """A scene to be sent."""

    lines: Sequence[Draft]
    cov: Matrix  #: (4 L, 4 L) joint covariance
    pose_cov: Matrix  #: may be singular
    correlation_time: float  #: [s]
    offset_sigma: float  #: of the map [m]
    heading_sigma: float  #: of the map [rad]
    fit_ranges: Sequence[tuple[float, float]]
    quartics: Sequence[float]
    specific: Sequence[Matrix] | None  #: line-specific covariances, if they are known


class SentScene(NamedTuple):
    """Records of a scene."""

    records: dict[Owner, bytes]
    #: Why lines belong to no pose error: ACROSS, RANGE, MEAN, COVARIANCE; or have no PLACE.
    left_out: dict[Slot, str]
    places: Places = Places()  #: of whole scenes


class UnseenError(Exception):
    """What the pose error does to a line overflows."""


@dataclass
class _Member:
    """A line of a scene while it is encoded."""

    slot: Slot
    place: int  #: in the scene
    with_levels: dict[str, int]  #: raw values but for D, if that is sent as levels
    with_entries: dict[str, int]  #: and if all entries are sent
    mean: Vector  #: of the scene
    due_to_pose: Matrix
    excess: Matrix  #: square of the error of a mean that exceeds the message
    specific: Matrix  #: with the excess
    is_full: bool = False  #: all entries are sent
    is_spared: bool = False  #: it has levels whatever they cost
    cost: float = 0.0  #: of levels; more than 1 is too much
    # What a receiver decodes, in the present form:
    curve: Curve = field(init=False)
    J: Matrix = field(init=False)
    common: Matrix = field(init=False)
    known: Matrix = field(init=False)  #: what D has to cover, of this line alone
    least: Matrix = field(init=False)  #: covariance of the resolution of the mean
    more: Matrix = field(init=False)  #: by which D is enlarged
    spacings: list[int] = field(init=False)
    raw_own: dict[str, int] = field(default_factory=dict)  #: of D
    is_covered: bool = True

    @property
    def raw(self) -> dict[str, int]:
        """Raw values of the record."""
        return (self.with_entries if self.is_full else self.with_levels) | self.raw_own

    @property
    def wanted(self) -> Wanted:
        """What levels have to cover."""
        to_metres = self.J.inverse()
        covered = to_metres.congruence(self.known + self.more) - self.common
        return Wanted(covered, self.common, to_metres.congruence(self.known + self.least))


class SceneSender:
    """Sender of scenes of a DBC whose records have a pose error."""

    def __init__(self, layout: Layout, pose: PoseLayout | SceneLayout) -> None:
        self.layout, self.pose = layout, pose
        self.own = signals_of_slot(layout, next(iter(layout.messages), Slot.EGO_LEFT))
        self.search = LevelSearch(self.own)
        self.mean = mean_signals(layout)
        #: Records of lines can have all entries of D.
        self.has_entries = "HasCovariance" in layout.signals

    # ---- records -------------------------------------------------------------------------------

    def send(
        self,
        scene: SceneDraft,
        counters: Mapping[Owner, int],
        ages: Mapping[Owner, float],
        *,
        full: bool = False,
        last: Places | None = None,
        secured: bool = False,
    ) -> SentScene | None:
        """Return the records of the pose error and of the lines, with these counters and ages [s].

        A conditional line that does not fit is not sent. A complete one is, but belongs to no pose
        error. None if the pose error does not fit, or a line is no function of x near the mean
        pose. If ``full``, all entries of conditional lines are sent. Of whole scenes, ``last`` are
        the places of the last cycle, and an authenticated record has fewer.
        """
        specific = None if scene.specific is None else [*map(matrix, scene.specific)]
        cov, pose_cov = matrix(scene.cov), matrix(scene.pose_cov)
        scene = replace(scene, cov=cov, pose_cov=pose_cov, specific=specific)
        left_out: dict[Slot, str] = {}
        try:
            members = self._members(scene, left_out)
            for member in members:
                member.is_full = full and self.has_entries
            pose_raw = self._raw_pose(scene)
            if pose_raw is None:
                return None
            pose = pose_of(self.pose, RawRecord(0, pose_raw | {"Age": 0}), 0)
            sent = {own.slot: own for own in self._encoded(scene, pose, members, left_out)}
        except UnseenError:
            return None
        if isinstance(self.pose, SceneLayout):
            places = self._places(scene, left_out, last or Places(), secured=secured)
            parts = self.pose, scene, pose_raw, sent, left_out
            return self._whole(*parts, places, counters, ages, secured=secured)
        records: dict[Owner, bytes] = {}
        following = dict(counters)
        for line in scene.lines:
            slot, counter = line.slot, counters.get(line.slot, 0)
            if not self.layout.is_conditional:
                records[slot] = write(self.layout, replace(line, age=ages[slot]), counter)
            elif slot in sent:
                raw = sent[slot].raw | {"Kind": line.kind, "Counter": counter}
                records[slot] = written(self.layout, raw, self.layout.messages[slot].data_id)
            else:
                continue
            following[slot] = (counter + 1) % 2 ** self.layout["Counter"].length
        for slot, signal in self.pose.counters.items():
            then, modulus = following.get(slot, 0), 2**signal.length
            is_member = slot in sent
            pose_raw[signal.name] = (
                counters.get(slot, 0) % modulus if is_member else absent(then - 1, then, modulus)
            )
            if not self.layout.is_conditional:
                levels = sent[slot].raw if is_member else {}
                pose_raw |= {
                    of_slot(slot, name): levels.get(name, 0) for name in names.SLOT_SIGNALS
                }
        pose_raw["Age"] = raw_age(self.pose, ages[POSE])
        pose_raw["Counter"] = counters.get(POSE, 0)
        data_id = self.layout.messages_of[POSE].data_id
        return SentScene({POSE: written(self.pose, pose_raw, data_id), **records}, left_out)

    def _places(
        self, scene: SceneDraft, left_out: Mapping[Slot, str], last: Places, *, secured: bool
    ) -> Places:
        """Return the places of the lines of a scene."""
        candidates = [
            Candidate(
                line.slot, Curve(Vector(line.mean), *scene.fit_ranges[i]), line.slot in left_out
            )
            for i, line in enumerate(scene.lines)
        ]
        return chosen(self.messages(secured=secured), candidates, last)

    def _whole(
        self,
        layout: SceneLayout,
        scene: SceneDraft,
        pose_raw: Raw,
        sent: Mapping[Slot, _Member],
        left_out: Mapping[Slot, str],
        places: Places,
        counters: Mapping[Owner, int],
        ages: Mapping[Owner, float],
        *,
        secured: bool,
    ) -> SentScene:
        """Return the records of a whole scene, ``Scene`` last, since it completes the scene."""
        kinds = {line.slot: line.kind for line in scene.lines}
        length = layout.secured_bytes if secured else layout.record_bytes
        records = dict[Owner, bytes]()
        for owner, slots in ((SCENE2, places.scene2), (SCENE, places.scene)):
            if slots is None:
                continue
            lines = list[Raw]()
            for fixed, slot in zip(layout.fixed[owner], slots, strict=False):
                named = {} if fixed is not None or slot is None else {"Slot": int(slot)}
                if slot is None:
                    lines.append({"Kind": NONE})
                elif slot in left_out:
                    lines.append({"Kind": NONE + 1 + REASONS.index(left_out[slot])} | named)
                else:
                    lines.append(sent[slot].raw | {"Kind": kinds[slot]} | named)
            raw = {
                **pose_raw,
                "Age": raw_age(layout, ages[owner]),
                "Counter": counters.get(owner, 0),
                "SceneCounter": joint_bits(layout, counters.get(SCENE, 0)),
            }
            data_id = layout.messages[owner].data_id
            records[owner] = write_whole(layout, raw, lines, length, data_id)
        placed = {*places.scene, *(places.scene2 or ())}
        no_place = {slot: "PLACE" for slot in sent if slot not in placed}
        return SentScene(records, {**left_out, **no_place}, places)

    def messages(self, *, secured: bool) -> list[tuple[Slot | None, ...]]:
        """Return the slots of the places of the messages of whole scenes that can be sent."""
        layout = self.pose
        assert isinstance(layout, SceneLayout)  # noqa: S101 - others have no places
        count = layout.secured_places if secured else layout.places
        return [
            layout.fixed[owner][:count]
            for owner, own in layout.messages.items()
            if (own.secured_can_id if secured else own.fd_can_id) is not None
        ]

    def _raw_pose(self, scene: SceneDraft) -> dict[str, int] | None:
        """Return the raw values of the pose error that hold its covariance and its levels."""
        code, time = code_of(self.pose, names.POSE_ROWS), self.pose["CorrelationTime"]
        coded = encode(code, POSE_SLACK * scene.pose_cov, least_variances(code))
        if not coded.is_covered:
            return None
        sigmas = {"MapOffset": scene.offset_sigma, "MapHeading": scene.heading_sigma}
        levels = {name: level_above(self.pose[name], sigma) for name, sigma in sigmas.items()}
        times = range(1, time.raw_max + 1)
        long_enough = (raw for raw in times if exp2(value(time, raw)) >= scene.correlation_time)
        return coded.raw | levels | {time.name: next(long_enough, 0)}

    # ---- lines that can be stated --------------------------------------------------------------

    def _members(self, scene: SceneDraft, left_out: dict[Slot, str]) -> list[_Member]:
        """Return the lines that the message can state, or parts of them."""
        members = []
        of_form = self._conditional if self.layout.is_conditional else self._complete
        for place, line in enumerate(scene.lines):
            curve = Curve(Vector(line.mean), *scene.fit_ranges[place], scene.quartics[place])
            found = of_form(scene, place, curve) if is_possible(scene, place, curve) else "ACROSS"
            if isinstance(found, str):
                left_out[line.slot] = found
            else:
                members.append(found)
        return members

    def _complete(self, scene: SceneDraft, place: int, curve: Curve) -> _Member | str:
        """Return a line of a complete record that may belong to the pose error.

        The levels are for the mean and the range as sent, without anything that is clipped.
        """
        line, first, last = scene.lines[place], self.layout["XMin"], self.layout["XMax"]
        raw_mean, is_clipped = clipped_mean(self.layout, line.mean)
        ends, _ = stated_range(self.layout, line.x_min, line.x_max)
        low, high = physical_range(self.layout, ends)
        is_cut = ends != (above(first, line.x_min), below(last, line.x_max)) or not low < high
        if is_clipped or is_cut:
            return "RANGE"
        raw = dict(zip((*PARAMETER_SIGNALS, "XMin", "XMax"), (*raw_mean, *ends), strict=True))
        shapes = {"Quartic": curve.quartic, "FitBehind": low - curve.begin}
        for name, x in (shapes | {"FitAhead": curve.end - high}).items():
            raw[name] = nearest_limited(self.own[name], x)
        return self._member(scene, place, curve, raw)

    def _conditional(self, scene: SceneDraft, place: int, curve: Curve) -> _Member | str:
        """Return a line of which the message can state a part: in either form."""
        stated = self._stated(scene.lines[place], curve)
        if isinstance(stated, str):
            return stated
        ends = {"XMin": stated.begin, "XMax": stated.end}
        common = {name: int(nearest(self.layout[name], x)) for name, x in ends.items()}
        if "Quartic" in self.own:
            common["Quartic"] = nearest_limited(self.own["Quartic"], stated.quartic)
        member = self._member(scene, place, stated, common)
        factor = rounding_factor(member.specific, bases(stated))
        coarse = rounded_mean(self.mean, stated.mean, factor)
        if not self.has_entries:
            member.with_levels = (coarse or {}) | common
            return "MEAN" if coarse is None else member
        fines = [self.layout[name] for name in names.FINE_SIGNALS]
        fine = rounded_mean(list(map(refined, self.mean, fines)), stated.mean, factor)
        if coarse is None or fine is None:
            return "MEAN"
        for signal, of_fine in zip(self.mean, fines, strict=True):  # raw values of both
            steps = of_fine.raw_max - of_fine.raw_min + 1
            fine[signal.name], rest = divmod(fine[signal.name] - of_fine.raw_min, steps)
            fine[of_fine.name] = rest + of_fine.raw_min
        no_levels = dict.fromkeys(names.OWN_SIGNALS, 0)
        member.with_levels = coarse | common | {"HasCovariance": 0}
        member.with_entries = fine | common | no_levels | {"HasCovariance": 1}
        return member

    def _stated(self, line: Draft, curve: Curve) -> Curve | str:
        """Return the part of a line that the message can state.

        Of a line with parameters beyond it, that near the car that another cubic follows.
        """
        mean, begin, end, quartic = curve
        length, least = end - begin, 0.0
        limits = [bounds(signal) for signal in self.mean]
        if not all(low <= x <= high for x, (low, high) in zip(mean, limits, strict=True)):
            least = MIN_RANGE + (max(line.x_min - begin, 0.0) + max(end - line.x_max, 0.0))
            # Levels alone have no bounds of their own.
            reach = reachable(code_of(self.layout)) if self.has_entries else UNBOUNDED
            near = nearest_line(self.mean, mean, (begin, end), least, reach)
            if near is None:
                return "MEAN"
            mean, (begin, end) = near
        first, last = (self.layout[name].physical_range for name in ("XMin", "XMax"))
        begin, end = max(float(math.ceil(begin)), first[0]), min(float(math.floor(end)), last[1])
        if begin > first[1] or end < last[0] or begin >= end or end - begin < least:
            return "RANGE"
        shorter = (end - begin) / length
        squared = shorter * shorter
        return Curve(mean, begin, end, quartic * (squared * squared))

    def _member(self, scene: SceneDraft, place: int, curve: Curve, raw: dict[str, int]) -> _Member:
        """Return a line with the parts of its covariance."""
        line, mean, J = scene.lines[place], Vector(scene.lines[place].mean), bases(curve)
        A = spread(changes_of(curve._replace(mean=mean)), scene.pose_cov)
        if A is None:
            raise UnseenError
        error = mean - curve.mean
        error[1] = slope_error(mean[1], curve.mean[1])
        due_to_pose, excess = A @ A.T, error.outer()
        if scene.specific is not None:
            specific = scene.specific[place]
        else:
            rest = scene.cov.block_of(place, place) - due_to_pose
            values, V = J.inverse().congruence(rest).eigen()
            roots = Vector(math.sqrt(max(x, 0.0)) for x in values)
            root = J @ Matrix(row * roots for row in V)
            specific = root @ root.T
        return _Member(line.slot, place, raw, raw, mean, due_to_pose, excess, specific + excess)

    # ---- line-specific covariances -------------------------------------------------------------

    def _encoded(
        self, scene: SceneDraft, pose: Pose, members: list[_Member], left_out: dict[Slot, str]
    ) -> list[_Member]:
        """Return the lines that fit, with the raw values of D."""
        while members:
            cheapest = min(members, key=lambda one: (not math.isnan(one.cost), one.cost))
            if all(one.is_full for one in members) and 0 < cheapest.cost < math.inf:
                cheapest.is_full, cheapest.is_spared = False, True
            for one in members:
                one.curve = curve_of(self.layout, self.own, one.raw)
                one.is_covered = is_line(one.curve)
            if not all(one.is_covered for one in members):
                members = _kept(members, left_out, "ACROSS")
                continue
            costs = self._cover(scene, pose, members)
            if any(cost > 1 for cost in costs):  # all entries of these
                for one, cost in zip(members, costs, strict=True):
                    one.cost = cost if math.isnan(cost) or cost > one.cost else one.cost
                    one.is_full |= cost > 1
                continue
            if all(one.is_covered for one in members):
                return members
            by_levels = [
                one
                for one in members
                if not (one.is_covered or one.is_spared) and one.is_full and one.cost < math.inf
            ]
            for one in by_levels:  # entries have ranges; what levels stand for has none
                one.is_full, one.is_spared = False, True
            if not by_levels:
                members = _kept(members, left_out, "COVARIANCE")
        return []

    def _cover(self, scene: SceneDraft, pose: Pose, members: list[_Member]) -> list[float]:
        """Set the raw values of D, so that the lines are covered; return the costs of levels."""
        of_pose, true = self._decoded(scene, pose, members)
        costs = [0.0] * len(members)
        for trial in range(TRIALS):
            for n, one in enumerate(members):
                if trial == 0 or one.is_full or not self._is_enough(one):
                    costs[n] = self._choose(one)
            if any(cost > 1 for cost in costs) or not all(one.is_covered for one in members):
                return costs
            own = [
                own_covariance(self.layout, self.own, one.raw, one.curve, one.common)
                for one in members
            ]
            lacking = uncovered(true, of_pose, own, [one.J for one in members])
            if lacking is None:
                return costs
            for one, lack in zip(members, lacking, strict=True):
                one.is_covered = lack.is_finite()
                one.more += FIRST_SHARE * 2.0**trial * lack
            if not all(one.is_covered for one in members):
                return costs
        for one in members:
            one.is_covered = False
        return [math.inf if self.has_entries and not one.is_full else 0.0 for one in members]

    def _decoded(
        self, scene: SceneDraft, pose: Pose, members: list[_Member]
    ) -> tuple[Matrix, Matrix]:
        """Set what a receiver decodes of lines without D.

        Return the joint covariance that the pose error causes, and the one that is to be covered.
        """
        A, errors = Matrix(), Vector()
        for one in members:
            error = one.mean - one.curve.mean
            changes = changes_of(one.curve)
            rows, common = spread(changes, pose.cov), common_covariance(pose, changes)
            if rows is None:
                raise UnseenError
            one.J, one.common, one.known = changes.bases, common, one.specific + error.outer()
            one.least, one.more = RESOLUTION**2 * (one.J @ one.J.T), diagonal([0.0] * 4)
            if not one.is_full:
                one.spacings = self.search.spacings(one.wanted, one.curve)
            A.extend(rows)
            errors.extend(error)
        keep = [4 * one.place + i for one in members for i in range(4)]
        true = scene.cov.block(keep, keep) + errors.outer()
        return A @ A.T, true.with_blocks([one.excess for one in members])

    def _choose(self, one: _Member) -> float:
        """Set the raw values of D of a line; return what levels cost."""
        if one.is_full:
            code = code_of(self.layout)
            coded = encode(code, one.known + one.least + one.more, least_variances(code))
            one.raw_own, one.is_covered = coded.raw, coded.is_covered
            return 0.0
        one.raw_own, one.is_covered = self.search.encode(one.wanted, one.curve, one.spacings)
        if not self.has_entries:
            return 0.0
        if not one.is_covered:
            return math.inf
        if one.is_spared:
            return 0.0
        to_metres = one.J.inverse()
        decoded = level_covariance(self.own, one.raw_own, one.curve) + one.common
        true = to_metres.congruence(one.specific + one.least)
        whole = to_metres.congruence(one.due_to_pose + one.known + one.least)
        kl = divergence(whole, to_metres.congruence(one.due_to_pose) + decoded)
        return max(largest_ratio(decoded, true) / LEVELS_RATIO, kl / LEVELS_KL)  # NaN stays

    def _is_enough(self, one: _Member) -> bool:
        """Whether the levels of a line still cover it."""
        own = level_covariance(self.own, one.raw_own, one.curve)
        return shortfall(own - one.wanted.target) <= 0


def _kept(members: list[_Member], left_out: dict[Slot, str], reason: str) -> list[_Member]:
    """Return the lines that are covered; the others are left out."""
    left_out |= {one.slot: reason for one in members if not one.is_covered}
    return [one for one in members if one.is_covered]


def is_possible(scene: SceneDraft, place: int, curve: Curve) -> bool:
    """Whether a line is a function of x, with covariances that do not overflow."""
    covs = [scene.cov.block_of(place, place)]
    covs += [] if scene.specific is None else [scene.specific[place]]
    is_small = all(x <= LARGEST * LARGEST for cov in covs for x in cov.diagonal())
    return is_small and all(abs(x) <= LARGEST for x in curve.mean) and is_line(curve)


def raw_age(layout: PoseLayout | SceneLayout, age: float) -> int:
    """Return the raw value of an age [s], rounded up."""
    return limited(layout["Age"], above(layout["Age"], 1000 * age))


def level_above(signal: Signal, sigma: float) -> int:
    """Return the raw value of the least level from sigma on, or the greatest; 0 for 0."""
    if sigma <= 0:
        return 0
    return limited(signal, max(math.ceil((log2(sigma) - signal.offset) / signal.factor - 1e-9), 1))


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
    most = LARGEST_OWN**2
    shares = 1 / most * J.inverse().congruence(own)
    root = factor_or_identity(IDENTITY + shares).lower_solution(IDENTITY)
    limit = (most + RESOLUTION**2) * IDENTITY - most * (root.T @ root)
    return factor_or_identity(J.congruence(limit).block(ORDER, ORDER))


def rounded_mean(signals: Sequence[Signal], mean: Vector, L: Matrix) -> dict[str, int] | None:
    """Return the raw values of a mean; None if they do not fit.

    Each parameter is rounded to its conditional mean given the errors of those before it, so the
    error of the lateral position is small all over the range.
    """
    raw, errors = dict[str, int](), Vector()
    for row, state in zip(L, ORDER, strict=True):
        signal, expected = signals[state], errors @ row
        wanted = nearest(signal, mean[state] + expected)
        raw[signal.name] = limited(signal, wanted)
        if wanted != raw[signal.name]:
            return None
        rest = value(signal, raw[signal.name]) - mean[state] - expected
        errors.append(rest / row[len(errors)])
    return raw


def refined(signal: Signal, fine: Signal) -> Signal:
    """Return one signal for the sum of two, with the steps of the finer one."""
    steps = fine.raw_max - fine.raw_min + 1
    return replace(
        signal,
        factor=fine.factor,
        offset=signal.offset + fine.offset,
        raw_min=steps * signal.raw_min + fine.raw_min,
        raw_max=steps * signal.raw_max + fine.raw_max,
    )
