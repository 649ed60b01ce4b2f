"""Encoder of scenes, for the receiver of ``scene_code``.

The joint covariance C that a receiver decodes covers that of the scene plus the errors of the
decoded means, since the encoder decodes what it encodes. P' covers P. D_i covers what the line has
of its own, and the error of its mean. If together they do not cover the scene, since the errors of
all means are one error, and the lines differ from f_i in different ways, the D_i of the lines
concerned are enlarged until they do.

Lines for which levels cost too much send all entries; but not all lines of a scene do if there is
one that levels cover, so that a scene with its pose error takes no more frames than complete
records.

The message can state a part of all lines. Of a line with a range beyond it, the part within is
sent. Of a line with parameters beyond it, that near the car that another cubic follows closely
enough, whose deviation is covered like any error of a mean.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.errors import EncodeError, IllPosedError
from ...values.linalg import block_diagonal, diagonal_blocks, positive_part
from ...values.line import LeftOut
from ...values.scene import Scene
from ...values.seen_lines import SeenLines, bases
from ..layout.signals import Signal
from .cholesky import CholeskyCode
from .code import Array
from .joint import divergence, largest_ratio, uncovered
from .nearest_line import is_within, nearest_line, slope_error
from .rounding import refined, rounded_means, split
from .scene_code import FORM, RESOLUTION, DecodedLines, Rows, SceneCode

#: Largest divergence that levels may cost a line; beyond it all entries are sent [nat].
LEVELS_KL = 0.01
#: Largest ratio of a standard deviation of what a line has of its own, with levels to without.
LEVELS_RATIO = 1.1
#: Factor on the covariance of the pose error that is covered. A line that is rounded depends on the
#: pose a little differently; what that does is much less, but not little to what lines have of
#: their own.
POSE_SLACK = 1.002
#: Repetitions of the enlargement of D_i.
TRIALS = 12
#: Share of what the first trial lacks by which D_i are enlarged; each next one takes twice as much.
FIRST_SHARE = 0.5
#: Largest standard deviation of a line that is encoded: no D_i covers more, and none overflows.
LARGEST = 1e50
#: Least valid range of a line of which a part is sent [m].
MIN_RANGE = 1.0
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class EncodedScene:
    """Raw values of a scene by signal: of the Pose record and of the lines' records."""

    pose: dict[str, int]
    lines: dict[int, dict[str, int]]  #: by their places in the scene; lines that do not fit lack
    decoded: DecodedLines | None  #: what a receiver decodes; None without lines
    left_out: dict[int, LeftOut]  #: why the other lines do not fit, by their places


