"""Encoder of scenes, for the receiver of ``scene_code``.

The joint covariance C that a receiver decodes covers that of the scene plus the errors of the
decoded means, since the encoder decodes what it encodes. P' covers P. D_i covers what is specific
to the line, and the error of its mean. If together they do not cover the scene, since the errors of
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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...values.elementary import log2
from ...values.errors import EncodeError
from ...values.line import LeftOut
from ...values.scene import Scene
from ...values.seen_lines import bases
from ..layout.signals import Signal
from .code import Array
from .rounding import refined, rounded_means, rounding_factor, split
from .scene_code import FORM, RESOLUTION, DecodedLines, Rows, SceneCode
from .specific_encoder import SentLines, SpecificEncoder, least_variances
from .stated_lines import (
    CovarianceParts,
    Mask,
    StatedLines,
    can_be_seen,
    reasons,
    seen_lines,
    stated_lines,
)

#: Factor on the covariance of the pose error that is covered. A line that is rounded depends on the
#: pose a little differently; what that does is much less, but not little to what lines have of
#: their own.
POSE_SLACK = 1.002
#: Places of lines in a scene.
Places = NDArray[np.intp]


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
        self._specific = SpecificEncoder(code)

    def encode(self, scene: Scene, *, full: bool = False) -> EncodedScene:
        """Encode a scene for records that are conditional on the pose.

        Lines that do not fit are left out, with a reason: the message can state no part of the
        line that is long enough, or no covariance of it covers its line-specific covariance.

        Args:
            scene: the lines with their joint covariance.
            full: send all entries of each D_i, not levels, unless only levels cover it.

        Raises:
            EncodeError: the pose error does not fit.
        """
        rows: list[Rows] = []
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # if it does not fit
            stated = stated_lines(self._code, scene)
            fits = np.array([i not in stated.left_out for i in range(len(scene.lines))], dtype=bool)
            parts = CovarianceParts.of(scene, stated, fits)
            factor = rounding_factor(parts.specific, parts.J, RESOLUTION)
            for mean in (self._code.mean, self._refined):
                raw, within = rounded_means(mean, stated.means, factor)
                stated.left_out.update(reasons(fits & ~within, LeftOut.MEAN))
                fits &= within
                rows.append(self._raw_ranges(stated.ranges) | raw)
        with_levels, with_entries = rows
        for signal, fine in zip(self._code.mean, self._code.fine, strict=True):
            pair = split(with_entries[signal.name], signal, fine)
            with_entries[signal.name], with_entries[fine.name] = pair
        shapes = self._raw_shapes(stated, with_levels)
        forms = _Forms(with_levels | shapes, with_entries | shapes, np.full(len(fits), full))
        return self._encode(scene, stated, forms, fits, parts)

    def encode_levels(
        self, scene: Scene, lines: Sequence[Mapping[str, int] | None]
    ) -> EncodedScene:
        """Encode line-specific covariances, for records with a covariance of their own.

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
        seen = can_be_seen(scene)
        left_out = reasons(~fits, LeftOut.RANGE) | reasons(~seen, LeftOut.ACROSS)
        fits &= seen
        stated = StatedLines(scene.means, scene.fit_ranges, scene.quartics, left_out)
        raw |= self._raw_shapes(stated, raw)
        forms = _Forms(raw, raw, np.zeros_like(fits))
        return self._encode(scene, stated, forms, fits, CovarianceParts.of(scene, stated, fits))

    def _encode(
        self,
        scene: Scene,
        stated: StatedLines,
        forms: _Forms,
        fits: Mask,
        parts: CovarianceParts,
    ) -> EncodedScene:
        """Encode the pose, and D_i of the lines that fit.

        Args:
            scene: the lines with their joint covariance.
            stated: the parts of the lines that are sent.
            forms: of the lines.
            fits: (L,) which lines fit.
            parts: of the covariances of the lines.
        """
        pose_raw = self._encode_pose(scene)
        pose = self._code.decode_pose(pose_raw)
        places = np.flatnonzero(fits)
        while len(places):
            forms.spare_one(places)
            raw = forms.rows(places)
            seen, covered = seen_lines(*self._code.decode_lines(raw))
            reason = LeftOut.ACROSS
            if seen is not None:
                d = scene.means[places] - seen.means
                lines = SentLines(
                    forms.is_full[places],
                    forms.is_spared[places],
                    seen.means,
                    seen.fit_ranges,
                    bases(seen.means, seen.fit_ranges),
                    self._code.common(seen, pose),
                    parts.due_to_pose[places],
                    parts.specific[places],
                    d[:, :, None] * d[:, None],
                )
                true = parts.joint(scene, places, d)
                specific, covered, cost = self._specific.cover(lines, true, seen.spread(pose.cov))
                if forms.need_entries(places, cost):
                    continue
                if covered.all():
                    raw |= specific
                    sent = {int(place): self._row(raw, i) for i, place in enumerate(places)}
                    decoded = self._code.decode(pose, [*sent.values()])
                    return EncodedScene(pose_raw, sent, decoded, stated.left_out)
                if forms.need_levels(places, covered):
                    continue
                reason = LeftOut.COVARIANCE
            stated.left_out.update(dict.fromkeys(places[~covered].tolist(), reason))
            places = places[covered]
        return EncodedScene(pose_raw, {}, None, stated.left_out)

    def _row(self, raw: Mapping[str, NDArray[np.int64]], i: int) -> dict[str, int]:
        """Return the raw values of a line, without those of the other form of D_i."""
        unused = {FORM}
        if self._code.entries_code is not None and not raw[FORM][i]:
            unused |= {
                signal.name for signal in (*self._code.entries_code.signals, *self._code.fine)
            }
        return {name: int(values[i]) for name, values in raw.items() if name not in unused}

    def _encode_pose(self, scene: Scene) -> dict[str, int]:
        code, error, known = self._code, scene.pose_error, scene.map_error
        coded = code.pose_code.encode(POSE_SLACK * error.cov[None], least_variances(code.pose_code))
        if not coded.covered[0]:
            sigma = np.sqrt(error.cov.diagonal())
            raise EncodeError(
                "the pose error does not fit the Pose message: its standard deviations are "
                f"{sigma[0]:g} m along, {sigma[1]:g} m across and {sigma[2]:g} rad"
            )
        raw = {name: int(values[0]) for name, values in coded.raw.items()}
        raw[code.offset.name] = level_above(code.offset, known.offset_sigma if known else 0.0)
        raw[code.heading.name] = level_above(code.heading, known.heading_sigma if known else 0.0)
        raw[code.time.name] = code.raw_time(error.correlation_time)
        return raw

    def _raw_ranges(self, ranges: Array) -> Rows:
        """Return the (L,) raw values of ranges that the message can state."""
        pairs = zip(self._code.range, ranges.T, strict=True)
        return {signal.name: signal.raw(ends).astype(np.int64) for signal, ends in pairs}

    def _raw_shapes(
        self, stated: StatedLines, raw: Mapping[str, NDArray[np.int64]]
    ) -> dict[str, NDArray[np.int64]]:
        """Return the (L,) raw values of T_4, and of the fit range beyond a stated valid range."""
        values = [(self._code.quartic, stated.quartics)]
        if self._code.fit:
            low, high = (s.physical(raw[s.name]) for s in self._code.range)
            behind, ahead = low - stated.ranges[:, 0], stated.ranges[:, 1] - high
            values += zip(self._code.fit, (behind, ahead), strict=True)
        return {s.name: s.limited(s.raw(value)).astype(np.int64) for s, value in values}


