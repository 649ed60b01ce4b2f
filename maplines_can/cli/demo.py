"""The command ``maplines demo``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..pictures.round_trip_picture import draw_round_trip
from ..propagation.component_counts import TOLERANCE
from ..simulation.round_trip import BusSettings, LineResult, RoundTrip, SceneResult, round_trip
from ..values.arrays import count_text
from ..values.line import Status
from ..wire import POSE
from .command_line import add_command, add_json, option_group, progress_bar, seconds
from .file_arguments import add_force, check_new
from .options import add_bus, add_codec, add_faults, bus_settings, keyed_codec
from .output import (
    counts_text,
    faults_text,
    left_out_text,
    pose_errors_text,
    slot_text,
    unsent_texts,
)
from .sending import Sending, add_sending, components_dict, components_text, sending_of

PICTURES = (".png", ".svg", ".pdf")

DESCRIPTION = """\
Send the lines of a scenario over a bus, receive them, and compare what was received with what was
sent. Without further options the bus is within this process; no CAN hardware is needed."""

LEGEND = """\
A line is y(x) = y_off + tan(beta) x + c0 x^2/2 + c1 x^3/6: lateral position y, to the left, at
the distance x ahead of the car. Each value is given as mean ± standard deviation (sigma).

KL: Kullback-Leibler divergence of the received Gaussian from another one; 0 if they are equal,
    0.01 nat if all four sigmas are 5 % too large.
