"""What is computed with lines in C: as in Python, in single precision never overconfident."""

import math
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support import c_core

from maplines_can import (
    Gaussian,
    GaussianMixture,
    IllPosedError,
    MapLine,
    Motion,
    PoseError,
    Scene,
    Slot,
    Status,
    predict_to,
)
from maplines_can.model.lines import y_beyond
from maplines_can.model.matrices import Matrix, Vector, matrix
from maplines_can.values.line import lateral_jacobian

FLOAT = pytest.param(("-O2", "-DMAPLINES_FLOAT"), id="float")
DOUBLE = pytest.param(("-O2",), id="double")
#: Standard deviations of usual size [m, rad, 1/m, 1/m^2].
USUAL = np.array([0.2, 0.01, 5e-4, 1e-5])
T_NS = 5_000_000_000
X = np.array([0.0, 20.0, 40.0, 80.0, -15.0])


class Reader:
    """Reader of what the harness writes."""

    def __init__(self, data: bytes) -> None:
        self._data, self._place = data, 0

    def byte(self) -> int:
        self._place += 1
        return self._data[self._place - 1]

    def floats(self, *shape: int) -> np.ndarray:
        n = math.prod(shape)
        values = np.frombuffer(self._data, "<f8", n, self._place).reshape(shape)
        self._place += 8 * n
        return values

    def time(self) -> int:
        self._place += 8
        return struct.unpack_from("<q", self._data, self._place - 8)[0]

    def line(self) -> dict[str, Any]:
        components, t_ns = self.byte(), self.time()
        age, x_min, x_max = self.floats(3)
        mean, factor = self.floats(4), self.floats(4, 4)
        return {
            "components": components, "t_ns": t_ns, "age": age, "x": (x_min, x_max),
            "mean": mean, "factor": factor,
        }  # fmt: skip

    def ends(self) -> bool:
        return self._place == len(self._data)


def ran(data: bytes, flags: tuple[str, ...]) -> Reader:
    return Reader(c_core.run(c_core.harness("use", flags=flags), data))


def packed(*values: object) -> bytes:
    return b"".join(np.asarray(value, dtype="<f8").tobytes() for value in values)


def packed_line(line: MapLine, factor: np.ndarray) -> bytes:
    head = bytes([line.slot, line.status, 1]) + struct.pack("<q", line.t_ns or 0)
    return head + packed(line.age, line.x_min, line.x_max, line.gaussian.mean, factor)


def random_factor(rng: np.random.Generator, n: int = 4) -> np.ndarray:
    """A lower triangular root in a random order of the rows, with correlations of any size."""
    rows = np.eye(n) + np.tril(rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-2, 2), -1)
    rows *= 10.0 ** rng.uniform(-1, 1, size=(n, 1))
    return rows[rng.permutation(n)]


def random_line(rng: np.random.Generator, slot: int = 0) -> tuple[MapLine, np.ndarray]:
    factor = random_factor(rng)
    factor *= (USUAL * 10.0 ** rng.uniform(-1, 1) / np.linalg.norm(factor, axis=1))[:, None]
    mean = rng.normal(size=4) * [3.0, 0.1, 2e-3, 1e-5]
    factor, mean = single(factor), single(mean)  # so that both builds read the same
    x_min = float(rng.integers(-40, 20))
    line = MapLine(
        Slot(slot), Gaussian.trusted(mean, factor @ factor.T), x_min=x_min,
        x_max=x_min + float(rng.integers(0, 100)), age=rng.integers(30) * 8e-3, t_ns=T_NS,
    )  # fmt: skip
    return line, factor


def single(values: np.ndarray) -> np.ndarray:
    """The values rounded to single precision."""
    return values.astype(np.float32).astype(float)


