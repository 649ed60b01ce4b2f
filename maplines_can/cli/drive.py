"""The command ``maplines drive``."""

from __future__ import annotations

import argparse
import json
import time
import uuid
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ..bus import LogWriter, frame_time
from ..logs.log_writer import check_log_path
from ..maps import LaneTracker, Map, Route, town_path
from ..maps.line_source import ChooseComponents, LineSource
from ..propagation.component_counts import component_counts
from ..simulation.bus_share import (
    MAX_LOAD,
    check_scene_load,
    component_budget,
    line_nonlinearity,
)
from ..simulation.trajectory import CarState
from ..simulation.transmission import Counters, Transmission, TruthRecorder
from ..simulation.truth import TruthWriter, truth_paths
from ..values.arrays import count_text
from ..values.gaussian import Gaussian
from ..values.line import LeftOut, Slot
from ..values.polyline import Polyline
from ..wire import Frame, LineCodec
from .command_line import add_command, add_json, note, number, option_group, progress_bar, seconds
from .drive_options import (
    TOUR,
    add_reported_pose,
    add_view,
    add_way,
    check_reported_pose,
    check_way,
    map_of,
    reported_pose_of,
    states_of,
    way_of,
)
from .file_arguments import add_force, check_new
from .options import (
    add_bus,
    add_codec,
    add_faults,
    bus_settings,
    fault_counts,
    fault_injector,
    fault_opener,
    keyed_codec,
)
from .output import counts_text, faults_text, pose_errors_text, unsent_texts
from .sending import add_line_model, bus_share, map_error_of, sends_scenes

#: Name of the map of this package.
TOWN = town_path().name
#: Share of cycles off the map above which the drive may be of another one.
MAX_OFF_MAP = 0.1

DESCRIPTION = f"""\
Let a car drive on a map and send the lines around it until the drive ends, or until Ctrl-C. Then
print the counters.

The drive follows --route, or is recorded in a file (--drive); otherwise it leads through all of
{TOWN}, the map of this package, or {TOUR / 1000:g} km through another map on a route chosen at
random (--seed). The car knows its pose with errors of the standard deviations --sigma, correlated
in time, or from a localisation (--localise); each line is sent as the Gaussian that follows from
them.

By default the lines are sent in real time on a bus within this process; choose another one by
--interface and --channel. With --as-fast-as-possible there is no bus, only --record: the log has
the time stamps that the frames would have."""


def add_drive(commands: Any) -> None:
    """Add the command ``drive``."""
    example = "maplines drive town.xodr --route 1..7 --as-fast-as-possible --record drive.blf"
    parser = add_command(commands, "drive", _drive, DESCRIPTION, example)
    add = parser.add_argument
    scenario, output = option_group(parser, "scenario"), option_group(parser, "output")
    add("map", nargs="?", metavar="MAP", help=f"map file, or {TOWN} of this package (default)")
    add_way(parser)
    option_group(parser, "bus").add_argument(
        "--rate",
        type=number(float, 5, 100),
        default=20.0,
        metavar="HZ",
        help="how often the lines are computed and sent [1/s], 5 to 100 (default: 20)",
    )
    scenario.add_argument(
        "--seconds", type=seconds, metavar="S", help="end after this part of the drive [s]"
    )
    add_view(scenario)
    add_reported_pose(parser)
    add_line_model(parser)
    scenario.add_argument(
        "--seed",
        type=number(int, 0, 2**32),
        default=0,
        help="seed of the pose errors and of a route chosen at random (default: 0)",
    )
    add_bus(parser, private=True)
    add_codec(parser)
    add_faults(parser)
    output.add_argument(
        "--record",
        metavar="FILE",
        help="write the frames into this log: .log (candump), .asc, .blf or .mf4; and beside it "
        "the truth, see --truth",
    )
    output.add_argument(
        "--truth",
        metavar="FILE",
        help="write the true poses and lines into this table, .csv or .parquet (default: beside "
        "--record, such as drive.truth.parquet; .csv without pyarrow)",
    )
    option_group(parser, "bus").add_argument(
        "--as-fast-as-possible",
        action="store_true",
        help="do not wait, and use no bus: only --record, --truth or --json",
    )
    add_force(parser)
    add_json(parser, "the counters")