class SceneEncoder:
    """Encoder of the raw values of a Pose record and of the records of lines.

    Args:
        code: of the receiver.
    """

    def __init__(self, code: SceneCode) -> None:
        self._code = code
        self._refined = [refined(*pair) for pair in zip(code.mean, code.fine, strict=False)]
        self._reach = np.zeros(4) if code.own_code is None else code.own_code.reach

    def encode(self, scene: Scene, *, full: bool = False) -> EncodedScene:
        """Encode a scene for records that are conditional on the pose.

        Lines that do not fit are left out, with a reason: the message can state no part of the
        line that is long enough, or no covariance of it covers what the line has of its own.

        Args:
            scene: the lines with their joint covariance.
            full: send all entries of each D_i, not levels, unless only levels cover it.

        Raises:
            EncodeError: the pose error does not fit.
        """
        rows: list[Rows] = []
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # if it does not fit
            stated = self._stated(scene)
            fits = np.array([i not in stated.left_out for i in range(len(scene.lines))], dtype=bool)
            parts = _Parts.of(scene, stated, fits)
            for mean in (self._code.mean, self._refined):
                raw, within = rounded_means(mean, stated.means, parts.own, parts.J, RESOLUTION)
                stated.left_out.update(_reasons(fits & ~within, LeftOut.MEAN))
                fits &= within
                rows.append(self._raw_ranges(stated.ranges) | raw)
        for signal, fine in zip(self._code.mean, self._code.fine, strict=True):
            pair = split(rows[1][signal.name], signal, fine)
            rows[1][signal.name], rows[1][fine.name] = pair
        return self._encode(scene, stated, rows[0], rows[1], fits, parts, full)

    def encode_levels(
        self, scene: Scene, lines: Sequence[Mapping[str, int] | None]
    ) -> EncodedScene:
        """Encode what lines have of their own, for records with a covariance of their own.

        Args:
            scene: the lines with their joint covariance.
            lines: raw values by signal of the mean and the range of each line as sent; None for a
                line that is not to be in the scene at the receiver.

        Raises:
            EncodeError: the pose error does not fit.
        """
        signals = [*self._code.mean, *self._code.range]
        raw = {
            s.name: np.array([line[s.name] if line else 0 for line in lines], dtype=np.int64)
            for s in signals
        }
        low, high = (s.physical(raw[s.name]) for s in self._code.range)
        fits = np.array([line is not None for line in lines], dtype=bool) & (low < high)
        left_out = _reasons(~fits, LeftOut.RANGE) | _reasons(~_can_be_seen(scene), LeftOut.ACROSS)
        fits &= _can_be_seen(scene)
        stated = _Stated(scene.means, scene.fit_ranges, scene.quartics, left_out)
        return self._encode(scene, stated, raw, raw, fits, _Parts.of(scene, stated, fits), False)

    def _encode(
        self,
        scene: Scene,
        stated: _Stated,
        with_levels: Rows,
        with_entries: Rows,
        fits: Mask,
        parts: _Parts,
        full: bool,
    ) -> EncodedScene:
        """Encode the pose, and D_i of the lines that fit.

        Args:
            scene: the lines with their joint covariance.
            stated: the parts of the lines that are sent.
            with_levels: (L,) raw values of means and ranges, if D_i are sent as levels.
            with_entries: the same, if all entries of D_i are sent.
            fits: (L,) which lines fit.
            parts: of the covariances of the lines.
            full: send all entries of each D_i.
        """
        pose_raw = self._encode_pose(scene)
        pose = self._code.decode_pose(pose_raw)
        shapes = self._encode_shapes(stated, with_levels)
        forms = with_levels | shapes, with_entries | shapes
        is_full, places = np.full(len(fits), full), np.flatnonzero(fits)
        costs, is_spared = np.zeros(len(fits)), np.zeros(len(fits), dtype=bool)
        noise: Array | None = None
        while len(places):
            cheapest = places[costs[places].argmin()]
            if is_full[places].all() and 0 < costs[cheapest] < np.inf:
                is_full[cheapest], is_spared[cheapest] = False, True
            raw = _chosen(*forms, is_full, places)
            means, fit_ranges, quartics = self._code.decode_lines(raw)
            covered = _are_functions(means, fit_ranges, quartics)
            if covered.all():
                if noise is None and not is_full[places].all():
                    noise = self._code.levels.noise(means, fit_ranges)
                seen = SeenLines(means, fit_ranges, quartics)
                d = scene.means[places] - means
                keep = (4 * places[:, None] + np.arange(4)).ravel()
                lines = _Lines(
                    is_full[places],
                    is_spared[places],
                    means,
                    fit_ranges,
                    bases(means, fit_ranges),
                    self._code.common(seen, pose),
                    np.zeros((len(means), 0)) if noise is None else noise,
                    parts.due_to_pose[places],
                    parts.own[places],
                    d[:, :, None] * d[:, None],
                )
                true = scene.cov[np.ix_(keep, keep)] + np.outer(d, d)
                true += block_diagonal(parts.excess[places])
                own, covered, cost = self._cover(lines, true, seen.spread(pose.cov))
                if (cost > 1).any():
                    costs[places] = np.maximum(costs[places], cost)
                    is_full[places] |= cost > 1
                    continue
                if covered.all():
                    sent = {int(place): self._row(raw | own, i) for i, place in enumerate(places)}
                    decoded = self._code.decode(pose, [*sent.values()])
                    return EncodedScene(pose_raw, sent, decoded, stated.left_out)
                # Entries have ranges; what levels stand for has none in a range of a few metres.
                by_levels = ~covered & is_full[places] & ~is_spared[places]
                by_levels &= np.isfinite(costs[places])
                if by_levels.any():
                    is_spared[places] |= by_levels
                    is_full[places] &= ~by_levels
                    continue
                reason = LeftOut.COVARIANCE
            else:
                reason = LeftOut.ACROSS
            stated.left_out.update(dict.fromkeys(places[~covered].tolist(), reason))
            places, noise = places[covered], None if noise is None else noise[covered]
        return EncodedScene(pose_raw, {}, None, stated.left_out)

    def _row(self, raw: Mapping[str, NDArray[np.int64]], i: int) -> dict[str, int]:
        """Return the raw values of a line, without those of the other form of D_i."""
        unused = {FORM}
        if self._code.own_code is not None and not raw[FORM][i]:
            unused |= {signal.name for signal in (*self._code.own_code.signals, *self._code.fine)}
        return {name: int(values[i]) for name, values in raw.items() if name not in unused}

    def _encode_pose(self, scene: Scene) -> dict[str, int]:
        code, error, known = self._code, scene.pose_error, scene.map_error
        coded = code.pose_code.encode(POSE_SLACK * error.cov[None], _floor(code.pose_code))
        if not coded.covered[0]:
            sigma = np.sqrt(error.cov.diagonal())
            raise EncodeError(
                "the pose error does not fit the Pose message: its standard deviations are "
                f"{sigma[0]:g} m along, {sigma[1]:g} m across and {sigma[2]:g} rad"
            )
        raw = {name: int(values[0]) for name, values in coded.raw.items()}
        raw[code.offset.name] = _level_above(code.offset, known.offset_sigma if known else 0.0)
        raw[code.heading.name] = _level_above(code.heading, known.heading_sigma if known else 0.0)
        raw[code.time.name] = code.raw_time(error.correlation_time)
        return raw

    def _stated(self, scene: Scene) -> _Stated:
        """Return the parts of the lines that the message can state."""
        seen = _can_be_seen(scene)
        left_out = _reasons(~seen, LeftOut.ACROSS)
        means, ranges = scene.means.copy(), scene.fit_ranges.copy()
        within = is_within(self._code.mean, means)
        least = np.zeros(len(means))  # of the lengths of the ranges of other lines [m]
        for i in np.flatnonzero(seen & ~within):
            line, fit_range = scene.lines[i], scene.fit_ranges[i]
            room = max(line.x_min - fit_range[0], 0.0) + max(fit_range[1] - line.x_max, 0.0)
            least[i] = MIN_RANGE + room
            near = nearest_line(self._code.mean, means[i], fit_range, least[i], self._reach)
            if near is None:
                left_out[int(i)] = LeftOut.MEAN
            else:
                means[i], ranges[i] = near
        first, last = self._code.range
        ranges[:, 0] = np.ceil(ranges[:, 0]).clip(first.physical_range[0])
        ranges[:, 1] = np.floor(ranges[:, 1]).clip(max=last.physical_range[1])
        cannot = (ranges[:, 0] > first.physical_range[1]) | (ranges[:, 1] < last.physical_range[0])
        cannot |= ranges[:, 0] >= ranges[:, 1]
        cannot |= np.diff(ranges)[:, 0] < least  # rounding inwards may leave too little
        left_out = _reasons(cannot, LeftOut.RANGE) | left_out
        ranges[[*left_out]] = 0.0, 1.0
        shorter = np.diff(ranges)[:, 0] / np.diff(scene.fit_ranges)[:, 0]
        return _Stated(means, ranges, scene.quartics * shorter**4, left_out)

    def _raw_ranges(self, ranges: Array) -> Rows:
        """Return the (L,) raw values of ranges that the message can state."""
        pairs = zip(self._code.range, ranges.T, strict=True)
        return {signal.name: signal.raw(ends).astype(np.int64) for signal, ends in pairs}

    def _encode_shapes(
        self, stated: _Stated, raw: Mapping[str, NDArray[np.int64]]
    ) -> dict[str, NDArray[np.int64]]:
        """Return the (L,) raw values of T_4, and of the fit range beyond a stated valid range."""
        values = [(self._code.quartic, stated.quartics)]
        if self._code.fit:
            low, high = (s.physical(raw[s.name]) for s in self._code.range)
            behind, ahead = low - stated.ranges[:, 0], stated.ranges[:, 1] - high
            values += zip(self._code.fit, (behind, ahead), strict=True)
        return {s.name: s.limited(s.raw(value)).astype(np.int64) for s, value in values}

    def _cover(self, lines: _Lines, true: Array, spread: Array) -> tuple[Rows, Mask, Array]:
        """Return raw values of (L,) D_i, which cover their lines, and the costs of levels.

        A line with a cost of more than 1 is to send all entries. It is infinite if levels do not
        cover the line.

        Args:
            lines: the lines.
            true: (4 L, 4 L) joint covariance that is to be covered.
            spread: (4 L, 4 L) that due to the decoded pose error.
        """
        more = np.zeros_like(lines.own)
        for trial in range(TRIALS):
            raw, covered, cost = self._encode_own(lines, more)
            if (cost > 1).any() or not covered.all():
                return raw, covered, cost
            own = self._code.decode_own(raw, lines.means, lines.fit_ranges, lines.common)
            lacking = uncovered(true, spread, own, lines.J)
            if lacking is None:
                return raw, covered, cost
            more += FIRST_SHARE * 2.0**trial * lacking
        has_entries = self._code.own_code is not None
        return raw, np.zeros_like(covered), np.where(~lines.is_full & has_entries, np.inf, 0.0)

    def _encode_own(self, lines: _Lines, more: Array) -> tuple[Rows, Mask, Array]:
        """Return what ``_cover`` does, for D_i that cover each line alone plus ``more``."""
        code, is_full = self._code, lines.is_full
        signals = [*code.levels.signals, *(code.own_code.signals if code.own_code else ())]
        raw = {signal.name: np.zeros(len(more), dtype=np.int64) for signal in signals}
        covered, cost = np.ones_like(is_full), np.zeros(len(is_full))
        if not is_full.all():
            short = ~is_full
            levels, covered[short], of_levels = self._encode_levels(lines.of(short), more[short])
            for name, values in levels.items():
                raw[name][short] = values
            if code.own_code is not None:
                of_levels[lines.is_spared[short]] = 0.0
                cost[short] = np.where(covered[short], of_levels, np.inf)
        if code.own_code is not None and is_full.any():
            target = (lines.own + lines.error + lines.least + more)[is_full]
            coded = code.own_code.encode(target, _floor(code.own_code))
            covered[is_full] = coded.covered
            for name, values in coded.raw.items():
                raw[name][is_full] = values
        return raw | {FORM: is_full.astype(np.int64)}, covered, cost

    def _encode_levels(self, lines: _Lines, more: Array) -> tuple[Rows, Mask, Array]:
        """Return the raw values of (L,) levels, which lines they cover, and what they cost."""
        levels, known = self._code.levels, lines.own + lines.error
        raw, covered = levels.encode(
            known + more, lines.common, known + lines.least, lines.J, lines.noise
        )
        own = levels.decode(raw, lines.means, lines.fit_ranges) + lines.common
        inverse = np.linalg.inv(lines.J)  # all coefficients in metres
        true, whole, decoded, decoded_whole = (
            inverse @ cov @ inverse.swapaxes(1, 2)
            for cov in (
                lines.own + lines.least,
                lines.due_to_pose + known + lines.least,
                own,
                lines.due_to_pose + own,
            )
        )
        kl, ratio = divergence(whole, decoded_whole), largest_ratio(decoded, true)
        return raw, covered, np.maximum(kl / LEVELS_KL, ratio / LEVELS_RATIO**2)