def check_root(F: np.ndarray, expected: Gaussian, flags: tuple[str, ...], tolerance: float) -> None:
    """A square root is that of a covariance; in single precision, of one that just covers it."""
    cov, sigma = expected.cov, expected.sigma
    scale = np.outer(sigma, sigma)
    if flags == DOUBLE.values[0]:
        assert (np.abs(F @ F.T - cov) <= tolerance * scale).all()
        return
    T = np.linalg.cholesky(cov / scale)
    inverse = np.linalg.inv(T)
    values = np.linalg.svd(inverse @ (F / sigma[:, None]))[1]
    rounding = tolerance * np.linalg.norm(inverse) ** 2  # of the covariance in double precision
    # By the rounding of the factor and of the mean, amplified by the correlations.
    K = np.linalg.norm(np.abs(inverse) @ np.abs(T))
    q = np.linalg.norm(np.abs(inverse) @ np.abs(expected.mean / sigma))
    assert values[-1] >= 1 - rounding
    if 2.0**-24 * K < 0.2:
        assert values[0] <= 1 + rounding + 2.0**-24 * (3 * K + q)


def places_of(line: MapLine) -> np.ndarray:
    """Places in and about the range of a line: its ends, those of differences over 10 m, beyond."""
    low, high = line.x_min, line.x_max
    near = (low, high, low + 5, high - 5, low - 0.0005, high + 0.0005, low - 3, high + 28)
    return np.array([*X, *near, math.nan])


def exact_sigma(mean: np.ndarray, factor: np.ndarray, x: np.ndarray, weights: np.ndarray) -> float:
    """Standard deviation of a weighted sum in extended precision."""
    J = (weights[:, None] * lateral_jacobian(mean, x)).astype(np.longdouble).sum(axis=0)
    return float(np.sqrt(((factor.astype(np.longdouble).T @ J) ** 2).sum()))


def rounding(n: int, flags: tuple[str, ...]) -> float:
    """What the C code adds for n terms, relative to the size of the terms."""
    return (16 + 8 * n) * (2.0**-24 if "-DMAPLINES_FLOAT" in flags else 2.0**-53)


@pytest.mark.parametrize("flags", [DOUBLE, FLOAT])
def test_quantities_of_a_line(flags: Any) -> None:
    """Values are Python's; a sigma is not less than the exact one, and more by rounding only.

    Both are NaN if a place of the difference is outside of the range.
    """
    rng = np.random.default_rng(1)
    lines = [random_line(rng) for _ in range(30)]
    data = b"".join(
        b"\0" + packed_line(line, F) + bytes([len(places_of(line))]) + packed(places_of(line))
        for line, F in lines
    )
    out = ran(data, flags)
    tolerance = 1e-12 if flags == DOUBLE.values[0] else 3e-6
    sums = [(np.array([0.0]), np.array([1.0])), (np.array([-5.0, 5.0]), np.array([-0.1, 0.1]))]
    sums.append((np.array([-5.0, 0.0, 5.0]), np.array([0.04, -0.08, 0.04])))
    for line, F in lines:
        mean = line.gaussian.mean
        for x in places_of(line):
            y, y_sigma, *rest = out.floats(6)
            check_extrapolated(line, x, (y, y_sigma), out.floats(2), tolerance)
            assert out.byte() == line.is_valid_at(x)
            for (value, sigma), (steps, weights) in zip(
                [(y, y_sigma), rest[:2], rest[2:]], sums, strict=True
            ):
                at = x + steps
                if not line.is_valid_at(at).all():
                    assert math.isnan(value)
                    assert math.isnan(sigma)
                    continue
                J = np.abs(weights[:, None] * lateral_jacobian(mean, at)).sum(axis=0)
                largest = np.abs(weights) @ np.abs(line.y(at)) + J @ np.abs(mean)
                assert abs(value - weights @ line.y(at)) <= tolerance * largest
                exact = exact_sigma(mean, F, at, weights)
                excess = 2.1 * rounding(len(at), flags) * np.linalg.norm(np.abs(F).T @ J)
                assert exact <= sigma <= exact + excess
        covariance = out.floats(4, 4)
        assert np.allclose(covariance, F @ F.T, rtol=0, atol=4 * tolerance * np.max(F @ F.T))
        assert (covariance == covariance.T).all()
    assert out.ends()


