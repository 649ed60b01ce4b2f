"""Code of scenes: the pose error once, and of each line what it has of its own.

All lines of a scene are seen from one pose, so their parameters are theta_i = f_i(delta) + own_i,
with delta ~ N(0, P) the pose error. The receiver knows f_i: it is the decoded line, seen from a
displaced pose. From P' and the decoded covariances D_i of own_i it rebuilds the joint covariance

    C = cov f(delta) + blockdiag(D_1, ..., D_L),   delta ~ N(0, P')

by sigma points that go through all lines at once. The first term is positive semidefinite and
every D_i is positive definite, so C is positive definite for any bits.

C covers the joint covariance of the scene plus the errors of the decoded means, since the encoder
decodes what it encodes. P' covers P. D_i covers what C lacks without it. If together they do not
cover the scene, since the lines differ from f_i in different ways, the D_i of the lines concerned
are enlarged until they do.

D_i has one of two forms. ``OwnLevels`` takes 19 bits and suffices for most lines whose map error
is known. The form with all entries takes as many bits as the covariance of a line by itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import EncodeError, IllPosedError
from ...line import Slot, lateral_jacobian
from ...scene import Scene
from ...seen_lines import SeenLines
from ..message.record_layout import RecordLayout
from ..message.signals import (
    FINE_SIGNALS,
    PARAMETER_SIGNALS,
    POSE_ROWS,
    SLOT_SIGNALS,
    Signal,
    slot_title,
)
from .cholesky import CholeskyCode
from .code import Array
from .joint import block_diagonal, blocks, positive_part, uncovered
from .own_levels import OwnLevels, bases
from .rounding import refined, rounded_means, split

#: Signal that says whether a record has all entries of D_i.
FORM = "HasCovariance"
#: Largest divergence that levels may cost a line; beyond it all entries are sent [nat].
LEVELS_KL = 0.01
#: Largest ratio of a standard deviation of what a line has of its own, with levels to without.
LEVELS_RATIO = 1.1
#: Standard deviation of the coefficients of ``bases`` that D_i of levels has at least: about that
#: of the rounding errors of the means [m].
RESOLUTION = 2.0**-9
#: Factor on the covariance of the pose error that is covered. A line that is rounded depends on the
#: pose a little differently; what that does is much less, but not little to what lines have of
#: their own.
POSE_SLACK = 1.002
#: Repetitions of the enlargement of D_i.
TRIALS = 12
#: Largest standard deviation of a line that is encoded: no D_i covers more, and none overflows.
LARGEST = 1e50
#: Share by which decoded variances are enlarged, more than the rounding error of their sum: so
#: they are definite even if the pose error is millions of times what a line has of its own.
ROUNDING = 2.0**-42
#: Share of what a first trial lacks by which the D_i are enlarged; each next one adds twice as much.
FIRST = 0.5
#: (L,) raw values by signal.
Rows = dict[str, NDArray[np.int64]]


class DecodedPose(NamedTuple):
    """Content of a Pose record that matters to the covariance of lines."""

    cov: Array  #: (3, 3) P'
    correlation_time: float  #: [s]
    offset_sigma: float  #: common offset of the points of a line of the map [m]
    heading_sigma: float  #: common rotation of the points of a line of the map [rad]


class DecodedLines(NamedTuple):
    """L lines of a scene as a receiver decodes them."""

    means: Array  #: (L, 4)
    fit_ranges: Array  #: (L, 2) [m]
    own_covs: Array  #: (L, 4, 4) D_i
    cov: Array  #: (4 L, 4 L) C
    quartics: Array  #: (L,) coefficients of T_4 [m]


@dataclass(frozen=True, eq=False)
class EncodedScene:
    """Raw values of a scene by signal: of the Pose record and of the lines' records."""

    pose: dict[str, int]
    lines: dict[int, dict[str, int]]  #: by their places in the scene; lines that do not fit lack
    decoded: DecodedLines | None  #: what a receiver decodes; None without lines


