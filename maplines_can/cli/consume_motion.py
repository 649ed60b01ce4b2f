"""Motion of the car for ``maplines consume``: a speed, a table, or signals in a bus log."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from ..bus import read_signals
from ..ego.columns import COLUMNS
from ..propagation import Motion
from .consume_input import table_rows
from .output import counts_text
from .parsing import number
from .stderr import note

#: Standard deviations of a known motion [m/s, rad/s].
MOTION_SIGMA = (0.1, 0.005)

Series = tuple[NDArray[np.float64], NDArray[np.float64]]


def add_motion(parser: argparse.ArgumentParser) -> None:
    """Add the options of the motion."""
    add = parser.add_argument
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
        help="table of the signals of the motion in the bus log --motion, by default in LOG, in "
        'TOML, such as speed_kmh = "ESP.VehicleSpeed" and yaw_rate_deg_s = "ESP.YawRate", or in '
        "CSV with the header column,signal",
    )
    add("--signals-dbc", metavar="FILE", help="DBC of these signals: that of the car")
    add("--speed", type=number(float, -100, 100), metavar="M/S", help="constant speed [m/s]")


def motion_of(arguments: argparse.Namespace, unknown: Motion) -> Callable[[int], Motion]:
    """Return a function from the time [ns] to the motion; ``unknown`` if no option says it.

    Raises:
        ValueError: options do not fit together, or a table is wrong.
        MaplinesError: signals cannot be read.
    """
    if (arguments.signals is None) != (arguments.signals_dbc is None):
        raise ValueError("--signals and --signals-dbc go together: the names, and their DBC")
    if arguments.speed is not None and (arguments.motion or arguments.signals):
        raise ValueError("--speed is that of a car without --motion and --signals; leave it out")
    if arguments.motion is None and arguments.signals is None:
        known = unknown
        if arguments.speed is not None:
            sigma = (MOTION_SIGMA[0], math.sqrt(unknown.cov[1, 1]))
            known = Motion.with_sigma(arguments.speed, 0.0, sigma)
        return lambda _: known
    if not arguments.log:
        raise ValueError("--motion and --signals need LOG, the map lines of the same clock")
    table = _table(arguments.motion) if arguments.signals is None else _signals(arguments)
    speed, yaw_rate = table["speed"], table["yaw_rate"]

    def motion(t_ns: int) -> Motion:
        at_speed, at_rate = (float(np.interp(t_ns / 1e9, *one)) for one in (speed, yaw_rate))
        return Motion.with_sigma(at_speed, at_rate, MOTION_SIGMA)

    return motion


def _table(path: str) -> dict[str, Series]:
    """Return the series of a table."""
    rows = table_rows(path)
    try:
        t = np.array([float(row["time"]) for row in rows])
        names = [name for name in (rows[0] if rows else ()) if name in COLUMNS]
        found = {name: (t, np.array([float(row[name]) for row in rows])) for name in names}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"--motion {path} must have numbers in the columns time, speed and yaw_rate; the first "
            f"problem: {error}"
        ) from error
    return _in_si_units(found, f"--motion {path}")


def _signals(arguments: argparse.Namespace) -> dict[str, Series]:
    """Return the series of signals in a log."""
    log = arguments.motion or arguments.log
    found = read_signals(log, arguments.signals_dbc, arguments.signals)
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
        if quantity not in {"speed", "yaw_rate"}:
            continue
        if not len(t) or not (np.diff(t) > 0).all() or not np.isfinite(values).all():
            raise ValueError(f"{source}: {name} must have finite values with increasing time")
        table[quantity] = t, factor * values
    for quantity in ("speed", "yaw_rate"):
        if quantity not in table:
            names = " or ".join(name for name, (of, _) in COLUMNS.items() if of == quantity)
            raise ValueError(f"{source} must have rows with increasing time, and a column {names}")
    return table
