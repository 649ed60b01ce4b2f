"""Options of ``send`` and ``demo``, and the lines that they send."""

from __future__ import annotations

import argparse
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from typing import Any, Literal

import numpy as np

from ..bus import bus_load, transfers_within
from ..propagation import MapError, Refit, component_counts, map_lines, map_scene, nonlinearity
from ..propagation.certain_range import MAX_SIGMA
from ..propagation.component_counts import remaining_nonlinearity
from ..simulation.scenarios import SCENARIOS, STREETS, Scenario
from ..values.errors import IllPosedError
from ..values.gaussian import Gaussian
from ..values.line import MapLine, MapLineList, Slot
from ..values.polyline import Polyline
from ..values.scene import Scene
from ..wire import Codec
from .output import left_out_text
from .parsing import number, option_group, positive
from .scene_sending import add_pose_error, check_scene_load, sends_scenes

#: Default bus-load limit for --components auto.
MAX_LOAD = 0.3
#: Rate of each line if neither --rate nor the DBC states it [1/s].
DEFAULT_RATE = 20.0
#: Speed of the car of a scenario along its road [m/s], and the lateral sine by which it weaves
#: within its lane: amplitude [m] and period [s].
SPEED, AMPLITUDE, SINE_PERIOD = 10.0, 0.3, 10.0