def check_extrapolated(line: MapLine, x: float, known: Any, found: Any, tolerance: float) -> None:
    """In the range it is what the line says, beyond what the model says, to a share of its size."""
    if not x < line.x_min and not x > line.x_max:
        assert np.array_equal(found, known, equal_nan=True)
        return
    end = line.x_min if x < line.x_min else line.x_max
    mean, cov = Vector(line.gaussian.mean.tolist()), matrix(line.gaussian.cov)
    value, sigma = y_beyond(mean, cov, end, x)
    none = Matrix([Vector([0.0] * 4)] * 4)
    d = abs(x - end)
    size = np.abs(mean) @ np.abs(
        [1, abs(end) + d, (abs(end) + d) ** 2 / 2, (abs(end) + d) ** 3 / 6]
    )
    assert abs(found[0] - value) <= 10 * tolerance * size
    assert sigma >= y_beyond(mean, none, end, x)[1]
    assert found[1] == pytest.approx(sigma, rel=0.05 if tolerance > 1e-9 else 1e-6)


@pytest.mark.parametrize("flags", [DOUBLE, FLOAT])
@pytest.mark.parametrize(
    ("mean", "factor", "x", "expected"),
    [
        pytest.param([0, 0, 0, 0], np.zeros((4, 4)), 40.0, 0.0, id="no-error"),
        pytest.param([0, 0, 0, 0], np.eye(4), 1e30, math.inf, id="beyond-single-precision"),
        pytest.param([0, 0, 0, 0], np.eye(4), math.nan, math.nan, id="no-number"),
        pytest.param([0, 0, 0, 0], np.eye(4), math.inf, math.nan, id="infinite"),
        pytest.param([0, 0, 0, 0], np.full((4, 4), math.inf), 40.0, math.inf, id="unknown"),
        pytest.param([0, 0, 0, 0], np.diag([1, 0, 0, 0]), 40.0, 1.0, id="offset-only"),
        pytest.param([math.nan, 0, 0, 0], np.eye(4), 0.0, math.nan, id="mean-is-no-number"),
        pytest.param([math.inf, 0, 0, 0], np.eye(4), 0.0, math.nan, id="mean-is-infinite"),
    ],
)
def test_sigma_is_never_negative(flags: Any, mean: Any, factor: Any, x: Any, expected: Any) -> None:
    """Whatever is given: in the range, what is not known has an infinite sigma, and what is no
    number has none."""
    head = bytes([0, 0, 1, 1]) + struct.pack("<q", 0) + packed(0, 0, 1e31, mean, factor)
    out = ran(head + b"\1" + packed(x), flags)
    values = out.floats(8)
    sigma = values[1]
    assert (np.isnan(values[1::2]) == np.isnan(values[::2])).all()
    if math.isinf(expected) and x == 1e30 and flags == DOUBLE.values[0]:
        expected = 1e90 / 6
    assert sigma == pytest.approx(expected, rel=1e-5, nan_ok=True)


@pytest.mark.parametrize("flags", [DOUBLE, FLOAT])
def test_mahalanobis_distance(flags: Any) -> None:
    """The distance of measured positions is that of the differences from their distribution."""
    rng = np.random.default_rng(3)
    cases, data = [], b""
    for _ in range(300):
        line, F = random_line(rng)
        n = int(rng.integers(0, 9))
        x, sigma = rng.uniform(line.x_min, line.x_max, n), 10.0 ** rng.uniform(-2, 0, n)
        x = single(x).clip(line.x_min, line.x_max)
        y = line.y(x) + rng.normal(size=n) * (sigma + line.y_sigma(x))
        cases.append((line, x, y, sigma))
        data += b"\1" + packed_line(line, F) + bytes([n]) + packed(np.column_stack([x, y, sigma]))
    out = ran(data, flags)
    tolerance = 1e-9 if flags == DOUBLE.values[0] else 2e-3
    for line, x, y, sigma in cases:
        J = lateral_jacobian(line.gaussian.mean, x)
        S = J @ line.gaussian.cov @ J.T + np.diag(sigma**2)
        z = y - line.y(x)
        expected = math.sqrt(z @ np.linalg.solve(S, z)) if len(x) else 0.0
        assert out.floats(1)[0] == pytest.approx(expected, rel=tolerance)