class _Stated(NamedTuple):
    """Parts of lines that a message can state; anything for the lines that are left out."""

    means: Array  #: (L, 4) within the ranges of the message
    ranges: Array  #: (L, 2) [m]
    quartics: Array  #: (L,) [m]
    left_out: dict[int, LeftOut]  #: lines of which the message can state no part


class _Parts(NamedTuple):
    """Parts of the covariances of the lines of a scene; 0 for those that do not fit."""

    J: Array  #: (L, 4, 4) derivatives of ``bases``
    due_to_pose: Array  #: (L, 4, 4)
    own: Array  #: (L, 4, 4), with the excess
    excess: Array  #: (L, 4, 4) squares of the errors of means that exceed the message

    @classmethod
    def of(cls, scene: Scene, stated: _Stated, fits: NDArray[np.bool_]) -> _Parts:
        """Return the parts of a scene."""
        lines = len(scene.lines)
        J, due_to_pose, own = np.tile(np.eye(4), (lines, 1, 1)), *np.zeros((2, lines, 4, 4))
        error = np.where(fits[:, None], slope_error(scene.means, stated.means), 0.0)
        excess = error[:, :, None] * error[:, None]
        if fits.any():
            J[fits] = bases(stated.means[fits], stated.ranges[fits])
            seen = SeenLines(scene.means[fits], stated.ranges[fits], stated.quartics[fits])
            due_to_pose[fits] = diagonal_blocks(seen.spread(scene.pose_error.cov), 4)
            if scene.specific_covs is not None:
                own[fits] = scene.specific_covs[fits]
            else:
                own[fits] = positive_part(
                    diagonal_blocks(scene.cov, 4)[fits] - due_to_pose[fits], J[fits]
                )
        return cls(J, due_to_pose, own + excess, excess)


