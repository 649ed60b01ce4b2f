"""Recordings: blocks of frames against frame by frame, and how fast they are read.

python tools/evidence recordings.identity log=drive.blf
python tools/evidence recordings.speed log=drive.blf peers=300000
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from maplines_can import Codec
from maplines_can.bus import read_log
from maplines_can.recordings.blocks import read_blocks
from maplines_can.recordings.fitting import best_fit, fits
from maplines_can.recordings.line_block import COMPLETE, REASONS
from maplines_can.recordings.receive import LogReceiver
from maplines_can.recordings.table import line_table
from maplines_can.values.errors import LogError
from maplines_can.wire import Decoder, Reason, default_dbc_path

from .harness import evidence

#: Members of a row that are compared one by one.
_COMPARED = (
    *("frame", "slot", "t_ns", "status", "kind", "age"),
    *("counter", "ahead", "e2e_status"),
)
_NUMBER = {reason: number for number, reason in enumerate(REASONS)}


@evidence(seconds=10.0)
def identity(log: str = "", dbc: str = "auto", seconds: float = 600.0) -> dict[str, Any]:
    """Compare the lines, reasons and counters of a log in blocks with those frame by frame.

    A difference ends the evidence. The log is read twice, by two readers. By default it is that of
    a simulated drive of so many seconds on a faulty bus.
    """
    if not log:
        with TemporaryDirectory() as folder:
            return dict(identity(str(_drive(Path(folder) / "drive.log", seconds))))
    codec = best_fit(fits(log), log).codec if dbc == "auto" else Codec.from_dbc(dbc)
    receiver, decoders = LogReceiver(codec), dict[str, Decoder]()
    frames = _until_error(read_log(log))
    checks: dict[str, Mapping[Any, Any]] = {}
    ends: list[str] = []
    counted = lines = 0
    for block in _until_error(read_blocks(log), ends):
        found = receiver.feed(block)
        reasons, rows = bytearray(), list[tuple[Any, ...]]()
        means, covs = list[Any](), list[Any]()
        for k, frame in enumerate(islice(frames, len(block))):
            if frame.channel not in decoders:
                decoders[frame.channel] = codec.decoder()
                checks[frame.channel] = decoders[frame.channel].checks
            answer = decoders[frame.channel].feed(
                frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended
            )
            if isinstance(answer, Reason):
                reasons.append(_NUMBER[answer])
                continue
            reasons.append(COMPLETE)
            for line in answer:
                check = checks[frame.channel][line.slot]
                of_check = check.counter, check.ahead or 0, check.status
                of_line = line.slot, line.t_ns, line.status, line.kind, line.age
                rows.append((counted + k, *of_line, *of_check))
                means.append(line.gaussian.mean)
                covs.append(line.gaussian.cov)
        _check(found.reasons.tobytes(), bytes(reasons))
        _check([*zip(*(found.lines[name].tolist() for name in _COMPARED), strict=True)], rows)
        _check(found.lines["mean"].tobytes(), np.array(means, float).tobytes())
        _check(found.lines["cov"].tobytes(), np.array(covs, float).tobytes())
        counted += len(block)
        lines += len(rows)
    _check(next(frames, None), None)
    receiver.finish()
    for channel, decoder in decoders.items():
        decoder.expire(receiver.last_ns + 10**18)
        ours = receiver.decoders[channel]
        _check(ours.counts, decoder.counts)
        for owner, check in decoder.checks.items():
            _check(ours.checks[owner].stats(), check.stats())
    return {"frames": counted, "lines": lines, "different": 0, "damaged": len(ends)}


def _check(found: Any, expected: Any) -> None:
    if found != expected:
        raise AssertionError(f"in blocks {found!r}, frame by frame {expected!r}")


def _drive(path: Path, seconds: float) -> Path:
    """Record a drive on a faulty bus."""
    command = [sys.executable, "-m", "maplines_can.cli", "drive", "--as-fast-as-possible"]
    command += ["--seconds", str(seconds), "--record", str(path)]
    command += ["--faults", "loss=0.05,dup=0.02,corrupt=0.02,reorder=0.01"]
    subprocess.run(command, check=True, capture_output=True)
    return path


def _until_error(items: Iterator[Any], errors: list[str] | None = None) -> Iterator[Any]:
    try:
        yield from items
    except LogError as error:
        if errors is not None:
            errors.append(str(error))


@evidence(in_real_time=True)
def speed(log: str = "", peers: int = 300_000) -> dict[str, Any]:
    """Time the table of a log of ``maplines.dbc`` beside peers, each in a process of its own.

    The peers read the first frames only: python-can with cantools in a loop, and our decoder frame
    by frame; cantools' command reads the candump logs; asammdf extracts the MF4 ones as a whole.
    """
    if not log:
        with TemporaryDirectory() as folder:
            return dict(speed(str(_drive(Path(folder) / "drive.log", 3600.0)), peers))
    ours = _timed("blocks", log, 0)
    found = {"blocks": ours}
    names = ["frames", "loop"]
    if Path(log).suffix == ".mf4":
        names.append("asammdf")
    if Path(log).suffix == ".log":
        names.append("command")
    for name in names:
        found[name] = _timed(name, log, 0 if name == "asammdf" else peers)
    ratios = {
        f"times {name}": ours["rate"] / peer["rate"]
        for name, peer in found.items()
        if name != "blocks"
    }
    return found | ratios


def _timed(what: str, log: str, most: int) -> dict[str, float]:
    """Return frames per second of CPU, the share of the reader, and the peak memory [MB]."""
    command = [sys.executable, "-m", "evidence.recordings", what, log, str(most)]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[1], capture_output=True, check=True, text=True
    )
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def _blocks(log: str, _most: int) -> tuple[int, float]:
    receiver, frames, reading = LogReceiver(Codec.from_dbc()), 0, 0.0
    blocks = iter(read_blocks(log))
    while True:
        began = time.process_time()
        block = next(blocks, None)
        reading += time.process_time() - began
        if block is None:
            return frames, reading
        line_table(receiver.feed(block), block, (0.0, 20.0, 40.0))
        frames += len(block)


def _frames(log: str, most: int) -> tuple[int, float]:
    decoder, frames = Codec.from_dbc().decoder(), 0
    for frame in islice(read_log(log), most):
        decoder.feed(frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended)
        frames += 1
    return frames, 0.0


def _loop(log: str, most: int) -> tuple[int, float]:
    import can
    import cantools

    database: Any = cantools.database.load_file(default_dbc_path())
    known, frames = {message.frame_id for message in database.messages}, 0
    for message in islice(can.LogReader(log), most):
        frames += 1
        if message.arbitration_id in known:
            try:
                database.decode_message(message.arbitration_id, message.data)
            except (ValueError, cantools.Error):  # a damaged frame
                continue
    return frames, 0.0


def _command(log: str, most: int) -> tuple[int, float]:
    """Run ``cantools decode`` on the rows of a candump log."""
    command = [sys.executable, "-m", "cantools", "decode", "--single-line"]
    command.append(str(default_dbc_path()))
    with Path(log).open() as file:
        rows = [*islice(file, most)]
    text = "".join(row.removesuffix(" T\n").removesuffix(" R\n").rstrip() + "\n" for row in rows)
    subprocess.run(command, input=text, stdout=subprocess.DEVNULL, check=True, text=True)
    return len(rows), 0.0


def _asammdf(log: str, _most: int) -> tuple[int, float]:
    import asammdf

    with asammdf.MDF(log) as mdf:
        frames = sum(group.channel_group.cycles_nr for group in mdf.groups)
        mdf.extract_bus_logging(database_files={"CAN": [(str(default_dbc_path()), 0)]})
    return frames, 0.0


def _main(what: str, log: str, most: str) -> None:
    began = time.process_time()
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    run = {f.__name__: f for f in (_blocks, _frames, _loop, _command, _asammdf)}[f"_{what}"]
    frames, reading = run(log, int(most))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = time.process_time() - began
    cpu += after.ru_utime + after.ru_stime - children.ru_utime - children.ru_stime
    memory = max(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, after.ru_maxrss) / 1024
    print(json.dumps({"rate": frames / cpu, "reader": reading / cpu, "memory_MB": memory}))


if __name__ == "__main__":
    _main(*sys.argv[1:])