def _drive(arguments: argparse.Namespace) -> int:
    clock = _Clock()
    _check_options(arguments)
    fast = arguments.as_fast_as_possible
    codec = keyed_codec(arguments, clock=clock.time_ns if fast else time.time_ns)
    if arguments.record:
        check_log_path(Path(arguments.record))
    truth_path = _truth_path(arguments)
    others = _other_truths(arguments, truth_path)
    _check_overwriting(arguments, others)
    check_new(arguments, arguments.record, truth_path, *others)
    road_map = map_of(arguments.map)
    slots = tuple(Slot)[: arguments.lines]
    components = _components(codec, slots, arguments)
    if fast and not (arguments.record or arguments.truth or arguments.json):
        raise ValueError(
            "--as-fast-as-possible uses no bus, and nothing would be kept; add --record FILE, such "
            "as --record drive.blf, or leave it out to send in real time (--json prints counters)"
        )
    way, route = way_of(road_map, arguments)
    states = states_of(way, arguments)
    reported = reported_pose_of(road_map, way, arguments)
    source = LineSource(
        road_map,
        reported.pose,
        slots,
        route,
        arguments.window,
        map_error=map_error_of(arguments),
        components=components,
        correlation_time=reported.correlation_time if sends_scenes(codec, arguments) else None,
        max_sigma=arguments.max_sigma,
    )
    with ExitStack() as stack:
        truth = None
        for path in others:
            path.unlink(missing_ok=True)
        if truth_path:
            writer = stack.enter_context(TruthWriter(truth_path, slots))
            truth = TruthRecorder(writer, LaneTracker(road_map, route), slots)
        shape = "{l_bar}{bar}| {n:.0f}/{total:.0f} s"
        progress = stack.enter_context(progress_bar(" s", bar_format=shape, leave=False))
        drive = Transmission(
            source,
            states,
            1 / arguments.rate,
            codec,
            arguments.fd,
            bus_share(arguments, arguments.rate).bitrates,
            (lambda start: LogWriter(arguments.record, start)) if arguments.record else None,
            truth,
            progress,
        )
        if not arguments.json:
            note(_start_text(road_map, route, states, arguments))
        sent = _simulate(drive, clock, arguments) if fast else _send(drive, arguments)
    result = _result(states, drive.counters, arguments) | sent
    result |= {"record": arguments.record, "truth": truth_path}
    if reported.localisation is not None:
        result["measurements"] = reported.localisation.counts()
    _note_end(drive.counters, result["seconds"])
    print(json.dumps(result, indent=2) if arguments.json else _text(result))
    return 0


class _Clock:
    """Clock of a drive that is not sent in real time."""

    def __init__(self) -> None:
        self.now_ns = time.time_ns()

    def time_ns(self) -> int:
        """Return the time [ns]."""
        return self.now_ns

    def set(self, t_ns: int) -> None:
        """Set the time [ns]."""
        self.now_ns = t_ns


def _check_options(arguments: argparse.Namespace) -> None:
    """Raise ValueError if options do not fit together."""
    if arguments.as_fast_as_possible and (
        arguments.channel is not None or arguments.interface != "virtual"
    ):
        raise ValueError(
            "--as-fast-as-possible uses no bus; leave out --interface and --channel, and give "
            "--record for a log"
        )
    check_way(arguments)
    if not arguments.window[0] < arguments.window[1]:
        low, high = arguments.window
        raise ValueError(f"window must be MIN < MAX [m], got {low:g} {high:g}")
    check_reported_pose(arguments)


def _note_end(counters: Counters, seconds: float) -> None:
    """Print what was unusual in a drive of a duration [s]."""
    if counters.off_map > MAX_OFF_MAP * counters.cycles:
        share = 100 * counters.off_map / counters.cycles
        note(f"in {share:.0f} % of the cycles no lane is near the car: is the drive of this map?")
    if counters.stopped:
        note(f"stopped by Ctrl-C after {seconds:.1f} s of the drive")


def _check_overwriting(arguments: argparse.Namespace, others: Sequence[Path]) -> None:
    """Raise ValueError if an output would overwrite an input, or remove it: one of the others."""
    inputs = {Path(name).resolve() for name in (arguments.map, arguments.drive) if name}
    outputs = {"record": [arguments.record, *others], "truth": [arguments.truth]}
    for option, paths in outputs.items():
        if any(path and Path(path).resolve() in inputs for path in paths):
            name = getattr(arguments, option)
            raise ValueError(f"--{option} {name} would overwrite what is read; use another name")


def _simulate(drive: Transmission, clock: _Clock, arguments: argparse.Namespace) -> dict[str, Any]:
    return drive.simulate(time.time_ns(), clock.set, fault_injector(arguments))


def _send(drive: Transmission, arguments: argparse.Namespace) -> dict[str, Any]:
    settings = bus_settings(arguments)
    if arguments.interface == "virtual" and arguments.channel is None:
        settings["channel"] = f"maplines-{uuid.uuid4()}"
    opener = fault_opener(arguments)
    sent = drive.send(opener, settings)
    return sent | ({"faults": fault_counts(opener)} if opener else {})


def _components(
    codec: LineCodec, slots: tuple[Slot, ...], arguments: argparse.Namespace
) -> int | ChooseComponents:
    """Return the number of mixture components of each line, or a function that chooses it.

    Raises:
        ValueError: the lines exceed ``--max-load``, or the whole bus in a log without a bus.
    """
    as_scene = sends_scenes(codec, arguments)
    auto = arguments.components == "auto"
    bus = bus_share(arguments, arguments.rate)
    if bus.max_load is None and auto:
        bus = bus._replace(max_load=MAX_LOAD)
    if arguments.as_fast_as_possible:
        most = 1.0 if bus.max_load is None else bus.max_load
        bus = bus._replace(max_load=min(most, _free_load(arguments)))
    if as_scene:
        check_scene_load(codec, slots, bus)
        return 1
    least = 1 if auto else arguments.components
    budget = component_budget(codec, slots, least, bus)

    def choose(lines: Mapping[Slot, Polyline], ego: Gaussian) -> Mapping[Slot, int]:
        amounts = [line_nonlinearity(line, ego, arguments.window) for line in lines.values()]
        return dict(zip(lines, component_counts(amounts, budget=budget), strict=True))

    return choose if auto else least


