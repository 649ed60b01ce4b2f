"""The example nodes build by CMake and pkg-config, and talk with those of Python on SocketCAN.

Run the latter with ``tools/vcan python3 tools/run.py pytest -m socketcan tests/c``.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import c_nodes
import pytest
from support.kernel_can import has_vcan

from maplines_can.cli import main

EXAMPLES = Path(__file__).parents[2] / "c" / "examples"
SOURCES = sorted(EXAMPLES.glob("*.c"))
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Wshadow", "-Werror"]
DBCS = ("maplines.dbc", "maplines-pose.dbc", "maplines-secoc.dbc", "maplines-scene.dbc")

needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="SocketCAN is of Linux")


@needs_linux
@pytest.mark.parametrize("cc", ["gcc", "clang"])
@pytest.mark.parametrize("dbc", DBCS)
def test_examples_compile_without_a_warning(tmp_path: Any, cc: Any, dbc: Any) -> None:
    """With the tables of each DBC."""
    if shutil.which(cc) is None:
        pytest.skip(f"no {cc}")
    assert main(["generate", "c", "--dbc", dbc, "--name", "maplines", "--out", str(tmp_path)]) == 0
    for source in SOURCES:
        command = [cc, *WARNINGS, f"-I{tmp_path}", "-c", str(source), "-o", os.devnull]
        subprocess.run(command, check=True)


@pytest.mark.socketcan
@pytest.mark.skipif(not has_vcan(), reason="no vcan0 here: run inside tools/vcan")
@pytest.mark.parametrize(
    ("sender", "dbc", "scenes", "fd"),
    [
        ("c", DBCS[0], False, False),
        ("c", DBCS[0], True, True),
        ("c", DBCS[1], True, False),
        ("python", DBCS[0], True, False),
        ("python", DBCS[1], True, False),
        ("c", DBCS[3], True, True),
        ("python", DBCS[3], True, True),
    ],
)
def test_nodes_of_c_and_python_receive_the_same(
    tmp_path: Any, sender: Any, dbc: Any, scenes: Any, fd: Any
) -> None:
    """Both receivers get the same numbers of all lines and scenes; Ctrl-C ends a node cleanly.

    A busy machine may suspend a sender within a line for so long that both drop that line.
    """
    c_nodes.build(tmp_path, dbc)
    found = c_nodes.talk(tmp_path, sender, dbc, seconds=1.5, rate=10.0, scenes=scenes, fd=fd)
    assert found["equal"], found
    assert found["lines received by C"] > 0
    assert found["of these, equal to that of C"] == found["scenes received by Python"]
    assert bool(found["scenes received by C"]) == scenes
