"""Motion of the car for ``maplines consume``: a speed, a table, or signals of a log or a bus."""

from __future__ import annotations

import argparse
import math
from array import array
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from ..bus import Link, SignalDecoder, read_signals
from ..propagation import Motion
from ..simulation.drive_columns import COLUMNS
from .consume_input import table_rows
from .log_input import note_log
from .options import bus_settings
from .output import counts_text
from .parsing import number, option_group
from .stderr import note

#: Standard deviations of a known motion [m/s, rad/s].
MOTION_SIGMA = (0.1, 0.005)

#: Quantities of a motion.
QUANTITIES = ("speed", "yaw_rate")
_MOTION = {name for name, (quantity, _) in COLUMNS.items() if quantity in QUANTITIES}
#: Most records of a table; an hour at 100 Hz has 360 000.
MAX_RECORDS = 2_000_000
#: Oldest signal of a bus that counts [s].
OLDEST = 0.5
#: Time of a signal that does not count [ns].
NEVER_NS = -(10**18)
#: How long to wait for a further frame [s], and most frames that are read in a cycle.
POLL, MOST = 0.001, 50

Series = tuple[NDArray[np.float64], NDArray[np.float64]]
#: Returns the motion at the time now on the clock of the map lines [ns]; None if it is unknown.
MotionAt = Callable[[int], Motion | None]


def add_motion(parser: argparse.ArgumentParser) -> None:
    """Add the options of the motion."""
    add = option_group(parser, "scenario").add_argument
    add(
        "--motion",
        metavar="FILE",
        help="table of the motion, .csv or .parquet, with columns time [s], on the clock of the "
        "log, speed [m/s] and yaw_rate [rad/s], such as the truth of maplines drive; or, with "
        "--signals, a bus log of the car",
    )
    add(
        "--signals",
        metavar="FILE",
        help="table of the signals of the motion in the bus log --motion, by default in LOG, or, "
        "without LOG, on the bus, whose channel is opened a second time for them; in TOML, such as "
        'speed_kmh = "ESP.VehicleSpeed" and yaw_rate_deg_s = "ESP.YawRate", or in CSV with the '
        "header column,signal",
    )
    add("--signals-dbc", metavar="FILE", help="DBC of these signals: that of the car")
    add(
        "--signals-channel",
        metavar="NAME",
        help="channel of the bus with these signals (default: that of the map lines)",
    )
    add("--speed", type=number(float, -100, 100), metavar="M/S", help="constant speed [m/s]")


@contextmanager
def motion_of(arguments: argparse.Namespace, default: Motion) -> Iterator[MotionAt]:
    """Yield a function from the time now [ns] to the motion.

    It returns ``default`` if no option says the motion, and None if it should, but is unknown.

    Raises:
        ValueError: options do not fit together, or a table is wrong.
        MaplinesError: signals cannot be read, or the interface cannot be opened.
    """
    if (arguments.signals is None) != (arguments.signals_dbc is None):
        raise ValueError("--signals and --signals-dbc go together: the names, and their DBC")
    if arguments.speed is not None and (arguments.motion or arguments.signals):
        raise ValueError("--speed is that of a car without --motion and --signals; leave it out")
    if arguments.signals_channel and (arguments.log or not arguments.signals):
        raise ValueError("--signals-channel is that of --signals on a bus, without LOG")
    if arguments.motion and not arguments.log:
        raise ValueError("--motion needs LOG, the map lines of the same clock")
    if arguments.signals and not arguments.log:
        with _live(arguments) as motion:
            yield motion
    elif arguments.motion or arguments.signals:
        yield _recorded(_signals(arguments) if arguments.signals else _table(arguments.motion))
    else:
        if arguments.speed is not None:
            sigma = (MOTION_SIGMA[0], math.sqrt(default.cov[1, 1]))
            default = Motion.with_sigma(arguments.speed, 0.0, sigma)
        yield lambda _: default