class _Lines(NamedTuple):
    """L lines as a receiver decodes them, and what their D_i have to cover."""

    is_full: Mask  #: (L,) of which lines all entries are sent
    is_spared: Mask  #: (L,) of which lines levels are sent, whatever they cost
    means: Array  #: (L, 4)
    fit_ranges: Array  #: (L, 2) [m]
    J: Array  #: (L, 4, 4) derivatives of ``bases``
    common: Array  #: (L, 4, 4) what the levels of the scene's map error stand for
    noise: Array  #: (L, S, 4, 4) of ``OwnLevels.noise``
    due_to_pose: Array  #: (L, 4, 4) part of the true covariances
    own: Array  #: (L, 4, 4) the other part
    error: Array  #: (L, 4, 4) squares of the errors of the means

    @property
    def least(self) -> Array:
        """(L, 4, 4) covariances of the resolution of the means."""
        return np.asarray(RESOLUTION**2 * self.J @ self.J.swapaxes(1, 2))

    def of(self, mask: Mask) -> _Lines:
        """Return some of the lines."""
        values: Iterable[Any] = self
        return _Lines(*(value[mask] for value in values))


def _chosen(with_levels: Rows, with_entries: Rows, is_full: Mask, places: NDArray[np.intp]) -> Rows:
    """Return the raw values of the lines at some places, each in the form in which it is sent."""
    chosen = {
        name: np.where(is_full, values, with_levels.get(name, 0))[places]
        for name, values in with_entries.items()
    }
    return chosen | {FORM: is_full[places].astype(np.int64)}


