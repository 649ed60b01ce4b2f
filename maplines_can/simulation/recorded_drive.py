"""Recorded drive: pose and motion of a car between the records of a file or of a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats
from ..values.errors import DriveFileError
from ..values.gaussian import Gaussian
from .drive_columns import POSITION, chosen, quantities, read_csv
from .map_frame import north, project
from .recorded_errors import covariances, covered, first_problem, linear, valid_series
from .trajectory import CarState, even_times

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

#: Longest time between two records that is interpolated [s].
MAX_GAP = 1.5


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """Pose and motion of a car, interpolated between records.

    Position and heading are cubic between two records, with the derivatives of the parabola through
    three records (Catmull-Rom); speed, yaw rate and covariance are linear. Without a recorded speed
    or yaw rate, it is the derivative of the pose. Gaps longer than ``max_gap`` are not bridged.

    Args:
        t: (n,) increasing times of the records [s].
        pose: (n, 3) x [m], y [m], heading [rad] in the map frame; the heading may have steps of
            2 pi.
        speed: (n,) along the heading [m/s].
        yaw_rate: (n,) positive to the left [rad/s].
        cov: (n, 3, 3) covariances of the recorded poses.
        max_gap: longest time between two records that is interpolated [s].
        skipped: number of records of the file that are not used, because a value is missing or
            not finite.

    Raises:
        ValueError: a shape or a value is wrong, a time is not later than the one before, or a
            matrix is not a covariance.

    >>> drive = RecordedDrive([0, 1, 2, 9], [[0, 0, 0], [10, 0, 0], [20, 0, 0], [90, 0, 0]])
    >>> state = drive.at(0.5)
    >>> state.pose, state.speed, drive.covers([0.5, 2.5])
    (array([5., 0., 0.]), array(10.), array([ True, False]))
    """

    t: NDArray[np.float64]
    pose: NDArray[np.float64]
    speed: NDArray[np.float64] | None = None
    yaw_rate: NDArray[np.float64] | None = None
    cov: NDArray[np.float64] | None = None
    max_gap: float = MAX_GAP
    skipped: int = 0
    _spline: CubicHermiteSpline = field(init=False, repr=False)

    def __post_init__(self) -> None:
        from scipy.interpolate import CubicHermiteSpline

        n = np.size(self.t)
        shapes = {"t": (n,), "pose": (n, 3), "speed": (n,), "yaw_rate": (n,), "cov": (n, 3, 3)}
        for name, shape in shapes.items():
            if getattr(self, name) is None:
                continue
            array = np.array(floats(getattr(self, name), name))
            if array.shape != shape or not n:
                raise ValueError(f"{name} must have shape {shape}, with n >= 1, got {array.shape}")
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if not 0 < floats(self.max_gap, "max_gap") < np.inf:
            raise ValueError(f"max_gap must be finite and more than 0 s, got {self.max_gap!r}")
        if problem := first_problem(self.t, self.pose, self.speed, self.yaw_rate, self.cov):
            raise ValueError(f"record {problem[0]}: {problem[1]}")
        pose = self.pose.copy()
        pose[:, 2] = np.unwrap(pose[:, 2])
        rate = np.zeros_like(pose)
        for piece in np.split(np.arange(n), np.flatnonzero(self._is_gap) + 1):
            if len(piece) > 1:
                rate[piece] = _derivative(self.t[piece], pose[piece])
        times, poses, rates = self.t, pose, rate
        if n == 1:  # a spline has two points
            times, poses, rates = (
                np.append(times, times + 1),
                np.tile(pose, (2, 1)),
                np.zeros((2, 3)),
            )
        object.__setattr__(self, "_spline", CubicHermiteSpline(times, poses, rates))

    @classmethod
    def from_csv(
        cls,
        path: str | PathLike[str],
        projection: str | None = None,
        max_gap: float = MAX_GAP,
    ) -> RecordedDrive:
        """Return the drive of a CSV file with a header; other columns are ignored.

        Time, position and heading are needed:

        - ``time`` [s], ``time_ms``, ``time_us`` or ``time_ns``
        - ``x``, ``y`` in the map frame [m]; or ``lat_deg``, ``lon_deg`` of WGS84
        - ``heading`` [rad] or ``heading_deg``, counter-clockwise from the x axis of the map; or,
          with latitude and longitude, ``bearing`` [rad] or ``bearing_deg``, clockwise from north
        - ``speed`` [m/s], ``speed_kmh`` or ``speed_mph``
        - ``yaw_rate`` [rad/s] or ``yaw_rate_deg_s``
        - ``sigma_x``, ``sigma_y`` [m], ``sigma_heading`` [rad] or ``sigma_heading_deg``; or
          ``sigma_along``, ``sigma_across``, ``sigma_heading`` in the ego frame; or ``cov_xx``,
          ``cov_xy``, ``cov_yy``, ``cov_xh``, ``cov_yh``, ``cov_hh`` in the map frame

        A row with an empty or non-finite value in one of these columns is skipped and counted.

        Args:
            path: of the file; the delimiter is a comma, a semicolon or a tab.
            projection: of the map, for latitude and longitude.
            max_gap: see ``RecordedDrive``.

        Raises:
            DriveFileError: the file cannot be used; the message has the line and the cure.
            MissingExtraError: pyproj is needed and not installed.
        """
        table, lines, skipped = read_csv(path)
        return _drive(table, projection, max_gap, str(path), skipped, lambda i: f"line {lines[i]}")

    @classmethod
    def from_signals(
        cls,
        signals: Mapping[str, tuple[ArrayLike, ArrayLike]],
        projection: str | None = None,
        max_gap: float = MAX_GAP,
    ) -> RecordedDrive:
        """Return the drive of signals that were received at different times.

        The records have the times of the first signal of the position (``x`` or ``lat_deg``). The
        others are interpolated to these times, unless they have a gap there; such a record, and
        one whose position is not finite, is skipped and counted.

        Args:
            signals: times (n,) [s] and values (n,) by the column names of ``from_csv``, as
                ``maplines_can.bus.read_signals`` returns them.
            projection: of the map, for latitude and longitude.
            max_gap: see ``RecordedDrive``.

        Raises:
            DriveFileError: a signal is missing, or a value is wrong.
            MissingExtraError: pyproj is needed and not installed.
        """
        source = "signals"
        found = quantities(["time", *signals], source)
        del found["time"]
        series = {
            quantity: valid_series(signals[column], column, factor)
            for quantity, (column, factor) in found.items()
        }
        t = series[chosen(found, POSITION)[0]][0]
        table = {"time": t}
        for quantity, (times, values) in series.items():
            if quantity in {"heading", "bearing"}:
                values = np.unwrap(values)
            known = covered(times, t, max_gap)
            table[quantity] = np.where(known, np.interp(t, times, values), np.nan)
        good = np.all([np.isfinite(values) for values in table.values()], axis=0)
        table = {quantity: values[good] for quantity, values in table.items()}
        skipped = int(np.size(signals[found[chosen(found, POSITION)[0]][0]][0]) - good.sum())
        return _drive(
            table, projection, max_gap, source, skipped, lambda i: f"t = {table['time'][i]:.6f} s"
        )

    @property
    def start(self) -> float:
        """First time [s]."""
        return float(self.t[0])

    @property
    def end(self) -> float:
        """Last time [s]."""
        return float(self.t[-1])

    @property
    def gaps(self) -> NDArray[np.float64]:
        """(k, 2) first and last times of the gaps that are not bridged [s]."""
        return np.column_stack([self.t[:-1], self.t[1:]])[self._is_gap]

    def covers(self, t: ArrayLike) -> NDArray[np.bool_]:
        """Return (...,) whether the pose is known at (...,) times [s]."""
        return covered(self.t, floats(t, "t"), self.max_gap)

    def times(self, rate: float) -> NDArray[np.float64]:
        """Return the (n,) times of a rate in Hz at which the pose is known [s].

        Raises:
            ValueError: the rate is not positive.
        """
        times = even_times(self.start, self.end, rate)
        return times[self.covers(times)]

    def at(self, t: ArrayLike) -> CarState:
        """Return pose and motion at one time or at (n,) times [s]; the heading is continuous.

        Raises:
            ValueError: a time is outside the drive, or in a gap.
        """
        t = self._require(t)
        pose, rate = self._spline(t), self._spline(t, 1)
        heading = pose[..., 2]
        speed = (
            rate[..., 0] * np.cos(heading) + rate[..., 1] * np.sin(heading)
            if self.speed is None
            else linear(self.t, self.speed, t)
        )
        yaw_rate = rate[..., 2] if self.yaw_rate is None else linear(self.t, self.yaw_rate, t)
        return CarState(t, pose, np.asarray(speed), np.asarray(yaw_rate))

    def reported(self, t: float) -> Gaussian:
        """Return the recorded pose at a time, with its recorded covariance.

        Raises:
            ValueError: the drive has no covariances, or the time is outside it or in a gap.
        """
        if self.cov is None:
            raise ValueError(
                "the drive has no covariances; record them (see from_csv), or use a PoseSource"
            )
        pose = self.at(t).pose
        return Gaussian(pose, linear(self.t, self.cov, floats(t, "t")))

    @property
    def _is_gap(self) -> NDArray[np.bool_]:
        return np.diff(self.t) > self.max_gap

    def _require(self, t: ArrayLike) -> NDArray[np.float64]:
        t = floats(t, "t")
        if not self.covers(t).all():
            worst = t[~self.covers(t)].flat[0]
            raise ValueError(
                f"t must be from {self.start:.3f} to {self.end:.3f} s and not between records more "
                f"than {self.max_gap:g} s apart, got {worst:.3f}; use times(), or a larger max_gap"
            )
        return t


def _drive(
    table: Mapping[str, NDArray[np.float64]],
    projection: str | None,
    max_gap: float,
    source: str,
    skipped: int,
    where: Callable[[int], str],
) -> RecordedDrive:
    """Return the drive of the quantities of a file; ``where`` names a record in the messages."""
    t = table["time"]
    if not len(t):
        raise DriveFileError(
            f"{source}: has no record that can be used ({skipped} skipped, because a value is "
            "missing or not finite)"
        )
    degrees = "lat" in table
    if "bearing" in table and not degrees:
        raise DriveFileError(
            f"{source}: a bearing from true north needs lat_deg and lon_deg; with x and y, give "
            "heading or heading_deg, counter-clockwise from the x axis"
        )
    try:
        position = (
            project(table["lat"], table["lon"], projection)
            if degrees
            else np.column_stack([table["x"], table["y"]])
        )
        heading = (
            north(table["lat"], table["lon"], projection) - table["bearing"]
            if "bearing" in table
            else table["heading"]
        )
    except DriveFileError as error:
        raise DriveFileError(f"{source}: {error}") from error
    pose = np.column_stack([position, heading])
    speed, yaw_rate = table.get("speed"), table.get("yaw_rate")
    cov = covariances(table, heading)
    if problem := first_problem(t, pose, speed, yaw_rate, cov):
        raise DriveFileError(f"{source}: {where(problem[0])}: {problem[1]}")
    return RecordedDrive(t, pose, speed, yaw_rate, cov, max_gap, skipped)


def _derivative(t: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (n, k) derivatives of (n, k) values, n >= 2, by parabolas through three records."""
    return np.asarray(np.gradient(values, t, axis=0, edge_order=2 if len(t) > 2 else 1))
