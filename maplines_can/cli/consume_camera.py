"""Lines of a camera for ``maplines consume``: from a log, a table, or a bus."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bus import Link, Receiver, read_log
from ..logs.log_summary import Times
from ..propagation import pose_time_ns
from ..recordings.fitting import check_fit
from ..values.arrays import count_text
from ..values.gaussian import Gaussian
from ..values.line import PARAMETERS, MapLine, Slot
from ..wire import Codec, Reason
from .command_line import note, option_group
from .consume_input import table_rows
from .frame_source import note_log
from .options import bus_settings, codec_from

#: Oldest line that is handed on [s].
OLDEST = 0.5

#: Most lines of a table, all of which are in memory; an hour of two lines at 20 Hz has 144 000.
MAX_LINES = 200_000
_WANTED = {
    *("t", "slot", "age", "x_min", "x_max", *PARAMETERS),
    *(f"sigma_{name}" for name in PARAMETERS),
    *(f"cov_{one}_{other}" for one in PARAMETERS for other in PARAMETERS),
}

#: Returns the lines that have arrived since the last call, with their age now, for the time now on
#: the clock of the map lines [ns].
NewLines = Callable[[int], list[MapLine]]

#: Columns of a table of camera lines, for --help.
COLUMNS = """\
--camera reads a log of the same clock as LOG, with messages of this project, or a table, .csv or
.parquet, such as that of 'maplines decode --csv', with a row for each line and the columns
  t                 time of the line [s], on the clock of LOG
  slot              EGO_LEFT, EGO_RIGHT, ...
  y_off, beta, c0, c1    [m, rad, 1/m, 1/m^2], in the ego frame
  sigma_y_off, ...  standard deviations of these four; or cov_y_off_y_off, ... as of decode
  age               optional: age of the line at the time t [s] (default: 0)
  x_min, x_max      optional: valid range [m] (default: 0, 40)
