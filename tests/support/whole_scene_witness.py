"""Whole scenes read from their frames by cantools and NumPy alone, as dbc/README.md says."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cantools
import numpy as np
from numpy.typing import NDArray

from maplines_can import Slot

Array = NDArray[np.float64]
cheb = np.polynomial.chebyshev
ROOTS = cheb.chebpts1(8)
PARAMETERS = ("YOff", "Beta", "C0", "C1")
TILTS = (0.0, 1.0, -1.0, 6.0)
NO_LINE = 8


class Read(NamedTuple):
    """What the frames of a cycle say."""

    slots: list[Slot]  #: of the lines, as the frames have them
    means: Array  #: (n, 4)
    cov: Array  #: (4 n, 4 n)
    kinds: list[int]
    left_out: dict[Slot, int]  #: reasons by their numbers
    raw: dict[str, dict[str, Any]]  #: raw values by the name of the message


@cache
def database_of(path: Path) -> Any:
    return cantools.database.load_file(path)


def places_of(message: Any) -> list[str]:
    """Return how the names of the signals of each place begin."""
    kinds = [signal for signal in message.signals if signal.name.endswith("Kind")]
    return [signal.name.removesuffix("Kind") for signal in sorted(kinds, key=lambda s: s.start)]


def slot_at(prefix: str, raw: Mapping[str, Any]) -> Slot:
    """Return the slot of a place: it is named by the record, or by the DBC."""
    titles = {slot.name.replace("_", "").lower(): slot for slot in Slot}
    name = f"{prefix}Slot"
    return Slot(raw[name]) if name in raw else titles[prefix.lower()]


def read(frames: Iterable[Any], path: Path) -> Read:
    """Return the lines of frames, which are of one pose error, and their joint covariance."""
    database, found, raws, left_out = database_of(path), [], {}, {}
    for frame in frames:
        message = database.get_message_by_frame_id(frame.can_id)
        raw = message.decode(frame.data, decode_choices=False, scaling=False)
        values = message.decode(frame.data, decode_choices=False)
        raws[message.name] = raw
        for prefix in places_of(message):
            kind = raw[f"{prefix}Kind"]
            own = {
                name.removeprefix(prefix): (raw[name], value)
                for name, value in values.items()
                if name.startswith(prefix)
            }
            if kind < NO_LINE:
                found.append((slot_at(prefix, raw), kind, own, raw, values))
            elif kind > NO_LINE:
                left_out[slot_at(prefix, raw)] = kind - NO_LINE
    means = np.array([[own[name][1] for name in PARAMETERS] for _, _, own, _, _ in found])
    rows, blocks = [], []
    for (_, _, own, raw, values), mean in zip(found, means.reshape(-1, 4), strict=True):
        low, high = own["XMin"][1], own["XMax"][1]
        W, J = changes(mean, low, high), bases(mean, low, high)
        rows.append(of_line(W, J, mean))
        blocks.append(specific(own, raw, values, mean, W[:3] @ J.T, J))
    cov = np.zeros((0, 0))
    if found:
        cov = joint(np.hstack(rows), pose_of(found[0][4]), blocks)
    slots, kinds = [one[0] for one in found], [one[1] for one in found]
    return Read(slots, means.reshape(-1, 4), cov, kinds, left_out, raws)


def pose_of(values: Mapping[str, Any]) -> Array:
    """Return the Cholesky factor of the pose error."""
    names = ("Along", "Across", "Heading")
    L = np.zeros((3, 3))
    for i, row in enumerate(names):
        L[i, i] = 2.0 ** values[f"Pivot{row}"]
        for j, column in enumerate(names[:i]):
            L[i, j] = values[f"Ratio{row}{column}"] * L[i, i]
    return 2.0 ** (values["Inflation"] / 2) * L


def level(raw: int, octave: float) -> float:
    return 2.0**octave if raw else 0.0


def moved(values: Array, half: float) -> Array:
    c = cheb.chebfit(ROOTS, values, 3)
    return np.array([0, 2 * c[0], 4 * c[1], 6 * (c[2] + c[0])]) / half


def changes(mean: Array, low: float, high: float) -> Array:
    """Return the changes of the coefficients of T_0 to T_3 by the pose."""
    y_off, beta, c0, c1 = mean
    half = (high - low) / 2
    x, tangent = (low + high) / 2 + half * ROOTS, np.tan(beta)
    y = y_off + tangent * x + c0 / 2 * x**2 + c1 / 6 * x**3
    m, k = tangent + c0 * x + c1 / 2 * x**2, c0 + c1 * x
    turned = -(x + m * y)
    p = cheb.chebfit(ROOTS, turned, 3)
    slope = cheb.chebval(ROOTS, cheb.chebder(p)) / half
    left = (turned - cheb.chebval(ROOTS, p)) * y
    squared = cheb.chebfit(ROOTS, (m * x - y - k * y**2) / 2 - slope * y, 3) + moved(left, half)
    along, both, along_squared = cheb.chebfit(ROOTS, np.array([m, 1 + slope, k / 2]).T, 3).T
    return np.array([along, [-1, 0, 0, 0], p, squared, both, along, along_squared])


def bases(mean: Array, low: float, high: float) -> Array:
    """Return the derivatives of the line with respect to these coefficients."""
    w = np.polynomial.Polynomial([-(low + high) / (high - low), 2 / (high - low)])
    T = [1 + 0 * w, w, 2 * w**2 - 1, 4 * w**3 - 3 * w]
    J = np.array([np.resize(np.append(t.coef, np.zeros(4)), 4) for t in T]).T
    return np.array([1, np.cos(mean[1]) ** 2, 2, 6])[:, None] * J


def of_line(W: Array, J: Array, mean: Array) -> Array:
    """Return the changes of the line itself."""
    W = W @ J.T
    along, heading = W[[0, 2], 1]
    W[3:, 1] -= np.tan(mean[1]) * np.array([heading**2, 2 * heading * along, 0, along**2])
    return W


def point_noise(mean: Array, low: float, high: float, spacing: float, phase: float) -> Array:
    w = -np.cos(np.pi * np.arange(64) / 63)
    x = (low + high) / 2 + (high - low) / 2 * w
    stretch = np.hypot(1, np.tan(mean[1]) + mean[2] * x + mean[3] / 2 * x**2)
    along = np.append(0, np.cumsum(np.diff(x) * (stretch[1:] + stretch[:-1])))
    place = 2 * along / along[-1] / spacing + phase
    i = np.floor(place).astype(int)
    W = np.zeros((64, i[-1] + 2))
    W[range(64), i], W[range(64), i + 1] = 1 - (place - i), place - i
    fit = np.linalg.pinv(cheb.chebvander(w, 3)) * stretch
    return fit @ W @ (fit @ W).T * (1 + 2.0**-14 * np.eye(4))


def specific(own: Any, raw: Any, values: Any, mean: Array, G: Array, J: Array) -> Array:
    """Return the line-specific covariance of levels."""
    k, spacing = own["OwnShape"][0], 2.0 ** own["OwnShape"][1]
    points = level(*own["OwnPoints"])
    uncertain = np.diag([0, 1 / 4, 1, 2])
    if points:
        ratio = (0.0, *(0.5 * 1.8 ** np.arange(5)))[k % 6]
        phase = 1.618033988749895 * k % 1
        N = point_noise(mean, own["XMin"][1], own["XMax"][1], spacing, phase)
        S = points**2 * (N + ratio**2 * spacing * uncertain)
    else:
        S = level(k, k / 25 - 10) ** 2 * uncertain
    u = level(*own["OwnLateral"]) * np.array([1, TILTS[own["OwnTilt"][0]], 0, 0])
    D = J @ (S + np.outer(u, u) + 4.0**-9 * np.eye(4)) @ J.T
    for name, g in zip(("MapOffset", "MapOffset", "MapHeading"), G, strict=True):
        D += level(raw[name], values[name]) ** 2 * np.outer(g, g)
    return D


def joint(W: Array, L: Array, blocks: list[Array]) -> Array:
    """Return the joint covariance of lines."""
    q = np.array([L[2] ** 2, L[2] * L[0], L[2] * L[1], L[0] ** 2]).T @ W[3:]
    m, first = q.sum(axis=0), L.T @ W[:3]
    C = first.T @ first + (3 * q - m).T @ (3 * q - m) / 3 + 2 * np.outer(m, m)
    for i, D in enumerate(blocks):
        C[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] += D
    return C
