"""Sources of the lines that a restbus sends: a scenario, a drive, a log or a script."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast, get_args

from ..bus import LogFrame, read_log
from ..logs.log_part import Window, of_channel, time_of
from ..logs.log_summary import LogReader, Times
from ..maps import random_tour, town_path, town_tour
from ..maps.formats.load import load
from ..maps.line_source import LineSource
from ..recordings.fitting import check_fit
from ..simulation.map_frame import check_on_map
from ..simulation.pose_source import PoseSource
from ..simulation.recorded_drive import RecordedDrive
from ..simulation.scenario_lines import ScenarioLines, weaving_ego
from ..simulation.scenarios import SCENARIOS, STREETS, scenario
from ..simulation.trajectory import SimulatedDrive, drive_along
from ..values.errors import LogError, RestbusError
from ..values.line import MapLine, Slot, aged
from ..values.scene import Scene
from ..wire import Codec, Reason, default_dbc_path
from .signal_values import script
from .toml_tables import Table

#: Lines at a time since the start [s]: all that are sent from now on; None at the end.
Lines = Callable[[float], "list[MapLine] | Scene | None"]
SOURCES = ("scenario", "drive", "log", "script")
#: Standard deviations of the reported pose of a drive, along, across [m] and heading [deg], and
#: their correlation time [s].
SIGMA, CORRELATION_TIME = (0.3, 0.1, 0.2), 10.0
#: Length of a tour on a map [m].
TOUR = 10_000.0
#: Lines of a log that are older than this are sent no more [s].
MAX_LOG_AGE = 1.0


def codec_of(name: str, folder: Path, encoding: str | None = None) -> Codec:
    """Return the codec of a DBC: a file, or one of this package."""
    path = folder / name
    if not path.exists() and Path(name).name == name and name.startswith("maplines"):
        path = default_dbc_path(name)
    return Codec.from_dbc(path, encoding=encoding)


def lines_of(table: Table, codec: Codec, period: float, seed: int, folder: Path) -> Lines:
    """Return the source that a table of the configuration describes.

    Raises:
        RestbusError: the table is wrong.
    """
    given = [key for key in SOURCES if key in table]
    if len(given) != 1:
        known = '", "'.join(SOURCES)
        got = ", ".join(given) or "none"
        table.end("period_ms", "dbc", *SOURCES) if not given else None
        raise RestbusError(
            f'{table.name}: one of "{known}" must say where the lines come from, got {got}'
        )
    pose_error = table.flag("pose_error") or codec.layout.is_conditional
    if pose_error and codec.layout.pose is None:
        raise RestbusError(
            f"{table.name}: pose_error needs a DBC with a message of the pose error, such as "
            f'dbc = "maplines.dbc"; {codec.layout.source} has none'
        )
    makers = {"scenario": _scenario, "drive": _drive, "log": _log, "script": _script}
    return makers[given[0]](table, period, seed, folder, pose_error)


def _slots(table: Table) -> int:
    return int(table.number("lines", 1, 8, "lines", 4, whole=True))


def _scenario(table: Table, _period: float, _seed: int, _folder: Path, pose_error: bool) -> Lines:
    name = table.choice("scenario", SCENARIOS | STREETS)
    moves = table.flag("moves", default=True)
    source = ScenarioLines(scenario(name), _slots(table), 1, math.inf if pose_error else None)
    still = None if moves else source.seen_from()

    def lines(t: float) -> list[MapLine] | Scene:
        return still or source.seen_from(weaving_ego(source.scenario, t))

    return lines


def _drive(table: Table, period: float, seed: int, folder: Path, pose_error: bool) -> Lines:
    name, path = table.text("drive"), table.take("map")
    road_map = load(town_path() if path is None else folder / str(path))
    way: SimulatedDrive | RecordedDrive
    route = None
    if name == "tour":
        route = town_tour(road_map) if path is None else random_tour(road_map, TOUR, seed)
        try:
            way = drive_along(road_map, route)
        except ValueError as error:
            raise RestbusError(
                f"{table.name}: the route chosen at random on {road_map.name} cannot be driven: "
                f"{error}; set another seed, or drive to the file of a recorded drive"
            ) from None
    else:
        way = RecordedDrive.from_csv(folder / name, projection=road_map.projection)
        centres = [lane.centre for lane in road_map.lanes.values()]
        check_on_map(way.pose[:, :2], centres, road_map.projection, name)
    along, across, heading = SIGMA
    errors = PoseSource((along, across, math.radians(heading)), CORRELATION_TIME, seed)
    slots = tuple(Slot)[: _slots(table)]
    time = CORRELATION_TIME if pose_error else None
    source = LineSource(road_map, errors.pose, slots, route, correlation_time=time)
    times = way.times(1 / period)
    start, end = float(times[0]), float(times[-1])

    def lines(t: float) -> list[MapLine] | Scene | None:
        if start + t > end:
            return None
        state = way.at([start + t])
        cycle = source.cycle(start + t, state.pose[0])
        return cycle.lines if cycle.scene is None else cycle.scene

    return lines


def _log(table: Table, _period: float, _seed: int, folder: Path, pose_error: bool) -> Lines:
    if pose_error:
        raise RestbusError(
            f"{table.name}: the lines of a log are sent without the pose error; set "
            'pose_error = false and dbc = "maplines.dbc"'
        )
    name = table.text("log")
    path = folder / name
    if not path.exists():
        raise RestbusError(f"{table.name}: log: there is no file {path}")
    codec = codec_of(table.text("log_dbc", "maplines.dbc"), folder)
    times = cast(Times, table.choice("log_times", get_args(Times), "auto"))
    channel = table.text("log_channel") if "log_channel" in table else None
    try:
        window = Window(time_of(table.text("log_time", "..")))
    except ValueError as error:
        raise RestbusError(f"{table.name}: log_time {error}") from None
    try:
        check_fit(path, codec, times=times)
        frames = of_channel(read_log(path, times=times), channel, path)
        return _LogLines(frames, codec, window, name)
    except LogError as error:
        raise RestbusError(f"{table.name}: log: {error}") from error


class _LogLines:
    """Lines of a part of a log, at the time since its start.

    Args:
        frames: of the log.
        codec: of its lines.
        window: of the part; the frames before are decoded, too.
        name: of the log.

    Raises:
        LogError: the log cannot be read, or has no frame in this time.
    """

    def __init__(
        self, frames: LogReader[LogFrame], codec: Codec, window: Window, name: str
    ) -> None:
        self._frames, self._decoder, self._window, self._name = (
            frames, codec.decoder(), window, name,
        )  # fmt: skip
        self._latest: dict[Slot, MapLine] = {}
        self._waiting = self._following()
        while self._waiting and not window.has(self._waiting[0].t_ns / 1e9):
            self._feed()
        if not self._waiting:
            raise LogError(f"{name}: has no frame in this time")
        self._origin_ns = self._waiting[0].t_ns

    def __call__(self, t: float) -> list[MapLine] | None:
        """Return the lines at a time since the start [s]; None at the end."""
        now_ns = self._origin_ns + round(t * 1e9)
        while self._waiting and self._waiting[0].t_ns <= now_ns:
            self._feed()
        ages = {slot: now_ns - (line.t_ns or 0) for slot, line in self._latest.items()}
        for slot, age_ns in ages.items():
            if age_ns > MAX_LOG_AGE * 1e9:
                del self._latest[slot]
        if not (self._waiting or self._latest):
            return None
        return [aged(line, line.age + 1e-9 * ages[slot]) for slot, line in self._latest.items()]

    def _feed(self) -> None:
        """Decode the frame that waits, and read the next one."""
        (frame,) = self._waiting
        answer = self._decoder.feed(
            frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended
        )
        for line in () if isinstance(answer, Reason) else answer:
            self._window.see((line.t_ns or 0) / 1e9, self._name)
            self._latest[line.slot] = line
        self._waiting = self._following()

    def _following(self) -> list[LogFrame]:
        frame = next(self._frames, None)
        return [] if frame is None or frame.t_ns / 1e9 > self._window.bounds[1] else [frame]


def _script(table: Table, _period: float, _seed: int, folder: Path, _pose_error: bool) -> Lines:
    text = table.text("script")
    function = script(f"{table.name}: script", text, folder, "lines")

    def lines(t: float) -> list[MapLine] | Scene:
        try:
            result: Any = function(t)
        except Exception as error:
            kind = type(error).__name__
            raise RestbusError(f"{table.name}: {text} fails at {t:g} s: {kind}: {error}") from error
        if isinstance(result, Scene):
            return result
        result = [result] if isinstance(result, MapLine) else result
        if not isinstance(result, list) or not all(isinstance(line, MapLine) for line in result):
            raise RestbusError(
                f"{table.name}: {text} must return a list of MapLine, or a Scene, at {t:g} s, "
                f"got {result!r}"
            )
        return result

    return lines
