"""The command ``maplines fmu run``."""

from __future__ import annotations

import argparse
import json
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..bus import LogWriter
from ..cosimulation.bus_operations import Transmit
from ..cosimulation.checks import check
from ..cosimulation.connections import BusLink, Record, SentFrame
from ..cosimulation.csv_tables import OutputWriter, read_inputs, split_name
from ..cosimulation.fmu_description import read_description
from ..cosimulation.node import Value
from ..cosimulation.runner import CoSimulation, node_names
from ..logs.log_writer import check_log_path
from ..values.arrays import count_text
from ..wire import Frame
from .command_line import add_command, add_json, note, number, option_group, progress_bar
from .file_arguments import add_force, check_new
from .options import add_faults, fault_injector
from .output import faults_text

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

DESCRIPTION = """\
Simulate FMUs that are nodes of a CAN bus: co-simulation of FMI 3.0 with the layered standard
FMI-LS-BUS 1.0.0, low cut.

If one of them simulates the bus (isBusSimulationFMU), it connects the others: the first to its
first terminal, and so on. Otherwise the bus of this package does, for any number of nodes: without
delay, or with --bitrate, arbitration and confirmations. A node has the name of its file; a second
one of the same name is NAME_2, or the next number that no file has.

All FMUs are checked first, as by 'maplines fmu check'."""
#: Time that is simulated if --until is not given [s].
UNTIL = 10.0
#: Time stamp at the start of a log [s]: a .blf or .mf4 has a date, here 2000-01-01 UTC.
LOG_START = {".blf": 946_684_800.0, ".mf4": 946_684_800.0}
#: Seconds after which the progress bar shows.
PATIENCE = 2.0


def add_run(commands: Any) -> None:
    """Add the command ``fmu run``."""
    example = "maplines fmu run sender.fmu receiver.fmu --until 60 --faults loss=0.1 --log can.blf"
    parser = add_command(commands, "run", _run, DESCRIPTION, example)
    parser.add_argument("fmus", nargs="+", metavar="FMU", help="FMU of a node, or of the bus")
    scenario = option_group(parser, "scenario").add_argument
    scenario(
        "--until",
        type=number(float, 1e-9, 1e6),
        default=UNTIL,
        metavar="SECONDS",
        help=f"time to simulate [s] (default: {UNTIL:g})",
    )
    scenario(
        "--step",
        type=number(float, 1e-9, 1e3),
        metavar="SECONDS",
        help="longest time between communication points, and between rows of --output [s]; ticks "
        "of clocks and frames have points of their own (default: from the FMUs, or 0.01)",
    )
    scenario(
        "--set",
        action="append",
        default=[],
        dest="values",
        metavar="NODE.VARIABLE=VALUE",
        help="start value of a parameter or an input; the elements of an array have spaces between "
        "them; may be given several times",
    )
    scenario(
        "--input",
        metavar="FILE",
        help="set inputs from this table, .csv with the columns time [s] and NODE.VARIABLE",
    )
    scenario(
        "--ignore-findings",
        action="store_true",
        help="run FMUs that break the standard, too; the findings are printed",
    )
    option_group(parser, "bus").add_argument(
        "--bitrate",
        type=number(int, 1, 10**9, "nodes"),
        metavar="BITRATE",
        help="let frames take their time on the bus, with arbitration, at this bit rate [bit/s], "
        "or 'nodes': as the nodes configure it; the data phase of CAN FD is 4 times as fast unless "
        "a node configures it (default: no delay)",
    )
    add_faults(parser)
    output = option_group(parser, "output").add_argument
    output(
        "--log",
        metavar="FILE",
        help="write the frames on the bus: .log, .asc, "
        "or .blf and .mf4, in which the simulation starts at 2000-01-01",
    )
    output("--output", metavar="FILE", help="write the outputs of all nodes into this table, .csv")
    add_force(parser)
    add_json(parser, "the counters")


def _run(arguments: argparse.Namespace) -> int:
    if arguments.log:
        check_log_path(Path(arguments.log))
    check_new(arguments, arguments.log, arguments.output)
    names = node_names(arguments.fmus)
    values = _start_values(arguments.values, names)
    inputs = read_inputs(arguments.input, names) if arguments.input else []
    if arguments.ignore_findings:
        _note_findings(names)
    injector = fault_injector(arguments, SentFrame)
    start = time.monotonic()
    with ExitStack() as stack:
        record = _recorder(stack, arguments.log) if arguments.log else None
        simulation = stack.enter_context(
            CoSimulation(
                arguments.fmus,
                values=values,
                step=arguments.step,
                bitrate=0 if arguments.bitrate == "nodes" else arguments.bitrate,
                injector=injector,
                record=record,
                inputs=inputs,
                until=arguments.until,
                ignore_findings=arguments.ignore_findings,
            )
        )
        is_stopped = _simulate(simulation, stack, arguments)
        result = _result(simulation) | {"stopped": is_stopped, "elapsed": time.monotonic() - start}
    result["faults"] = {} if injector is None else injector.as_dict()
    result["log"] = arguments.log
    print(json.dumps(result, indent=2) if arguments.json else _text(result))
    return 0