@contextmanager
def _live(arguments: argparse.Namespace) -> Iterator[MotionAt]:
    """Yield the motion of the newest signals on a bus; unknown if they are too old."""
    source = f"--signals {arguments.signals}"
    decoder = SignalDecoder(arguments.signals_dbc, arguments.signals, encoding=arguments.encoding)
    units = {name: COLUMNS.get(name, (name, 1.0)) for name in decoder.names}
    _check_quantities({quantity for quantity, _ in units.values()}, source)
    settings = bus_settings(arguments)
    settings |= {"channel": arguments.signals_channel or settings.get("channel")}
    newest: dict[str, tuple[int, float]] = {}  # time [ns] and value by quantity
    last_ns: int | None = None

    with Link(**settings) as link:
        link.accept_only(decoder.can_ids)

        def motion(now_ns: int) -> Motion | None:
            nonlocal last_ns
            # After a pause, what arrives may have waited for all of it.
            is_late = last_ns is None or abs(now_ns - last_ns) > 1e9 * OLDEST
            last_ns = now_ns
            for name, value in _arrived(link, decoder):
                quantity, factor = units[name]
                newest[quantity] = NEVER_NS if is_late else now_ns, factor * value
            known = [newest.get(quantity, (NEVER_NS, 0.0)) for quantity in QUANTITIES]
            if any(abs(now_ns - t_ns) > 1e9 * OLDEST for t_ns, _ in known):
                return None
            return Motion.with_sigma(known[0][1], known[1][1], MOTION_SIGMA)

        yield motion
    if missing := [quantity for quantity in QUANTITIES if quantity not in newest]:
        note(f"{source}: no {' and no '.join(missing)} has arrived; check --signals-channel")
    if damage := decoder.damage():
        note(f"{source}: skipped: {counts_text(damage)}")
    for mixture in decoder.mixtures():
        note(f"{source}: {mixture}")


def _arrived(link: Link, decoder: SignalDecoder) -> Iterator[tuple[str, float]]:
    """Yield names and values of the signals that have arrived."""
    for _ in range(MOST):
        message = link.recv(POLL)
        if message is None:
            return
        if not (message.is_error_frame or message.is_remote_frame):
            can_id, data = message.arbitration_id, bytes(message.data)
            found = decoder.decode(can_id, data, is_extended=message.is_extended_id)
            yield from ((name, value) for name, value in found.items() if math.isfinite(value))


def _recorded(table: Mapping[str, Series]) -> MotionAt:
    speed, yaw_rate = (table[quantity] for quantity in QUANTITIES)

    def motion(now_ns: int) -> Motion:
        at_speed, at_rate = (float(np.interp(now_ns / 1e9, *one)) for one in (speed, yaw_rate))
        return Motion.with_sigma(at_speed, at_rate, MOTION_SIGMA)

    return motion


def _table(path: str) -> dict[str, Series]:
    """Return the series of a table."""
    values: dict[str, array[float]] = {}
    try:
        for row in table_rows(path, {"time", *_MOTION}, MAX_RECORDS):
            for name, value in row.items():
                values.setdefault(name, array("d")).append(float(value))
        t = np.array(values.pop("time") if values else ())
        found = {name: (t, np.array(series)) for name, series in values.items()}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"--motion {path} must have numbers in the columns time, speed and yaw_rate; the first "
            f"problem: {error}"
        ) from error
    return _in_si_units(found, f"--motion {path}")


def _signals(arguments: argparse.Namespace) -> dict[str, Series]:
    """Return the series of signals in a log."""
    log = arguments.motion or arguments.log
    found = read_signals(
        log,
        arguments.signals_dbc,
        arguments.signals,
        encoding=arguments.encoding,
        times=arguments.times,
    )
    if log != arguments.log:
        note_log(log, found.log)
    if found.skipped:
        note(f"{log}: skipped: {counts_text(found.skipped)}")
    return _in_si_units(found, f"--signals {arguments.signals}")


def _in_si_units(found: Mapping[str, Series], source: str) -> dict[str, Series]:
    """Return speed and yaw rate of series by column names such as ``speed_kmh``.

    Raises:
        ValueError: one of them is missing, or its times do not increase.
    """
    table: dict[str, Series] = {}
    for name, (t, values) in found.items():
        quantity, factor = COLUMNS.get(name, (name, 1.0))
        if quantity not in QUANTITIES:
            continue
        if not len(t) or not (np.diff(t) > 0).all() or not np.isfinite(values).all():
            raise ValueError(f"{source}: {name} must have finite values with increasing time")
        table[quantity] = t, factor * values
    _check_quantities(table, source)
    return table


def _check_quantities(found: Container[str], source: str) -> None:
    """Raise ValueError if there is no speed or no yaw rate."""
    for quantity in QUANTITIES:
        if quantity not in found:
            names = " or ".join(name for name, (of, _) in COLUMNS.items() if of == quantity)
            raise ValueError(f"{source} must have values, with increasing times, of {names}")