@pytest.mark.parametrize(
    ("positions", "factor", "expected"),
    [
        pytest.param([(10, 0.5, 0.5)], np.zeros((4, 4)), 1.0, id="one"),
        pytest.param([(10, 0.5, 0.5)], np.diag([0.5, 0, 0, 0]), math.sqrt(0.5), id="both"),
        pytest.param([(0, 0.5, 0.5)] * 8, np.zeros((4, 4)), math.sqrt(8), id="eight"),
        pytest.param([(0, math.nan, 0.5)], np.zeros((4, 4)), math.inf, id="no-number"),
        pytest.param([(math.inf, 1, 0.5)], np.eye(4), math.nan, id="infinitely-far"),
        pytest.param([(10, 0, 1), (81, 0, 1)], np.eye(4), math.nan, id="beyond-the-end"),
        pytest.param([(-1, 0, 1), (10, 0, 1)], np.eye(4), math.nan, id="before-the-start"),
        pytest.param([(math.nan, 0, 0)], np.eye(4), math.nan, id="nowhere"),
        pytest.param([(0, 1, math.nan)], np.eye(4), math.inf, id="sigma-no-number"),
        pytest.param([(0, 1, 1e-30)] * 2, np.eye(4), math.inf, id="one-position-twice"),
    ],
)
def test_mahalanobis_distance_of_some_positions(
    positions: Any, factor: Any, expected: float
) -> None:
    """From the line y = 0."""
    head = bytes([1, 0, 1, 1]) + struct.pack("<q", 0) + packed(0, 0, 80, np.zeros(4), factor)
    out = ran(head + bytes([len(positions)]) + packed(positions), ("-O2",))
    assert out.floats(1)[0] == pytest.approx(expected, rel=1e-6, nan_ok=True)


def random_scene(
    rng: np.random.Generator, n: int
) -> tuple[Scene, list[np.ndarray], np.ndarray, np.ndarray]:
    """A scene, with the factors of its lines, their spread and their line-specific factors."""
    A = rng.normal(size=(n, 4, 7)) * USUAL[:, None] + rng.normal(size=(1, 4, 7)) * USUAL[:, None]
    own = np.array([random_factor(rng) for _ in range(n)])
    own *= (0.3 * USUAL / np.linalg.norm(own, axis=2))[..., None]
    cov = A.reshape(-1, 7) @ A.reshape(-1, 7).T
    lines, factors = [], []
    for i, slot in enumerate(rng.permutation(8)[:n]):
        block = slice(4 * i, 4 * i + 4)
        cov[block, block] += own[i] @ own[i].T
        line, _ = random_line(rng, slot)
        lines.append(
            replace(line, gaussian=Gaussian.trusted(line.gaussian.mean, cov[block, block]))
        )
        factors.append(np.linalg.cholesky(cov[block, block]))
    ranges = np.tile([-40.0, 120.0], (n, 1))
    scene = Scene(tuple(lines), (cov + cov.T) / 2, PoseError(np.eye(3)), ranges)
    return scene, factors, A, own


