"""Fixtures of several test files."""

# ruff: noqa: E402
import os

# Before NumPy is loaded: one thread for the small matrices of each test process. On a busy machine,
# threads wait for each other for longer than they compute.
for library in ("OPENBLAS", "MKL", "OMP"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import tempfile
import time
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import settings
from support.dbcs import default_codec
from support.fmu_nodes import library_once

from maplines_can import Link

# Not the cache of the user: each test process, and the commands that it starts, have their own.
_CACHE = tempfile.TemporaryDirectory()
for variable in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
    os.environ[variable] = _CACHE.name

# No test depends on how busy the machine is, and a commit has one verdict. More and new examples:
# pytest --hypothesis-profile random
settings.register_profile("fixed", deadline=None, derandomize=True, max_examples=30)
settings.register_profile("random", deadline=None, max_examples=300)
settings.load_profile("fixed")


@pytest.fixture(autouse=True, scope="session")
def fmus_compiled_once() -> Iterator[None]:
    """Nodes of FMUs are compiled once for each content."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("maplines_can.generation.fmu.compilers.library", library_once)
        yield


@pytest.fixture
def codec() -> Any:
    return default_codec()


@pytest.fixture
def links() -> Iterator[Any]:
    """Yield two links of one virtual channel."""
    channel = f"e2e-{time.monotonic_ns()}"
    with (
        Link(interface="virtual", channel=channel) as one,
        Link(interface="virtual", channel=channel) as other,
    ):
        yield one, other
