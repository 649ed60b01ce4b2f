"""Reader of scenes: lines and their joint Gaussian, from the pose error and the lines' records."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.elementary import exp2
from ...values.gaussian import Gaussian
from ...values.line import PARAMETERS, Kind, MapLine, Slot, Status
from ...values.map_error import MapError
from ...values.scene import PoseError, Scene
from ...values.seen_lines import SeenLines, valid_ranges
from ..covariance.scene_code import DecodedLines, SceneCode
from ..layout.message_layout import Layout
from ..layout.pose_layout import PoseLayout, slot_of
from ..layout.signals import PARAMETER_SIGNALS, SLOT_SIGNALS, slot_title
from .record import RawRecord

#: Steps of the ends of the valid range [1/m]. The ends are moved inwards to the next one, so that a
#: range that is computed from decoded values does not exceed that of the sender. A division gives
#: the floating-point number nearest to the decimal: -19.9, where -199 * 0.1 is -19.900000000000002.
STEPS = 10
#: Least derivative of Beta with respect to the heading of the car; that of a straight line is 1.
MIN_TURN = 0.1
N = len(PARAMETERS)


class Member(NamedTuple):
    """A received line of a scene: its record, or the line if that has its own covariance."""

    content: RawRecord | MapLine
    t_ns: int  #: time of its first frame [ns]


class SceneReader:
    """Reader of scenes of a layout with a message of the pose error."""

    def __init__(self, layout: Layout, pose: PoseLayout, code: SceneCode) -> None:
        self._code = code
        self._age, self._too_old = pose["Age"], pose["Age"].raw_max
        self._heading_step = float(exp2(pose["MapHeading"].factor))
        self._greatest_heading = pose["MapHeading"].raw_max
        self._signals = [layout[name] for name in (*PARAMETER_SIGNALS, "XMin", "XMax")]

    def scene(self, pose: RawRecord, t_ns: int, members: Sequence[Member]) -> Scene:
        """Return the scene of a pose error and the lines received that belong to it.

        Its lines have the covariances that they have in the joint one. That of a complete record is
        often smaller, as it need not be conditional on the pose error: it stays with the line of
        the slot, as ``Decoder.feed`` returns it.

        Args:
            pose: record of the pose error.
            t_ns: time of its first frame [ns].
            members: its lines.

        Raises:
            IllPosedError: a line is no function of x in its range; no sender sends such a line.
        """
        decoded_pose = self._code.decode_pose(pose.raw)
        error = PoseError(decoded_pose.cov, decoded_pose.correlation_time)
        map_error = MapError(
            offset_sigma=decoded_pose.offset_sigma, heading_sigma=decoded_pose.heading_sigma
        )
        if not members:
            return Scene((), np.zeros((0, 0)), error, np.zeros((0, 2)), map_error)
        raw = [self._raw(member.content, pose.raw) for member in members]
        decoded = self._code.decode(decoded_pose, raw)
        x_ranges = valid_ranges(
            decoded.means,
            decoded.fit_ranges,
            decoded_pose.cov,
            decoded.specific_covs,
            self._heading_sigma(pose, decoded_pose.heading_sigma, decoded),
        )
        x_min = np.ceil(x_ranges[:, 0] * STEPS) / STEPS + 0.0  # without -0.0
        x_max = np.floor(x_ranges[:, 1] * STEPS) / STEPS
        age = self.age(pose)
        lines = []
        for i, (content, line_ns) in enumerate(members):
            block = slice(N * i, N * i + N)
            cov = decoded.cov[block, block].copy()
            if isinstance(content, MapLine):
                gaussian = Gaussian.trusted(content.gaussian.mean, cov)
                lines.append(replace(content, gaussian=gaussian, status=_of_scene(content.status)))
                continue
            low, high = float(x_min[i]), float(x_max[i])
            middle = float(x_ranges[i].mean())
            lines.append(
                MapLine(
                    slot=slot_of(content.owner),
                    gaussian=Gaussian.trusted(decoded.means[i].copy(), cov),
                    kind=Kind(content.raw["Kind"]),
                    x_min=min(low, middle),
                    x_max=max(high, middle) if low <= high else middle,
                    age=_later(age, line_ns - t_ns),
                    t_ns=line_ns,
                )
            )
        return Scene(
            tuple(lines),
            decoded.cov,
            error,
            decoded.fit_ranges,
            map_error,
            quartics=decoded.quartics,
            specific_covs=decoded.specific_covs,
        )

    def _heading_sigma(
        self, pose: RawRecord, sigma: float, decoded: DecodedLines
    ) -> NDArray[np.float64]:
        """Return the (n,) largest standard deviations of the map's heading at each line [rad]."""
        largest = np.full(len(decoded.means), sigma * self._heading_step)
        if pose.raw["MapHeading"] != self._greatest_heading:
            return largest
        # It may be beyond the levels, but no more than the variance of Beta has room for.
        seen = SeenLines(decoded.means, decoded.fit_ranges, decoded.quartics)
        turn = np.abs(seen.jacobian()[:, 1, 2]).clip(MIN_TURN)
        return np.maximum(largest, np.sqrt(decoded.specific_covs[:, 1, 1]) / turn)

    def age(self, pose: RawRecord) -> float:
        """Return the age of a pose error when it was sent [s]; infinite if it is too old."""
        raw = pose.raw["Age"]
        return math.inf if raw >= self._too_old else self._age.physical_one(raw) / 1000

    def _raw(self, content: RawRecord | MapLine, pose: Mapping[str, int]) -> dict[str, int]:
        """Return the raw values of a line: mean, range, and line-specific covariance."""
        if isinstance(content, RawRecord):
            return dict(content.raw)
        values = [*content.gaussian.mean, content.x_min, content.x_max]
        raw = {s.name: int(s.raw(x)) for s, x in zip(self._signals, values, strict=True)}
        prefix = slot_title(Slot(content.slot))
        return raw | {name: pose[prefix + name] for name in SLOT_SIGNALS}


def _of_scene(status: Status) -> Status:
    """Return the status of a line whose record may have said less of its covariance than a scene.

    >>> _of_scene(Status.DIAGONAL).name, _of_scene(Status.SATURATED).name
    ('FULL', 'SATURATED')
    """
    return Status.FULL if status in (Status.UNKNOWN, Status.DIAGONAL) else status


def _later(age: float, passed_ns: int) -> float:
    """Return an age [s] when some time [ns] has passed, 0 or more.

    It is in whole nanoseconds, up to 2^53 of them.

    >>> _later(0.008, 1_620_000), _later(0.008, -9_000_000), _later(math.inf, 1)
    (0.00962, 0.0, inf)
    """
    return age if math.isinf(age) else max(float(round(1e9 * age)) + passed_ns, 0.0) / 1e9
