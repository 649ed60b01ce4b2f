"""The receiver of whole scenes by hand gives the values of the test vectors.

It has no part of this project in it: the signals are those that cantools makes of the DBC.
"""

import ctypes
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can.wire import Layout, default_dbc_path
from maplines_can.wire.layout.packing import Packing

C = Path(__file__).parents[2] / "c"
DBC = default_dbc_path("maplines-scene.dbc")
MAP_HEADING = Layout.from_dbc(DBC).record_of("scene")["MapHeading"]
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")


class Line(ctypes.Structure):
    """``line_t`` of the program."""

    _fields_ = (
        ("kind", ctypes.c_int),
        ("mean", ctypes.c_double * 4),
        ("range", ctypes.c_double * 2),
        ("levels", ctypes.c_double * 4),
        ("shape", ctypes.c_int),
        ("A", ctypes.c_double * 7 * 4),
        ("D", ctypes.c_double * 4 * 4),
    )


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory: Any) -> Any:
    """The program as a library."""
    folder = tmp_path_factory.mktemp("by_hand")
    generate = [sys.executable, "-m", "cantools", "generate_c_source", str(DBC)]
    subprocess.run(generate, check=True, cwd=folder, stdout=subprocess.DEVNULL)
    own = C / "examples" / "by_hand" / "whole_scene.c"
    subprocess.run(["cc", *WARNINGS, f"-I{folder}", "-c", own, "-o", os.devnull], check=True)
    sources = [own, folder / "maplines_scene.c"]
    made = folder / "by_hand.so"
    shared = ["cc", "-O2", "-shared", "-fPIC", f"-I{folder}", *sources, "-lm", "-o", made]
    subprocess.run(shared, check=True)
    library = ctypes.CDLL(str(made))
    library.sigma_of.restype = ctypes.c_double
    library.sigma_of.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double]
    library.is_intact.restype = ctypes.c_bool
    return library


def frames() -> Iterator[tuple[bytes, dict[str, Any], dict[str, Any]]]:
    """The frames Scene of the vectors with their step, and that of the scene behind it."""
    own = Layout.from_dbc(DBC).messages_of["scene"]
    vectors = json.loads((C / "tests" / "vectors" / "maplines_scene.json").read_text())
    for case in vectors["cases"]:
        for step, after in zip(case["steps"], [*case["steps"][1:], {}], strict=True):
            is_scene = step["step"] == "frame" and step["can_id"] == own.fd_can_id
            if is_scene and step["is_extended"] == own.fd_is_extended:
                yield bytes.fromhex(step["data"]), step, after


def map_heading(data: bytes) -> int:
    """The raw value of MapHeading in a record."""
    packing = Packing([MAP_HEADING], len(data))
    return int(packing.unpack(np.frombuffer(data, np.uint8)[None])["MapHeading"][0])


def symmetric(upper: Any) -> Any:
    """The matrix of its upper triangle by rows."""
    n = round((2 * len(upper["decimal"]) + 0.25) ** 0.5 - 0.5)
    cov = np.zeros((n, n))
    cov[np.triu_indices(n)] = upper["decimal"]
    return cov + np.triu(cov, 1).T


def difference(some: Any, others: Any) -> float:
    """The greatest difference of two covariances, in standard deviations."""
    sigma = np.sqrt(others.diagonal())
    return float(np.abs((some - others) / np.outer(sigma, sigma)).max())


def test_records_are_intact_as_in_the_vectors(by_hand: Any) -> None:
    """By the checksum, which each reason but CRC and LENGTH leaves right."""
    data_id = Layout.from_dbc(DBC).messages_of["scene"].data_id
    for data, step, _ in frames():
        is_intact = len(data) == 64 and by_hand.is_intact(data, len(data), data_id)
        assert is_intact == (step.get("reason") not in ("CRC", "LENGTH"))


def test_lines_are_those_of_the_vectors(by_hand: Any) -> None:
    """Mean, valid range, covariance and sigma; and the joint covariance of all lines."""
    joints = count = 0
    for data, step, after in frames():
        if "lines" not in step:
            continue
        lines = (Line * 4)()
        by_hand.read_scene(data, lines)
        found = [line for line in lines if line.kind < 8]
        roots = [np.array(line.A) for line in found]
        own = [np.array(line.D) for line in found]
        assert len(found) == len(step["lines"])
        for line, A, D, expected in zip(found, roots, own, step["lines"], strict=True):
            count += 1
            low, high = line.range
            assert [*line.mean] == expected["mean"]["decimal"]
            assert difference(A @ A.T + D, symmetric(expected["cov"])) < 1e-5
            if low <= high:  # the greatest MapHeading says that it may be more
                near = 0.11 if map_heading(data) == MAP_HEADING.raw_max else 1e-9
                assert [low, high] == pytest.approx(expected["range"]["decimal"], abs=near)
            x = (low + high) / 2
            J = np.array([1, (1 + np.tan(line.mean[1]) ** 2) * x, x**2 / 2, x**3 / 6])
            variance = J @ (A @ A.T + D) @ J
            assert by_hand.sigma_of(ctypes.byref(line), None, x) ** 2 == pytest.approx(variance)
        if after.get("step") == "scene" and len(after["slots"]) == len(found) > 1:
            order = np.argsort([after["slots"].index(line["slot"]) for line in step["lines"]])
            A = np.vstack([roots[i] for i in order])
            joint = A @ A.T
            for place, i in enumerate(order):
                joint[4 * place : 4 * place + 4, 4 * place : 4 * place + 4] += own[i]
            assert difference(joint, symmetric(after["joint"])) < 1e-5
            joints += 1
    assert count > 70
    assert joints > 10
