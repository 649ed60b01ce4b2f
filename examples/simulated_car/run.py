"""A car in a simulator: FMUs on a CAN bus with faults, and a lane keeping in C in the loop.

    python examples/simulated_car/run.py

The car of ``maplines drive`` leaves its rails here: it steers by what it receives.

    pose  ->  sender FMU with a map  ->  bus with faults  ->  receiver FMU
     ^                                                             |
    car  <------------------  lane_keeping.c  <--------------------+

In a tunnel the pose becomes uncertain, and later the bus is down for a while; the lane keeping
slows down or stops before it could leave the lane. The picture shows it.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import subprocess
import tempfile
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from maplines_can import Gaussian, Slot, maps
from maplines_can.cli import main as maplines
from maplines_can.cosimulation import CoSimulation
from maplines_can.cosimulation.connections import SentFrame
from maplines_can.simulation import PoseSource, drive_along
from maplines_can.testing import FaultInjector, Faults

FOLDER = Path(__file__).parent
PERIOD = 0.05  #: of lines and control [s]
AGE = 0.02  #: of the pose when the sender takes it [s]
X = (0.0, 10.0, 20.0, 35.0)  #: where the receiver gives the lines [m]
#: Of the lines that the sender computes [m].
PARAMETERS = {"window.x_min": -5.0, "window.x_max": 45.0, "max_misfit": 0.05}
SIDES = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
COUNTRY_ROAD = (119.0, 178.0)  #: time in which `maplines drive` is on it [s]
HALF_LANE, HALF_CAR = 1.625, 0.9  #: half of their widths [m]
SIGMA = (0.2, 0.06, 0.002)  #: of the pose: along, across [m], heading [rad]
TUNNEL = (15.0, 30.0)  #: time in which the standard deviations grow, to `FACTOR` times [s]
FACTOR = 3.0
FAULTS = "corrupt=0.002,loss=1@40-41.5,seed=1"  #: the bus is down for a while
WHEELBASE, STEERING_LAG, SPEED_LAG = 2.7, 0.15, 0.4  #: of the car [m, s, s]
MOST_ACCELERATION, MOST_DECELERATION = 2.0, 6.0  #: [m/s^2]


class Lane(ctypes.Structure):
    """``lane_t`` of lane_keeping.c."""

    _fields_ = [("is_usable", ctypes.c_bool)] + [
        (name, ctypes.c_double * len(X))
        for name in ("x", "left", "left_sigma", "right", "right_sigma")
    ]


class Demand(ctypes.Structure):
    """``demand_t`` of lane_keeping.c."""

    _fields_ = [(name, ctypes.c_double) for name in ("curvature", "speed", "sure")]


class Moment(NamedTuple):
    """What the picture shows of one time."""

    t: float
    offset: float  #: from the middle of the lane, positive to the left [m]
    speed: float  #: [m/s]
    wanted: float  #: planned speed [m/s]
    sigma: float  #: of the left line at 20 m [m]
    is_usable: bool


class Car:
    """Kinematic bicycle whose steering and speed follow their demands with a lag."""

    def __init__(self, pose: np.ndarray, speed: float) -> None:
        self.pose, self.speed, self.curvature = pose.copy(), speed, 0.0

    def drive(self, demand: Demand, time: float, step: float = 0.01) -> None:
        """Drive for a time [s]."""
        for _ in range(round(time / step)):
            self.curvature += step * (demand.curvature - self.curvature) / STEERING_LAG
            rate = (demand.speed - self.speed) / SPEED_LAG
            rate = min(max(rate, -MOST_DECELERATION), MOST_ACCELERATION)
            self.speed = max(0.0, self.speed + step * rate)
            way = step * self.speed
            heading = self.pose[2] + way * self.curvature / 2
            self.pose += (way * math.cos(heading), way * math.sin(heading), way * self.curvature)


class TunnelPose:
    """Reported pose whose error and covariance grow in a tunnel, and are small again after it."""

    def __init__(self) -> None:
        self._source = PoseSource(SIGMA, correlation_time=5.0, seed=2)

    def __call__(self, t: float, pose: np.ndarray) -> Gaussian:
        """Return the pose at a time [s]."""
        begin, end = TUNNEL
        inside = (t - begin) / (end - begin)
        factor = 1.0 + (FACTOR - 1.0) * inside if 0 <= inside < 1 else 1.0
        reported = self._source.pose(t, pose)
        return Gaussian(pose + factor * (reported.mean - pose), factor**2 * reported.cov)


def inputs_of(pose: Gaussian) -> dict[str, Any]:
    """Return the inputs of the sender FMU for a pose."""
    values: dict[str, Any] = {"valid": True, "age": AGE}
    for i in range(3):
        values[f"mean[{i + 1}]"] = float(pose.mean[i])
        values |= {f"cov[{i + 1},{j + 1}]": float(pose.cov[i, j]) for j in range(i + 1)}
    return values


def received(simulation: CoSimulation) -> Lane:
    """Return the lines that the receiver FMU has now."""
    lane = Lane(True)
    lane.x[:] = X
    for slot, side in zip(SIDES, ("left", "right"), strict=True):
        lane.is_usable &= simulation.get("receiver", f"{slot.name}.usable")
        for what, name in (("y", side), ("y_sigma", f"{side}_sigma")):
            values = [simulation.get("receiver", f"{slot.name}.{what}[{i + 1}]") for i in range(4)]
            getattr(lane, name)[:] = values
    return lane


class Road:
    """Country road of the map of this package, and how fast ``maplines drive`` goes on it."""

    def __init__(self) -> None:
        self.map = maps.load(maps.town_path())
        self.route = maps.town_tour(self.map)
        self.plan = drive_along(self.map, self.route)
        states = self.plan.at(np.arange(*COUNTRY_ROAD, 0.1))
        self._poses, self._speeds = states.pose, states.speed
        self.start, self.start_speed = states.pose[0], float(states.speed[0])

    def wanted(self, pose: np.ndarray) -> tuple[float, float]:
        """Return the planned speed [m/s] and the offset of a pose to the left of the way [m]."""
        nearest = int(np.argmin(np.hypot(*(self._poses[:, :2] - pose[:2]).T)))
        way = self._poses[nearest]
        dx, dy = pose[:2] - way[:2]
        return float(self._speeds[nearest]), -dx * math.sin(way[2]) + dy * math.cos(way[2])


def build(folder: Path) -> Any:
    """Generate the FMUs, compile the lane keeping, and return its function."""
    options = {"sender": ["--map", "--lines", "2"], "receiver": []}
    for node, own in options.items():
        with redirect_stdout(StringIO()):
            out = ["--out", str(folder / f"{node}.fmu")]
            status = maplines(["generate", "fmu", node, *own, *out])
        if status:
            raise SystemExit(status)
    library = folder / "lane_keeping.so"
    command = ["cc", "-std=c99", "-O2", "-Wall", "-Wextra", "-fPIC", "-shared"]
    subprocess.run(  # noqa: S603 - our own source
        [*command, str(FOLDER / "lane_keeping.c"), "-lm", "-o", str(library)], check=True
    )
    function = ctypes.CDLL(str(library)).lane_keeping
    function.argtypes = [ctypes.POINTER(Lane), ctypes.c_double, ctypes.c_double,
                         ctypes.POINTER(Demand)]  # fmt: skip
    function.restype = None
    return function


def simulate(seconds: float, faults: str) -> tuple[list[Moment], CoSimulation]:
    """Drive for a time [s]; return what happened, and the closed simulation."""
    road, demand, moments = Road(), Demand(), list[Moment]()
    reported = TunnelPose()
    car = Car(road.start, road.start_speed)
    injector = FaultInjector[SentFrame](Faults.parse(faults), make_frame=SentFrame)
    values = {("receiver", f"x[{i + 1}]"): x for i, x in enumerate(X)}
    values |= {("sender", "cycle_time"): PERIOD, ("receiver", "cycle_time"): PERIOD}
    values |= {("sender", name): value for name, value in PARAMETERS.items()}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        lane_keeping = build(folder)
        fmus = [folder / "sender.fmu", folder / "receiver.fmu"]
        with CoSimulation(
            fmus, values=values, step=PERIOD, bitrate=500_000, injector=injector
        ) as simulation:

            def control() -> None:
                t = simulation.now
                if t > 0:
                    car.drive(demand, PERIOD)
                wanted, offset = road.wanted(car.pose)
                for variable, value in inputs_of(reported(t, car.pose)).items():
                    simulation.set("sender", f"pose.{variable}", value)
                lane = received(simulation)
                lane_keeping(lane, car.speed, wanted, demand)
                moments.append(
                    Moment(t, offset, car.speed, wanted, lane.left_sigma[2], lane.is_usable)
                )

            simulation.run(seconds, control)
    return moments, simulation


def draw(moments: list[Moment], path: Path) -> None:
    """Draw the drive."""
    from matplotlib.figure import Figure

    t = np.array([moment.t for moment in moments])
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    axes[0].plot(t, [moment.offset for moment in moments], "C0")
    axes[0].set_ylabel("offset from the middle\nof the lane [m]")
    axes[0].set_ylim(-1.0, 1.0)
    for side in (-1, 1):
        axes[0].axhline(side * (HALF_LANE - HALF_CAR), color="C3", linestyle="--", linewidth=1)
    axes[0].text(t[-1], HALF_LANE - HALF_CAR, "the car touches a line ", color="C3", fontsize=8,
                 horizontalalignment="right", verticalalignment="bottom")  # fmt: skip
    axes[1].plot(t, [moment.wanted for moment in moments], "0.6", label="planned")
    axes[1].plot(t, [moment.speed for moment in moments], "C0", label="driven")
    axes[1].set_ylabel("speed [m/s]")
    axes[1].legend(loc="lower right")
    sigma = np.array([moment.sigma for moment in moments])
    axes[2].plot(t, np.where(np.isfinite(sigma), sigma, np.nan), "C1")
    axes[2].set_ylabel("received sigma of the\nleft line at 20 m [m]")
    axes[2].set_xlabel("time [s]")
    unusable = np.array([not moment.is_usable for moment in moments])
    for axis in axes:
        axis.axvspan(*TUNNEL, color="C1", alpha=0.12)
        axis.fill_between(t, 0, 1, where=unusable, transform=axis.get_xaxis_transform(),
                          color="C3", alpha=0.25)  # fmt: skip
        axis.set_xlim(t[0], t[-1])
        axis.grid(alpha=0.3)
    axes[0].set_title("orange: tunnel; red: no usable lines (bus down, or before the first)")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="to drive (default: 60)")
    parser.add_argument("--faults", default=FAULTS, help=f"of the bus (default: {FAULTS})")
    parser.add_argument("--out", type=Path, default=Path("simulated_car.png"), help="picture")
    arguments = parser.parse_args()
    moments, simulation = simulate(arguments.seconds, arguments.faults)
    draw(moments, arguments.out)
    offsets = [abs(moment.offset) for moment in moments]
    print(
        f"{simulation.link.frames} frames on the bus; the car was at most {max(offsets):.2f} m "
        f"off the middle of its lane, and stood at {moments[-1].speed:.1f} m/s at the end"
    )
    print(f"picture: {arguments.out}")


if __name__ == "__main__":
    main()
