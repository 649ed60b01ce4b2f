"""Options of ``drive``: its path, a route or a recorded drive, and the pose that the car knows."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from itertools import islice, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..bus import read_signals
from ..maps import Map, Route, load, random_tour, town_path, town_tour
from ..maps.formats.load import map_path
from ..maps.line_source import WINDOW
from ..maps.view import AHEAD, BEHIND
from ..simulation.map_frame import check_on_map
from ..simulation.pose_source import PoseSource
from ..simulation.recorded_drive import RecordedDrive
from ..simulation.trajectory import CarState, SimulatedDrive, drive_along
from ..values.arrays import count_text
from ..values.errors import DriveFileError, RouteError
from ..values.gaussian import Gaussian
from ..values.line import Slot
from .command_line import note, number, option_group
from .frame_source import add_times, note_log
from .output import counts_text

if TYPE_CHECKING:
    from ..simulation.simulated_localisation import SimulatedLocalisation

#: Length of a route that is chosen at random [m].
TOUR = 10_000.0
#: Ways from road to road that are compared, if a route is given by roads.
MAX_WAYS = 400
#: Suffixes of bus logs, which have no columns of a drive. A .csv file is a table of the drive.
LOG_SUFFIXES = (".log", ".asc", ".blf", ".crtd", ".mf4", ".trc", ".db", ".pcap", ".pcapng")


def add_way(parser: argparse.ArgumentParser) -> None:
    """Add ``--route``, ``--drive`` and the options of a drive in a bus log."""
    options = option_group(parser, "scenario")
    ways = options.add_mutually_exclusive_group()
    add_route(ways)
    ways.add_argument(
        "--drive",
        metavar="FILE",
        help="recorded drive: a CSV file with time, x and y (or lat_deg and lon_deg) and heading; "
        "or, with --signals, a bus log as for 'decode'",
    )
    options.add_argument(
        "--signals",
        metavar="FILE",
        help="table of the signals in the bus log --drive, in TOML, such as "
        'speed_kmh = "ESP.VehicleSpeed", or in CSV with the header column,signal',
    )
    options.add_argument(
        "--signals-dbc",
        metavar="FILE",
        help="DBC of these signals: that of the car, whereas --dbc is that of the lines",
    )
    add_times(parser)


def add_route(group: Any) -> None:
    """Add ``--route`` to a group of options."""
    group.add_argument(
        "--route",
        metavar="A..B",
        help="route from A to B, which are ids of lanes or of roads; A..B..C leads through B",
    )


def add_view(scenario: Any) -> None:
    """Add ``--lines`` and ``--window``: what is sent of the map around the car."""
    scenario.add_argument(
        "--lines",
        type=number(int, 1, len(Slot)),
        default=4,
        metavar="N",
        help="slots that are sent, the first N of: "
        + ", ".join(slot.name.lower().replace("_", " ") for slot in Slot)
        + " (default: 4)",
    )
    scenario.add_argument(
        "--window",
        nargs=2,
        type=number(float, -BEHIND, AHEAD),
        default=WINDOW,
        metavar=("MIN", "MAX"),
        help="range of the lines ahead of the car [m], "
        f"-{BEHIND:g} to {AHEAD:g}; in a corner, what is behind the car shortens what is ahead "
        f"(default: {WINDOW[0]:g} {WINDOW[1]:g})",
    )


def check_way(arguments: argparse.Namespace) -> None:
    """Check that the options of a drive in a bus log fit together.

    Raises:
        ValueError: they do not.
    """
    if arguments.signals and not arguments.drive:
        raise ValueError("--signals are those of a recorded drive; give its log by --drive")
    if arguments.signals and not arguments.signals_dbc:
        raise ValueError(
            "--signals needs --signals-dbc, the DBC of the car; --dbc is that of the lines"
        )
    if arguments.signals_dbc and not arguments.signals:
        raise ValueError("--signals-dbc needs --signals, the names of the signals")


def way_of(
    road_map: Map, arguments: argparse.Namespace
) -> tuple[SimulatedDrive | RecordedDrive, Route | None]:
    """Return the drive and its route; a recorded drive has none.

    Raises:
        RouteError: there is no such route, or the map has no lanes.
        DriveFileError: the recorded drive cannot be used, or is not on the map.
        ValueError: options do not fit together.
    """
    if arguments.drive is not None:
        _check_lanes(road_map)
        return _recorded(road_map, arguments), None
    route = route_of(road_map, arguments)
    try:
        return drive_along(road_map, route), route
    except ValueError as error:
        if arguments.route is not None:
            raise RouteError(f"--route {arguments.route}: {error}; choose other lanes") from None
        raise RouteError(
            f"the route chosen at random on {road_map.name} cannot be driven: {error}; give "
            "another --seed, or --route A..B with ids of lanes or roads"
        ) from None


def route_of(road_map: Map, arguments: argparse.Namespace) -> Route:
    """Return the route of ``--route``, or else that of the town, or one that is chosen at random.

    Raises:
        RouteError: there is no such route, or the map has no lanes.
    """
    _check_lanes(road_map)
    if arguments.route is not None:
        return _route(road_map, arguments.route)
    if arguments.map is None or map_path(arguments.map).resolve() == town_path().resolve():
        return town_tour(road_map)
    return random_tour(road_map, TOUR, arguments.seed)


def _check_lanes(road_map: Map) -> None:
    if not any(lane.type.is_drivable for lane in road_map.lanes.values()):
        raise RouteError(f"the map {road_map.name} has no lanes to drive on")


def _route(road_map: Map, text: str) -> Route:
    """Return the route of ``--route``: the shortest one, if it is given by roads."""
    stops = [_lanes(road_map, name, text) for name in text.split("..")]
    if len(stops) < 2:
        raise RouteError(f"--route must be A..B, two ids of lanes or roads, got {text!r}")
    best: Route | None = None
    error = RouteError("there is none")
    for start, *via, goal in islice(product(*stops), MAX_WAYS):
        try:
            route = road_map.route(start, goal, via)
        except RouteError as wrong:
            error = wrong
            continue
        if best is None or route.length < best.length:
            best = route
    if best is None:
        raise RouteError(f"--route {text}: {error}")
    return best


def _lanes(road_map: Map, name: str, text: str) -> list[str]:
    """Return the lanes that a name in ``--route`` may stand for."""
    if name in road_map.lanes:
        return [name]
    if name in road_map.roads:
        lanes = [id_ for id_ in road_map.roads[name].lanes if road_map.lanes[id_].type.is_drivable]
        if lanes:
            return lanes
        raise RouteError(f"--route {text}: the road {name!r} has no lane to drive on")
    some = ", ".join([*islice(road_map.roads, 3), *islice(road_map.lanes, 3)])
    raise RouteError(
        f"--route {text}: the map has neither a lane nor a road {name!r}; its ids are such as "
        f"{some}"
    )


def _recorded(road_map: Map, arguments: argparse.Namespace) -> RecordedDrive:
    """Return the recorded drive of the options; it must be on the map."""
    name = arguments.drive
    recorded = _from_log(road_map, arguments) if arguments.signals else _from_table(road_map, name)
    centres = [lane.centre for lane in road_map.lanes.values()]
    share = check_on_map(recorded.pose[:, :2], centres, road_map.projection, name)
    if share < 1:
        note(f"{name}: {100 * (1 - share):.1f} % of the positions are off the map")
    if recorded.skipped:
        note(f"{name}: skipped: {count_text(recorded.skipped, 'record')}")
    return recorded


def _from_table(road_map: Map, name: str) -> RecordedDrive:
    suffix = Path(name).suffix.lower()
    if suffix in LOG_SUFFIXES:
        raise DriveFileError(
            f"{name}: a bus log needs --signals, the names of its signals, and --signals-dbc"
        )
    return RecordedDrive.from_csv(name, projection=road_map.projection)


def _from_log(road_map: Map, arguments: argparse.Namespace) -> RecordedDrive:
    signals = read_signals(
        arguments.drive,
        arguments.signals_dbc,
        arguments.signals,
        encoding=arguments.encoding,
        times=arguments.times,
    )
    note_log(arguments.drive, signals.log)
    if signals.skipped:
        note(f"{arguments.drive}: skipped: {counts_text(signals.skipped)}")
    try:
        return RecordedDrive.from_signals(signals, road_map.projection)
    except DriveFileError as error:
        raise DriveFileError(f"{arguments.drive}: {error}") from error


def map_of(path: str | None) -> Map:
    """Load a map, by default that of this package, and note what is not used of it."""
    road_map = load(town_path() if path is None else path)
    if road_map.skipped:
        note(
            f"{road_map.name}: {len(road_map.skipped)} parts of the file are not used, or assumed "
            f"('maplines map' lists them); first: {road_map.skipped[0]}"
        )
    return road_map


def states_of(way: SimulatedDrive | RecordedDrive, arguments: argparse.Namespace) -> CarState:
    """Return the true states at the sending rate."""
    times = way.times(arguments.rate)
    if arguments.seconds is not None:
        times = times[times - times[0] < arguments.seconds]
    return way.at(times)


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