def _simulate(simulation: CoSimulation, stack: ExitStack, arguments: argparse.Namespace) -> bool:
    """Simulate to the end, and return whether Ctrl-C ended it before."""
    shape = "{l_bar}{bar}| {n:.1f}/{total:.0f} s"
    settings = {"bar_format": shape, "leave": False, "delay": PATIENCE}
    progress = stack.enter_context(progress_bar(" s", **settings))
    outputs = None
    if arguments.output:
        outputs = stack.enter_context(OutputWriter(arguments.output, simulation))

    def each_step() -> None:
        if outputs is not None:
            outputs.write()
        progress(simulation.now, arguments.until)

    try:
        simulation.run(arguments.until, each_step)
    except KeyboardInterrupt:
        note(f"stopped by Ctrl-C after {simulation.now:.3f} s of the simulation")
        return True
    if simulation.ended_by is not None:
        note(f"{simulation.ended_by} ended the simulation at {simulation.now:.3f} s")
    return False


def _recorder(stack: ExitStack, path: str) -> Record:
    """Return a function that writes a frame at a time [s] into a log."""
    start = LOG_START.get(Path(path).suffix.lower(), 0.0)
    log = stack.enter_context(LogWriter(path, start))

    def write(frame: Transmit, t: float) -> None:
        data = b"" if frame.is_remote else frame.data
        log.write(
            Frame(frame.can_id, data, frame.is_fd, frame.is_extended),
            start + t,
            is_remote_frame=frame.is_remote,
            dlc=frame.requested if frame.is_remote else len(data),
            bitrate_switch=frame.bit_rate_switch,
            error_state_indicator=frame.error_state,
        )

    return write


def _start_values(
    texts: Sequence[str], names: Mapping[str, Path]
) -> dict[tuple[str, str], str | Value | Sequence[Value]]:
    """Return the values of ``--set``."""
    values: dict[tuple[str, str], str | Value | Sequence[Value]] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"--set must be NODE.VARIABLE=VALUE, got {text!r}")
        values[split_name(name, names)] = value
    return values


def _note_findings(names: Mapping[str, Path]) -> None:
    for path in dict.fromkeys(names.values()):
        for finding in check(read_description(path)):
            note(f"{path}: {finding}")


def _result(simulation: CoSimulation) -> dict[str, Any]:
    """Return the counters of a simulation, for JSON."""
    link = simulation.link
    result: dict[str, Any] = {
        "seconds": simulation.now,
        "points": simulation.points,
        "step": simulation.step,
        "nodes": {
            channel.label: {
                "sent": link.sent[channel.label],
                "received": link.received[channel.label],
                "confirmed": link.confirmed[channel.label],
            }
            for channel in link.channels
        },
        "frames": link.frames,
        "problems": dict(link.problems),
        "warnings": {
            name: {"count": node.warnings, "last": node.last_message}
            for name, node in simulation.nodes.items()
            if node.warnings
        },
        "ended_by": simulation.ended_by,
    }
    if isinstance(link, BusLink) and link.bus.busy_ns and simulation.now_ns:
        result["load"] = link.bus.busy_ns / simulation.now_ns
    return result


def _text(result: Mapping[str, Any]) -> str:
    """Return the counters of a simulation as text."""
    load = f", load {100 * result['load']:.1f} %" if "load" in result else ""
    rows = [
        f"{result['seconds']:g} s simulated in {result['elapsed']:.1f} s, "
        f"{count_text(result['points'], 'communication point')}",
        *(
            f"{name}: sent {count_text(one['sent'], 'frame')}, received {one['received']}, "
            f"{one['confirmed']} confirmed"
            for name, one in result["nodes"].items()
        ),
        f"bus: {count_text(result['frames'], 'frame')}{load}",
    ]
    if result["faults"]:
        rows.append(f"faults: {faults_text(result['faults'])}")
    rows += [
        f"problem: {what} ({count_text(count, 'time')})"
        for what, count in result["problems"].items()
    ]
    for name, one in result["warnings"].items():
        rows.append(f"{name}: {count_text(one['count'], 'warning')}, the last one: {one['last']}")
    return "\n".join(rows)
