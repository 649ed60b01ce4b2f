"""The ``maplines`` command."""

from __future__ import annotations

import argparse
import json
import logging
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from .bus import (
    Faults,
    Link,
    Receiver,
    Transmitter,
    key_from_env,
    key_from_file,
    read_log,
)
from .errors import LogError, MaplinesError
from .line import MapLine, Slot
from .propagation import MapError
from .scenarios import SCENARIOS, scenario
from .study.design.command import add_design
from .study.figures.paper import draw_figures
from .study.figures.picture import draw_round_trip
from .study.listing import check_dict, check_text, line_dict, line_text, slot_text, write_csv
from .study.page.command import add_report
from .study.production.command import add_production
from .study.report import counts_text, faults_text, parts_text, trip_text
from .study.round_trip import round_trip
from .study.sending import MAX_LOAD, carrier_text, chosen_parts, scene_lines
from .study.sweep.command import add_study
from .study.truth.table import truth_table
from .study.truth.text import as_csv, as_markdown, as_text
from .wire import Authenticator, Codec, Decoder, E2EState, Key, SlotStats

__all__ = ["main"]

#: How often a silent bus is looked at for slots that go INVALID [s].
WATCH = 0.05
PICTURES = (".png", ".svg", ".pdf")


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit status: 0, 1 for an error, 2 for wrong usage."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    if getattr(arguments, "keys", None):
        arguments.fd = True  # classic CAN has no room for a MAC
    logging.basicConfig(format="maplines: %(message)s", stream=sys.stderr)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # a kill ends as Ctrl-C does
    try:
        return int(arguments.run(arguments))
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of our output, such as head, has enough
        sys.stderr.close()
        return 0
    except (MaplinesError, OSError, ValueError) as error:
        print(f"maplines: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1


# ---- the jobs ---------------------------------------------------------------------


def _demo(arguments: argparse.Namespace) -> int:
    codec = _codec(arguments)
    scene = scenario(arguments.scenario)
    alone = arguments.interface == "virtual" and arguments.channel is None
    interface = None if alone else _bus_settings(arguments)
    if arguments.plot and Path(arguments.plot).suffix.lower() not in PICTURES:
        raise ValueError(f"{arguments.plot}: a picture is one of {', '.join(PICTURES)}")
    with _progress(arguments.seconds, "s") as bar:

        def tick(elapsed: float) -> None:
            if bar is not None:
                bar.update(min(elapsed, arguments.seconds) - bar.n)

        trip = round_trip(
            scene,
            codec,
            **_sending(arguments),
            map_error=_map_error(arguments),
            seconds=arguments.seconds,
            interface=interface,
            faults=arguments.faults,
            tick=tick,
        )
    if arguments.plot:
        draw_round_trip(trip, scene, arguments.plot)
    if arguments.json:
        print(json.dumps(trip.as_dict(), indent=2))
    else:
        print(trip_text(trip))
        if arguments.plot:
            print(f"\npicture: {arguments.plot}")
    return 0 if all(line.mean for line in trip.lines) else 1


def _send(arguments: argparse.Namespace) -> int:
    codec = _codec(arguments)
    scene = scenario(arguments.scenario)
    parts = chosen_parts(scene, codec, **_sending(arguments))
    lines = scene_lines(
        scene,
        arguments.lines,
        components=[line.parts for line in parts],
        map_error=_map_error(arguments),
    )
    with Link(**_bus_settings(arguments), faults=arguments.faults) as link:
        transmitter = Transmitter(
            link, codec, period=1 / arguments.rate, fd=arguments.fd, count=arguments.count
        )
        try:
            with transmitter:
                transmitter.publish(lines)
                if not arguments.json:
                    until = f"{arguments.count} times" if arguments.count else "until Ctrl-C"
                    carrier = carrier_text(codec, fd=arguments.fd)
                    _note(
                        f"{len(lines)} lines of {arguments.scenario} on {link.name}, {carrier}, "
                        f"{arguments.rate:g} Hz, {until}"
                    )
                    for line in parts:
                        _note(f"{slot_text(line.slot)}: {parts_text(line)}")
                transmitter.wait()
        except KeyboardInterrupt:
            pass
        stats, faults = transmitter.stats(), link.faults
        if arguments.json:
            rest = {"lateness": stats.lateness._asdict(), "outages": link.outages}
            rest["parts"] = [asdict(line) for line in parts]
            rest |= {"faults": faults} if faults else {}
            print(json.dumps(stats._asdict() | rest))
        else:
            print(
                f"sent {stats.lines} lines in {stats.frames} frames; {stats.down} lines given up "
                f"while the interface was down, {stats.full} with a full queue, "
                f"{stats.overruns} periods overrun"
            )
            if faults:
                print(f"faults: {faults_text(faults)}")
            print(f"late by {_milliseconds(stats.lateness)} (median, 99 %, most)")
        return 0


def _receive(arguments: argparse.Namespace) -> int:
    codec = _codec(arguments)
    left = arguments.count
    with (
        Link(**_bus_settings(arguments), faults=arguments.faults) as link,
        Receiver(link, codec.decoder(), can_ids=codec.can_ids) as receiver,
    ):
        if not arguments.json:
            _note(f"listening on {link.name}; Ctrl-C ends")
        try:
            for line, check in _arriving(receiver, arguments.timeout):
                row = line_dict(line) | {"e2e": check_dict(check)}
                print(json.dumps(row) if arguments.json else line_text(line))
                sys.stdout.flush()
                left = None if left is None else left - 1
                if left == 0:
                    break
        except KeyboardInterrupt:
            pass
        stats, faults, slots = receiver.stats(), link.faults, receiver.slots()
    dropped = {reason.name: n for reason, n in stats.counts.items()}
    _note(
        f"{stats.lines} lines from {stats.frames} frames; {stats.lost} lines lost by their "
        f"counters; dropped frames: {counts_text(dropped)}; {stats.pending} still waiting"
        + "".join(
            f"; {n} {what}"
            for n, what in (
                (stats.error_frames, "error frames"),
                (stats.remote_frames, "remote frames"),
                (stats.overflowed, "lines dropped because they were not fetched"),
            )
            if n
        )
    )
    for slot, check in slots.items():
        _note(f"{slot_text(slot.name)}: {check_text(check)}")
    if faults:
        _note(f"faults: {faults_text(faults)}")
    return 0 if left in (None, 0) else 1


def _arriving(receiver: Receiver, timeout: float | None) -> Iterator[tuple[MapLine, SlotStats]]:
    """Lines with the checks of their slots; says when a slot's state changes, in silence too."""
    states: dict[Slot, tuple[E2EState, bool]] = {}
    last = time.monotonic()
    while True:
        line = receiver.get(WATCH if timeout is None else min(WATCH, timeout))
        slots = receiver.slots()
        for slot, check in slots.items():
            state = check.state, check.two_senders
            if states.get(slot) != state:
                states[slot] = state
                _note(f"{slot_text(slot.name)}: {check_text(check)}")
        if line is not None:
            last = time.monotonic()
            yield line, slots[line.slot]
        elif timeout is not None and time.monotonic() - last >= timeout:
            _note(f"nothing received for {timeout:g} s")
            return


def _decode(arguments: argparse.Namespace) -> int:
    codec = _codec(arguments, clock=None)  # a log is as old as it is
    decoders: dict[str, Decoder] = {}
    status = 0

    def lines() -> Iterator[tuple[str, MapLine]]:
        nonlocal status
        last_ns = 0
        frames = tqdm(read_log(arguments.log), unit=" frames", disable=not sys.stderr.isatty())
        try:
            for frame in frames:
                decoder = decoders.setdefault(frame.channel, codec.decoder())
                last_ns = frame.t_ns
                answer = decoder.feed(
                    frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended
                )
                if isinstance(answer, MapLine):
                    yield frame.channel, answer
        except LogError as error:  # what is good came first
            _note(f"error: {error}")
            status = 1
        for decoder in decoders.values():
            decoder.expire(last_ns + 10**18)

    try:
        if arguments.csv:
            write_csv(sys.stdout, lines())
        else:
            for channel, line in lines():
                print(json.dumps(line_dict(line) | {"channel": channel}))
    except KeyboardInterrupt:  # the counts so far are still of use
        status = 130
    total = sum((decoder.counts for decoder in decoders.values()), Counter())
    _note(
        f"{sum(d.lines for d in decoders.values())} lines from "
        f"{sum(d.frames for d in decoders.values())} frames; "
        f"{sum(d.lost for d in decoders.values())} lines lost by their counters; "
        f"dropped frames: {counts_text({reason.name: n for reason, n in total.items()})}"
    )
    return status


def _figures(arguments: argparse.Namespace) -> int:
    with _counted(" figures") as progress:
        paths = draw_figures(
            Path(arguments.out),
            seed=arguments.seed,
            samples=arguments.samples,
            codec=Codec.from_dbc(arguments.dbc),
            progress=progress,
        )
    if arguments.json:
        print(json.dumps([str(path) for path in paths], indent=2))
    else:
        print(f"{len(paths)} files in {arguments.out}")
    return 0


def _truth(arguments: argparse.Namespace) -> int:
    scenes = [scenario(name) for name in arguments.scenario or SCENARIOS]
    with _counted(" rows") as progress:
        rows = truth_table(
            scenes,
            n=arguments.samples,
            seed=arguments.seed,
            codec=Codec.from_dbc(arguments.dbc),
            progress=progress,
        )
    writers = {"text": as_text, "csv": as_csv, "markdown": as_markdown}
    print(writers[arguments.format](rows).rstrip("\n"))
    return 0


def _scenarios(arguments: argparse.Namespace) -> int:
    if arguments.json:
        rows = [
            {
                "name": scene.name,
                "about": scene.about,
                "ego_sigma": scene.ego.sigma.tolist(),
                "window": scene.window,
                "lines": [line.slot.name for line in scene.lines],
            }
            for scene in SCENARIOS.values()
        ]
        print(json.dumps(rows, indent=2))
    else:
        for scene in SCENARIOS.values():
            print(f"{scene.name:<20}{scene.about}")
    return 0


# ---- what they print ------------------------------------------------------------------


def _milliseconds(values: Iterable[float]) -> str:
    return ", ".join(f"{1e3 * value:.2f}" for value in values) + " ms"


def _note(text: str) -> None:
    print(f"maplines: {text}", file=sys.stderr, flush=True)


def _progress(total: float, unit: str) -> AbstractContextManager[Any]:
    if not sys.stderr.isatty():
        return nullcontext()
    shape = "{l_bar}{bar}| {n:.1f}/{total:.1f} " + unit
    return tqdm(total=total, bar_format=shape, leave=False)


@contextmanager
def _counted(unit: str) -> Iterator[Callable[[float, float], None]]:
    """A progress bar that is told how much of how much is done."""
    with tqdm(total=1, unit=unit, disable=not sys.stderr.isatty()) as bar:

        def progress(done: float, total: float) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield progress


# ---- what they are asked ----------------------------------------------------------------


def _codec(arguments: argparse.Namespace, clock: Callable[[], int] | None = time.time_ns) -> Codec:
    keys = [read(name, key_id) for read, name, key_id in arguments.keys or ()]
    if not keys:
        return Codec.from_dbc(arguments.dbc)
    window = getattr(arguments, "freshness_window", 1.0)
    if "rate" in arguments:  # lines are encoded up to a period ahead
        window = max(window, 1 / arguments.rate)
    authenticator = Authenticator(*keys, clock=clock, window_ns=round(1e9 * window))
    return Codec.from_dbc(arguments.dbc, authenticator)


def _key_from(read: Callable[[str, int], Key]) -> Callable[[str], tuple[Any, str, int]]:
    """A type for argparse: where a key is, after its number if that is not 1."""

    def parse(text: str) -> tuple[Any, str, int]:
        key_id, colon, name = text.partition(":")
        return (read, name, int(key_id)) if colon and key_id.isdecimal() else (read, text, 1)

    return parse


def _bus_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    names = ("interface", "channel", "bitrate")
    settings = {name: getattr(arguments, name) for name in names}
    settings = {name: value for name, value in settings.items() if value is not None}
    return settings | ({"fd": True} if arguments.fd else {})


def _sending(arguments: argparse.Namespace) -> dict[str, Any]:
    names = ("lines", "components", "max_load", "rate", "fd")
    settings = {name: getattr(arguments, name) for name in names}
    return settings | {"bitrate": arguments.bitrate or 500_000}


def _map_error(arguments: argparse.Namespace) -> MapError | None:
    if not arguments.map_error:
        return None
    return MapError(arguments.map_error, arguments.map_error, np.radians(0.05))


def _number(kind: type, least: float, most: float, word: str | None = None) -> Any:
    """A type for argparse: a number of a kind within bounds, both allowed, or a word."""

    def parse(text: str) -> Any:
        if text == word:
            return word
        try:
            value = kind(text)
        except ValueError:
            value = float("nan")
        if not least <= value <= most:
            what = "a whole number" if kind is int else "a number"
            raise argparse.ArgumentTypeError(
                f"must be {what} from {least:g} to {most:g}{f' or {word}' if word else ''}, "
                f"got {text!r}"
            )
        return value

    return parse


def _faults(text: str) -> Faults:
    try:
        return Faults.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


_natural = _number(int, 1, 10**9)
_seconds = _number(float, 1e-3, 1e6)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="maplines",
        description="The lines of a digital map on a CAN bus, with their uncertainty.",
        epilog="Begin with 'maplines demo'. Each job explains itself: maplines JOB --help.",
    )
    parser.add_argument(
        "--version", action="version", version=f"maplines {version('maplines_can')}"
    )
    jobs = parser.add_subparsers(title="jobs", required=True, metavar="JOB")

    def job(name: str, run: Any, about: str, example: str) -> argparse.ArgumentParser:
        sub = jobs.add_parser(
            name,
            help=about,
            description=about,
            epilog=f"example: {example}",
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )
        sub.set_defaults(run=run)
        return sub

    demo = job(
        "demo",
        _demo,
        "Send the lines of a scene over a bus, receive them, and compare.",
        "maplines demo --scenario street-turn --fd --plot turn.png",
    )
    send = job(
        "send",
        _send,
        "Send the lines of a scene until Ctrl-C.",
        "maplines send --interface socketcan --channel vcan0 --rate 50",
    )
    receive = job(
        "receive",
        _receive,
        "Print the lines that arrive until Ctrl-C, then what was dropped and why.",
        "maplines receive --interface socketcan --channel vcan0 --json",
    )
    decode = job(
        "decode",
        _decode,
        "Print the lines of a log as JSON lines or CSV, then what was dropped and why.",
        "maplines decode drive.blf --csv > drive.csv",
    )
    figures = job(
        "figures",
        _figures,
        "Draw the figures of the paper, before and after the wire, as PNG and SVG.",
        "maplines figures --out figures",
    )
    truth = job(
        "truth",
        _truth,
        "Judge each representation of a line against a million samples, before and after the wire.",
        "maplines truth --scenario street-turn-10deg --format csv > truth.csv",
    )
    studies = add_study(jobs, _counted)
    add_report(studies)
    add_production(studies)
    add_design(jobs, _counted)
    list_ = job("scenarios", _scenarios, "List the scenes.", "maplines scenarios --json")

    for sub in (demo, send):
        names = list(SCENARIOS)
        sub.add_argument("--scenario", default="highway", choices=names, help="the scene")
        sub.add_argument(
            "--lines", type=_number(int, 1, 8), default=4, metavar="N", help="1 to 8 lines"
        )
        sub.add_argument(
            "--rate",
            type=_number(float, 1e-3, 1000),
            default=20.0,
            help="lines of each slot a second",
        )
        sub.add_argument(
            "--components",
            type=_number(int, 1, 8, "auto"),
            default=1,
            metavar="K",
            help="send each line as a Gaussian mixture of so many parts; auto: of as many as its "
            "bend asks for and the bus allows",
        )
        sub.add_argument(
            "--max-load",
            type=_number(float, 1e-3, 1),
            metavar="SHARE",
            help=f"most of the bus's time that the lines may take; for auto {MAX_LOAD:g}",
        )
        sub.add_argument(
            "--map-error",
            type=_number(float, 1e-6, 100),
            metavar="SIGMA",
            help="error of the map's points and of their common offset [m], beside the pose's",
        )
    for sub in (demo, send, receive):
        default = "virtual" if sub is demo else None
        sub.add_argument(
            "--interface",
            default=default,
            help="python-can interface, such as virtual, socketcan, udp_multicast; "
            "without it, python-can's own configuration",
        )
        sub.add_argument("--channel", help="channel of the interface, such as vcan0")
        sub.add_argument("--bitrate", type=_natural, help="[bit/s]")
        sub.add_argument("--fd", action="store_true", help="CAN FD: one frame of 32 bytes a line")
        sub.add_argument(
            "--faults",
            type=_faults,
            metavar="SPEC",
            help="spoil the bus by rates: loss=0.1,dup=0.05,reorder=0.05,corrupt=0.02,seed=7; also "
            "late=0.1,delay=0.02,jitter=0.01 [s]; garbage=0.01; flood=1000,flood_ids=0x340+0 "
            "[1/s]; or by a script, script=FILE, with lines such as 'loss 3' and 'flip 20-29 3'; a "
            "wrong key is answered with the right ones",
        )
    figures.add_argument("--out", required=True, metavar="DIR", help="where to put them")
    truth.add_argument(
        "--scenario",
        action="append",
        choices=list(SCENARIOS),
        help="only this one; may be repeated",
    )
    truth.add_argument("--format", choices=["text", "csv", "markdown"], default="text")
    for sub, samples in ((figures, 100_000), (truth, 1_000_000)):
        sub.add_argument("--seed", type=_number(int, 0, 2**32), default=0, help="of the draws")
        sub.add_argument(
            "--samples", type=_number(int, 1000, 10**7), default=samples, help="Monte Carlo draws"
        )
    for sub in (demo, send, receive, decode):
        sub.add_argument(
            "--key-file",
            action="append",
            dest="keys",
            type=_key_from(key_from_file),
            metavar="[ID:]FILE",
            help="authenticate (AUTOSAR SecOC, CAN FD only) with the key whose 32 or 64 hex digits "
            "are in this file, number 1 if no other is given; the first key is sent with, all are "
            "accepted",
        )
        sub.add_argument(
            "--key-env",
            action="append",
            dest="keys",
            type=_key_from(key_from_env),
            metavar="[ID:]NAME",
            help="the same, from an environment variable",
        )
    for sub in (demo, send, receive, decode, figures, truth):
        sub.add_argument("--dbc", help="another DBC than the project's own")
    demo.add_argument("--seconds", type=_seconds, default=3.0, help="how long [s]")
    demo.add_argument("--plot", metavar="FILE", help="draw the picture: .png, .svg or .pdf")
    send.add_argument("--count", type=_natural, help="send each line so many times, then end")
    receive.add_argument(
        "--freshness-window",
        type=_seconds,
        default=1.0,
        metavar="S",
        help="with a key, how far a frame's time may be from this machine's clock [s]",
    )
    receive.add_argument("--count", type=_natural, help="end after so many lines")
    receive.add_argument("--timeout", type=_seconds, help="end when nothing comes for so long [s]")
    decode.add_argument("log", help="a log that python-can reads: .asc .blf .csv .log .mf4 .trc")
    decode.add_argument("--csv", action="store_true", help="CSV instead of JSON lines")
    for sub in (demo, send, receive, figures, list_):
        sub.add_argument("--json", action="store_true", help="for machines")
    return parser


if __name__ == "__main__":
    sys.exit(main())
