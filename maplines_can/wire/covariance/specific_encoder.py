"""Encoder of the line-specific covariances D_i of a scene, in either of their forms."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.elementary import exp2
from ...values.fixed_order import congruence, inverse, product
from .cholesky import CholeskyCode
from .code import Array
from .joint import divergence, largest_ratio, uncovered
from .scene_code import FORM, RESOLUTION, Rows, SceneCode
from .specific_levels import Arc
from .stated_lines import Mask

#: Largest divergence that levels may cost a line; beyond it all entries are sent [nat].
LEVELS_KL = 0.01
#: Largest ratio of a line-specific standard deviation, with levels to without.
LEVELS_RATIO = 1.1
#: Repetitions of the enlargement of D_i.
TRIALS = 12
#: Share of what the first trial lacks by which D_i are enlarged; each next one takes twice as much.
FIRST_SHARE = 0.5
Raws = NDArray[np.int64]


class SentLines(NamedTuple):
    """L lines as a receiver decodes them, and what their D_i have to cover."""

    is_full: Mask  #: (L,) of which lines all entries are sent
    is_spared: Mask  #: (L,) of which lines levels are sent, whatever they cost
    means: Array  #: (L, 4)
    fit_ranges: Array  #: (L, 2) [m]
    J: Array  #: (L, 4, 4) derivatives of ``bases``
    common: Array  #: (L, 4, 4) of ``SceneCode.common``
    due_to_pose: Array  #: (L, 4, 4) part of the true covariances
    specific: Array  #: (L, 4, 4) the other part
    error: Array  #: (L, 4, 4) squares of the errors of the means

    @property
    def least(self) -> Array:
        """(L, 4, 4) covariances of the resolution of the means."""
        return RESOLUTION**2 * product(self.J, self.J.mT)

    def of(self, mask: Mask) -> SentLines:
        """Return some of the lines."""
        values: Iterable[Any] = self
        return SentLines(*(value[mask] for value in values))


class SpecificEncoder:
    """Encoder of line-specific covariances.

    Args:
        code: of the receiver.
    """

    def __init__(self, code: SceneCode) -> None:
        self._code = code

    def cover(self, lines: SentLines, true: Array, spread: Array) -> tuple[Rows, Mask, Array]:
        """Return raw values of (L,) D_i, which cover their lines, and the costs of levels.

        A line with a cost of more than 1 is to send all entries. It is infinite if levels do not
        cover the line.

        Args:
            lines: the lines.
            true: (4 L, 4 L) joint covariance that is to be covered.
            spread: (4 L, 4 L) that due to the decoded pose error.
        """
        more = np.zeros_like(lines.specific)
        spacings = self._spacings(lines.of(~lines.is_full))
        raw, covered, cost = self._encode(lines, more, spacings)
        for trial in range(TRIALS):
            if trial > 0:
                raw, covered, cost = self._encode_again(lines, more, spacings, raw, cost)
            if (cost > 1).any() or not covered.all():
                return raw, covered, cost
            specific = self._code.decode_specific(raw, lines.means, lines.fit_ranges, lines.common)
            lacking = uncovered(true, spread, specific, lines.J)
            if lacking is None:
                return raw, covered, cost
            comparable = np.asarray(np.isfinite(lacking).all(axis=(1, 2)))
            if not comparable.all():
                return raw, comparable, cost
            more += FIRST_SHARE * 2.0**trial * lacking
        has_entries = self._code.entries_code is not None
        return raw, np.zeros_like(covered), np.where(~lines.is_full & has_entries, np.inf, 0.0)

    def _spacings(self, lines: SentLines) -> Raws:
        """Return those of ``SpecificLevels.spacings`` for (L,) lines, each of them alone."""
        known, arc = lines.specific + lines.error, Arc.of(lines.means, lines.fit_ranges)
        return self._code.levels.spacings(known, lines.common, known + lines.least, lines.J, arc)

    def _encode_again(
        self, lines: SentLines, more: Array, spacings: Raws, raw: Rows, cost: Array
    ) -> tuple[Rows, Mask, Array]:
        """Return what ``_encode`` does, with ``raw`` and ``cost`` of the levels that still cover.

        What they cost does not depend on ``more``, and what covers more is no better.
        """
        known, names = lines.specific + lines.error, [s.name for s in self._code.levels.signals]
        stays = np.zeros_like(lines.is_full)
        if (short := ~lines.is_full).any():
            stays[short] = self._code.levels.covered(
                {name: raw[name][short] for name in names},
                (known + more)[short],
                lines.common[short],
                lines.J[short],
                lines.means[short],
                lines.fit_ranges[short],
            )
        other, covered = ~stays, np.ones_like(stays)
        if other.any():
            found, covered[other], cost[other] = self._encode(
                lines.of(other), more[other], spacings[other[short]]
            )
            for name, values in found.items():
                raw[name][other] = values
        return raw, covered, cost

    def _encode(self, lines: SentLines, more: Array, spacings: Raws) -> tuple[Rows, Mask, Array]:
        """Return what ``cover`` does, for D_i that cover each line alone plus ``more``."""
        code, is_full = self._code, lines.is_full
        signals = [*code.levels.signals, *(code.entries_code.signals if code.entries_code else ())]
        raw = {signal.name: np.zeros(len(more), dtype=np.int64) for signal in signals}
        covered, cost = np.ones_like(is_full), np.zeros(len(is_full))
        if not is_full.all():
            short = ~is_full
            levels, covered[short], of_levels = self._encode_levels(
                lines.of(short), more[short], spacings
            )
            for name, values in levels.items():
                raw[name][short] = values
            if code.entries_code is not None:
                of_levels[lines.is_spared[short]] = 0.0
                cost[short] = np.where(covered[short], of_levels, np.inf)
        if code.entries_code is not None and is_full.any():
            target = (lines.specific + lines.error + lines.least + more)[is_full]
            coded = code.entries_code.encode(target, least_variances(code.entries_code))
            covered[is_full] = coded.covered
            for name, values in coded.raw.items():
                raw[name][is_full] = values
        return raw | {FORM: is_full.astype(np.int64)}, covered, cost

    def _encode_levels(
        self, lines: SentLines, more: Array, spacings: Raws
    ) -> tuple[Rows, Mask, Array]:
        """Return the raw values of (L,) levels, which lines they cover, and what they cost."""
        levels, known = self._code.levels, lines.specific + lines.error
        arc = Arc.of(lines.means, lines.fit_ranges)
        raw, covered = levels.encode(
            known + more, lines.common, known + lines.least, lines.J, arc, spacings
        )
        to_metres = inverse(lines.J)  # all coefficients in metres
        true, whole, due_to_pose = (
            congruence(to_metres, cov)
            for cov in (
                lines.specific + lines.least,
                lines.due_to_pose + known + lines.least,
                lines.due_to_pose,
            )
        )
        decoded = levels.decode(raw, lines.means, lines.fit_ranges) + lines.common
        kl, ratio = divergence(whole, due_to_pose + decoded), largest_ratio(decoded, true)
        return raw, covered, np.maximum(kl / LEVELS_KL, ratio / LEVELS_RATIO**2)


def least_variances(code: CholeskyCode) -> Array:
    """Return the least variances that a code can decode to, for targets that are singular."""
    pivots = dict(zip(code.factor.order, code.factor.pivots, strict=True))
    return exp2([2 * pivots[i].physical_range[0] for i in range(len(pivots))])