@pytest.mark.parametrize("flags", [DOUBLE, FLOAT])
def test_quantities_of_a_scene(flags: Any) -> None:
    """Sums, width, centre, range and joint covariance are those of ``Scene``."""
    rng = np.random.default_rng(4)
    cases, data = [], b""
    for k in range(200):
        scene, factors, A, own = random_scene(rng, 1 + k % 8)
        n = len(scene.lines)
        data += bytes([2, n])
        for line, F, spread, specific in zip(scene.lines, factors, A, own, strict=True):
            data += packed_line(line, F) + packed(spread, specific)
        slots = [scene.lines[i].slot for i in rng.permutation(n)[: 1 + k % n]]
        terms = [(slots[0], 10.0, 0.3), (slots[-1], 30.0, -1.5), (slots[0], 25.0, -0.2)]
        data += bytes([len(terms)])
        for slot, x, weight in terms:
            data += bytes([slot]) + packed(x, weight)
        data += bytes([len(slots), *slots]) + packed(40.0)
        cases.append((scene, slots, terms))
    out = ran(data, flags)
    tolerance = 1e-9 if flags == DOUBLE.values[0] else 1e-4
    known = 0
    for scene, slots, terms in cases:
        is_known = all(scene.line(slot).is_valid_at(x) for slot, x, _ in terms)
        assert out.byte() == is_known
        known += is_known
        joint = scene.joint()
        J = np.zeros(len(joint.mean))
        value = np.zeros(())
        for slot, x, weight in terms:
            i = scene.index[slot]
            value = value + weight * scene.line(slot).y(x)  # NaN beyond its range
            J[4 * i : 4 * i + 4] += weight * lateral_jacobian(scene.means[i], x)
        sigma = math.sqrt(J @ scene.cov @ J) if is_known else math.nan
        assert out.floats(2) == pytest.approx(
            [float(value), sigma], rel=tolerance, abs=tolerance * 10, nan_ok=True
        )
        for estimate in (scene.width, scene.centre):
            has_both = {Slot.EGO_LEFT, Slot.EGO_RIGHT} <= set(scene.index)
            expected = [*map(float, estimate(40.0))] if has_both else [math.nan] * 2
            assert out.byte() == math.isfinite(expected[1])
            assert out.floats(2) == pytest.approx(
                expected, rel=tolerance, abs=tolerance, nan_ok=True
            )
        low, high = scene.x_range(slots)
        assert out.byte() == (low <= high)
        assert tuple(out.floats(2)) == (low, high)
        assert out.byte() == 1
        covariance = out.floats(4 * len(slots), 4 * len(slots))
        joint_cov = scene.joint(slots).cov
        scale = np.sqrt(np.diag(joint_cov))
        assert (np.abs(covariance - joint_cov) <= tolerance * np.outer(scale, scale)).all()
        assert [out.byte() for _ in range(8)] == [slot in scene.index for slot in Slot]
    assert out.ends()
    assert 20 < known < 180


def test_a_scene_without_the_line() -> None:
    """No quantity of a line that the scene does not have."""
    line = bytes([3, 1, 1]) + struct.pack("<q", 0) + packed(0, 0, 80, np.zeros(20), np.zeros(44))
    query = b"\1" + b"\0" + packed(0.0, 1.0) + b"\2\3\0" + packed(0.0)
    out = ran(b"\2\1" + line + query, ("-O2",))
    for _ in range(3):
        assert out.byte() == 0
        assert np.isnan(out.floats(2)).all()
    assert out.byte() == 0
    out.floats(2)
    assert out.byte() == 0
    assert [out.byte() for _ in range(8)] == [0, 0, 0, 1, 0, 0, 0, 0]


def random_motion(rng: np.random.Generator) -> tuple[Motion, bytes]:
    speed, yaw_rate = rng.uniform(-5, 40), rng.normal() * 0.1
    s, w = rng.choice([0.0, 0.1, 1.0]), rng.choice([0.0, 0.002, 0.02])
    rho = rng.choice([0.0, 0.5, -1.0])
    cov = np.array([[s * s, rho * s * w], [rho * s * w, w * w]])
    return Motion(speed, yaw_rate, cov), packed(speed, yaw_rate, s, w, rho)