class SceneCode:
    """Code between scenes and the raw values of a Pose record and of the records of lines.

    There are two kinds of records of lines. Those that are conditional on the pose have a mean, a
    range, and D_i in one of its forms. Those with a covariance of their own have no room for D_i:
    their levels are in the Pose record, and their covariance is not used here.

    Args:
        pose: layout of the Pose record.
        line: layout of the records of lines.

    Raises:
        LayoutError: a signal is missing or not suitable.
    """

    def __init__(self, pose: RecordLayout, line: RecordLayout) -> None:
        self.pose_code = CholeskyCode(pose, POSE_ROWS)
        self._time, self._offset, self._heading = (
            pose[name] for name in ("CorrelationTime", "MapOffset", "MapHeading")
        )
        #: Whether the records of lines are conditional on the pose.
        self.is_conditional = FORM in line.signals
        prefix = "" if self.is_conditional else slot_title(Slot.EGO_LEFT)
        levels = line if self.is_conditional else pose
        self._mean = [line[name] for name in PARAMETER_SIGNALS]
        self._range = [line["XMin"], line["XMax"]]
        names = SLOT_SIGNALS[:4] if self.is_conditional else SLOT_SIGNALS
        own = [replace(levels[prefix + name], name=name) for name in names]
        self._levels = OwnLevels(*own[:3])
        self._quartic, self._fit = own[3], own[4:]
        self._own_code = CholeskyCode(line) if self.is_conditional else None
        self._fine = [line[name] for name in FINE_SIGNALS] if self.is_conditional else []
        self._refined = [refined(*pair) for pair in zip(self._mean, self._fine)]

    def decode_pose(self, raw: Mapping[str, int]) -> DecodedPose:
        """Return the content of a Pose record from its raw values by signal."""
        levels = [
            0.0 if raw[s.name] == 0 else 2.0 ** s.physical_one(raw[s.name])
            for s in (self._offset, self._heading)
        ]
        time = raw[self._time.name]
        return DecodedPose(
            self.pose_code.decode_one(raw),
            math.inf if time == 0 else 2.0 ** self._time.physical_one(time),
            *levels,
        )

    def decode(self, pose: DecodedPose, lines: Sequence[Mapping[str, int]]) -> DecodedLines:
        """Return lines with their joint covariance.

        Args:
            pose: content of the Pose record of their cycle.
            lines: raw values by signal of each line: mean, range and D_i, of which the levels are
                named as in a conditional record.

        Raises:
            IllPosedError: a line is no function of x in its range; no encoder sends such a line.
        """
        names = dict.fromkeys(name for line in lines for name in line)
        raw = {
            name: np.array([line.get(name, 0) for line in lines], dtype=np.int64) for name in names
        }
        raw[FORM] = np.array([self._is_full(line) for line in lines], dtype=np.int64)
        means, fit_ranges, quartics = self._decode_lines(raw)
        if not (fit_ranges[:, 0] < fit_ranges[:, 1]).all():
            raise IllPosedError("the range of a line is empty")
        seen = SeenLines(means, fit_ranges, quartics)
        own = self._decode_own(raw, seen, self._common(seen, pose))
        cov = seen.spread(pose.cov) + block_diagonal(own)
        cov = (cov + cov.T) / 2
        cov[np.diag_indices_from(cov)] *= 1 + ROUNDING
        return DecodedLines(means, fit_ranges, own, cov, quartics)

    def encode(self, scene: Scene, *, full: bool = False) -> EncodedScene:
        """Encode a scene for records that are conditional on the pose.

        Lines that do not fit are left out: a mean or a range is out of the range of its signals,
        or no covariance of the message covers what the line has of its own.

        Args:
            scene: the lines with their joint covariance.
            full: send all entries of each D_i, not levels.

        Raises:
            EncodeError: the pose error does not fit.
        """
        ranges, fits = self._encode_ranges(scene)
        fits &= _can_be_seen(scene)
        parts = _Parts.of(scene, fits)
        rows: list[Rows] = []
        for signals in (self._mean, self._refined):
            rounded, within = rounded_means(signals, scene.means, parts.own, parts.J, RESOLUTION)
            fits &= within
            rows.append(ranges | rounded)
        for signal, fine in zip(self._mean, self._fine, strict=True):
            raw = split(rows[1][signal.name], signal, fine)
            rows[1][signal.name], rows[1][fine.name] = raw
        return self._encode(scene, rows[0], rows[1], fits, parts, full)

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
        signals = [*self._mean, *self._range]
        raw = {
            s.name: np.array([line[s.name] if line else 0 for line in lines], dtype=np.int64)
            for s in signals
        }
        low, high = (s.physical(raw[s.name]) for s in self._range)
        fits = np.array([line is not None for line in lines], dtype=bool) & (low < high)
        fits &= _can_be_seen(scene)
        return self._encode(scene, raw, raw, fits, _Parts.of(scene, fits), False)

    def _encode(
        self,
        scene: Scene,
        with_levels: Rows,
        with_entries: Rows,
        fits: NDArray[np.bool_],
        parts: _Parts,
        full: bool,
    ) -> EncodedScene:
        """Encode the pose, and D_i of the lines that fit.

        Args:
            scene: the lines with their joint covariance.
            with_levels: (L,) raw values of means and ranges, if D_i are sent as levels.
            with_entries: the same, if all entries of D_i are sent.
            fits: (L,) which lines fit.
            parts: of the covariances of the lines.
            full: send all entries of each D_i.
        """
        pose_raw = self._encode_pose(scene)
        pose = self.decode_pose(pose_raw)
        shapes = self._encode_shapes(scene, with_levels)
        places = np.flatnonzero(fits)
        while len(places):
            forms = [
                {name: values[places] for name, values in (rows | shapes).items()}
                for rows in (with_levels, with_entries)
            ]
            lines, covered = self._encode_own(scene, places, forms, parts, pose, full)
            if covered.all():
                rows = [self._row(lines, i) for i in range(len(places))]
                decoded = self.decode(pose, rows)
                return EncodedScene(
                    pose_raw, dict(zip(places.tolist(), rows, strict=True)), decoded
                )
            places = places[covered]
        return EncodedScene(pose_raw, {}, None)

    def _is_full(self, line: Mapping[str, int]) -> bool:
        """Return whether raw values have all entries of D_i."""
        return self._own_code is not None and self._own_code.inflation.name in line

    def _row(self, raw: Mapping[str, NDArray[np.int64]], i: int) -> dict[str, int]:
        """Return the raw values of a line, without those of the other form of D_i."""
        unused = {FORM}
        if self._own_code is not None and not raw[FORM][i]:
            unused |= {signal.name for signal in (*self._own_code.signals, *self._fine)}
        return {name: int(values[i]) for name, values in raw.items() if name not in unused}

    def _encode_pose(self, scene: Scene) -> dict[str, int]:
        error = scene.pose_error
        coded = self.pose_code.encode(POSE_SLACK * error.cov[None], _floor(self.pose_code))
        if not coded.covered[0]:
            sigma = np.sqrt(error.cov.diagonal())
            raise EncodeError(
                "the pose error does not fit the Pose message: its standard deviations are "
                f"{sigma[0]:g} m along, {sigma[1]:g} m across and {sigma[2]:g} rad"
            )
        raw = {name: int(values[0]) for name, values in coded.raw.items()}
        known = scene.map_error
        raw[self._offset.name] = _level_above(self._offset, known.offset_sigma if known else 0.0)
        raw[self._heading.name] = _level_above(self._heading, known.heading_sigma if known else 0.0)
        raw[self._time.name] = 0
        if math.isfinite(error.correlation_time):
            nearest = self._time.raw(np.log2(error.correlation_time))
            raw[self._time.name] = int(nearest.clip(1, self._time.raw_max))
        return raw

    @np.errstate(over="ignore", invalid="ignore")  # of ranges that do not fit
    def _encode_ranges(self, scene: Scene) -> tuple[Rows, NDArray[np.bool_]]:
        """Return the (L,) raw values of ranges, and which of them are exact."""
        raw: Rows = {}
        fits = np.ones(len(scene.lines), dtype=bool)
        for signal, values in zip(self._range, scene.fit_ranges.T, strict=True):
            limited = signal.limited(signal.raw(values))
            fits &= signal.physical(limited) == values
            raw[signal.name] = limited.astype(np.int64)
        return raw, fits

    def _encode_shapes(
        self, scene: Scene, raw: Mapping[str, NDArray[np.int64]]
    ) -> dict[str, NDArray[np.int64]]:
        """Return the (L,) raw values of T_4, and of the fit range beyond a stated valid range."""
        values = [(self._quartic, scene.quartics)]
        if self._fit:
            low, high = (s.physical(raw[s.name]) for s in self._range)
            behind, ahead = low - scene.fit_ranges[:, 0], scene.fit_ranges[:, 1] - high
            values += zip(self._fit, (behind, ahead), strict=True)
        return {s.name: s.limited(s.raw(value)).astype(np.int64) for s, value in values}

    def _encode_own(
        self,
        scene: Scene,
        places: NDArray[np.intp],
        forms: Sequence[Rows],
        parts: _Parts,
        pose: DecodedPose,
        full: bool,
    ) -> tuple[Rows, NDArray[np.bool_]]:
        """Return the raw values of (L,) lines, and which of them are covered.

        Args:
            scene: the lines with their joint covariance.
            places: (L,) of the lines in the scene.
            forms: (L,) raw values of lines whose D_i are sent as levels, and as all entries.
            parts: of the covariances of all lines.
            pose: content of the Pose record.
            full: send all entries of each D_i.
        """
        is_full = np.full(len(places), full)
        while True:
            raw = {
                name: np.where(is_full, values, forms[0].get(name, 0))
                for name, values in forms[1].items()
            } | {FORM: is_full.astype(np.int64)}
            lines = self._rounded(scene, places, parts, raw, pose)
            if not isinstance(lines, _Rounded):
                return raw, lines
            own, covered, needed = self._cover(lines, is_full)
            if (needed == is_full).all():
                return raw | own, covered
            is_full = needed

    def _rounded(
        self,
        scene: Scene,
        places: NDArray[np.intp],
        parts: _Parts,
        raw: Rows,
        pose: DecodedPose,
    ) -> _Rounded | NDArray[np.bool_]:
        """Return lines as a receiver decodes them; or which of them are functions, if not all."""
        means, fit_ranges, quartics = self._decode_lines(raw)
        good = np.array([_is_function(*line) for line in zip(means, fit_ranges, quartics)])
        if not good.all():
            return good
        d = (scene.means[places] - means).ravel()
        keep = (4 * places[:, None] + np.arange(4)).ravel()
        error = d.reshape(-1, 4, 1)
        seen = SeenLines(means, fit_ranges, quartics)
        return _Rounded(
            raw,
            seen,
            bases(means, fit_ranges),
            self._common(seen, pose),
            seen.spread(pose.cov),
            scene.cov[np.ix_(keep, keep)] + np.outer(d, d),
            parts.due_to_pose[places],
            parts.own[places],
            error @ error.swapaxes(1, 2),
        )

    def _cover(
        self, lines: _Rounded, is_full: NDArray[np.bool_]
    ) -> tuple[Rows, NDArray[np.bool_], NDArray[np.bool_]]:
        """Return the raw values of D_i of (L,) lines, which are covered, and which need entries.

        Args:
            lines: as a receiver decodes them.
            is_full: (L,) of which lines all entries are sent.
        """
        seen, J, common = lines.seen, lines.J, lines.common
        least = RESOLUTION**2 * J @ J.swapaxes(1, 2)
        missing = lines.own + lines.error
        raw: Rows = {s.name: np.zeros(len(J), dtype=np.int64) for s in self._levels.signals}
        covered = np.ones(len(J), dtype=bool)
        short = np.flatnonzero(~is_full)
        true = (lines.due_to_pose + missing + least)[short]
        rest = (lines.due_to_pose + common)[short]
        noise = self._levels.noise(seen.means[short], seen.fit_ranges[short])
        more = np.zeros_like(missing)
        raw[FORM] = is_full.astype(np.int64)
        for trial in range(TRIALS):
            wanted = missing + more
            if len(short):
                levels, kl = self._levels.encode(
                    wanted[short] - common[short], rest, true, J[short], noise
                )
                covered[short] = np.isfinite(kl)
                for name, values in levels.items():
                    raw[name][short] = values
            if self._own_code is not None and len(short):
                by_levels = self._levels.decode(levels, seen.means[short], seen.fit_ranges[short])
                ratio = _worst_ratio(
                    by_levels + common[short],
                    (lines.own + least)[short],
                    seen.means[short],
                    seen.fit_ranges[short],
                )
                needed = is_full.copy()
                needed[short] = (kl > LEVELS_KL) | (ratio > LEVELS_RATIO)
                if (needed != is_full).any():
                    return raw, covered, needed
            if self._own_code is not None:
                coded = self._own_code.encode(wanted + least, _floor(self._own_code))
                covered[is_full] = coded.covered[is_full]
                raw |= {name: np.where(is_full, values, 0) for name, values in coded.raw.items()}
            if not covered.all():
                return raw, covered, is_full
            lacking = uncovered(lines.true, lines.spread, self._decode_own(raw, seen, common), J)
            if lacking is None:
                return raw, covered, is_full
            more += FIRST * 2.0**trial * lacking
        if self._own_code is not None and not is_full.all():
            return raw, covered, np.ones_like(is_full)
        return raw, np.zeros_like(covered), is_full

    def _decode_lines(self, raw: Mapping[str, NDArray[np.int64]]) -> tuple[Array, Array, Array]:
        """Return the (L, 4) means, (L, 2) fit ranges and (L,) quartics."""
        means, fit_ranges = (
            np.stack([s.physical(raw[s.name]) for s in signals], axis=-1)
            for signals in (self._mean, self._range)
        )
        if self._fit:
            behind, ahead = (s.physical(raw[s.name]) for s in self._fit)
            fit_ranges += np.column_stack([-behind, ahead])
        if self._fine and (full := raw[FORM] == 1).any():
            for i, signal in enumerate(self._fine):
                means[full, i] += signal.physical(raw[signal.name][full])
        return means, fit_ranges, np.asarray(self._quartic.physical(raw[self._quartic.name]))

    def _decode_own(
        self, raw: Mapping[str, NDArray[np.int64]], seen: SeenLines, common: Array
    ) -> Array:
        """Return the (L, 4, 4) D_i of (L,) raw values."""
        own = self._levels.decode(raw, seen.means, seen.fit_ranges) + common
        if self._own_code is not None and (full := raw[FORM] == 1).any():
            signals = self._own_code.signals
            own[full] = self._own_code.decode({s.name: raw[s.name][full] for s in signals})
        return own

    def _common(self, seen: SeenLines, pose: DecodedPose) -> Array:
        """Return the (L, 4, 4) covariances that the levels of a scene's map error stand for."""
        sigma = np.array([pose.offset_sigma, pose.offset_sigma, pose.heading_sigma])
        J = RESOLUTION * bases(seen.means, seen.fit_ranges)
        if sigma.any():
            J = np.concatenate([J, seen.jacobian() * sigma], axis=2)
        return np.asarray(J @ J.swapaxes(1, 2))


