"""From the time of the pose to another: a line as it is seen after the car has moved on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from ..arrays import floats, number_text
from ..gaussian import Gaussian, variances
from ..line import STATES, MapLine, Status, lateral, transform_line, transform_line_or_nan
from ..mixture import GaussianMixture
from .sigma_points import SigmaPoints
from .transform import Transform

__all__ = ["Motion", "pose_time_ns", "predict", "predict_to"]

#: Its 15 points err on the wide side. Against a million draws, with a heading known to 5 deg: on a
#: highway means within 0.4 % of sigma, sigmas from none less to 1.3 % more; in a street turn the
#: sigma of c1 is up to 12 % more. Linear() misses means by up to 21 %, and sigmas by 11 % less.
SIGMA_POINTS = SigmaPoints()
#: Constant speed and yaw rate say nothing beyond this, and two clocks are seldom that near [s].
LONGEST = 10.0
#: Standard deviations of the displacement by which a line's extent is drawn in.
MARGIN = 3.0
#: A cubic is fitted over this at least, where a line claims to hold at less [m].
LEAST_WINDOW = 1.0


@dataclass(frozen=True, eq=False)
class Motion:
    """How the car moves while time passes: constant turn rate and velocity (CTRV).

    The way of the ego frame's origin is an arc of a circle, along the car's x
    axis at each of its points (Schubert, Richter, Wanielik, FUSION 2008): it holds
    for the middle of the rear axle. Where the origin lies elsewhere, or the car
    brakes hard, give ``carried`` and ``line_at`` the displacement itself.

    Args:
        speed: forward, negative in reverse [m/s].
        yaw_rate: positive to the left [rad/s].
        cov: (2, 2) covariance of the two; it may be singular. What is not known
            of the acceleration belongs to it as well.

    Raises:
        ValueError: a value is not finite, or ``cov`` is no covariance.

    >>> Motion(20.0, 0.0).over(0.1).mean
    array([2., 0., 0.])
    """

    speed: float
    yaw_rate: float
    cov: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 2)))

    def __post_init__(self) -> None:
        for name in ("speed", "yaw_rate"):
            if not np.isfinite(floats(getattr(self, name), name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)!r}")
        object.__setattr__(self, "cov", Gaussian(np.zeros(2), self.cov).cov)

    @classmethod
    def with_sigma(cls, speed: float, yaw_rate: float, sigma: ArrayLike) -> Motion:
        """A motion of which the (2,) standard deviations are known [m/s, rad/s].

        >>> Motion.with_sigma(20.0, 0.1, sigma=(0.2, 0.01)).over(0.1).sigma.round(4)
        array([0.02 , 0.001, 0.001])
        """
        return cls(speed, yaw_rate, np.diag(variances(sigma)))

    def over(
        self, dt: float, time_sigma: float = 0.0, transform: Transform = SIGMA_POINTS
    ) -> Gaussian:
        """Displacement of the car in a time: the new pose in the old ego frame.

        Args:
            dt: [s]; less than 0 goes back.
            time_sigma: standard deviation of ``dt`` [s].
            transform: moment transform over speed, yaw rate and time.

        Returns:
            Gaussian over (x [m], y [m], heading [rad]).

        Raises:
            ValueError: a value is not finite, or ``time_sigma`` is negative.

        >>> Motion(10.0, np.pi / 2).over(1.0).mean.round(3)  # a quarter of a circle
        array([6.366, 6.366, 1.571])
        """
        if not np.isfinite(floats(dt, "dt")):
            raise ValueError(f"dt must be finite [s], got {dt!r}")
        if not 0 <= floats(time_sigma, "time_sigma") < np.inf:
            raise ValueError(f"time_sigma must be 0 s or more and finite, got {time_sigma!r}")
        rates = Gaussian(np.array([self.speed, self.yaw_rate]), self.cov)
        time = Gaussian(np.array([dt]), np.array([[variances(time_sigma)]]))
        with np.errstate(over="ignore", invalid="ignore"):  # the result's birth refuses it
            return transform(_arc, _independent(rates, time))


def _arc(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) displacements [m, m, rad] of (N, 3) speeds, yaw rates and times."""
    speed, yaw_rate, dt = points.T
    turn = yaw_rate * dt
    chord = speed * dt * np.sinc(turn / (2 * np.pi))  # numpy's sinc has pi in it
    return np.column_stack([chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn])


