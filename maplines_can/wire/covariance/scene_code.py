"""Code of scenes: the pose error once, and the line-specific covariance of each line.

All lines of a scene are seen from one pose, so their parameters are theta_i = f_i(delta) + own_i,
with delta ~ N(0, P) the pose error. The receiver knows f_i: it is the decoded line, seen from a
displaced pose. From P' and the decoded covariances D_i of own_i it rebuilds the joint covariance

    C = cov f(delta) + blockdiag(D_1, ..., D_L),   delta ~ N(0, P')

by sigma points that go through all lines at once. It has factors: C = A A^T + blockdiag(F_i F_i^T),
with A (4 L, 7) the deviations of the sigma points, and F_i regular. So C is positive definite for
any bits.

D_i has one of two forms. ``SpecificLevels`` takes 19 bits and suffices for most lines whose map
error is known. The form with all entries takes as many bits as the covariance of a line by itself;
it comes with finer means.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.errors import IllPosedError
from ...values.fixed_order import cholesky, product, upper_solution
from ...values.linalg import block_diagonal
from ...values.line import Slot
from ...values.seen_lines import SeenLines, bases
from ..layout.record_layout import RecordLayout
from ..layout.signals import (
    FINE_SIGNALS,
    PARAMETER_SIGNALS,
    POSE_ROWS,
    SLOT_SIGNALS,
    SignalRow,
    slot_title,
)
from .cholesky import CholeskyCode
from .factor import PowersOfTwo
from .specific_levels import SpecificLevels

Array = NDArray[np.float64]

#: Signal that says whether a record has all entries of D_i.
FORM = "HasCovariance"
#: Standard deviation of the coefficients of ``bases`` that D_i of levels has at least: about that
#: of the rounding errors of the means [m].
RESOLUTION = 2.0**-9
#: Share by which variances are enlarged, more than the rounding error of their sum: so matrices are
#: definite even if the pose error is millions of times what is line-specific.
ROUNDING = 2.0**-42
#: (L,) raw values by signal.
Rows = dict[str, NDArray[np.int64]]


class DecodedPose(NamedTuple):
    """Content of a Pose record that matters to the covariance of lines."""

    cov: Array  #: (3, 3) P'
    correlation_time: float  #: [s]
    offset_sigma: float  #: common offset of the points of a line of the map [m]
    heading_sigma: float  #: common rotation of the points of a line of the map [rad]


class DecodedLines(NamedTuple):
    """L lines of a scene as a receiver decodes them. What is of a line depends on no other one."""

    means: Array  #: (L, 4)
    fit_ranges: Array  #: (L, 2) [m]
    specific_covs: Array  #: (L, 4, 4) D_i
    quartics: Array  #: (L,) coefficients of T_4 [m]
    spread: Array  #: (4 L, 7) A
    specific_factors: Array  #: (L, 4, 4) F_i

    @classmethod
    def joined(cls, some: Iterable[DecodedLines]) -> DecodedLines:
        """Return lines that were decoded with the same pose."""
        return cls(*map(np.concatenate, zip(*some, strict=True)))

    def one(self, i: int) -> DecodedLines:
        """Return one of the lines."""
        line, rows = slice(i, i + 1), slice(4 * i, 4 * i + 4)
        return DecodedLines(
            self.means[line],
            self.fit_ranges[line],
            self.specific_covs[line],
            self.quartics[line],
            self.spread[rows],
            self.specific_factors[line],
        )

    @property
    def cov(self) -> Array:
        """(4 L, 4 L) joint covariance C."""
        cov = product(self.spread, self.spread.T) + block_diagonal(self.specific_covs)
        cov[np.diag_indices_from(cov)] *= 1 + ROUNDING
        return cov

    @property
    def covs(self) -> Array:
        """(L, 4, 4) covariances of the lines: the blocks on the diagonal of C."""
        A = self.spread.reshape(-1, 4, self.spread.shape[1])
        covs = product(A, A.mT) + self.specific_covs
        covs[:, range(4), range(4)] *= 1 + ROUNDING
        return covs


def _first_slot(pose: RecordLayout) -> str:
    """Return the prefix of the levels of the first slot; those of the others are the same."""
    titles = [slot_title(slot) for slot in Slot]
    return next((t for t in titles if f"{t}{SLOT_SIGNALS[0]}" in pose.signals), titles[0])


class SceneCode:
    """Code of the raw values of a Pose record and of the records of lines.

    There are two kinds of records of lines. Those that are conditional on the pose have a mean, a
    range, and D_i in one of its forms. Those with a covariance of their own have no room for D_i:
    their levels are in the Pose record, and their covariance is not used here. ``SceneEncoder``
    encodes both.

    Args:
        pose: layout of the Pose record.
        line: layout of the records of lines.

    Raises:
        LayoutError: a signal is missing or not suitable.
    """

    def __init__(self, pose: RecordLayout, line: RecordLayout) -> None:
        self.pose_code = CholeskyCode(pose, POSE_ROWS)
        self.time, self.offset, self.heading = (
            pose[name] for name in ("CorrelationTime", "MapOffset", "MapHeading")
        )
        self._times, self._offsets, self._headings = map(
            PowersOfTwo, (self.time, self.offset, self.heading)
        )
        #: Whether the records of lines are conditional on the pose.
        self.is_conditional = FORM in line.signals
        levels, prefix = (line, "") if self.is_conditional else (pose, _first_slot(pose))
        self.mean = [line[name] for name in PARAMETER_SIGNALS]
        self.range = [line["XMin"], line["XMax"]]
        names = SLOT_SIGNALS[:4] if self.is_conditional else SLOT_SIGNALS
        own = [replace(levels[prefix + name], name=name) for name in names]
        self.levels = SpecificLevels(*own[:3])
        self.quartic, self.fit = own[3], own[4:]
        self.entries_code = CholeskyCode(line) if self.is_conditional else None
        self.fine = [line[name] for name in FINE_SIGNALS] if self.is_conditional else []
        self._mean, self._range, self._fit, self._fine = map(
            SignalRow, (self.mean, self.range, self.fit, self.fine)
        )

    def decode_pose(self, raw: Mapping[str, int]) -> DecodedPose:
        """Return the content of a Pose record from its raw values by signal."""
        offset, heading = (
            0.0 if raw[s.name] == 0 else powers.of_one(raw[s.name])
            for s, powers in ((self.offset, self._offsets), (self.heading, self._headings))
        )
        time = self.correlation_time(raw[self.time.name])
        cov = self.pose_code.decode_one(raw)
        return DecodedPose(cov, time, offset, heading)

    def correlation_time(self, raw: int) -> float:
        """Return the correlation time of a raw value [s]; infinite for 0, which means unknown."""
        return math.inf if raw == 0 else self._times.of_one(raw)

    def raw_time(self, correlation_time: float) -> int:
        """Return the least raw value whose correlation time is not less than this one [s].

        It is 0, unknown, if there is none: a consumer would take errors of times that are too short
        for independent, and average them away.
        """
        raw = range(1, self.time.raw_max + 1)
        i = bisect_left(raw, correlation_time, key=self.correlation_time)
        return raw[i] if i < len(raw) else 0

    def decode(self, pose: DecodedPose, lines: Sequence[Mapping[str, int]]) -> DecodedLines:
        """Return lines, and the parts of their joint covariance.

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
        means, fit_ranges, quartics = self.decode_lines(raw)
        if not (fit_ranges[:, 0] < fit_ranges[:, 1]).all():
            raise IllPosedError("the range of a line is empty")
        seen = SeenLines(means, fit_ranges, quartics)
        J = bases(means, fit_ranges)
        A = seen.spread_factor(pose.cov)
        common = _common(J, pose, seen.jacobian() if _has_map_error(pose) else None)
        F = self._specific_factors(raw, means, fit_ranges, common, J)
        return DecodedLines(means, fit_ranges, product(F, F.mT), quartics, A, F)

    def decode_lines(self, raw: Rows) -> tuple[Array, Array, Array]:
        """Return the (L, 4) means, (L, 2) fit ranges and (L,) quartics."""
        means, fit_ranges = (row.physical_of(raw) for row in (self._mean, self._range))
        if self.fit:
            fit_ranges += self._fit.physical_of(raw) * [-1.0, 1.0]
        if self.fine and (full := raw[FORM] == 1).any():
            means[full] += self._fine.physical_of(raw)[full]
        return means, fit_ranges, np.asarray(self.quartic.physical(raw[self.quartic.name]))

    def decode_specific(self, raw: Rows, means: Array, fit_ranges: Array, common: Array) -> Array:
        """Return the (L, 4, 4) D_i of (L,) raw values.

        Args:
            raw: raw values by signal.
            means: (L, 4) lines.
            fit_ranges: (L, 2) [m].
            common: (L, 4, 4) that of ``common``.
        """
        F = self._specific_factors(raw, means, fit_ranges, common, bases(means, fit_ranges))
        return product(F, F.mT)

    def _specific_factors(
        self, raw: Rows, means: Array, fit_ranges: Array, common: Array, J: Array
    ) -> Array:
        """Return the (L, 4, 4) factors F_i of D_i; J are the derivatives of ``bases``."""
        F, full = np.empty_like(J), raw[FORM] == 1
        if not full.all():
            own = self.levels.decode(raw, means, fit_ranges) + common
            own[:, range(4), range(4)] *= 1 + ROUNDING
            F[...] = product(J, cholesky(own))
        if self.entries_code is not None and full.any():
            signals = self.entries_code.signals
            F[full] = self.entries_code.factors({s.name: raw[s.name][full] for s in signals})
        return F

    def common(self, seen: SeenLines, pose: DecodedPose) -> Array:
        """Return the (L, 4, 4) covariances of the coefficients of T_0 .. T_3 that all lines have.

        They are those of the resolution of the means, and what the levels of the map error of a
        scene stand for.
        """
        J = bases(seen.means, seen.fit_ranges)
        return _common(J, pose, seen.jacobian() if _has_map_error(pose) else None)

    def _is_full(self, line: Mapping[str, int]) -> bool:
        """Return whether raw values have all entries of D_i."""
        return self.entries_code is not None and self.entries_code.inflation.name in line


def _has_map_error(pose: DecodedPose) -> bool:
    """Return whether a Pose record states errors of the map, which act as pose errors."""
    return pose.offset_sigma > 0 or pose.heading_sigma > 0


def _common(J: Array, pose: DecodedPose, by_pose: Array | None = None) -> Array:
    """Return ``SceneCode.common`` of (L, 4, 4) derivatives of ``bases``.

    Args:
        J: derivatives of the lines with respect to the coefficients of T_0 .. T_3.
        pose: the Pose record.
        by_pose: (L, 4, 3) derivatives of the lines with respect to the pose, if that has errors of
            the map.
    """
    cov = np.zeros_like(J)
    cov[:, range(4), range(4)] = RESOLUTION**2
    if by_pose is not None:
        sigma = np.array([pose.offset_sigma, pose.offset_sigma, pose.heading_sigma])
        # J is upper triangular: T_k has no derivative beyond the k-th.
        K = upper_solution(J.mT, by_pose * sigma)
        cov += product(K, K.mT)
    return cov