@dataclass(frozen=True)
class LineComponents:
    """Number of mixture components of a line, and its nonlinearity."""

    components: int
    nonlinearity: float  #: of the line as a single Gaussian; see ``Nonlinearity.amount``
    remaining_nonlinearity: float  #: within each component


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
    add_pose_error(parser)
    option_group(parser, "message").add_argument(
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
    option_group(parser, "scenario").add_argument(
        "--map-error",
        type=number(float, 1e-6, 100),
        metavar="SIGMA",
        help="standard deviation of the map [m]: of each point, and of the common offset of all "
        "points of a line; the pose error comes on top (default: the map is exact)",
    )
    option_group(parser, "scenario").add_argument(
        "--max-sigma",
        type=number(float, 1e-3, math.inf),
        default=MAX_SIGMA,
        metavar="SIGMA",
        help="largest standard deviation of the lateral position of a line [m]: its valid range "
        f"ends where it passes this, before rounding; inf for no limit (default: {MAX_SIGMA:g})",
    )


def first_lines(scenario: Scenario, lines: int) -> dict[Slot, Polyline]:
    """Return the first lines of a scenario."""
    return dict(islice(scenario.lines.items(), lines))


def rate_of(scenario: Scenario, codec: Codec, arguments: argparse.Namespace) -> float:
    """Return how often each line is sent: ``--rate``, or the shortest cycle time in the DBC."""
    if arguments.rate is not None:
        return float(arguments.rate)
    messages = codec.layout.messages
    slots = [slot for slot in first_lines(scenario, arguments.lines) if slot in messages]
    cycles = [messages[slot].cycle_ms for slot in slots if messages[slot].cycle_ms]
    return 1000 / min(cycles) if cycles else DEFAULT_RATE


def components_of(
    scenario: Scenario, codec: Codec, arguments: argparse.Namespace, rate: float
) -> dict[Slot, LineComponents]:
    """Return the number of components of each line, from the options.

    Raises:
        ValueError: the lines exceed ``--max-load``, or options contradict each other.
    """
    max_load = arguments.max_load
    if sends_scenes(codec, arguments):
        slots = first_lines(scenario, arguments.lines)
        check_scene_load(codec, slots, rate, *bitrates(arguments), max_load=max_load)
        max_load = None
    elif arguments.correlation_time is not None:
        raise ValueError(
            "--correlation-time is sent with the pose error only; add --pose-error, or take "
            "--dbc maplines-pose.dbc"
        )
    return choose_components(
        scenario,
        codec,
        arguments.lines,
        components=arguments.components,
        rate=rate,
        fd=arguments.fd,
        bitrate=bitrates(arguments)[0],
        max_load=max_load,
    )


def lines_of(
    scenario: Scenario,
    components: Mapping[Slot, LineComponents],
    arguments: argparse.Namespace,
    ego: Gaussian | None = None,
    *,
    as_scene: bool = False,
) -> MapLineList | Scene:
    """Return the lines as seen from a pose; by default, that of the scenario.

    Args:
        scenario: the scenario.
        components: of each line.
        arguments: options of the lines.
        ego: the pose; None for that of the scenario.
        as_scene: return a ``Scene``, with their joint covariance.

    Raises:
        ValueError: all lines are left out as seen from the pose of the scenario.
    """
    first, pose = first_lines(scenario, arguments.lines), scenario.ego if ego is None else ego
    options: dict[str, Any] = {
        "window": scenario.window,
        "map_error": map_error_of(arguments),
        "max_sigma": arguments.max_sigma,
    }
    lines: MapLineList | Scene
    if as_scene:
        time = math.inf if arguments.correlation_time is None else arguments.correlation_time
        lines = map_scene(first, pose, correlation_time=time, **options)
    else:
        counts = {slot: line.components for slot, line in components.items()}
        lines = map_lines(first, pose, components=counts, **options)
    if ego is None and not single_lines(lines):
        raise ValueError(
            f"no line of the scenario {scenario.name!r} can be sent; "
            f"{left_out_text(lines.left_out)}"
        )
    return lines


def single_lines(lines: MapLineList | Scene) -> Sequence[MapLine]:
    """Return the lines one by one."""
    return lines.lines if isinstance(lines, Scene) else lines


def map_error_of(arguments: argparse.Namespace) -> MapError | None:
    """Return the map error of ``--map-error``; None if the map is exact."""
    sigma = arguments.map_error
    return MapError(sigma, sigma, np.radians(0.05)) if sigma else None


def weaving_ego(scenario: Scenario, t: float) -> Gaussian:
    """Return the pose at time t [s] of a car that weaves within its lane at ``SPEED``.

    Its offset to the left is a sine, and its heading relative to the road is the slope of its path.
    The road ahead stays that of the scenario, as it does on a straight or circular road.

    >>> weaving_ego(SCENARIOS["production"], 2.5).mean.round(9)  # at the end to the left
    array([0. , 0.3, 0. ])
    """
    phase = 2 * np.pi * t / SINE_PERIOD
    slope = 2 * np.pi / SINE_PERIOD * AMPLITUDE * np.cos(phase) / SPEED
    offset = [0.0, AMPLITUDE * np.sin(phase), np.arctan(slope)]
    return Gaussian(scenario.ego.mean + offset, scenario.ego.cov)


def bitrates(arguments: argparse.Namespace) -> tuple[int, int | None]:
    """Return the bit rates for the bus load: nominal, and of the data phase of CAN FD [bit/s]."""
    bitrate = arguments.bitrate or 500_000
    return bitrate, 4 * bitrate if arguments.fd else None


def choose_components(
    scenario: Scenario,
    codec: Codec,
    lines: int = 4,
    *,
    components: int | Literal["auto"] = "auto",
    rate: float = 20.0,
    fd: bool = False,
    bitrate: int = 500_000,
    max_load: float | None = None,
) -> dict[Slot, LineComponents]:
    """Choose the number of mixture components of each line within a bus load.

    Args:
        scenario: the scenario.
        codec: codec of the sender.
        lines: number of lines, the first of the scenario.
        components: of every line; "auto": as many as the nonlinearity of each line needs.
        rate: how often each line is sent [1/s].
        fd: whether the frames are CAN FD.
        bitrate: nominal bit rate of the bus [bit/s].
        max_load: largest share of the bus time that the lines may take, with worst-case bit
            stuffing. None: ``MAX_LOAD`` for "auto", otherwise no limit.

    Raises:
        ValueError: the lines exceed the limit, for "auto" even with one component each.
    """
    first = first_lines(scenario, lines)
    least = 1 if components == "auto" else components
    if components == "auto" and max_load is None:
        max_load = MAX_LOAD
    budget = component_budget(
        codec, first, least, rate=rate, fd=fd, bitrate=bitrate, max_load=max_load
    )
    amounts = [line_nonlinearity(line, scenario.ego, scenario.window) for line in first.values()]
    auto = components == "auto"
    counts = component_counts(amounts, budget=budget) if auto else [least] * len(first)
    return {
        slot: LineComponents(k, amount, remaining_nonlinearity(amount, k))
        for slot, k, amount in zip(first, counts, amounts, strict=True)
    }


def component_budget(
    codec: Codec,
    slots: Collection[Slot],
    least: int,
    *,
    rate: float,
    fd: bool,
    bitrate: int,
    max_load: float | None,
) -> int | None:
    """Return how many components all lines together may have; None for no limit.

    Args:
        codec: codec of the sender.
        slots: of the lines.
        least: components that each line has at least.
        rate: how often each line is sent [1/s].
        fd: whether the frames are CAN FD.
        bitrate: nominal bit rate of the bus [bit/s].
        max_load: largest share of the bus time; None for no limit.

    Raises:
        ValueError: the lines exceed the limit with the least components.
    """
    if max_load is None:
        return None
    bus = (1 / rate, bitrate, 4 * bitrate if fd else None)
    blank = np.zeros(codec.layout.record_bytes, dtype=np.uint8)
    transfers = [codec.frames(blank, slot, fd=fd) for slot in slots]
    budget = min(transfers_within(max_load, transfer, *bus) for transfer in transfers)
    total = least * len(slots)
    if budget < total:
        load = total * max(bus_load(transfer, *bus) for transfer in transfers)
        raise ValueError(
            f"{len(slots)} lines with {total} components take {100 * load:.3g} % of the "
            f"bus at {rate:g} Hz and {bitrate / 1000:g} kbit/s, and {100 * max_load:g} % are "
            "allowed; use fewer --lines or --components, a lower --rate, --fd, a higher "
            "--bitrate or a higher --max-load"
        )
    return budget


def line_nonlinearity(line: Polyline, ego: Gaussian, window: tuple[float, float]) -> float:
    """Return the nonlinearity of a line: 0 if it is not seen, 1 if some poses do not see it."""
    amount = 0.0
    try:
        refit = Refit(line, ego.mean, window)
        amount = 1.0
        amount = nonlinearity(refit, ego).amount
    except IllPosedError:
        pass
    return amount


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


def frame_format_text(codec: Codec, *, fd: bool) -> str:
    """Return the frame format, and whether the frames are authenticated, as text."""
    authenticated = ", authenticated" if codec.authenticator else ""
    return f"{'CAN FD' if fd else 'classic CAN'}{authenticated}"
