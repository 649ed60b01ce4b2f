"""Reader of scenes: lines and their joint Gaussian, from the pose error and the lines' records."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...values.elementary import exp2
from ...values.gaussian import Gaussian
from ...values.line import Kind, MapLine, Slot, Status
from ...values.map_error import MapError
from ...values.scene import PoseError, Scene
from ...values.seen_lines import SeenLines, valid_ranges
from ..covariance.scene_code import DecodedLines, DecodedPose, SceneCode
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


class Member(NamedTuple):
    """A received line of a scene: its record, or the line if that has its own covariance."""

    content: RawRecord | MapLine
    t_ns: int  #: time of its first frame [ns]


class ScenePose(NamedTuple):
    """A received pose error, and what it says of the lines that belong to it."""

    record: RawRecord
    t_ns: int  #: time of its first frame [ns]
    decoded: DecodedPose
    age: float  #: from the pose to the sending of the record [s]; infinite if it is too old


class SceneLine(NamedTuple):
    """A line of a scene, and its part of the scene."""

    line: MapLine  #: with the covariance that it has in the joint one
    part: DecodedLines


class SceneReader:
    """Reader of scenes of a layout with a message of the pose error.

    What there is of a line depends on its record and on the pose error only. So a line is decoded
    once, when it comes or with the others when its scene is asked for, and a scene is put together
    from its lines.
    """

    def __init__(self, layout: Layout, pose: PoseLayout, code: SceneCode) -> None:
        self._code = code
        self._age, self._too_old = pose["Age"], pose["Age"].raw_max
        self._heading_step = float(exp2(pose["MapHeading"].factor))
        self._greatest_heading = pose["MapHeading"].raw_max
        self._signals = [layout[name] for name in (*PARAMETER_SIGNALS, "XMin", "XMax")]

    def pose(self, record: RawRecord, t_ns: int) -> ScenePose:
        """Return the content of a record of the pose error, received at ``t_ns`` [ns]."""
        raw = record.raw["Age"]
        age = math.inf if raw >= self._too_old else self._age.physical_one(raw) / 1000
        return ScenePose(record, t_ns, self._code.decode_pose(record.raw), age)

    def lines(self, pose: ScenePose, members: Sequence[Member]) -> list[SceneLine]:
        """Return one or more lines that belong to a pose error.

        They have the covariances that they have in a scene. That of a complete record is often
        smaller, as it need not be conditional on the pose error: it stays with the line of the
        slot, as ``Decoder.feed`` returns it.

        Raises:
            IllPosedError: a line is no function of x in its range; no sender sends such a line.
        """
        raw = [self._raw(member.content, pose.record.raw) for member in members]
        decoded, lines = self._code.decode(pose.decoded, raw), []
        for i, (member, cov) in enumerate(zip(members, decoded.covs, strict=True)):
            content, part = member.content, decoded.one(i)
            if isinstance(content, MapLine):
                gaussian = Gaussian.trusted(content.gaussian.mean, cov)
                line = replace(content, gaussian=gaussian, status=_of_scene(content.status))
            else:
                x_min, x_max = self._valid_range(pose, part)
                line = MapLine(
                    slot=slot_of(content.owner),
                    gaussian=Gaussian.trusted(part.means[0], cov),
                    kind=Kind(content.raw["Kind"]),
                    x_min=x_min,
                    x_max=x_max,
                    age=_later(pose.age, member.t_ns - pose.t_ns),
                    t_ns=member.t_ns,
                )
            lines.append(SceneLine(line, part))
        return lines

    def scene(self, pose: ScenePose, lines: Sequence[SceneLine]) -> Scene:
        """Return the scene of a pose error and its lines."""
        known = pose.decoded
        error = PoseError(known.cov, known.correlation_time)
        map_error = MapError(offset_sigma=known.offset_sigma, heading_sigma=known.heading_sigma)
        if not lines:
            return Scene((), np.zeros((0, 0)), error, np.zeros((0, 2)), map_error)
        decoded = DecodedLines.joined(line.part for line in lines)
        return Scene(
            tuple(line.line for line in lines),
            decoded.cov,
            error,
            decoded.fit_ranges,
            map_error,
            quartics=decoded.quartics,
            specific_covs=decoded.specific_covs,
        )

    def _valid_range(self, pose: ScenePose, part: DecodedLines) -> tuple[float, float]:
        """Return the range in which a line is valid [m]."""
        known = pose.decoded
        heading = known.heading_sigma * self._heading_step
        if pose.record.raw["MapHeading"] == self._greatest_heading:
            # It may be beyond the levels, but no more than the variance of Beta has room for.
            seen = SeenLines(part.means, part.fit_ranges, part.quartics)
            turn = max(abs(float(seen.jacobian()[0, 1, 2])), MIN_TURN)
            heading = max(heading, math.sqrt(part.specific_covs[0, 1, 1]) / turn)
        ranges = valid_ranges(part.means, part.fit_ranges, known.cov, part.specific_covs, heading)
        x_min, x_max = ranges[0].tolist()
        low = math.ceil(x_min * STEPS) / STEPS
        high = math.floor(x_max * STEPS) / STEPS
        middle = (x_min + x_max) / 2
        return min(low, middle), max(high, middle) if low <= high else middle

    def _raw(self, content: RawRecord | MapLine, pose: Mapping[str, int]) -> dict[str, int]:
        """Return the raw values of a line: mean, range, and line-specific covariance."""
        if isinstance(content, RawRecord):
            return dict(content.raw)
        values = [*content.gaussian.mean.tolist(), content.x_min, content.x_max]
        raw = {s.name: s.raw_one(x) for s, x in zip(self._signals, values, strict=True)}
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
