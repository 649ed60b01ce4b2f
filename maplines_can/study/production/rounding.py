"""Lateral error and KL divergence of rounding a line to the values of a message.

For a message with the factors f_i and the derivatives J_i of y(x) with respect to its values:

- worst: sum of |J_i| f_i / 2, each value off by half a step in the same sense;
- rms: square root of the sum of (J_i f_i)^2 / 12, errors uniform over a step;
- measured: lines of the set *road*, rounded to the message's values and read back. Lines that do
  not fit are clipped to the range, counted, and left out of the errors. At x, only lines that
  stay within 45 deg of the car's axis up to x count;
- rounding KL: KL(N(m, S) || N(m', S)) of the rounded mean m' with the unchanged covariance S, as
  if S were sent exactly: the cost of rounding in all four parameters. On lines of the sets *road*
  and *paper*; the covariance of *paper* has only the error of the pose and is nearly singular;
- truncated: the error with the missing parameter set to 0. A sender that fits the line without
  that parameter does better.

Both formulas are linear, and hold for a line along the car's axis: a heading sent as an angle
weighs 1 + tan(beta)^2 times more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.line import PARAMETERS, lateral, lateral_jacobian
from ..metrics import evaluate
from ..sets import Gaussians, paper, road
from .messages import PRODUCTION, Message, default_message

Array = NDArray[np.float64]

#: Places of the lateral error [m].
DISTANCES = (20.0, 50.0, 80.0)
#: Quantiles of the rounding KL.
KL_QUANTILES = (0.5, 0.9)


def worst(message: Message, x: ArrayLike, *, polynomial: bool | None = None) -> Array:
    """Return the (...,) worst lateral error of rounding at x [m], to first order.

    Args:
        message: whose values are rounded.
        x: [m].
        polynomial: how to read the values; by default as the message says.

    >>> worst(PRODUCTION[1], [0, 50])  # half a step of 0.035 m; then all four
    array([0.0175, 0.0975])
    """
    return np.asarray(_steps(message, x, polynomial).sum(axis=-1) / 2)


def rms(message: Message, x: ArrayLike) -> Array:
    """Return the (...,) rms lateral error of uniform rounding at x [m], to first order."""
    return np.asarray(np.sqrt((_steps(message, x) ** 2).sum(axis=-1) / 12))


def _steps(message: Message, x: ArrayLike, polynomial: bool | None = None) -> Array:
    """Return the (..., 4) change of y(x) with a step of each value [m]."""
    factors = [abs(signal.factor) if signal else 0.0 for signal in message.signals]
    along = np.abs(lateral_jacobian(np.zeros(len(PARAMETERS)), x)) * factors
    if message.polynomial if polynomial is None else polynomial:
        along *= [1.0, 1.0, 2.0, 6.0]
    return np.asarray(along, dtype=float)


@dataclass(frozen=True)
class RoundingRow:
    """Figures of one message on a set of lines; triples are at ``DISTANCES`` [m]."""

    message: Message
    lines: int  #: of the set
    clipped: tuple[int, ...]  #: lines out of range, for each parameter
    fit: int  #: lines with all that is sent in range
    evaluated: tuple[int, ...]  #: lines that fit and reach that far
    worst: tuple[float, ...]  #: by the formula
    worst_other: tuple[float, ...] | None  #: with the other reading, unless it is documented
    rms: tuple[float, ...]  #: by the formula
    measured_rms: tuple[float, ...]  #: of rounding alone; NaN without lines
    measured_worst: tuple[float, ...]
    truncated_rms: tuple[float, ...] | None  #: with the missing parameter 0; None: all are sent
    truncated_median: tuple[float, ...] | None
    rounding_kl: tuple[float, ...]  #: at KL_QUANTILES of the lines that fit [nat]
    rounding_kl_pose: tuple[float, ...]  #: the same for lines with the pose's error alone
    sigma_best: tuple[float, ...]  #: of the set's lines that reach that far: 10 % quantile
    sigma_median: tuple[float, ...]


def production_table(n: int = 2000, seed: int = 0) -> list[RoundingRow]:
    """Return the row of each production message, and of this project's own, on the same lines.

    Args:
        n: lines of the set *road*.
        seed: of the roads and their errors.

    Raises:
        ValueError: fewer than 100 lines.
    """
    if n < 100:
        raise ValueError(f"n must be 100 lines or more, got {n!r}")
    lines, pose_only = road(n, seed), paper(n, seed)
    return [measured(message, lines, pose_only) for message in (*PRODUCTION, default_message())]


def measured(message: Message, lines: Gaussians, pose_only: Gaussians) -> RoundingRow:
    """Return the figures of one message.

    Args:
        message: to which the lines are rounded.
        lines: any set.
        pose_only: nearly singular ones, for ``rounding_kl_pose`` alone.
    """
    mean, cov = lines
    x = np.array(DISTANCES)
    reaches = _reaches(mean, x)
    J = lateral_jacobian(mean[:, None, :], x)
    sigma = np.sqrt(np.einsum("nxi,nij,nxj->nx", J, cov, J).clip(0))
    read, clipped = message.rounded(mean)
    fits = np.asarray(~clipped.any(axis=1))
    line = lateral(mean[:, None, :], x)
    error, truncated = (
        np.abs(lateral(other[:, None, :], x) - line)
        for other in (_rounded_alone(message, mean, read), read)
    )
    chosen = fits[:, None] & reaches

    def each(figure: str, values: Array, chosen: NDArray[np.bool_]) -> tuple[float, ...]:
        columns = (values[chosen[:, i], i] for i in range(len(x)))
        return tuple(_FIGURES[figure](column) if column.size else np.nan for column in columns)

    lacks = None in message.signals
    other = None if message.documented else worst(message, x, polynomial=not message.polynomial)
    return RoundingRow(
        message=message,
        lines=len(mean),
        clipped=tuple(clipped.sum(axis=0).tolist()),
        fit=int(fits.sum()),
        evaluated=tuple(chosen.sum(axis=0).tolist()),
        worst=tuple(worst(message, x).tolist()),
        worst_other=None if other is None else tuple(other.tolist()),
        rms=tuple(rms(message, x).tolist()),
        measured_rms=each("rms", error, chosen),
        measured_worst=each("worst", error, chosen),
        truncated_rms=each("rms", truncated, chosen) if lacks else None,
        truncated_median=each("median", truncated, chosen) if lacks else None,
        rounding_kl=_rounding_kl(message, lines),
        rounding_kl_pose=_rounding_kl(message, pose_only),
        sigma_best=each("best", sigma, reaches),
        sigma_median=each("median", sigma, reaches),
    )


_FIGURES = {
    "rms": lambda values: float(np.sqrt(np.mean(values**2))),
    "worst": lambda values: float(values.max()),
    "best": lambda values: float(np.quantile(values, 0.1)),
    "median": lambda values: float(np.median(values)),
}


def _rounded_alone(message: Message, mean: Array, read: Array) -> Array:
    """Return the lines as they are read, with the true values of parameters that are not sent."""
    return np.where([signal is None for signal in message.signals], mean, read)


def _rounding_kl(message: Message, lines: Gaussians) -> tuple[float, ...]:
    mean, cov = lines
    read, clipped = message.rounded(mean)
    fits = ~clipped.any(axis=1)
    if not fits.any():
        return (np.nan,) * len(KL_QUANTILES)
    m, S, decoded = mean[fits], cov[fits], _rounded_alone(message, mean, read)[fits]
    kl = evaluate(m, S, decoded, S, np.zeros(len(PARAMETERS))).kl
    # inverted_cdf allows infinite values.
    return tuple(np.quantile(kl, KL_QUANTILES, method="inverted_cdf").tolist())


def _reaches(mean: Array, x: Array) -> NDArray[np.bool_]:
    """Return (N, X) which lines stay within 45 deg of the car's axis from 0 m to x."""
    way = np.linspace(0, 1, 81) * x[:, None]  # (X, 81)
    beta, c0, c1 = (mean[:, i, None, None] for i in (1, 2, 3))
    slope = np.tan(beta) + way * (c0 + way * c1 / 2)
    return np.asarray((np.abs(slope) < 1).all(axis=2))
