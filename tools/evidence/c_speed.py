"""Time of the C core, as ratios to the Python package and to cantools' generated C.

One thread, -O2. Lines are timed inside a program in C; scenes by the CPU time of a program that
gets many of them, less that with few. Python does the same work on the same inputs.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np

from maplines_can import Codec, Gaussian, MapLine, Polyline, Scene, Slot, map_scene
from maplines_can.study.sets import road
from maplines_can.values.line import Status
from maplines_can.wire import POSE, default_dbc_path

from .c_core import tests
from .harness import evidence

LINES = 256  #: of c/tests/speed_harness.c
#: Lateral positions of eight parallel lines [m].
EIGHT = (1.75, -1.75, 5.25, -5.25, 0.0, 8.75, -8.75, 0.4)
#: Times the four pages of a record with random values: cantools packs no faster with others.
PEER = """
#include "peer.h"
#include <stdio.h>
#include <string.h>
#include <time.h>
int main(void)
{
    struct peer_ego_left_t line;
    uint8_t data[8];
    unsigned sum = 0;
    memset(&line, 0x35, sizeof line);
    double least = 1e300;
    for (int round = 0; round < 20; ++round)
    {
        clock_t begin = clock();
        for (int i = 0; i < 100000; ++i)
        {
            for (uint8_t page = 0; page < 4; ++page)
            {
                line.page = page;
                line.counter = (uint8_t)i;
                peer_ego_left_pack(data, &line, sizeof data);
                sum += data[2];
            }
        }
        double ns = 1e9 * (double)(clock() - begin) / CLOCKS_PER_SEC / 100000;
        least = ns < least ? ns : least;
    }
    printf("%g %u", least, sum);
    return 0;
}
"""


@evidence(rounds=2)
def c_speed(rounds: int = 20) -> dict[str, Any]:
    """Time the work of a sender and of a receiver in C and in Python."""
    codec = Codec.from_dbc()
    gaussians = road(LINES, 0)
    in_c = _lines_in_c(gaussians.mean, gaussians.cov, rounds)
    in_python = _lines_in_python(codec, gaussians.mean, gaussians.cov, rounds)
    rows = {
        name: {
            "C [us]": in_c[name] / 1e3,
            "Python [us]": python,
            "ratio": 1e3 * python / in_c[name],
        }
        for name, python in in_python.items()
    }
    packing = _packing_by_cantools()
    rows["encode a line over packing it by cantools' C"] = {
        "C [us]": in_c["encode a line"] / 1e3,
        "cantools' C [us]": packing / 1e3,
        "ratio": packing / in_c["encode a line"],
    }
    for dbc in ("maplines.dbc", "maplines-pose.dbc"):
        rows |= _scenes(dbc, rounds)
    return rows


def _lines_in_c(means: Any, covs: Any, rounds: int) -> dict[str, float]:
    """Return times of one line in C [ns]."""
    core = tests("c_core")
    head = np.array([rounds], dtype="<u4").tobytes()
    given = np.concatenate([means, covs.reshape(-1, 16)], axis=1).astype("<f8").tobytes()
    found = np.frombuffer(core.run(core.harness("speed"), head + given), "<f8")
    names = ("encode a line", "check and read a record", "four frames to a line", "sigma of y(x)")
    return dict(zip(names, found.tolist(), strict=True))


def _lines_in_python(codec: Codec, means: Any, covs: Any, rounds: int) -> dict[str, float]:
    """Return times of one line in Python [us]."""
    lines = [
        MapLine(Slot.EGO_LEFT, Gaussian(mean, cov), status=Status.FULL)
        for mean, cov in zip(means, covs, strict=True)
    ]
    encoder = codec.encoder()
    frames = [encoder.encode(line) for line in lines]
    records = [b"".join(frame.data for frame in of_line) for of_line in frames]

    def feed() -> None:
        decoder = codec.decoder()
        for k, of_line in enumerate(frames):
            for frame in of_line:
                decoder.feed(frame.can_id, frame.data, 50_000_000 * k)

    def read() -> None:
        for record in records:
            codec.reader.read(record, Slot.EGO_LEFT)

    work: dict[str, Callable[[], Any]] = {
        "encode a line": lambda: [encoder.encode(line) for line in lines],
        "check and read a record": read,
        "four frames to a line": feed,
        "sigma of y(x)": lambda: [line.y_sigma(40.0) for line in lines],
    }
    return {name: _least_us(one, rounds) / LINES for name, one in work.items()}


def _least_us(work: Callable[[], Any], rounds: int) -> float:
    """Return the least CPU time of some rounds [us]."""
    times = []
    for _ in range(max(2, rounds // 4)):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return 1e6 * min(times)


def _packing_by_cantools() -> float:
    """Return the time of packing the pages of a line by cantools' generated C [ns]."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "cantools", "generate_c_source", "--database-name", "peer",
                   str(default_dbc_path())]  # fmt: skip
        subprocess.run(command, check=True, cwd=folder, capture_output=True)
        Path(folder, "main.c").write_text(PEER)
        subprocess.run(["cc", "-O2", "main.c", "peer.c", "-o", "peer"], check=True, cwd=folder)
        done = subprocess.run([f"{folder}/peer"], check=True, capture_output=True, text=True)
    return float(done.stdout.split()[0])


