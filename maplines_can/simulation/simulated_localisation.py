"""Reported poses of a car on a drive, from a localisation with simulated sensors."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import ArrayLike

from ..localisation import Localisation, LocalisationLayer, Odometry
from ..localisation.scan_matching import ScanReference, match_ndt, simulated_scan
from ..values.gaussian import Gaussian, variances
from .recorded_drive import RecordedDrive
from .sensors import SensorSetup, simulated_measurements
from .trajectory import SimulatedDrive

#: Standard deviations of the pose with which a localisation starts: x, y [m], heading [rad].
START_SIGMA = (1.0, 1.0, math.radians(1.0))
#: Time between two scans of a lidar [s].
SCAN_PERIOD = 0.5


class SimulatedLocalisation:
    """Source of poses, as ``PoseSource``, from a localisation with simulated sensors.

    Args:
        way: the drive.
        layer: of the map on which the car drives.
        setup: of the sensors; None for the default ones.
        seed: of the errors of the sensors and of the start.
        start_sigma: (3,) standard deviations of the pose at the start: x, y [m], heading [rad].
        surfaces: walls and poles of the map, for a lidar whose scans are matched with them by NDT
            twice a second; None for a car without one.

    Raises:
        ValueError: a standard deviation is negative.

    >>> from maplines_can import Polyline
    >>> from maplines_can.simulation import SimulatedDrive
    >>> from maplines_can import maps
    >>> drive = SimulatedDrive(Polyline([[0, 0], [200, 0]]))
    >>> source = SimulatedLocalisation(drive, LocalisationLayer(maps.Map({}, {})))
    >>> stated = source.pose(1.0, drive.at(1.0).pose)
    >>> None if stated is None else stated.dimension
    3
    """

    def __init__(
        self,
        way: SimulatedDrive | RecordedDrive,
        layer: LocalisationLayer,
        setup: SensorSetup | None = None,
        seed: int = 0,
        start_sigma: ArrayLike = START_SIGMA,
        surfaces: ScanReference | None = None,
    ) -> None:
        setup = setup or SensorSetup()
        variance = variances(start_sigma)
        rng = np.random.default_rng(seed)
        start = way.at(way.start).pose + np.sqrt(variance) * rng.standard_normal(3)
        self._localisation = Localisation(
            Gaussian(start, np.diag(variance)), way.start, setup.errors, layer
        )
        self._arrivals = simulated_measurements(way, layer, setup, rng)
        self._next = 0
        self._way, self._surfaces = way, surfaces
        self._scan_due, self._scan_rng = way.start, np.random.default_rng([seed, 1])

    def pose(self, t: float, _true_pose: ArrayLike | None = None) -> Gaussian | None:
        """Return the reported pose at a time not earlier than that of the previous call [s].

        The filter takes the measurements that have arrived by then. None if it does not know the
        pose.

        Raises:
            ValueError: the time is earlier.
        """
        arrivals = self._arrivals
        while self._next < len(arrivals) and arrivals[self._next].t <= t:
            measurement = arrivals[self._next].measurement
            self._localisation.add(measurement)
            self._next += 1
            if isinstance(measurement, Odometry):
                self._scan(measurement.t)
        # Only wrong stamps of the odometry are ahead of the time at which they arrive.
        return self._localisation.ego(t) if self._localisation.t <= t else None

    def _scan(self, t: float) -> None:
        """Take the pose of a scan at the time of an odometry [s], if one is due and fits."""
        ego = self._localisation.ego()
        if self._surfaces is None or t < self._scan_due or ego is None or self._localisation.t != t:
            return
        self._scan_due = t + SCAN_PERIOD
        scan = simulated_scan(self._surfaces, self._way.at(t).pose, self._scan_rng)
        match = match_ndt(self._surfaces, scan, ego.mean)
        if match.is_valid:
            self._localisation.add(match.fix(t))

    @property
    def correlation_time(self) -> float:
        """Correlation time of the error across [s]; infinite if it is unknown."""
        return float(self._localisation.correlation_times()[0, 1])

    def counts(self) -> dict[str, Counter[str]]:
        """Return what became of the measurements: see ``Localisation.counts``."""
        return self._localisation.counts()
