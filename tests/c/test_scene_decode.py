"""Scenes in C, back to back with Python: the same numbers and refusals, bit for bit."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import c_core
import numpy as np
import pytest
from c_scenes import (
    Given,
    Wire,
    check_random_scenes,
    check_scenes,
    doubles,
    nearest,
    sent_scenes,
)
from random_dbc import LIMIT_SEED, random_dbc
from scene_streams import ALL, COMPLETE, CONDITIONAL, new_codec

from maplines_can import Slot
from maplines_can.values import fixed_order
from maplines_can.values.cubics import (
    _STEEPEST,
    Poses,
    fit_points,
    is_function,
    points_of,
    refitted,
)
from maplines_can.values.errors import IllPosedError
from maplines_can.values.linalg import block_diagonal, square_root
from maplines_can.values.line import lateral_jacobian
from maplines_can.values.seen_lines import (
    END_WEIGHT,
    NODES,
    POINTS,
    SeenLines,
    bases,
    valid_ranges,
)
from maplines_can.wire import POSE, Layout
from maplines_can.wire.covariance import specific_levels
from maplines_can.wire.covariance.specific_levels import SpecificLevels

SOURCES = Path(__file__).parents[2] / "c" / "src"


@pytest.fixture(scope="module", params=ALL)
def wire(request: Any) -> Wire:
    return Wire(new_codec(request.param))


def test_scenes_of_roads_are_the_same(wire: Wire) -> None:
    assert check_scenes(wire, [*sent_scenes(wire, 12, 1)])["refused"] == 0


def test_scenes_with_all_entries_are_the_same() -> None:
    wire = Wire(new_codec(CONDITIONAL))
    assert check_scenes(wire, [*sent_scenes(wire, 12, 2, full=True)])["refused"] == 0


def test_scenes_of_any_bits_are_the_same(wire: Wire) -> None:
    """And so are the refusals: of lines that are no function of x, and of empty ranges."""
    counts = check_random_scenes(wire.layout, 300, 3)
    assert counts["decoded"] > 50
    assert counts["refused"] > 50


def test_a_line_whose_direction_hardly_depends_on_the_heading() -> None:
    """One of this curvature is the same from all headings; the level of the map is the greatest."""
    wire, rng, scenes = Wire(new_codec(CONDITIONAL)), np.random.default_rng(8), []
    means = {"YOff": -10.0, "Beta": 0.0, "C0": 0.1, "C1": 0.0, "XMin": 0.0, "XMax": 8.0}
    for _ in range(20):
        pose = wire.random_raw(wire.pose, rng) | {"MapHeading": wire.pose["MapHeading"].raw_max}
        for name, sigma in (("Along", 0.3), ("Across", 0.2), ("Heading", 0.005)):
            pose[f"Pivot{name}"] = nearest(wire.pose[f"Pivot{name}"], np.log2(sigma))
        raw = wire.random_raw(wire.layout, rng) | {"HasCovariance": 0, "Kind": 1}
        raw |= {name: nearest(wire.layout[name], value) for name, value in means.items()}
        line = wire.packed(Slot.ROUTE, raw, wire.layout.messages[Slot.ROUTE].data_id)
        record = wire.packed(POSE, pose, wire.pose.messages.data_id)
        scenes.append(Given(0, record, [(Slot.ROUTE, 0, line)]))
    assert check_scenes(wire, scenes)["lines"] == 20


@pytest.mark.parametrize("seed", [*range(6), LIMIT_SEED, LIMIT_SEED + 1])
def test_scenes_of_random_dbcs_are_the_same(seed: int) -> None:
    """Whose orders of rows, factors, ranges and places differ."""
    layout = Layout.from_text(random_dbc(seed), "random.dbc")
    assert check_random_scenes(layout, 60, seed)["decoded"] > 0


# ---- single precision --------------------------------------------------------------------------

HEAD = np.dtype([("found", "u1"), ("count", "u1"), ("rest", "V12"), ("pose", "<f8", 13)])
LINE = np.dtype(
    [
        ("numbers", "u1", 4),
        ("t_ns", "<i8"),
        ("range_and_age", "<f8", 3),
        ("mean", "<f8", 4),
        ("factor", "<f8", (4, 4)),
        ("spread", "<f8", (4, 7)),
        ("specific", "<f8", (4, 4)),
        ("fit", "<f8", 3),
    ]
)


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_single_precision_covers(dbc: str) -> None:
    """The joint covariance, about the rounded means, exceeds that in double precision.

    But by little: standard deviations of lateral positions are at most 0.1 % larger.
    """
    wire = Wire(new_codec(dbc))
    scenes = [*sent_scenes(wire, 12, 7)]
    flags = (*c_core.FLAGS, "-DMAPLINES_FLOAT")
    data = b"".join(given.bytes_for(wire) for given in scenes)
    in_double = c_core.run(c_core.harness("scene", wire.layout), data)
    in_float = c_core.run(c_core.harness("scene", wire.layout, flags=flags), data)
    while in_double:
        count = np.frombuffer(in_double, HEAD, 1)["count"][0]
        size = HEAD.itemsize + int(count) * LINE.itemsize
        exact, rounded = (
            np.frombuffer(out[HEAD.itemsize : size], LINE) for out in (in_double, in_float)
        )
        in_double, in_float = in_double[size:], in_float[size:]
        if not count:
            continue
        A, A_float = (lines["spread"].reshape(-1, 7) for lines in (exact, rounded))
        e = (rounded["mean"] - exact["mean"]).ravel()
        whitening = block_diagonal(np.linalg.inv(exact["specific"]))
        A, A_float, e = whitening @ A, whitening @ A_float, whitening @ e
        F_float = whitening @ block_diagonal(rounded["specific"])
        lacking = A @ A.T + np.eye(len(A)) + np.outer(e, e) - A_float @ A_float.T
        assert np.linalg.eigvalsh(lacking - F_float @ F_float.T)[-1] <= 1e-9 * np.abs(A).max() ** 2
        for lines, other in zip(exact, rounded, strict=True):
            x_min, x_max, _ = lines["fit"]
            J = lateral_jacobian(lines["mean"], np.linspace(x_min, x_max, 5))
            before = J @ np.hstack([lines["spread"], lines["specific"]])
            after = J @ np.hstack([other["spread"], other["specific"]])
            growth = np.linalg.norm(after, axis=1) / np.linalg.norm(before, axis=1)
            assert growth.max() < 1.001
            own = np.linalg.norm(J @ other["factor"], axis=1) / np.linalg.norm(before, axis=1)
            assert (own >= 1 - 1e-9).all()
            assert own.max() < 1.001
    assert in_float == b""


# ---- functions of one line ---------------------------------------------------------------------

RNG = np.random.default_rng(5)


def random_curve(rng: Any) -> tuple[Any, Any, float]:
    """Mean, fit range and quartic of a line; some are nearly across the car, or far from it."""
    mean = rng.normal(0, 1, 4) * [4, 0.3, 5e-3, 5e-5] * 10.0 ** rng.uniform(-2, 0.7)
    low = rng.uniform(-40, 40)
    return mean, np.array([low, low + rng.uniform(0.5, 100)]), rng.normal(0, 0.1)


def random_pose_cov(rng: Any) -> Any:
    """Covariance of a pose error: regular, singular or huge."""
    root = rng.normal(0, 1, (3, 3)) * [[0.3], [0.2], [0.005]] * 10.0 ** rng.uniform(-3, 2)
    root[:, rng.integers(0, 4) :] = 0.0
    return fixed_order.product(root, root.T)


def test_functions_of_a_line_are_the_same() -> None:
    cases, expected = b"", []
    for i in range(600):
        mean, fit_range, quartic = random_curve(RNG)
        P, pose = random_pose_cov(RNG), RNG.normal(0, 1, 3) * [2, 2, 0.3]
        match i % 6:  # so far away that no pose is near enough, or the last bits decide
            case 0:
                mean[0] *= 10.0 ** RNG.uniform(18, 45)
            case 1:
                size = 10.0 ** RNG.uniform(20, 80)
                P, pose = P * size, pose * size
            case 2:
                P = P * 0.0
        root = RNG.normal(0, 1, (4, 4)) * [[0.1], [1e-3], [1e-5], [1e-7]]
        cov, heading_sigma = fixed_order.product(root, root.T), abs(RNG.normal(0, 0.01))
        cov, heading_sigma = cov * (i % 4 > 0), heading_sigma * (i % 3 > 0)
        cases += b"\1" + doubles(mean, fit_range, quartic, P, pose, cov, heading_sigma)
        expected.append(of_a_line(mean, fit_range, quartic, P, pose, cov, heading_sigma))
    out = c_core.run(c_core.harness("scene", new_codec(CONDITIONAL).layout), cases)
    for i, one in enumerate(expected):
        for j, part in enumerate(one):
            assert out[: len(part)] == part, (i, j, np.frombuffer(part[len(part) % 8 :]))
            out = out[len(part) :]
    assert out == b""


def of_a_line(
    mean: Any, fit_range: Any, quartic: float, P: Any, pose: Any, cov: Any, heading_sigma: float
) -> list[bytes]:
    """Output of the harness for a line."""
    fit = fit_points(POINTS, END_WEIGHT)
    window = (np.array(fit_range[0]), np.array(fit_range[1]))
    points = points_of(mean, window, np.array(quartic), fit, 0)
    with np.errstate(invalid="ignore", over="ignore"):
        moved = refitted(*points, Poses.of(pose), fit.weights)
    out = [bytes([bool(is_function(*points))]), doubles(moved)]
    root = np.sqrt(3) * square_root(P).T
    sigma_points = np.vstack([np.zeros(3), root, -root])
    J = bases(mean[None], fit_range[None])
    ends = valid_ranges(mean[None], fit_range[None], P, cov[None], heading_sigma)
    out += [doubles(J), doubles(sigma_points), doubles(ends)]
    try:
        seen = SeenLines(mean[None], fit_range[None], np.array([quartic]))
    except IllPosedError:
        return out + [b"\0"] * 3
    for values in (
        lambda: seen(pose[None])[0, 0],
        lambda: seen.jacobian()[0],
        lambda: seen.spread_factor(P),
    ):
        try:
            out += [b"\1" + doubles(values())]
        except IllPosedError:
            out += [b"\0"]
    return out


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_levels_are_the_same(dbc: str) -> None:
    """For every raw value of the shape, and some of the others."""
    code = Wire(new_codec(dbc)).code
    levels: SpecificLevels = code.levels
    cases, expected = b"", b""
    for shape in range(levels.shape.raw_max + 1):
        mean, fit_range, _ = random_curve(RNG)
        lateral, points = (
            int(RNG.integers(0, s.raw_max + 1)) * int(RNG.integers(0, 2))
            for s in (levels.lateral, levels.points)
        )
        cases += b"\2" + doubles(mean, fit_range) + struct.pack("<3q", lateral, points, shape)
        names = (s.name for s in levels.signals)
        raw = {n: np.array([v]) for n, v in zip(names, (lateral, points, shape), strict=True)}
        expected += doubles(levels.decode(raw, mean[None], fit_range[None]))
    assert c_core.run(c_core.harness("scene", new_codec(dbc).layout), cases) == expected


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_square_roots_are_the_same(n: int) -> None:
    """Of regular and of singular matrices, with and without zero rows."""
    cases, expected = b"", b""
    for _ in range(200):
        root = RNG.normal(0, 1, (n, n)) * 10.0 ** RNG.uniform(-3, 3, (n, 1))
        root[:, RNG.integers(0, n + 1) :] = 0.0
        root[RNG.integers(0, 2 * n, 1) % (2 * n) == np.arange(n)] = 0.0
        S = fixed_order.product(root, root.T)
        cases += b"\3" + bytes([n]) + doubles(S)
        expected += doubles(square_root(S))
    out = c_core.run(c_core.harness("scene", new_codec(CONDITIONAL).layout), cases)
    got, wanted = np.frombuffer(out), np.frombuffer(expected)
    assert np.array_equal(got, wanted)


# ---- constants ---------------------------------------------------------------------------------


def test_the_constants_are_those_of_python() -> None:
    text = (SOURCES / "cubics.c").read_text() + (SOURCES / "levels.c").read_text()

    def table(name: str) -> list[float]:
        found = re.search(rf"\b{name}\[[^=]*= \{{(.*?)\}};", text, re.DOTALL)
        assert found is not None, name
        return [*map(float.fromhex, found[1].replace("\n", " ").strip(" ,").split(","))]

    fit = fit_points(POINTS, END_WEIGHT)
    assert table("cubic_nodes") == fit.nodes.tolist()
    assert table("cubic_quartic") == fit.quartic.tolist()
    assert table("nodes") == NODES.tolist()
    assert table("fit_matrix") == specific_levels._FIT.ravel().tolist()
    assert table("ratios") == specific_levels.RATIOS.tolist()
    for name, value in (
        ("MAPLINES_STEEPEST", _STEEPEST),
        ("MAPLINES_GOLDEN_RATIO", specific_levels.GOLDEN_RATIO),
        ("MAPLINES_HALF_PI", np.pi / 2),
    ):
        found = re.search(rf"#define {name} +(\S+)", text)
        assert found is not None, name
        assert float.fromhex(found[1]) == value
