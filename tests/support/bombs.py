"""Files that would fill the memory, and a process with little memory that reads files."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import pytest

MB = 1 << 20
#: What a file has when it is unpacked; more than the memory of the process.
SIZE = 900
#: Most memory of a process that reads any file [MB].
MOST = 300
#: Address space of the process [MB]; what is imported takes most of it.
ADDRESSES = 3000

_CHILD = """
import json, resource, sys
limit = int(sys.argv[1]) << 20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
for path in sys.argv[2:]:
    count, text = 0, ""
    try:
        for _ in read(path):
            count += 1
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
    status = open("/proc/self/status").read()  # ru_maxrss has that of the parent, too
    peak = int(status.partition("VmHWM:")[2].split()[0]) / 1024
    print(json.dumps([path, count, text, peak]), flush=True)
"""


class Outcome(NamedTuple):
    """What became of a file."""

    records: int  #: that were read
    text: str  #: type and message of the error; empty if there is none
    peak: float  #: memory of the process so far [MB]


def read_in_little_memory(read: str, paths: Iterable[Path]) -> dict[str, Outcome]:
    """Read files one after the other in a process of its own, and return the outcomes by name.

    Args:
        read: code that defines ``read(path)``, which returns an iterable.
        paths: of the files.
    """
    if not Path("/proc/self/status").exists():
        pytest.skip("the memory of a process is read from /proc")
    command = [sys.executable, "-c", read + _CHILD, str(ADDRESSES), *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(row) for row in done.stdout.splitlines()]
    return {Path(path).name: Outcome(*rest) for path, *rest in rows}


def gzipped(head: bytes, unit: bytes, size: int = SIZE) -> bytes:
    """Return the head and then ``size`` MB of a repeated unit, compressed; in no time."""
    times = MB // len(unit)
    return gzip.compress(head) + gzip.compress(unit * times) * size


def deflated(size: int = SIZE) -> bytes:
    """Return ``size`` MB of zeros as a stream of zlib without its end; in no time."""
    packer = zlib.compressobj(9)
    first, again = (packer.compress(bytes(MB)) + packer.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
    return first + again * (size - 1)