def _free_load(arguments: argparse.Namespace) -> float:
    """Return the share of the time of a simulated bus that the flood of ``--faults`` leaves.

    Raises:
        ValueError: it leaves none.
    """
    flood = 0.0 if arguments.faults is None else arguments.faults.flood
    frame = Frame(0, bytes(8))
    load = flood * frame_time(frame, *bus_share(arguments, arguments.rate).bitrates)
    if load >= 1:
        raise ValueError(
            f"--faults flood={flood:g} takes {100 * load:.3g} % of the bus; use a lower rate, or a "
            "higher --bitrate"
        )
    return float(1 - load)


def _truth_path(arguments: argparse.Namespace) -> str | None:
    if arguments.truth or not arguments.record:
        return arguments.truth
    parquet, table = truth_paths(arguments.record)
    return str(parquet if find_spec("pyarrow") else table)


def _other_truths(arguments: argparse.Namespace, truth_path: str | None) -> list[Path]:
    """Return the files that would be taken for the truth of the log, but are not written."""
    if not arguments.record:
        return []
    written = Path(truth_path or "").resolve()
    return [path for path in truth_paths(arguments.record) if path.resolve() != written]


def _start_text(
    road_map: Map, route: Route | None, states: CarState, arguments: argparse.Namespace
) -> str:
    """Return what is about to begin."""
    name = f"{arguments.drive} on {road_map.name}" if route is None else road_map.name
    way = "" if route is None else f" from lane {route.lanes[0]} to {route.lanes[-1]}"
    km = _length(states) / 1000
    return f"{name}{way}: {km:.1f} km, {states.t[-1] - states.t[0]:.0f} s, {arguments.rate:g} Hz"


def _length(states: CarState) -> float:
    return float(np.hypot(*np.diff(states.pose[:, :2], axis=0).T).sum())


def _result(states: CarState, counters: Counters, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the counters of a drive, for JSON."""
    taken = counters.cycles + counters.late_cycles
    driven = CarState(*(values[:taken] for values in states))
    duration = taken / arguments.rate
    return asdict(counters) | {
        "left_out": dict(counters.left_out),
        "seconds": duration,
        "km": _length(driven) / 1000,
        "rate": arguments.rate,
        "bus_load": counters.bus_time / duration if duration else 0.0,
        "ms_per_cycle": 1000 * counters.cpu / max(counters.cycles, 1),
        "core_share": counters.cpu / duration if duration else 0.0,
    }


def _text(result: dict[str, Any]) -> str:
    """Return the counters as text."""
    rows = [
        f"drive     {result['km']:.2f} km, {result['seconds']:.1f} s, "
        f"{count_text(result['cycles'], 'cycle')} at {result['rate']:g} Hz"
        + f"; {result['late_cycles']} left out, because this machine was late"
        * bool(result["late_cycles"]),
        f"sent      {count_text(result['lines'], 'line')}"
        f"{pose_errors_text(result.get('pose_errors', 0))} in "
        f"{count_text(result['frames'], 'frame')}; bus load {100 * result['bus_load']:.1f} %",
        f"slots     {count_text(result['lane_changes'], 'lane change')}, "
        f"{count_text(result['slot_changes'], 'slot')} with a new line; "
        f"{count_text(result['off_map'], 'cycle')} off the map",
    ]
    if result["no_pose"]:
        share = 100 * result["no_pose"] / max(result["cycles"], 1)
        rows.append(
            f"no pose   in {count_text(result['no_pose'], 'cycle')} ({share:.1f} %) the car did "
            "not know its pose, and no line was sent"
        )
    lost = unsent_texts(*(result.get(name, 0) for name in ("down", "full", "overruns")))
    rows += [f"lost      {'; '.join(lost)}"] * bool(lost)
    if "faults" in result:
        rows.append(f"faults    {faults_text(result['faults'])}")
    reasons = [
        f"{count_text(n, 'time')}, {LeftOut[name]}"
        for name, n in sorted(result["left_out"].items())
    ]
    rows.append(f"left out  {'; '.join(reasons) or 'no line'}")
    rows.append(
        f"CPU       {result['ms_per_cycle']:.2f} ms a cycle, {100 * result['core_share']:.1f} % of "
        "one core in real time"
    )
    if result["truth"]:
        other = result["other_lane"]
        rows.append(
            f"truth     {result['truth']}; in {count_text(other, 'cycle')} the car was on another "
            "lane than it believed"
        )
    for source, counts in result.get("measurements", {}).items():
        rows.append(f"{source:<10}{counts_text(counts)}")
    rows += [f"log       {result['record']}"] * bool(result["record"])
    return "\n".join(rows)
