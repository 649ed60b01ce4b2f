"""Options of commands that send lines, and the lines that ``send`` and ``demo`` send."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np

from ..propagation import MapError
from ..propagation.from_map import MAX_SIGMA
from ..simulation.bus_share import (
    MAX_LOAD,
    BusShare,
    LineComponents,
    check_scene_load,
    choose_components,
)
from ..simulation.scenario_lines import ScenarioLines
from ..simulation.scenarios import SCENARIOS, STREETS, Scenario, scenario
from ..values.line import LeftOut, MapLine, MapLineList, Slot
from ..values.scene import Scene
from ..wire import SCENE, SCENE2, LineCodec
from .command_line import number, option_group, positive
from .output import left_out_text

#: Rate of each line if neither --rate nor the DBC states it [1/s].
DEFAULT_RATE = 20.0


class Sending(NamedTuple):
    """Lines of a scenario that are sent."""

    source: ScenarioLines
    lines: MapLineList | Scene  #: as seen from the pose of the scenario
    components: dict[Slot, LineComponents]
    bus: BusShare

    @property
    def is_scene(self) -> bool:
        """Whether the lines are sent with the error of their pose."""
        return isinstance(self.lines, Scene)

    @property
    def each_line(self) -> Sequence[MapLine]:
        """Lines one by one."""
        return self.lines.lines if isinstance(self.lines, Scene) else self.lines

    def left_out(self, codec: LineCodec) -> Mapping[Slot, LeftOut]:
        """Return why lines are not sent: those of a scene that do not fit the message, too."""
        if isinstance(self.lines, Scene):
            return codec.encoder().left_out(self.lines, fd=self.bus.fd)
        return self.lines.left_out


def add_sending(parser: argparse.ArgumentParser) -> None:
    """Add the options of the lines: scenario, number, rate, components and map error."""
    add = option_group(parser, "scenario").add_argument
    add(
        "--scenario",
        default="production",
        choices=list(SCENARIOS | STREETS),
        metavar="NAME",
        help=f"scenario to send: {', '.join(SCENARIOS | STREETS)} (default: production)",
    )
    add(
        "--lines",
        type=number(int, 1, 8),
        default=4,
        metavar="N",
        help="send the first N lines of the scenario, 1 to 8 (default: 4)",
    )
    option_group(parser, "bus").add_argument(
        "--rate",
        type=number(float, 1e-3, 1000),
        metavar="HZ",
        help="how often each line is sent [1/s] (default: from GenMsgCycleTime of the DBC, the "
        f"shortest of these lines; {DEFAULT_RATE:g} if it has none)",
    )
    add_line_model(parser)
    add(
        "--correlation-time",
        type=positive,
        metavar="S",
        help="time in which the correlation of the pose errors falls to 1/e [s], which is sent "
        "with the pose error, rounded up; as unknown beyond the greatest value of the DBC, 45 s "
        "(default: unknown)",
    )


def add_line_model(parser: argparse.ArgumentParser) -> None:
    """Add the options of what lines are sent as: pose error, components, load, map error."""
    message, scenario = option_group(parser, "message"), option_group(parser, "scenario")
    message.add_argument(
        "--pose-error",
        action="store_true",
        help="send the error of the pose, too, from which the lines of a cycle are seen: receivers "
        "then know their joint covariance (always so with --dbc maplines-pose.dbc, whose lines "
        "take fewer frames, but are received with the pose error only, and with --dbc "
        "maplines-scene.dbc, whose CAN FD frames are whole scenes)",
    )
    message.add_argument(
        "--components",
        type=number(int, 1, 8, "auto"),
        default=1,
        metavar="K",
        help="send each line as a Gaussian mixture of K components, 1 to 8; auto: as many as its "
        "nonlinearity needs and --max-load allows; not with the pose error, which a receiver "
        "splits itself (default: 1, a single Gaussian)",
    )
    option_group(parser, "bus").add_argument(
        "--max-load",
        type=number(float, 1e-3, 1),
        metavar="SHARE",
        help="largest bus load of the lines, as a share of the bus time from 0.001 to 1 "
        f"(default: {MAX_LOAD:g} with --components auto, otherwise no limit)",
    )
    add_map_error(scenario)


def add_map_error(scenario: Any) -> None:
    """Add ``--map-error`` and ``--max-sigma`` to a group of options."""
    scenario.add_argument(
        "--map-error",
        type=number(float, 1e-6, 100),
        metavar="SIGMA",
        help="standard deviation of the map [m]: of each point, and of the common offset of all "
        "points of a line; the pose error comes on top (default: the map is exact)",
    )
    scenario.add_argument(
        "--max-sigma",
        type=number(float, 1e-3, math.inf),
        default=MAX_SIGMA,
        metavar="SIGMA",
        help="largest standard deviation of the lateral position of a line [m]: its valid range "
        f"ends where it passes this, before rounding; inf for no limit (default: {MAX_SIGMA:g})",
    )


def sending_of(codec: LineCodec, arguments: argparse.Namespace) -> Sending:
    """Return what is sent, by the options of ``add_sending``.

    Raises:
        ValueError: the lines exceed ``--max-load``; options contradict each other or the DBC; or
            all lines are left out as seen from the pose of the scenario.
    """
    sent, number, time = scenario(arguments.scenario), arguments.lines, arguments.correlation_time
    bus = bus_share(arguments, _rate(sent, codec, arguments))
    limit, as_scene = bus, sends_scenes(codec, arguments)
    if as_scene:
        check_scene_load(codec, sent.first_lines(number), bus)
        limit = bus._replace(max_load=None)
    elif time is not None:
        raise ValueError(
            "--correlation-time is sent with the pose error only; add --pose-error, or take "
            "--dbc maplines-pose.dbc or maplines-scene.dbc"
        )
    components = choose_components(sent, codec, number, arguments.components, limit)
    source = ScenarioLines(
        sent,
        number,
        {slot: line.components for slot, line in components.items()},
        (math.inf if time is None else time) if as_scene else None,
        map_error_of(arguments),
        arguments.max_sigma,
    )
    sending = Sending(source, source.seen_from(), components, bus)
    if not sending.each_line:
        raise ValueError(
            f"no line of the scenario {sent.name!r} can be sent; "
            f"{left_out_text(sending.lines.left_out)}"
        )
    return sending


def _rate(scenario: Scenario, codec: LineCodec, arguments: argparse.Namespace) -> float:
    """Return how often each line is sent: ``--rate``, or the shortest cycle time in the DBC."""
    if arguments.rate is not None:
        return float(arguments.rate)
    messages = codec.layout.messages_of.items()
    owners = *scenario.first_lines(arguments.lines), SCENE, SCENE2
    cycles = [own.cycle_ms for owner, own in messages if owner in owners and own.cycle_ms]
    return 1000 / min(cycles) if cycles else DEFAULT_RATE


def sends_scenes(codec: LineCodec, arguments: argparse.Namespace) -> bool:
    """Return whether lines are sent as scenes: together with the error of their pose.

    Raises:
        ValueError: options contradict each other or the DBC.
    """
    layout = codec.layout
    if arguments.pose_error and layout.pose is None:
        raise ValueError(
            f"--pose-error: {layout.source} has no message of the pose error (MapLinePose); leave "
            f"it out, or take one of this package, such as --dbc maplines.dbc"
        )
    if not (arguments.pose_error or layout.is_conditional):
        return False
    if arguments.components != 1:
        why = "--pose-error" if arguments.pose_error else f"{layout.source}"
        raise ValueError(
            f"--components {arguments.components} does not go with {why}: lines are sent with the "
            "error of their pose, and a receiver splits that itself; leave out --components"
        )
    return True


def bus_share(arguments: argparse.Namespace, rate: float) -> BusShare:
    """Return the bus of the options, and the share of it that the lines may take."""
    return BusShare(rate, arguments.fd, arguments.bitrate or 500_000, arguments.max_load)


def map_error_of(arguments: argparse.Namespace) -> MapError | None:
    """Return the map error of ``--map-error``; None if the map is exact."""
    sigma = arguments.map_error
    return MapError(sigma, sigma, np.radians(0.05)) if sigma else None


def components_text(line: LineComponents) -> str:
    """Return the number of components of a line and its nonlinearity as text."""
    text = f"nonlinearity {line.nonlinearity:.2f}"
    if line.components == 1:
        return f"1 component, {text}"
    within = f"{line.remaining_nonlinearity:.2f} within each of them"
    return f"{line.components} components, {text}, {within}"


def components_dict(components: Mapping[Slot, LineComponents]) -> list[dict[str, Any]]:
    """Return the number of components of each line and its nonlinearity, for JSON."""
    return [{"slot": slot.name} | asdict(line) for slot, line in components.items()]