class _Parts(NamedTuple):
    """Parts of the covariances of the lines of a scene; 0 for those that do not fit."""

    J: Array  #: (L, 4, 4) derivatives of ``bases``
    due_to_pose: Array  #: (L, 4, 4)
    own: Array  #: (L, 4, 4)

    @classmethod
    def of(cls, scene: Scene, fits: NDArray[np.bool_]) -> _Parts:
        """Return the parts of a scene."""
        lines = len(scene.lines)
        J, due_to_pose, own = np.tile(np.eye(4), (lines, 1, 1)), *np.zeros((2, lines, 4, 4))
        if fits.any():
            means, fit_ranges = scene.means[fits], scene.fit_ranges[fits]
            J[fits] = bases(means, fit_ranges)
            seen = SeenLines(means, fit_ranges, scene.quartics[fits])
            due_to_pose[fits] = blocks(seen.spread(scene.pose_error.cov))
            if scene.own_covs is not None:
                own[fits] = scene.own_covs[fits]
            else:
                own[fits] = positive_part(blocks(scene.cov)[fits] - due_to_pose[fits], J[fits])
        return cls(J, due_to_pose, own)


class _Rounded(NamedTuple):
    """L lines as a receiver decodes them."""

    raw: Rows
    seen: SeenLines
    J: Array  #: (L, 4, 4) derivatives of ``bases``
    common: Array  #: (L, 4, 4)
    spread: Array  #: (4 L, 4 L) joint covariance due to the decoded pose error
    true: Array  #: (4 L, 4 L) that of the scene plus the square of the errors of the means
    due_to_pose: Array  #: (L, 4, 4)
    own: Array  #: (L, 4, 4)
    error: Array  #: (L, 4, 4) squares of the errors of the means


