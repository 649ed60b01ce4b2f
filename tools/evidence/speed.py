"""Times of the core, and of logs that become tables.

The core is timed inside a program in C, on one thread and with -O2. The readers of a log run in a
process of their own each.
"""

from __future__ import annotations

import multiprocessing
import resource
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np

from maplines_can import Codec, Slot
from maplines_can.recordings.block_reception import LogReceiver
from maplines_can.recordings.blocks import read_blocks
from maplines_can.recordings.line_tables import line_table
from maplines_can.study.sets import road
from maplines_can.wire import default_dbc_path

from .harness import evidence

LINES = 256  #: of c/tests/speed_harness.c
#: DBCs of scenes, and whether their frames are CAN FD.
SCENES = {
    "maplines-pose.dbc, classic": ("maplines-pose.dbc", False),
    "maplines-pose.dbc, FD": ("maplines-pose.dbc", True),
    "maplines-scene.dbc": ("maplines-scene.dbc", True),
}
#: Faults of the bus of a drive that is recorded.
FAULTS = "loss=0.05,dup=0.02,corrupt=0.02,reorder=0.01"


def of_tests(name: str) -> Any:
    """Return a helper module of the tests."""
    tests = str(Path(__file__).parents[2] / "tests")
    if tests not in sys.path:
        sys.path.insert(0, tests)
    return import_module(f"support.{name}")


@evidence
def lines(rounds: int = 20) -> dict[str, Any]:
    """Time the work of a sender and of a receiver of lines in C."""
    given, c_core = road(LINES, 0), of_tests("c_core")
    numbers = np.concatenate([given.mean, given.cov.reshape(-1, 16)], axis=1).astype("<f8")
    head = np.array([rounds], dtype="<u4").tobytes()
    program = c_core.harness("speed", Codec.from_dbc().layout)
    found = np.frombuffer(c_core.run(program, head + numbers.tobytes()), "<f8") / 1e3
    names = ("encode a line", "check and read a record", "four frames to a line", "sigma of y(x)")
    return {f"{name} [us]": us for name, us in zip(names, found.tolist(), strict=True)}


@evidence
def scenes(rounds: int = 20) -> dict[str, Any]:
    """Time scenes of a bend in C: to frames, and back to the joint covariance."""
    c_core, c_scenes = of_tests("c_core"), of_tests("c_scenes")
    found: dict[str, Any] = {}
    for count, (name, (dbc, fd)) in product((4, 8), SCENES.items()):
        scene = of_tests("scene_streams").road_scene([*Slot][:count])
        program = c_core.harness("scene_speed", default_dbc_path(dbc))
        given = struct.pack("<IB", rounds, fd) + c_scenes.scene_input(scene)
        encode, decode = np.frombuffer(c_core.run(program, given), "<f8").tolist()
        found[f"{count} lines, {name}"] = {"encode [us]": encode / 1e3, "decode [us]": decode / 1e3}
    return found


# ---- logs ------------------------------------------------------------------------------------


@evidence
def logs(log: str = "", peers: int = 300_000) -> dict[str, Any]:
    """Time the table of a log beside python-can with cantools, which read its first frames only.

    By default, the log is that of a simulated drive of an hour on a faulty bus.
    """
    if not log:
        with tempfile.TemporaryDirectory() as folder:
            path = f"{folder}/drive.log"
            command = [sys.executable, "-m", "maplines_can.cli", "drive", "--as-fast-as-possible"]
            command += ["--seconds", "3600", "--record", path, "--faults", FAULTS]
            subprocess.run(command, check=True, capture_output=True)
            return dict(logs(path, peers))
    found = {}
    for reader in (blocks, loop):
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            found[reader.__name__] = pool.submit(timed, reader, log, peers).result()
    return found | {"times loop": found["blocks"]["rate"] / found["loop"]["rate"]}


def timed(reader: Callable[[str, int], int], log: str, most: int) -> dict[str, float]:
    """Return frames per second of CPU, and the peak memory [MB]."""

    def used() -> Iterator[float]:
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN):
            usage = resource.getrusage(who)
            yield usage.ru_utime + usage.ru_stime

    before = sum(used())
    frames = reader(log, most)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"rate": frames / (sum(used()) - before), "memory [MB]": memory}


def blocks(log: str, _: int) -> int:
    """Make a table of the lines of a whole log."""
    receiver, frames = LogReceiver(Codec.from_dbc()), 0
    for block in read_blocks(log):
        line_table(receiver.feed(block), block, (0.0, 20.0, 40.0))
        frames += len(block)
    return frames


def loop(log: str, most: int) -> int:
    """Read by python-can, and decode the signals by cantools."""
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
    return frames
