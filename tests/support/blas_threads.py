"""Calls that wake threads of BLAS: a program that prints the names of those that do, as JSON.

OpenBLAS hands a product to sleeping threads if it takes it for large, and then waits for them. A
thread that has slept all the while has done nothing: its state is still that of sleeping, and the
kernel has not switched to it. That needs no clock.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from cycle_calls import calls
from scipy.linalg.blas import dgemm

#: Calls of which the first ones fill caches, such as the gains of a speed.
REPEATS = 2
#: Threads that work for longer without a job do not sleep at all [s].
MAX_SPIN = 60.0


class Thread(NamedTuple):
    """What the kernel says of a thread."""

    state: str  #: "S" if it sleeps
    switches: tuple[str, str]  #: to it, voluntary or not


def others() -> dict[str, Thread]:
    """Return the other threads of this process by their number."""
    found = {}
    for task in Path("/proc/self/task").iterdir():
        if task.name != str(os.getpid()):
            status = dict(line.split(":", 1) for line in (task / "status").read_text().splitlines())
            switches = status["voluntary_ctxt_switches"], status["nonvoluntary_ctxt_switches"]
            found[task.name] = Thread(status["State"].split()[0], switches)
    return found


def asleep() -> dict[str, Thread]:
    """Return ``others`` when all of them sleep; after their last work they spin for a while."""
    end = time.monotonic() + MAX_SPIN
    while time.monotonic() < end:
        found = others()
        if all(thread.state == "S" for thread in found.values()):
            return found
        time.sleep(1e-3)
    raise RuntimeError(f"threads have not slept for {MAX_SPIN:g} s: {found}")


def wakes(call: Callable[[], Any]) -> bool:
    """Return whether another thread does anything during a call."""
    before = asleep()
    call()
    return others() != before


if __name__ == "__main__":
    large = np.ones((1000, 1000))
    controls = {"NumPy": lambda: large @ large.T.copy(), "SciPy": lambda: dgemm(1.0, large, large)}
    found = {
        "controls": [name for name, call in controls.items() if wakes(call)],
        "cycle": [name for name, call in calls().items() for _ in range(REPEATS) if wakes(call)],
    }
    print(json.dumps(found))
