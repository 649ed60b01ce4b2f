"""Prediction of a line to another time, with the motion of the car and its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..values.arrays import number_text
from ..values.elementary import sin_cos
from ..values.gaussian import Gaussian, independent
from ..values.line import (
    PARAMETERS,
    MapLine,
    Status,
    lateral,
    transform_line,
    transform_line_or_nan,
)
from ..values.mixture import GaussianMixture
from .motion import Motion
from .sigma_points import SIGMA_POINTS
from .transform import Transform

#: Largest time between pose and prediction [s]. Beyond it a constant speed and yaw rate predict
#: nothing, and the two times are probably of different clocks.
MAX_TIME = 10.0
#: Standard deviations of the displacement by which the valid range is shortened at each end.
MARGIN = 3.0
#: Least length of the window in which a cubic is fitted, for shorter valid ranges [m].
MIN_WINDOW = 1.0


def predict(
    gaussian: Gaussian,
    displacement: Gaussian,
    window: tuple[float, float],
    transform: Transform = SIGMA_POINTS,
) -> Gaussian:
    """Predict the Gaussian of a line after a displacement of the car.

    The result has the moments of ``transform_line`` (Map Line Interface, section
    III-A-1) over the joint distribution of line and displacement. They are assumed
    independent: the line depends on localisation, the displacement on odometry since then.

    Args:
        gaussian: over (y_off, beta, c0, c1) in the old ego frame [m, rad, 1/m, 1/m^2].
        displacement: over (x [m], y [m], heading [rad]), the new pose in the old ego frame.
        window: (x_min, x_max) valid range of the line in the old ego frame [m].
        transform: moment transform. The 15 points of ``SigmaPoints()`` give standard deviations
            that are rather too large, by up to 1.3 % on a highway and 12 % in a street turn;
            ``Linear()`` has errors of up to 21 % of sigma in the mean.

    Raises:
        ValueError: a dimension is wrong, or the window is empty.
        IllPosedError: at a point that the transform needs, the line in the new frame
            is not a function of x or is nearly perpendicular to the x axis. ``Linear()``
            evaluates only near the mean, so it may not notice this.

    >>> line = Gaussian([1.75, 0.0, 0.001, 0.0], np.diag([0.1, 0.01, 1e-4, 1e-6]) ** 2)
    >>> now = predict(line, Motion.with_sigma(20.0, 0.0, (0.5, 0.05)).over(0.1), (0.0, 80.0))
    >>> now.mean[:2].round(3), now.sigma[:2].round(3)
    (array([1.752, 0.002]), array([0.102, 0.011]))
    """
    if gaussian.dimension != len(PARAMETERS):
        raise ValueError(f"gaussian must be over {PARAMETERS}, got {gaussian.dimension}-D")
    _check_displacement(displacement)

    def move(points: NDArray[np.float64]) -> NDArray[np.float64]:
        lines, displacements = np.split(points, [len(PARAMETERS)], axis=1)
        return transform_line_or_nan(lines, displacements, window)

    with np.errstate(over="ignore", invalid="ignore"):  # Gaussian raises for such a result
        return transform(move, independent(gaussian, displacement))


def predict_to(
    line: MapLine,
    t_ns: int,
    motion: Motion | Gaussian,
    *,
    time_sigma: float = 0.0,
    transform: Transform = SIGMA_POINTS,
) -> MapLine:
    """Predict a received line to another time, in the ego frame of that time.

    The prediction starts at the time of the pose (``pose_time_ns``). ``t_ns`` may be earlier, for
    example that of an older camera image. Each component of a mixture is predicted and keeps its
    weight. Slot, kind and status stay. x_min and x_max become the ends of the mean line in the new
    frame, moved inwards by three standard deviations of the displacement.

    The result has the time ``t_ns`` and the age 0, since its frame is that of ``t_ns``. It may be
    predicted further, or sent. The age of the measurement is only known from the received line.

    The status determines how the covariance is predicted. For UNKNOWN only the mean is
    transformed; the covariance stays ``VAGUE_SIGMA``. For DIAGONAL the covariance is predicted as
    if all correlations were zero.

    Args:
        line: a line with its reception time.
        t_ns: the time to predict to, on the clock of ``line.t_ns`` [ns].
        motion: the motion of the car; or its displacement from the time of the pose to
            ``t_ns``, (x [m], y [m], heading [rad]), from odometry.
        time_sigma: standard deviation of the time difference [s]. In the message the age is
            rounded up to steps of 8 ms, so the pose may be up to 8 ms younger: 0.005 covers that.
        transform: moment transform, see ``predict``.

    Raises:
        ValueError: the line is not usable (its status is OUT_OF_RANGE or its age is infinite, see
            ``MapLine.is_usable``) or was not received (``t_ns`` is None), the time is more than
            10 s from its pose, or a value or dimension is wrong.
        IllPosedError: see ``predict``.

    >>> line = MapLine(0, Gaussian([1.75, 0.01, 0, 0], np.diag([0.1, 0.01, 1e-4, 1e-6]) ** 2),
    ...                x_max=80.0, age=0.04, t_ns=1_000_000_000)
    >>> now = predict_to(line, 1_060_000_000, Motion.with_sigma(20.0, 0.0, (0.2, 0.01)))
    >>> now.gaussian.mean.round(4) + 0.0, round(now.x_max, 2), now.age  # 0.1 s and 2 m on
    (array([1.77, 0.01, 0.  , 0.  ]), 77.94, 0.0)
    """
    if line.status is Status.OUT_OF_RANGE:
        raise ValueError(
            f"line must be usable, got {line.slot.name} with status OUT_OF_RANGE, which has "
            "neither mean nor covariance; check line.is_usable first"
        )
    away_ns = t_ns - pose_time_ns(line)
    if not abs(away_ns) <= MAX_TIME * 1e9:
        raise ValueError(
            f"t_ns must be within {MAX_TIME:g} s of the line's pose, got {number_text(t_ns)}, "
            f"which is {number_text(away_ns)} ns from it; use the clock [ns] of "
            f"line.t_ns={number_text(line.t_ns)}"
        )
    dt = away_ns * 1e-9
    if isinstance(motion, Motion):
        displacement = motion.over(dt, time_sigma)
    elif time_sigma:
        raise ValueError(
            f"time_sigma must be 0 with a displacement, got {time_sigma!r}; "
            "increase the covariance of the displacement instead"
        )
    else:
        displacement = motion
    _check_displacement(displacement)
    window = line.x_min, line.x_max
    x_min, x_max = _valid_range(line.gaussian.mean, displacement, window)
    missing = max(0.0, MIN_WINDOW - (window[1] - window[0]))
    window = window[0] - missing / 2, window[1] + missing / 2
    gaussian, mixture = line.gaussian, line.mixture
    if line.status == Status.UNKNOWN:
        mixture = None
        gaussian = Gaussian(transform_line(gaussian.mean, displacement.mean, window), gaussian.cov)
    elif mixture is None:
        gaussian = predict(gaussian, displacement, window, transform)
    else:
        components = (predict(c, displacement, window, transform) for c in mixture.components)
        mixture = GaussianMixture(mixture.weights, tuple(components))
        gaussian = mixture.overall
    return replace(
        line, gaussian=gaussian, mixture=mixture, x_min=x_min, x_max=x_max, t_ns=t_ns, age=0.0
    )


def pose_time_ns(line: MapLine) -> int:
    """Return the time of the pose that a received line refers to, on the receiver's clock [ns].

    This is the reception time minus the age; the transmission time is neglected. The age is
    rounded up, so the pose may be younger by one step of the age and the lateness that the
    transmitter allows for: up to 12 ms with the project's DBC.

    Raises:
        ValueError: the line was not received (``t_ns`` is None), or its age is infinite: it is too
            old, or its age is unknown.

    >>> pose_time_ns(MapLine.mean_only(0, [1.75, 0, 0, 0], age=0.04, t_ns=1_000_000_000))
    960000000
    """
    if line.t_ns is None:
        raise ValueError(
            "line.t_ns must be the reception time [ns], got None; set it with "
            "dataclasses.replace(line, t_ns=...), or use predict(line.gaussian, displacement, ...)"
        )
    if not math.isfinite(line.age):
        raise ValueError(
            f"line.age must be finite, got {line.age} s for {line.slot.name}: the line is too old, "
            "or its age is unknown; check line.is_usable first"
        )
    return line.t_ns - round(line.age * 1e9)


def _check_displacement(displacement: Gaussian) -> None:
    """Raise ValueError unless the Gaussian is over three variables."""
    if displacement.dimension != 3:
        raise ValueError(
            "displacement must be over (x [m], y [m], heading [rad]), "
            f"got {displacement.dimension}-D"
        )


@np.errstate(over="ignore", invalid="ignore")  # the constructor of the result raises
def _valid_range(
    mean: NDArray[np.float64], displacement: Gaussian, window: Sequence[float]
) -> tuple[float, float]:
    """Return (x_min, x_max) of the mean line in the new frame, less the uncertainty [m]."""
    dx, dy, heading = displacement.mean
    d, c = sin_cos(heading)
    x = np.array(window)
    s, t = x - dx, lateral(mean, x) - dy
    u = c * s + d * t
    J_u_displacement = np.column_stack([np.full(2, -c), np.full(2, -d), c * t - d * s])
    variance = np.einsum("ki,ij,kj->k", J_u_displacement, displacement.cov, J_u_displacement)
    order = u.argsort()  # after a U-turn the end comes first
    x_min, x_max = u[order] + MARGIN * np.sqrt(variance.clip(0))[order] * [1, -1]
    if x_min > x_max:
        x_min = x_max = u.mean()
    return float(x_min), float(x_max)
