"""Options of ``drive`` for the pose that the car knows: its errors, or its localisation."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..maps import Map
from ..simulation.pose_source import PoseSource
from ..simulation.recorded_drive import RecordedDrive
from ..simulation.trajectory import SimulatedDrive
from ..values.gaussian import Gaussian
from .parsing import number, option_group
from .stderr import note

if TYPE_CHECKING:
    from ..simulation.simulated_localisation import SimulatedLocalisation

#: Standard deviations of the reported pose: along [m], across [m], heading [deg].
SIGMA = (0.3, 0.1, 0.2)

#: Correlation time of the errors of the reported pose [s].
CORRELATION_TIME = 10.0
#: Least correlation time that is stated [s]: errors that are independent from cycle to cycle have
#: none of 0.
MIN_TIME = 1e-3


class ReportedPose(NamedTuple):
    """Pose that the car knows."""

    #: at a time [s], by the true pose; None if the car does not know it
    pose: Callable[[float, NDArray[np.float64]], Gaussian | None]
    correlation_time: Callable[[], float]  #: of its error [s]
    localisation: SimulatedLocalisation | None = None


def add_reported_pose(parser: argparse.ArgumentParser) -> None:
    """Add ``--sigma``, ``--correlation-time``, ``--localise`` and ``--scan``."""
    add = option_group(parser, "scenario").add_argument
    add(
        "--sigma",
        type=_sigma,
        metavar="ALONG,ACROSS,HEADING",
        help="standard deviations of the pose that the car knows [m, m, deg] (default: "
        f"{','.join(f'{value:g}' for value in SIGMA)}; or those of --drive, whose poses are then "
        "sent as they are)",
    )
    add(
        "--correlation-time",
        type=number(float, 0, 1e9),
        metavar="S",
        help="time in which the correlation of the pose errors falls to 1/e [s], which is also "
        "sent with the pose error, rounded up; as unknown beyond the greatest value of the DBC, "
        f"45 s (default: {CORRELATION_TIME:g}; unknown for the errors of --drive)",
    )
    add(
        "--localise",
        action="store_true",
        help="take the pose from a Kalman filter on simulated sensors: GNSS, wheel speed, yaw "
        "rate, and a camera that sees lines and landmarks; it gives the covariance and the "
        "correlation time",
    )
    add(
        "--scan",
        action="store_true",
        help="with --localise, a lidar, too, whose scans are matched with the walls and poles of "
        "the map by NDT twice a second",
    )


def check_reported_pose(arguments: argparse.Namespace) -> None:
    """Raise ValueError if ``--localise`` is given with what it replaces, or ``--scan`` alone."""
    if arguments.scan and not arguments.localise:
        raise ValueError("--scan is a sensor of --localise; give that, too")
    given = arguments.sigma is not None or arguments.correlation_time is not None
    if arguments.localise and given:
        raise ValueError(
            "--localise gives the errors of the pose itself; leave out --sigma and "
            "--correlation-time"
        )


def reported_pose_of(
    road_map: Map, way: SimulatedDrive | RecordedDrive, arguments: argparse.Namespace
) -> ReportedPose:
    """Return the pose that the car knows, by the options."""
    if arguments.localise:
        # Imported here: the localisation loads scipy.
        from ..localisation import LocalisationLayer
        from ..localisation.scan_matching import ScanReference
        from ..simulation.simulated_localisation import SimulatedLocalisation

        surfaces = ScanReference(road_map) if arguments.scan else None
        layer = LocalisationLayer(road_map)
        source = SimulatedLocalisation(way, layer, seed=arguments.seed, surfaces=surfaces)
        return ReportedPose(source.pose, lambda: max(source.correlation_time, MIN_TIME), source)
    time = arguments.correlation_time
    if isinstance(way, RecordedDrive) and way.cov is not None and arguments.sigma is None:
        note(
            "the poses and covariances of --drive are sent as they are; the truth has the same "
            "poses, so there are no errors to be seen; --sigma adds some"
        )
        return ReportedPose(lambda t, _: way.reported(t), lambda: _sent(time, math.inf))
    sigma = SIGMA if arguments.sigma is None else arguments.sigma
    errors = PoseSource(
        (*sigma[:2], math.radians(sigma[2])),
        CORRELATION_TIME if time is None else time,
        arguments.seed,
    )
    return ReportedPose(errors.pose, lambda: _sent(time, CORRELATION_TIME))


def _sent(time: float | None, default: float) -> float:
    return max(default if time is None else time, MIN_TIME)


def _sigma(text: str) -> tuple[float, float, float]:
    """Argparse type of ``--sigma``."""
    parse: Callable[[str], Any] = number(float, 0, 1000)
    parts = text.split(",")
    if len(parts) != 3:
        raise argparse.ArgumentTypeError(
            f"must be three numbers ALONG,ACROSS,HEADING [m, m, deg], such as 0.3,0.1,0.2, "
            f"got {text!r}"
        )
    along, across, heading = (float(parse(part)) for part in parts)
    return along, across, heading