covered target: the sent Gaussian, widened by the rounding error of its mean. The received
    covariance is never smaller, so the receiver is never overconfident. Where a sigma is smaller
    than the rounding step of its mean, the KL from the sent Gaussian itself is large."""

COMPONENTS_LEGEND = f"""\
nonlinearity: share of the standard deviation of a line that comes from the nonlinear part of
    its dependence on the pose, 0 to 1; a large value means that one Gaussian fits badly.
    --components auto splits a line if it exceeds {TOLERANCE:g}, into enough components that at
    most three quarters of that is left within each, as far as --max-load allows."""


SCENE_LEGEND = """\
ego lane: width between its lines, and centre between them, with sigmas from the joint covariance
    of the lines. The error of the pose moves all lines together: a receiver that takes lines as
    independent overstates the sigma of the width, and understates that of the centre."""


def add_demo(commands: Any) -> None:
    """Add the command ``demo``."""
    example = "maplines demo --scenario street-turn --fd --plot turn.png"
    parser = add_command(commands, "demo", _demo, DESCRIPTION, example)
    add_sending(parser)
    add_bus(parser, private=True)
    add_codec(parser)
    option_group(parser, "scenario").add_argument(
        "--seconds", type=seconds, default=3.0, metavar="S", help="duration [s] (default: 3)"
    )
    option_group(parser, "output").add_argument(
        "--plot",
        metavar="FILE",
        help=f"draw the lines as sent and as received into this file: {', '.join(PICTURES)}",
    )
    add_force(parser)
    add_faults(parser)
    add_json(parser, "all figures")


def _demo(arguments: argparse.Namespace) -> int:
    codec = keyed_codec(arguments)
    if arguments.plot and Path(arguments.plot).suffix.lower() not in PICTURES:
        raise ValueError(
            f"--plot must be a file that ends in {', '.join(PICTURES)}, got {arguments.plot!r}"
        )
    check_new(arguments, arguments.plot)
    private = arguments.interface == "virtual" and arguments.channel is None
    sending = sending_of(codec, arguments)
    interface = None if private else bus_settings(arguments)
    bus = BusSettings(sending.bus.rate, *sending.bus.bitrates, interface)
    shape = "{l_bar}{bar}| {n:.1f}/{total:.1f} s"
    with progress_bar(" s", bar_format=shape, leave=False) as progress:
        trip = round_trip(
            sending.lines,
            codec,
            bus=bus,
            seconds=arguments.seconds,
            faults=arguments.faults,
            tick=lambda elapsed: progress(min(elapsed, arguments.seconds), arguments.seconds),
        )
    if arguments.plot:
        draw_round_trip(trip, sending.source.scenario, arguments.plot)
    if arguments.json:
        left_out = sending.lines.left_out.items()
        scene_figures = {
            "components": components_dict(sending.components),
            "left_out": {slot.name: reason.name for slot, reason in left_out},
        }
        name = sending.source.scenario.name
        print(json.dumps({"scenario": name} | trip.as_dict() | scene_figures, indent=2))
    else:
        print(_text(trip, sending, with_components=arguments.components != 1))
        if arguments.plot:
            print(f"\npicture: {arguments.plot}")
    return 0 if all(line.mean is not None for line in trip.lines) else 1


def _text(trip: RoundTrip, sending: Sending, *, with_components: bool) -> str:
    """Return the results as text: the lines, the counters and a legend."""
    scenario, left_out = sending.source.scenario, sending.lines.left_out
    components = sending.components if with_components else {}
    texts = [components_text(components[line.slot]) for line in trip.true_lines if components]
    out = [
        f"{scenario.name}: {scenario.about}",
        f"{count_text(len(trip.lines), 'line')} over {trip.frame_format}, {trip.bus.rate:g} Hz, "
        f"{trip.seconds:.1f} s",
        "",
        *_table(trip.lines, texts),
        *([left_out_text(left_out)] if left_out else []),
        *(["", *_scene(trip.scene)] if trip.scene else []),
        "",
        *_counters(trip),
        "",
        LEGEND,
    ]
    out += [COMPONENTS_LEGEND] * bool(components) + [SCENE_LEGEND] * (trip.scene is not None)
    return "\n".join(out)


def _scene(scene: SceneResult) -> list[str]:
    """Return the rows of a scene: the ego lane, and the frames of a cycle."""
    rows: list[str] = []
    for lane in scene.lane:
        ratio = "" if lane.sigma_ratio is None else f", sigma {100 * (lane.sigma_ratio - 1):+.1f} %"
        rows.append(
            f"{'ego lane' if not rows else '':<12}{lane.quantity:<6} at {lane.x:2g} m   "
            f"sent {lane.true_value:6.3f} ± {_sigma(lane.true_sigma)} m   "
            f"received {lane.value:6.3f} ± {_sigma(lane.sigma)} m{ratio}   "
            f"(if independent: ± {_sigma(lane.independent_sigma)} m)"
        )
    if scene.unsent:
        rows.append(left_out_text(scene.unsent))
    rows.append(
        f"{'frames':<12}{sum(scene.frames.values())} a cycle{_of_records(scene.frames)}; full "
        f"records without the pose error: {scene.frames_of_full_records}"
    )
    return rows


def _of_records(frames: Mapping[str, int]) -> str:
    """Return what the frames of a cycle are for, as text."""
    if POSE not in frames:
        return ", with the pose error and the lines"
    of_lines = [n for owner, n in frames.items() if owner != POSE]
    counts = " + ".join(str(n) for n in of_lines)
    if len(of_lines) > 1 and len(set(of_lines)) == 1:
        counts = f"{len(of_lines)} x {of_lines[0]}"
    return f": {frames[POSE]} for the pose error, {counts or 'none'} for the lines"


def _table(lines: Sequence[LineResult], notes: Sequence[str]) -> list[str]:
    """Return the rows of all lines, with a note on each line if there are notes."""
    head = ("y_off [m]", "beta [deg]", "c0 [1/km]", "c1 [1/km^2]", "y at x [m]")
    rows = [" " * 22 + _columns(head)]
    for i, line in enumerate(lines):
        slot = slot_text(line.slot)
        sent = _row(line, line.true_mean, line.true_sigma, line.true_y, line.true_y_sigma)
        rows.append(f"{slot:<12}{'sent':<10}{sent}")
        indent = " " * 12
        if line.mean is None or line.sigma is None or line.y is None or line.y_sigma is None:
            rows.append(f"{indent}nothing received")
            continue
        if line.status == Status.OUT_OF_RANGE.name:
            rows.append(f"{indent}received  out of range: not usable")
            continue
        rows += [
            f"{indent}{'received':<10}{_row(line, line.mean, line.sigma, line.y, line.y_sigma)}",
            f"{indent}status {(line.status or '').lower()}; at {line.x:g} m: mean off by "
            f"{1e3 * (line.y - line.true_y):+.2f} mm, sigma {_ratio(line)}",
            f"{indent}KL {line.kl_covered:.4f} nat from the covered target, "
            f"{line.kl:.4f} nat from the sent Gaussian",
            *(f"{indent}{note}" for note in notes[i : i + 1]),
        ]
    return rows


def _row(
    line: LineResult, mean: Iterable[float], sigma: Iterable[float], y: float, y_sigma: float
) -> str:
    scales = (1, np.degrees(1), 1e3, 1e6)
    cells = [f"{m * k:.3f} ± {_sigma(s * k)}" for m, s, k in zip(mean, sigma, scales, strict=True)]
    cells.append(f"{y:.3f} ± {_sigma(y_sigma)} at {line.x:g} m")
    return _columns(cells)


def _columns(cells: Sequence[str]) -> str:
    return "".join(f"{cell:>22}" for cell in cells[:-1]) + f"{cells[-1]:>27}"


def _sigma(value: float) -> str:
    return f"{value:.0e}" if 0 < value < 0.001 else f"{value:.3f}"


def _ratio(line: LineResult) -> str:
    """Return the change of the standard deviation of y in percent."""
    if not line.true_y_sigma or line.y_sigma is None:
        return "unchanged"
    return f"{100 * (line.y_sigma / line.true_y_sigma - 1):+.1f} %"


def _counters(trip: RoundTrip) -> list[str]:
    """Return the rows of the counters."""
    sent, received, jitter = trip.sent, trip.received, trip.period_jitter
    dropped = {reason.name: n for reason, n in received.counts.items()}
    bus, data_bitrate = trip.bus, trip.bus.data_bitrate
    rows = [
        f"sent      {count_text(sent.lines, 'line')}{pose_errors_text(sent.pose_errors)}, "
        f"{count_text(sent.frames, 'frame')}",
        f"received  {count_text(received.lines, 'line')}{pose_errors_text(received.pose_errors)}, "
        f"{count_text(received.frames, 'frame')}; "
        f"dropped: {counts_text(dropped)}",
        "; ".join(
            [
                f"lost      {count_text(trip.lines_lost, 'line')}, "
                f"{count_text(trip.frames_lost, 'frame')}",
                *unsent_texts(sent.down, sent.full, sent.overruns),
            ]
        ),
        f"bus load  {100 * trip.bus_load:.1f} % at {bus.bitrate / 1000:g} kbit/s"
        + (f" and {data_bitrate / 1e6:g} Mbit/s" if data_bitrate else ""),
        f"period    {1e3 / bus.rate:g} ms; deviation {1e3 * jitter['median']:.2f} ms (median), "
        f"{1e3 * jitter['p99']:.2f} ms (99 %)",
    ]
    if trip.faults:
        rows.insert(3, f"faults    {faults_text(trip.faults)}")
    if trip.cpu_share is not None:
        rows.append(f"CPU       {100 * trip.cpu_share:.0f} % of one core, sender and receiver")
    return rows