@pytest.mark.parametrize("flags", [DOUBLE, FLOAT])
def test_displacement_by_a_motion(flags: Any) -> None:
    """Mean and covariance are those of ``Motion.over``."""
    rng = np.random.default_rng(5)
    cases, data = [], b""
    for _ in range(500):
        motion, packed_motion = random_motion(rng)
        dt, time_sigma = rng.uniform(-1, 1), rng.choice([0.0, 0.005])
        cases.append(motion.over(dt, time_sigma))
        data += b"\3" + packed_motion + packed(dt, time_sigma)
    out = ran(data, flags)
    tolerance = 1e-12 if flags == DOUBLE.values[0] else 1e-6
    for expected in cases:
        assert out.byte() == 1
        assert np.allclose(out.floats(3), expected.mean, rtol=tolerance, atol=40 * tolerance)
        F = out.floats(3, 3)
        assert (np.triu(F, 1) == 0).all()
        scale = np.sqrt(np.outer(expected.cov.diagonal(), expected.cov.diagonal()))
        assert (np.abs(F @ F.T - expected.cov) <= 1e3 * tolerance * (scale + 1e-6)).all()


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param((math.nan, 0, 0, 0, 0, 0.1, 0), id="speed"),
        pytest.param((10, math.inf, 0, 0, 0, 0.1, 0), id="yaw-rate"),
        pytest.param((10, 0, -1, 0, 0, 0.1, 0), id="speed-sigma"),
        pytest.param((10, 0, 0, -1, 0, 0.1, 0), id="yaw-rate-sigma"),
        pytest.param((10, 0, 0, math.inf, 0, 0.1, 0), id="infinite-sigma"),
        pytest.param((10, 0, math.inf, 0, 0, 0.1, 0), id="infinite-speed-sigma"),
        pytest.param((10, 0, 0, 0, 1.1, 0.1, 0), id="correlation"),
        pytest.param((10, 0, 1, 0.1, 1.1, 0.1, 0), id="correlation-of-errors"),
        pytest.param((10, 0, 0, 0, math.nan, 0.1, 0), id="no-correlation"),
        pytest.param((10, 0, 0, 0, 0, math.nan, 0), id="time"),
        pytest.param((10, 0, 0, 0, 0, 0.1, -1), id="time-sigma"),
        pytest.param((10, 0, 0, 0, 0, 0.1, math.inf), id="infinite-time-sigma"),
        pytest.param((1e300, 0, 1e300, 0, 0, 1e300, 0), id="overflow"),
    ],
)
def test_a_wrong_motion_is_refused(wrong: Any) -> None:
    """The displacement stays as it was."""
    out = ran(b"\3" + packed(wrong), ("-O2",))
    assert out.byte() == 0
    assert (out.floats(12) == 0).all()


STATUSES = (Status.FULL, Status.DIAGONAL, Status.UNKNOWN, Status.REPAIRED, Status.SATURATED)


def displaced(rng: np.random.Generator) -> tuple[bytes, bytes, Gaussian, dict[str, float]]:
    """A displacement for the harness, and for Python."""
    mean = single(rng.normal(size=3) * [20.0, 0.5, 0.1])
    root = np.diag([0.2, 0.02, 0.004]) @ np.linalg.cholesky(np.eye(3) + 0.5)
    root = single(root * rng.choice([0.0, 0.1, 1.0]))
    return b"\5", packed(mean, root), Gaussian(mean, root @ root.T), {}


def moved(rng: np.random.Generator) -> tuple[bytes, bytes, Motion, dict[str, float]]:
    """A motion, as in ``displaced``."""
    (motion, packed_motion), time_sigma = random_motion(rng), rng.choice([0.0, 0.005])
    return b"\4", packed_motion + packed(time_sigma), motion, {"time_sigma": time_sigma}