def _scenes(dbc: str, rounds: int) -> dict[str, Any]:
    """Return the times of encoding and decoding scenes of eight lines in a bend."""
    codec = Codec.from_dbc(default_dbc_path(dbc))
    of_encode, of_decode, core = tests("test_scene_encode"), tests("c_scenes"), tests("c_core")
    scenes = [eight_lines(0.002 * k) for k in range(4)]
    counters = dict.fromkeys([POSE, *Slot], 0)
    cases = [of_encode.Case(scene, counters, 0.0, is_fd=False) for scene in scenes]
    encode = core.harness("scene_encode", codec.layout)
    encoded = [codec.encoder().encode_scene(scene) for scene in scenes]
    given = [_records(of_decode, one) for one in encoded]
    decode, wire = core.harness("scene", codec.layout), of_decode.Wire(codec)
    encode_us = _program_us(encode, [of_encode.input_of(case) for case in cases], rounds)
    decode_us = _program_us(decode, [one.bytes_for(wire) for one in given], rounds)

    def receive() -> None:
        for frames in encoded:
            decoder = codec.decoder()
            for of_owner in frames.values():
                for frame in of_owner:
                    decoder.feed(frame.can_id, frame.data, 0)
            decoder.latest_scene(0)

    rows = {
        f"encode 8 lines, {dbc}": (
            encode_us,
            _least_us(lambda: [codec.encoder().encode_scene(s) for s in scenes], rounds) / 4,
        ),
        f"decode 8 lines, {dbc}": (decode_us, _least_us(receive, rounds) / 4),
    }
    return {
        name: {"C [us]": c, "Python [us]": python, "ratio": python / c}
        for name, (c, python) in rows.items()
    }


def eight_lines(curvature: float) -> Scene:
    """Return a scene of eight parallel lines of a bend."""
    x = np.linspace(-60.0, 160.0, 200)
    lines = {
        slot: Polyline(np.column_stack([x, y + curvature / 2 * x**2 / (1 + abs(curvature) * 60)]))
        for slot, y in zip(Slot, EIGHT, strict=True)
    }
    return map_scene(lines, Gaussian([0, 0, 0], np.diag([0.3, 0.2, 0.005]) ** 2))


def _records(of_decode: Any, encoded: Any) -> Any:
    """Return the records of a scene as the comparison of decoded scenes takes them."""
    whole = {owner: b"".join(frame.data for frame in frames) for owner, frames in encoded.items()}
    pose = whole.pop("pose")
    return of_decode.Given(0, pose, [(slot, 0, record) for slot, record in whole.items()])


def _program_us(program: Path, inputs: list[bytes], rounds: int) -> float:
    """Return the CPU time of a program for one input [us]."""

    def spent(n: int) -> float:
        data = b"".join(islice(cycle(inputs), n))
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        subprocess.run([str(program)], input=data, stdout=subprocess.DEVNULL, check=True)
        return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before

    few, many = 4, 4 + 20 * rounds
    return 1e6 * min((spent(many) - spent(few)) / (many - few) for _ in range(3))