def _floor(code: CholeskyCode) -> Array:
    """Return the least variances that a code can decode to, for targets that are singular."""
    pivots = dict(zip(code.factor.order, code.factor.pivots, strict=True))
    return np.array([4.0 ** pivots[i].physical_range[0] for i in range(len(pivots))])


def _worst_ratio(own: Array, true: Array, means: Array, fit_ranges: Array) -> Array:
    """Return the (L,) largest ratios of standard deviations of lateral position and direction.

    They are taken at 0, 20 and 40 m and at the ends of the range, as far as they are in it.
    """
    low, high = fit_ranges.T
    places = np.column_stack([low, np.broadcast_to([0.0, 20.0, 40.0], (len(low), 3)), high])
    x = places.clip(low[:, None], high[:, None])
    position = lateral_jacobian(means[:, None], x)
    turned = np.broadcast_to(1 + np.tan(means[:, 1, None]) ** 2, x.shape)
    slope = np.stack([np.zeros_like(x), turned, x, x * x / 2], axis=-1)
    J = np.concatenate([position, slope], axis=1)  # (L, 10, 4)
    variances = [np.einsum("lki,lij,lkj->lk", J, cov, J) for cov in (own, true)]
    return np.sqrt((variances[0] / variances[1]).max(axis=1))


def _can_be_seen(scene: Scene) -> NDArray[np.bool_]:
    """Return which lines are functions of x and have covariances that do not overflow."""
    small = (scene.cov.diagonal().reshape(-1, 4) <= LARGEST**2).all(axis=1)
    small &= (np.abs(scene.means) <= LARGEST).all(axis=1)
    lines = zip(scene.means, scene.fit_ranges, scene.quartics, strict=True)
    return np.array([ok and _is_function(*line) for ok, line in zip(small, lines)], dtype=bool)


def _is_function(mean: Array, fit_range: Array, quartic: float) -> bool:
    """Return whether a line has a range, and is a function of x seen from other poses."""
    if not fit_range[0] < fit_range[1]:  # it may be too short for the steps of the message
        return False
    try:
        SeenLines(mean[None], fit_range[None], [quartic])
    except IllPosedError:
        return False
    return True


def _level_above(signal: Signal, sigma: float) -> int:
    """Return the raw value of the least level from sigma on, or the greatest; 0 for 0."""
    if sigma <= 0:
        return 0
    raw = math.ceil((math.log2(sigma) - signal.offset) / signal.factor - 1e-9)
    return min(max(raw, 1), signal.raw_max)