class _Forms:
    """Forms in which the lines of a scene are sent: D_i as levels, or all of its entries.

    Args:
        with_levels: (L,) raw values of lines by signal, if D_i are sent as levels.
        with_entries: the same, if all entries of D_i are sent.
        is_full: (L,) of which lines all entries are sent.
    """

    def __init__(self, with_levels: Rows, with_entries: Rows, is_full: Mask) -> None:
        self._with_levels, self._with_entries, self.is_full = with_levels, with_entries, is_full
        self.is_spared = np.zeros_like(is_full)  #: (L,) which have levels whatever they cost
        self._costs = np.zeros(len(is_full))

    def rows(self, places: Places) -> Rows:
        """Return the raw values of the lines at some places, each in its form."""
        chosen = {
            name: np.where(self.is_full, values, self._with_levels.get(name, 0))[places]
            for name, values in self._with_entries.items()
        }
        return chosen | {FORM: self.is_full[places].astype(np.int64)}

    def spare_one(self, places: Places) -> None:
        """Let the line for which levels cost the least have them, if none has and they cover it."""
        cheapest = places[self._costs[places].argmin()]
        if self.is_full[places].all() and 0 < self._costs[cheapest] < np.inf:
            self.is_full[cheapest], self.is_spared[cheapest] = False, True

    def need_entries(self, places: Places, costs: Array) -> bool:
        """Send all entries of the lines for which levels cost too much; whether there are any."""
        if not (costs > 1).any():
            return False
        self._costs[places] = np.maximum(self._costs[places], costs)
        self.is_full[places] |= costs > 1
        return True

    def need_levels(self, places: Places, covered: Mask) -> bool:
        """Send levels of lines that no entries cover; whether there are any.

        Entries have ranges; what levels stand for has none in a range of a few metres.
        """
        by_levels = ~covered & self.is_full[places] & ~self.is_spared[places]
        by_levels &= np.isfinite(self._costs[places])
        self.is_spared[places] |= by_levels
        self.is_full[places] &= ~by_levels
        return bool(by_levels.any())


def level_above(signal: Signal, sigma: float) -> int:
    """Return the raw value of the least level from sigma on, or the greatest; 0 for 0."""
    if sigma <= 0:
        return 0
    raw = math.ceil((float(log2(sigma)) - signal.offset) / signal.factor - 1e-9)
    return min(max(raw, 1), signal.raw_max)