@pytest.mark.parametrize("flags", [DOUBLE, FLOAT])
@pytest.mark.parametrize(("by", "tolerance"), [(displaced, 1e-8), (moved, 1e-6)])
def test_predictions_are_those_of_python(by: Any, tolerance: float, flags: Any) -> None:
    """To a share of sigma.

    Of a motion, Python forms the covariance of the displacement, which is nearly singular, and so
    loses half of the digits of its square root.
    """
    rng, is_double = np.random.default_rng(6), flags == DOUBLE.values[0]
    cases, data, predicted = [], b"", 0
    for k in range(300):
        line, F = random_line(rng)
        line = replace(line, status=STATUSES[k % 5])
        command, given, motion, options = by(rng)
        t_ns = T_NS + int(rng.integers(-300, 1000)) * 1_000_000
        data += command + packed_line(line, F) + struct.pack("<q", t_ns) + given
        try:
            expected = predict_to(line, t_ns, motion, **options)
        except IllPosedError:
            expected = None
        cases.append((line, F, expected))
    out = ran(data, flags)
    for line, F, expected in cases:
        assert (out.byte() == 0) == (expected is not None)
        found = out.line()
        if expected is None:
            continue
        assert found["t_ns"] == expected.t_ns
        assert (found["age"], found["components"]) == (0.0, 1)
        ends = pytest.approx((expected.x_min, expected.x_max), abs=1e-9 if is_double else 1e-4)
        assert found["x"] == ends
        if line.status == Status.UNKNOWN:
            assert (found["factor"] == F).all()
            continue
        assert (np.triu(found["factor"], 1) == 0).all()
        check_root(found["factor"], expected.gaussian, flags, tolerance)
        mean_error = np.abs(found["mean"] - expected.gaussian.mean) / expected.gaussian.sigma
        assert mean_error.max() <= (tolerance if is_double else 1e-4)
        predicted += 1
    assert out.ends()
    assert predicted > 0.7 * len(cases)


@pytest.mark.parametrize("flags", [DOUBLE, FLOAT])
def test_overall_gaussian_of_a_mixture(flags: Any) -> None:
    """Mean and covariance are those of ``GaussianMixture.overall``."""
    rng = np.random.default_rng(8)
    cases, data = [], b""
    for k in range(100):
        parts = [random_line(rng) for _ in range(1 + k % 8)]
        weights = rng.multinomial(1024, np.ones(len(parts)) / len(parts)) / 1024
        mixture = GaussianMixture(weights, [line.gaussian for line, _ in parts])
        cases.append(mixture.overall)
        data += bytes([6, len(parts)])
        for weight, (line, F) in zip(weights, parts, strict=True):
            data += packed(weight, line.gaussian.mean, F)
    out = ran(data, flags)
    tolerance = 1e-12 if flags == DOUBLE.values[0] else 1e-4
    for expected in cases:
        mean, F = out.floats(4), out.floats(4, 4)
        assert (np.abs(mean - expected.mean) <= tolerance * expected.sigma).all()
        check_root(F, expected, flags, 1e-9)
    assert out.ends()


NOT_USABLE, TOO_FAR, BAD_MOTION, ILL_POSED = 1, 2, 3, 4