def _reasons(lines: Mask, reason: LeftOut) -> dict[int, LeftOut]:
    """Return the reason of lines, by their places."""
    return dict.fromkeys(np.flatnonzero(lines).tolist(), reason)


def _floor(code: CholeskyCode) -> Array:
    """Return the least variances that a code can decode to, for targets that are singular."""
    pivots = dict(zip(code.factor.order, code.factor.pivots, strict=True))
    return np.array([4.0 ** pivots[i].physical_range[0] for i in range(len(pivots))])


def _can_be_seen(scene: Scene) -> Mask:
    """Return which lines are functions of x and have covariances that do not overflow."""
    variances = scene.cov.diagonal().reshape(-1, 4)
    large = (variances > LARGEST**2) | (np.abs(scene.means) > LARGEST)
    if scene.specific_covs is not None:
        large |= np.einsum("lii->li", scene.specific_covs) > LARGEST**2
    small = np.logical_not(large).all(axis=1)
    return _are_functions(scene.means, scene.fit_ranges, scene.quartics, np.asarray(small))


def _are_functions(
    means: Array, fit_ranges: Array, quartics: Array, among: Mask | None = None
) -> Mask:
    """Return which lines have a range, and are functions of x; False for those not ``among``."""
    found = fit_ranges[:, 0] < fit_ranges[:, 1]  # it may be too short for the steps of the message
    if among is not None:
        found &= among
    try:
        SeenLines(means[found], fit_ranges[found], quartics[found])
    except IllPosedError:
        for i in np.flatnonzero(found):
            try:
                SeenLines(means[i : i + 1], fit_ranges[i : i + 1], quartics[i : i + 1])
            except IllPosedError:
                found[i] = False
    return np.asarray(found)


def _level_above(signal: Signal, sigma: float) -> int:
    """Return the raw value of the least level from sigma on, or the greatest; 0 for 0."""
    if sigma <= 0:
        return 0
    raw = math.ceil((math.log2(sigma) - signal.offset) / signal.factor - 1e-9)
    return min(max(raw, 1), signal.raw_max)