def predict(
    gaussian: Gaussian,
    displacement: Gaussian,
    window: tuple[float, float],
    transform: Transform = SIGMA_POINTS,
) -> Gaussian:
    """The Gaussian of a line as seen after a displacement of the car.

    The moments of ``moved`` (Map Line Interface, section III-A-1) over line and
    displacement together, which are taken to be independent: the one comes from
    localisation, the other from odometry since.

    Args:
        gaussian: over (y_off, beta, c0, c1) in the old ego frame [m, rad, 1/m, 1/m^2].
        displacement: over (x [m], y [m], heading [rad]), the new pose in the old ego frame.
        window: where the line holds (x_min, x_max) in the old ego frame [m].
        transform: moment transform; ``SigmaPoints()`` needs 15 points.

    Raises:
        ValueError: a dimension is wrong, or the window is empty.
        IllPosedError: seen from the new pose the line stands across the car or
            doubles back, at a point that the transform needs. ``Linear()`` needs
            no points far from the mean.

    >>> line = Gaussian([1.75, 0.0, 0.001, 0.0], np.diag([0.1, 0.01, 1e-4, 1e-6]) ** 2)
    >>> now = predict(line, Motion.with_sigma(20.0, 0.0, (0.5, 0.05)).over(0.1), (0.0, 80.0))
    >>> now.mean[:2].round(3), now.sigma[:2].round(3)
    (array([1.752, 0.002]), array([0.102, 0.011]))
    """
    if gaussian.dimension != len(STATES):
        raise ValueError(f"gaussian must be over {STATES}, got {gaussian.dimension}-D")
    _check_displacement(displacement)

    def move(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return transform_line_or_nan(points[:, : len(STATES)], points[:, len(STATES) :], window)

    with np.errstate(over="ignore", invalid="ignore"):  # the result's birth refuses it
        return transform(move, _independent(gaussian, displacement))


def predict_to(
    line: MapLine,
    t_ns: int,
    motion: Motion | Gaussian,
    *,
    time_sigma: float = 0.0,
    transform: Transform = SIGMA_POINTS,
) -> MapLine:
    """A received line as it is at another time, in the ego frame of that time.

    The way from the time of its pose (``pose_time_ns``) to ``t_ns`` is the car's
    own; a time before the pose, such as that of an older camera image, is lawful.
    Each part of a mixture is carried, and keeps its weight. Slot, kind and status stay;
    x_min and x_max become the ends of the mean line as seen now, drawn in by three
    standard deviations of the displacement.

    The line returned has ``t_ns`` and the age 0, since its frame is that of
    ``t_ns``: it may be carried on from there, or sent. How long ago it was
    measured is to be asked of the line that was received.

    What the covariance is worth stays as it was. Of a line whose status is UNKNOWN
    the mean is moved, and its covariance claims as little as before. A line that
    is OUT_OF_RANGE has nothing that could be moved, and changes its time alone.
    The sigmas of a DIAGONAL line are carried as if nothing correlated.

    Args:
        line: with its time of reception.
        t_ns: the time asked for, on the clock of ``line.t_ns`` [ns].
        motion: the car's motion; or its displacement from the time of the pose to
            ``t_ns``, (x [m], y [m], heading [rad]), as odometry gives it.
        time_sigma: of the time between [s]. On the wire the age is rounded up to steps of
            8 ms, so that the pose may be 8 ms younger than it says: 0.005 covers that.
        transform: moment transform, see ``carried``.

    Raises:
        ValueError: the line was never received (``t_ns`` None), the time is more
            than 10 s from its pose, or a value or dimension is wrong.
        IllPosedError: see ``carried``.

    >>> line = MapLine(0, Gaussian([1.75, 0.01, 0, 0], np.diag([0.1, 0.01, 1e-4, 1e-6]) ** 2),
    ...                x_max=80.0, age=0.04, t_ns=1_000_000_000)
    >>> now = predict_to(line, 1_060_000_000, Motion.with_sigma(20.0, 0.0, (0.2, 0.01)))
    >>> now.gaussian.mean.round(4) + 0.0, round(now.x_max, 2), now.age  # 0.1 s and 2 m on
    (array([1.77, 0.01, 0.  , 0.  ]), 77.94, 0.0)
    """
    away_ns = t_ns - pose_time_ns(line)
    if not abs(away_ns) <= LONGEST * 1e9:
        raise ValueError(
            f"t_ns must be within {LONGEST:g} s of the line's pose, got {number_text(t_ns)}, which "
            f"is {number_text(away_ns)} ns from it; give a time [ns] of the clock that "
            f"line.t_ns={number_text(line.t_ns)} is of"
        )
    dt = away_ns * 1e-9
    if isinstance(motion, Motion):
        displacement = motion.over(dt, time_sigma)
    elif time_sigma:
        raise ValueError(
            f"time_sigma must be 0 with a displacement, got {time_sigma!r}; "
            "widen the displacement instead"
        )
    else:
        displacement = motion
    _check_displacement(displacement)
    if line.status == Status.OUT_OF_RANGE:
        return replace(line, t_ns=t_ns, age=0.0)
    window = line.x_min, line.x_max
    x_min, x_max = _extent(line.gaussian.mean, displacement, window)
    lacks = max(0.0, LEAST_WINDOW - (window[1] - window[0]))
    window = window[0] - lacks / 2, window[1] + lacks / 2
    gaussian, mixture = line.gaussian, line.mixture
    if line.status == Status.UNKNOWN:
        mixture = None
        gaussian = Gaussian(transform_line(gaussian.mean, displacement.mean, window), gaussian.cov)
    elif mixture is None:
        gaussian = predict(gaussian, displacement, window, transform)
    else:
        parts = (predict(part, displacement, window, transform) for part in mixture.components)
        mixture = GaussianMixture(mixture.weights, tuple(parts))
        gaussian = mixture.overall
    return replace(
        line, gaussian=gaussian, mixture=mixture, x_min=x_min, x_max=x_max, t_ns=t_ns, age=0.0
    )


def pose_time_ns(line: MapLine) -> int:
    """When the car had the pose that a received line is seen from, on the receiver's clock [ns].

    Its time of reception less its age; the way over the bus is taken to be none. An
    age at the end of the wire's range (248 ms) means this or more: the pose is then
    older than this says, and the line had better not be used.

    Raises:
        ValueError: the line was never received: its ``t_ns`` is None.

    >>> pose_time_ns(MapLine.mean_only(0, [1.75, 0, 0, 0], age=0.04, t_ns=1_000_000_000))
    960000000
    """
    if line.t_ns is None:
        raise ValueError(
            "line.t_ns must be the time of its reception [ns], got None; set it with "
            "dataclasses.replace(line, t_ns=...), or use predict(line.gaussian, displacement, ...)"
        )
    return line.t_ns - round(line.age * 1e9)


def _check_displacement(displacement: Gaussian) -> None:
    if displacement.dimension != 3:
        raise ValueError(
            "displacement must be over (x [m], y [m], heading [rad]), "
            f"got {displacement.dimension}-D"
        )


def _independent(*gaussians: Gaussian) -> Gaussian:
    """The Gaussian of independent variables laid end to end."""
    mean = np.concatenate([gaussian.mean for gaussian in gaussians])
    return Gaussian.trusted(mean, block_diag(*(gaussian.cov for gaussian in gaussians)))


def _extent(
    mean: NDArray[np.float64], displacement: Gaussian, window: Sequence[float]
) -> tuple[float, float]:
    """The mean line's (x_min, x_max) from the new pose, drawn in by what is not known of it [m]."""
    dx, dy, heading = displacement.mean
    c, d = np.cos(heading), np.sin(heading)
    x = np.array(window)
    s, t = x - dx, lateral(mean, x) - dy
    u = c * s + d * t
    J_u_displacement = np.column_stack([np.full(2, -c), np.full(2, -d), c * t - d * s])
    variance = np.einsum("ki,ij,kj->k", J_u_displacement, displacement.cov, J_u_displacement)
    order = u.argsort()  # seen backwards, the end comes first
    x_min, x_max = u[order] + MARGIN * np.sqrt(variance.clip(0))[order] * [1, -1]
    if x_min > x_max:
        x_min = x_max = u.mean()
    return float(x_min), float(x_max)
