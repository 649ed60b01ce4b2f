"""Time of the C core, and of packing alone by cantools' generated C.

One thread, -O2. Both are timed inside a program in C, without starts and pipes.
"""

from __future__ import annotations

import struct
import subprocess
import sys
import tempfile
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from maplines_can import Codec, Scene, Slot
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
    """Time the work of a sender and of a receiver of lines in C, and packing by cantools' C."""
    gaussians = road(LINES, 0)
    found = _lines(gaussians.mean, gaussians.cov, rounds)
    packing = _packing_by_cantools()
    return {name: {"C [us]": ns / 1e3, "ratio to packing": ns / packing}
            for name, ns in found.items()}  # fmt: skip


@evidence(rounds=2)
def scenes(rounds: int = 20) -> dict[str, Any]:
    """Time scenes in C: to frames, and back to the joint covariance.

    Lines of a bend on a map with an error of 5 cm, as records of lines and as whole scenes.
    """
    found: dict[str, Any] = {}
    for count, (name, (dbc, fd)) in product((4, 8), SCENES.items()):
        scene = _of_tests("scene_streams").road_scene([*Slot][:count])
        encode, decode = _scenes(scene, dbc, fd, rounds)
        found[f"{count} lines, {name}"] = {"encode [us]": encode / 1e3, "decode [us]": decode / 1e3}
    return found


def _scenes(scene: Scene, dbc: str, fd: bool, rounds: int) -> list[float]:
    """Return times of encoding and of decoding a scene [ns]."""
    c_core = _of_tests("c_core")
    program = c_core.harness("scene_speed", default_dbc_path(dbc))
    head = struct.pack("<IB", rounds, fd)
    out = c_core.run(program, head + c_core.scene_input(scene))
    return list(np.frombuffer(out, "<f8").tolist())


def _of_tests(name: str) -> Any:
    """Return a module of `tests/support`."""
    tests = str(Path(__file__).parents[2] / "tests")
    if tests not in sys.path:
        sys.path.insert(0, tests)
    return import_module(f"support.{name}")


def _lines(means: Any, covs: Any, rounds: int) -> dict[str, float]:
    """Return times of one line [ns]."""
    c_core = _of_tests("c_core")
    head = np.array([rounds], dtype="<u4").tobytes()
    given = np.concatenate([means, covs.reshape(-1, 16)], axis=1).astype("<f8").tobytes()
    program = c_core.harness("speed", Codec.from_dbc().layout)
    found = np.frombuffer(c_core.run(program, head + given), "<f8")
    names = ("encode a line", "check and read a record", "four frames to a line", "sigma of y(x)")
    return dict(zip(names, found.tolist(), strict=True))


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