--camera-channel receives them from another channel of the interface instead, or from the same one
if --camera-dbc has other CAN IDs."""


def add_camera(parser: argparse.ArgumentParser, sources: Any) -> None:
    """Add the options of the camera; those that exclude each other to a group of ``scenario``."""
    sources.add_argument("--camera", metavar="FILE", help="log or table with the lines of a camera")
    sources.add_argument(
        "--camera-channel", metavar="NAME", help="channel with the lines of a camera"
    )
    option_group(parser, "message").add_argument(
        "--camera-dbc", metavar="FILE", help="DBC of the camera lines (default: maplines.dbc)"
    )


def check_camera(arguments: argparse.Namespace) -> None:
    """Check that the options of the camera fit together.

    Raises:
        ValueError: they do not.
    """
    if arguments.camera and not arguments.log:
        raise ValueError("--camera needs LOG, a log of the map lines of the same clock")
    if arguments.camera_channel and arguments.log:
        raise ValueError("--camera-channel is a bus; with LOG, give a log or table by --camera")
    if arguments.camera_dbc and not (arguments.camera or arguments.camera_channel):
        raise ValueError("--camera-dbc is that of --camera or --camera-channel; leave it out")


@contextmanager
def camera_of(arguments: argparse.Namespace) -> Iterator[NewLines]:
    """Yield the function that returns the new lines of the camera; without a camera, none.

    Raises:
        ValueError: a table is wrong.
        MaplinesError: a log, a DBC or the interface cannot be opened.
    """
    if arguments.camera_channel:
        settings = bus_settings(arguments) | {"channel": arguments.camera_channel}
        codec = codec_from(arguments.camera_dbc, encoding=arguments.encoding)
        with Link(**settings) as link, Receiver(link, codec.decoder()) as receiver:
            yield lambda _: _arrived(receiver)
    elif arguments.camera:
        yield _recorded(
            _of_table(arguments.camera)
            if _is_table(arguments.camera)
            else _of_log(
                arguments.camera,
                codec_from(arguments.camera_dbc, encoding=arguments.encoding),
                arguments.times,
            )
        )
    else:
        yield lambda _: []


def _arrived(receiver: Receiver) -> list[MapLine]:
    """Return the lines that wait; their ages are by the clock of their own bus."""
    found = []
    while (line := receiver.get(0.0)) is not None:
        found.append(line)
    now_ns = receiver.now_ns()
    return [aged for line in found if (aged := _aged(line, now_ns)) is not None]


def _recorded(lines: Iterator[MapLine]) -> NewLines:
    waiting = next(lines, None)

    def new_lines(now_ns: int) -> list[MapLine]:
        nonlocal waiting
        found = []
        while waiting is not None and (waiting.t_ns or 0) <= now_ns:
            if (aged := _aged(waiting, now_ns)) is not None:
                found.append(aged)
            waiting = next(lines, None)
        return found

    return new_lines


def _aged(line: MapLine, now_ns: int) -> MapLine | None:
    """Return a line with its age now, and no time; None if it cannot be used."""
    if not line.is_usable:
        return None
    age = max(now_ns - pose_time_ns(line), 0) / 1e9
    return replace(line, age=age, t_ns=None) if age <= OLDEST else None


def _of_log(path: str, codec: Codec, times: Times = "auto") -> Iterator[MapLine]:
    """Return an iterator over the lines in a log, with their times.

    Raises:
        LogError: it has none.
    """
    check_fit(path, codec, times=times)
    decoder, frames = codec.decoder(), read_log(path, times=times)

    def lines() -> Iterator[MapLine]:
        for frame in frames:
            answer = decoder.feed(
                frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended
            )
            if not isinstance(answer, Reason):
                yield from answer
        note_log(path, frames.summary)

    return lines()


def _is_table(path: str) -> bool:
    """Return whether a file is a table of lines; a log of python-can may be .csv, too."""
    suffix = Path(path).suffix.lower()
    if suffix != ".csv":
        return suffix == ".parquet"
    with open(path, "rb") as file:
        return b"slot" in file.readline(10_000)


def _of_table(path: str) -> Iterator[MapLine]:
    """Return an iterator over the lines of a table in the order of time.

    Raises:
        ValueError: a column is missing, or a value is wrong.
    """
    lines, skipped = [], 0
    for number, row in enumerate(table_rows(path, _WANTED, MAX_LINES), start=1):
        try:
            line = _line_of(row)
        except KeyError as error:
            raise ValueError(
                f"--camera {path} has no column {error.args[0]}; see --help for the columns"
            ) from error
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"--camera {path}: row {number}: {error}") from error
        if line is None:
            skipped += 1
        else:
            lines.append(line)
    if skipped:
        note(f"{path}: skipped: {count_text(skipped, 'row')} without a finite value")
    if not lines:
        raise ValueError(f"--camera {path} has no line; see --help for the columns")
    return iter(sorted(lines, key=lambda line: line.t_ns or 0))


def _line_of(row: dict[str, Any]) -> MapLine | None:
    """Return the line of a row; None if a value is empty or not finite."""

    def of(name: str, default: float | None = None) -> float:
        value = row[name] if default is None else row.get(name, default)
        return math.nan if value in {None, ""} else float(value)

    slot = str(row["slot"])
    if slot not in Slot.__members__:
        raise ValueError(f"slot must be one of {', '.join(Slot.__members__)}, got {slot!r}")
    mean = [of(name) for name in PARAMETERS]
    if f"sigma_{PARAMETERS[0]}" in row:
        sigma = np.array([of(f"sigma_{name}") for name in PARAMETERS])
        if (sigma < 0).any():
            raise ValueError(f"standard deviations must be 0 or more, got {sigma.tolist()}")
        cov = np.diag(sigma**2)
    else:
        cov = _covariance(of)
    numbers = [of("t"), of("age", 0.0), of("x_min", 0.0), of("x_max", 40.0)]
    if not (np.isfinite(mean).all() and np.isfinite(cov).all() and np.isfinite(numbers).all()):
        return None
    t, age, x_min, x_max = numbers
    return MapLine(
        Slot[slot], Gaussian(mean, cov), x_min=x_min, x_max=x_max, age=age, t_ns=round(1e9 * t)
    )


def _covariance(of: Callable[[str], float]) -> NDArray[np.float64]:
    """Return the (4, 4) covariance of the columns that ``decode --csv`` writes."""
    upper = [
        [of(f"cov_{one}_{other}") if i <= j else 0.0 for j, other in enumerate(PARAMETERS)]
        for i, one in enumerate(PARAMETERS)
    ]
    return np.triu(upper) + np.triu(upper, 1).T