@pytest.mark.parametrize(
    ("status", "age", "t_ns", "line_t_ns", "mean", "motion", "expected"),
    [
        pytest.param(5, 0.0, 0, 0, [0, 0, 0, 0], (10, 0), NOT_USABLE, id="out-of-range"),
        pytest.param(1, math.inf, 0, 0, [0, 0, 0, 0], (10, 0), NOT_USABLE, id="too-old"),
        pytest.param(1, math.nan, 0, 0, [0, 0, 0, 0], (10, 0), NOT_USABLE, id="age-no-number"),
        pytest.param(1, 0.0, 10**10, 0, [0, 0, 0, 0], (1, 0), 0, id="ten-seconds"),
        pytest.param(1, 0.0, 10**10 + 1, 0, [0, 0, 0, 0], (1, 0), TOO_FAR, id="longer"),
        pytest.param(1, 1e30, 0, 0, [0, 0, 0, 0], (1, 0), TOO_FAR, id="age-beyond-all-times"),
        pytest.param(1, 0.0, 2**63 - 1, -(2**63), [0, 0, 0, 0], (1, 0), TOO_FAR, id="overflow"),
        pytest.param(1, 0.0, -(2**63), 2**63 - 1, [0, 0, 0, 0], (1, 0), TOO_FAR, id="underflow"),
        pytest.param(1, 0.1, 2**63 - 1, 2**63 - 1, [0, 0, 0, 0], (1, 0), 0, id="last-time"),
        pytest.param(1, 0.0, 0, -1, [0, 0, 0, 0], (math.nan, 0), BAD_MOTION, id="bad-motion"),
        pytest.param(1, 0.0, 10**9, 0, [0, 0, 0, 0], (5, 1.6), ILL_POSED, id="across"),
        pytest.param(0, 0.0, 10**9, 0, [0, 0, 0, 0], (5, 1.6), ILL_POSED, id="mean-across"),
        pytest.param(1, 0.0, 10**9, 0, [0, 1.6, 0, 0], (5, 0), ILL_POSED, id="steep"),
        pytest.param(1, 0.0, 10**9, 0, [math.nan, 0, 0, 0], (5, 0), NOT_USABLE, id="no-number"),
    ],
)
def test_what_cannot_be_predicted(
    status: Any, age: Any, t_ns: Any, line_t_ns: Any, mean: Any, motion: Any, expected: Any
) -> None:
    """The result says why, and the line stays as it was."""
    head = bytes([0, status, 2]) + struct.pack("<q", line_t_ns)
    F = np.diag(0.01 * USUAL)
    data = b"\4" + head + packed(age, 0, 80, mean, F) + struct.pack("<q", t_ns)
    out = ran(data + packed(*motion, 0, 0, 0, 0.0), ("-O2",))
    assert out.byte() == expected
    found = out.line()
    assert found["t_ns"] == (line_t_ns if expected else t_ns)
    assert found["components"] == (2 if expected else 1)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        pytest.param({}, 0, id="good"),
        pytest.param({"status": 5}, NOT_USABLE, id="out-of-range"),
        pytest.param({"age": math.inf}, NOT_USABLE, id="too-old"),
        pytest.param({"t_ns": 10**10 + 1}, TOO_FAR, id="too-late"),
        pytest.param({"mean": [math.nan, 0, 0]}, BAD_MOTION, id="mean"),
        pytest.param({"mean": [0, 0, math.inf]}, BAD_MOTION, id="heading"),
        pytest.param({"factor": np.diag([math.nan, 0, 0])}, BAD_MOTION, id="factor"),
        pytest.param({"factor": np.diag([0, 0, math.inf])}, BAD_MOTION, id="factor-infinite"),
        pytest.param({"mean": [0, 0, 1.6]}, ILL_POSED, id="across"),
    ],
)
def test_a_displacement_that_cannot_be_predicted_by(changes: dict[str, Any], expected: int) -> None:
    """The result says why, for lines and for components, and the line stays as it was."""
    given: dict[str, Any] = {
        "status": 1, "age": 0.0, "t_ns": 10**9, "mean": [1, 0, 0], "factor": np.zeros((3, 3)),
    } | changes  # fmt: skip
    head = bytes([0, given["status"], 2]) + struct.pack("<q", 0)
    line = head + packed(given["age"], 0, 80, np.zeros(4), np.diag(0.01 * USUAL))
    moved = packed(given["mean"], given["factor"])
    out = ran(
        b"\5" + line + struct.pack("<q", given["t_ns"]) + moved + b"\7" + line + moved, ("-O2",)
    )
    assert out.byte() == expected
    assert out.line()["components"] == (2 if expected else 1)
    of_component = expected if expected in (BAD_MOTION, ILL_POSED) else 0
    assert out.byte() == of_component
    assert (out.line()["factor"] == np.diag(0.01 * USUAL)).all() == (of_component > 0)


def test_after_a_u_turn_the_end_comes_first() -> None:
    """The range is from the new start to the new end; one that is all uncertain is a point."""
    line = MapLine(Slot.EGO_LEFT, Gaussian([0, 0, 0, 0], np.diag(USUAL**2)), x_max=40.0, t_ns=0)
    for sigma in (0.0, 20.0):
        moved = Gaussian([50.0, 0.0, math.pi], np.diag([sigma, 0, 0]) ** 2)
        expected = predict_to(line, 0, moved)
        data = b"\5" + packed_line(line, np.diag(USUAL)) + struct.pack("<q", 0)
        out = ran(data + packed(moved.mean, np.diag([sigma, 0, 0])), ("-O2",))
        assert out.byte() == 0
        assert out.line()["x"] == pytest.approx((expected.x_min, expected.x_max))
