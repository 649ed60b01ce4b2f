"""What production lane messages lose by rounding, beside this project's own message.

The messages are those of public sources: mostly reverse-engineered DBCs, so that widths and
factors are certain where decoders work with them, and meanings often are not. Each row says
which. Where a source does not say whether it sends coefficients of a polynomial or curvatures,

    y = c_0 + c_1 x + c_2 x^2 + c_3 x^3    or    y = c_0 + c_1 x + c_2 x^2/2 + c_3 x^3/6,

the first is taken, whose steps weigh more, and the worst case of the second stands beside it.

Definitions, for a message with the factors f_i and the derivatives J_i of y(x) with respect to
what it sends:

- worst: sum of |J_i| f_i / 2, each value half a step off in the same sense;
- rms: square root of the sum of (J_i f_i)^2 / 12, errors uniform over a step;
- measured: lines of ``sets.road`` rounded to the message's values and read back. Those that do
  not fit are brought to the end of the range, counted, and left out of the errors. At x a line
  is judged if it stays within 45 deg of the car's axis as far as that;
- rounding KL: KL(N(m, S) || N(m', S)) of the rounded mean m' with the covariance S untouched,
  as if it were sent exactly: what the rounding costs in all four parameters. On the lines of
  ``sets.road``, and on those of ``sets.paper``, whose covariance has the pose's error alone and
  is nearly singular;
- truncated: the error with the missing parameter set to 0. A sender that fits the line anew
  without it does better.

Both formulas are linear, and hold for a line along the car's axis: a heading that is sent as an
angle weighs 1 + tan(beta)^2 times more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...line import STATES, lateral, lateral_jacobian
from ...wire import Layout
from ...wire.message.signals import STATE_SIGNALS, Signal
from ..dbc.covariance_spec import covariance_signals
from ..metrics import evaluate
from ..sets import Gaussians, paper, road

__all__ = [
    "DISTANCES",
    "PRODUCTION",
    "Message",
    "Row",
    "default_message",
    "measured",
    "production_table",
    "rms",
    "worst",
]

Array = NDArray[np.float64]

#: Where the lateral error is judged [m].
DISTANCES = (20.0, 50.0, 80.0)
#: What rounding costs: so many of the lines are within it.
KL_QUANTILES = (0.5, 0.9)


@dataclass(frozen=True)
class Message:
    """One line on a bus: its parameters as they are sent, and what is known of that.

    Args:
        maker: of the car or camera.
        name: of the message, with its CAN ID.
        fields: of (y_off, beta, c0, c1) or what stands for them; None is not sent.
        polynomial: sends tan(beta), c0/2 and c1/6, not beta, c0 and c1.
        documented: the source says which of the two.
        uncertainty: what the message says of it.
        source: where its figures are from.
        certainty: how far to trust them.
        distance: sends |y_off|; the side is known from which line it is.
    """

    maker: str
    name: str
    fields: tuple[Signal | None, ...]
    polynomial: bool
    documented: bool
    uncertainty: str
    source: str
    certainty: str
    distance: bool = False

    def __post_init__(self) -> None:
        if len(self.fields) != len(STATES):
            raise ValueError(f"fields must be of {STATES}, got {len(self.fields)}")

    @property
    def bits(self) -> int:
        """Bits of the line's parameters."""
        return sum(field.length for field in self.fields if field)

    def sent(self, lines: ArrayLike) -> Array:
        """(..., 4) what the message would send of (..., 4) lines, before rounding."""
        values = np.array(lines, dtype=float)
        if self.distance:
            values[..., 0] = np.abs(values[..., 0])
        if self.polynomial:
            values[..., 1] = np.tan(values[..., 1])
        return values / self._scale

    def read(self, values: ArrayLike, lines: ArrayLike) -> Array:
        """(..., 4) lines from (..., 4) values; ``lines`` tell the side and nothing else."""
        read = np.asarray(values, dtype=float) * self._scale
        if self.polynomial:
            read[..., 1] = np.arctan(read[..., 1])
        if self.distance:
            read[..., 0] = np.copysign(read[..., 0], np.asarray(lines, dtype=float)[..., 0])
        return read

    def rounded(self, lines: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Lines through the message's values.

        Returns:
            (..., 4) what is read; a parameter that is not sent is 0.
            (..., 4) which parameters were out of range, and were brought to its end.
        """
        values = self.sent(lines)
        clipped = np.zeros(values.shape, dtype=bool)
        for i, field in enumerate(self.fields):
            if field is None:
                values[..., i] = 0.0
                continue
            raw = field.raw(values[..., i])
            limited = field.limited(raw)
            clipped[..., i] = raw != limited
            values[..., i] = field.physical(limited)
        return self.read(values, lines), clipped

    @property
    def _scale(self) -> Array:
        return np.array([1.0, 1.0, 2.0, 6.0] if self.polynomial else [1.0, 1.0, 1.0, 1.0])


def _signal(
    name: str,
    bits: int,
    factor: float,
    unit: str,
    *,
    offset: float = 0.0,
    signed: bool = False,
    limits: tuple[float, float] | None = None,
) -> Signal:
    """A field; ``limits`` where the source prints a range narrower than the bits."""
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    if limits is not None:
        slack = 1e-6  # a limit printed in decimals still admits the raw value that it means
        low = max(low, int(np.ceil((limits[0] - offset) / factor - slack)))
        high = min(high, int(np.floor((limits[1] - offset) / factor + slack)))
    return Signal(
        name=name,
        start=0,  # of no matter here
        length=bits,
        big_endian=False,
        signed=signed,
        factor=factor,
        offset=offset,
        unit=unit,
        raw_min=low,
        raw_max=high,
    )


_OPENDBC = "commaai/opendbc, reverse-engineered"

#: Messages that say where a line lies. Those with a curvature and no lateral offset are not
#: among them (Tesla UI_csaRoadCurvature, GM 0x409, Ford 0x3CA, VW HCA_03, Mobileye 0x737), nor
#: those of unknown units (Mazda).
PRODUCTION = (
    Message(
        "Mobileye",
        "LKA lane 0x766/0x767",
        (
            _signal("c0", 16, 2**-8, "m", signed=True),
            _signal("c1", 16, 2**-10, "rad", offset=-0x7FFF * 2**-10, limits=(-0.357, 0.357)),
            _signal(
                "c2", 16, 9.765625e-7, "1/m", offset=-0x7FFF * 9.765625e-7, limits=(-0.02, 0.02)
            ),
            _signal("c3", 16, 2**-28, "1/m^2", offset=-0x7FFF * 2**-28, limits=(-1.2e-4, 1.2e-4)),
        ),
        polynomial=True,
        documented=True,
        uncertainty="quality, 2 b",
        source="ApolloAuto/apollo, decoder and its comments",
        certainty="good; a second decoder agrees on offset and heading",
    ),
    Message(
        "Tesla",
        "DAS_lanes 0x239",
        (
            _signal("C0", 8, 0.035, "m", offset=-3.5, limits=(-3.5, 3.5)),
            _signal("C1", 8, 0.0016, "rad", offset=-0.2, limits=(-0.2, 0.2)),
            _signal("C2", 8, 2e-5, "1/m", offset=-0.0025, limits=(-0.0025, 0.0025)),
            _signal("C3", 8, 2.4e-7, "1/m^2", offset=-3e-5, limits=(-3e-5, 3e-5)),
        ),
        polynomial=True,
        documented=False,
        uncertainty="usage, 2 b a side",
        source=_OPENDBC,
        certainty="meaning uncertain; the centre of the lane, one line",
    ),
    Message(
        "Tesla",
        "UI_roadCurvature 0x2C8",
        (
            _signal("C0", 11, 0.02, "m", signed=True),
            _signal("C1", 10, 0.00075, "rad", signed=True),
            _signal("C2", 14, 7.5e-6, "1/m", signed=True),
            _signal("C3", 13, 3e-8, "1/m^2", signed=True),
        ),
        polynomial=True,
        documented=False,
        uncertainty="health, 2 b",
        source=_OPENDBC,
        certainty="meaning uncertain; the road of the map",
    ),
    Message(
        "Ford",
        "LateralMotionControl 0x3D3",
        (
            _signal("offset", 10, 0.01, "m", offset=-5.12),
            _signal("angle", 11, 0.0005, "rad", offset=-0.5),
            _signal("curvature", 11, 2e-5, "1/m", offset=-0.02),
            _signal("curvature rate", 13, 2.5e-7, "1/m^2", offset=-0.001024),
        ),
        polynomial=False,
        documented=True,
        uncertainty="none",
        source=_OPENDBC,
        certainty="good; a path to follow, not a line that is seen",
    ),
    Message(
        "Ford",
        "LateralMotionControl2 0x3D6",
        (
            _signal("offset", 10, 0.01, "m", offset=-5.12),
            _signal("angle", 11, 0.0005, "rad", offset=-0.5),
            _signal("curvature", 11, 2e-5, "1/m", offset=-0.02),
            _signal("curvature rate", 11, 1e-6, "1/m^2", offset=-0.001024),
        ),
        polynomial=False,
        documented=True,
        uncertainty="none",
        source=_OPENDBC,
        certainty="good, offsets as in 0x3D3; a path to follow, CAN FD variant",
    ),
    Message(
        "Hyundai/Kia",
        "FR_CMR_03 0x1B5",
        (
            _signal("offset", 14, 0.0039625, "m", signed=True),
            _signal("heading", 10, 2**-10, "rad", signed=True),
            _signal("curvature", 16, 1e-6, "1/m", signed=True),
            _signal("curvature rate", 16, 4e-9, "1/m^2", signed=True),
        ),
        polynomial=True,
        documented=False,
        uncertainty="quality, 3 b",
        source=_OPENDBC,
        certainty="meaning uncertain; offset factor likely a misprint of 1/256",
    ),
    Message(
        "GM",
        "ego lines 0x350-0x353",
        (
            _signal("offset", 7, 0.05, "m"),
            _signal("heading", 8, 0.002, "", signed=True),
            _signal("curvature", 16, 2**-20, "1/m", signed=True),
            _signal("curvature rate", 16, 2**-24, "1/m^2", signed=True),
        ),
        polynomial=True,
        documented=False,
        distance=True,
        uncertainty="quality, 7 b (0 to 100 %)",
        source=_OPENDBC,
        certainty="meaning uncertain; unit of the rate printed as 1/(m s), read as 1/m^2",
    ),
    Message(
        "GM",
        "lanes 3 and 4 0x354/0x355",
        (
            _signal("offset", 8, 0.1, "m", signed=True),
            _signal("heading", 8, 0.002, "", signed=True),
            _signal("curvature", 16, 2**-20, "1/m", signed=True),
            _signal("curvature rate", 16, 2**-24, "1/m^2", signed=True),
        ),
        polynomial=True,
        documented=False,
        uncertainty="quality, 7 b (0 to 100 %)",
        source=_OPENDBC,
        certainty="meaning uncertain; unit of the rate printed as 1/(m s), read as 1/m^2",
    ),
    Message(
        "Honda",
        "LANE_LINE 0x240/0x241",
        (
            _signal("offset", 12, 0.004, "m", offset=-8.192),
            _signal("heading", 12, 0.0005, "rad", offset=-1.024),
            _signal("curvature", 12, 1e-5, "1/m", offset=-0.02048),
            None,
        ),
        polynomial=True,
        documented=False,
        uncertainty="probability, 6 b",
        source=_OPENDBC,
        certainty="meaning uncertain; 12 further bits that no decoder reads may be the rate",
    ),
)


def default_message(layout: Layout | None = None) -> Message:
    """The mean of this project's message, as its DBC has it.

    Args:
        layout: by default of ``dbc/maplines.dbc``.
    """
    layout = layout or Layout.from_dbc()
    covariance = sum(
        layout[spec.name].length for spec in covariance_signals(layout.covariance_code)
    )
    return Message(
        "this project",
        "MapLine",
        tuple(layout[name] for name in STATE_SIGNALS),
        polynomial=False,
        documented=True,
        uncertainty=f"covariance, {covariance} b" if covariance else "none",
        source="the DBC",
        certainty="it is the contract",
    )


# -- figures --------------------------------------------------------------------


def worst(message: Message, x: ArrayLike, *, polynomial: bool | None = None) -> Array:
    """(...,) worst lateral error of rounding at x [m], to first order.

    Args:
        message: what it sends.
        x: [m].
        polynomial: how to read it; by default as the message says.

    >>> worst(PRODUCTION[1], [0, 50])  # half a step of 0.035 m; then all four
    array([0.0175, 0.0975])
    """
    return np.asarray(_steps(message, x, polynomial).sum(axis=-1) / 2)


def rms(message: Message, x: ArrayLike) -> Array:
    """(...,) root mean square of the lateral error of uniform rounding at x [m], first order."""
    return np.asarray(np.sqrt((_steps(message, x) ** 2).sum(axis=-1) / 12))


def _steps(message: Message, x: ArrayLike, polynomial: bool | None = None) -> Array:
    """(..., 4) how far y(x) moves with a step of each value [m]."""
    factors = [abs(field.factor) if field else 0.0 for field in message.fields]
    along = np.abs(lateral_jacobian(np.zeros(len(STATES)), x)) * factors
    if message.polynomial if polynomial is None else polynomial:
        along *= [1.0, 1.0, 2.0, 6.0]
    return np.asarray(along, dtype=float)


@dataclass(frozen=True)
class Row:
    """One message on the lines of a set; three figures are of ``DISTANCES`` [m]."""

    message: Message
    lines: int  #: of the set
    clipped: tuple[int, ...]  #: lines whose parameter was out of range, for each parameter
    fit: int  #: lines with all that is sent in range
    judged: tuple[int, ...]  #: lines that fit and reach so far
    worst: tuple[float, ...]  #: by the formula
    worst_other: tuple[float, ...] | None  #: if the other reading were meant
    rms: tuple[float, ...]  #: by the formula
    measured_rms: tuple[float, ...]  #: of rounding alone; NaN where no line is judged
    measured_worst: tuple[float, ...]
    truncated_rms: tuple[float, ...] | None  #: with the missing parameter 0; None: all are sent
    truncated_median: tuple[float, ...] | None
    rounding_kl: tuple[float, ...]  #: at KL_QUANTILES of the lines that fit [nat]
    rounding_kl_pose: tuple[float, ...]  #: the same of the lines with the pose's error alone
    sigma_best: tuple[float, ...]  #: of the set's lines that reach so far: the best known 10 %
    sigma_median: tuple[float, ...]  #: and half of them


def production_table(n: int = 2000, seed: int = 0) -> list[Row]:
    """Each production message, and this project's own, on the same lines of ``sets.road``.

    Args:
        n: lines.
        seed: of the roads and their errors.

    Raises:
        ValueError: fewer than 100 lines.
    """
    if n < 100:
        raise ValueError(f"n must be 100 lines or more, got {n!r}")
    lines, pose_only = road(n, seed), paper(n, seed)
    return [measured(message, lines, pose_only) for message in (*PRODUCTION, default_message())]


def measured(message: Message, lines: Gaussians, pose_only: Gaussians) -> Row:
    """The figures of one message.

    Args:
        message: what the lines go through.
        lines: of any set.
        pose_only: nearly singular ones, for ``rounding_kl_pose`` alone.
    """
    mean, cov = lines
    x = np.array(DISTANCES)
    reaches = _reaches(mean, x)
    sigma = _sigma(mean, cov, x)
    read, clipped = message.rounded(mean)
    fits = np.asarray(~clipped.any(axis=1))
    rounded = _rounded_alone(message, mean, read)
    error = np.abs(_lateral_error(rounded, mean, x))
    truncated = np.abs(_lateral_error(read, mean, x))
    judged = fits[:, None] & reaches
    lacks = None in message.fields

    def each(figure: str, values: Array, chosen: NDArray[np.bool_]) -> tuple[float, ...]:
        columns = (values[chosen[:, i], i] for i in range(len(x)))
        return tuple(_FIGURES[figure](column) if column.size else np.nan for column in columns)

    return Row(
        message=message,
        lines=len(mean),
        clipped=tuple(int(count) for count in clipped.sum(axis=0)),
        fit=int(fits.sum()),
        judged=tuple(int(count) for count in judged.sum(axis=0)),
        worst=_floats(worst(message, x)),
        worst_other=None
        if message.documented
        else _floats(worst(message, x, polynomial=not message.polynomial)),
        rms=_floats(rms(message, x)),
        measured_rms=each("rms", error, judged),
        measured_worst=each("worst", error, judged),
        truncated_rms=each("rms", truncated, judged) if lacks else None,
        truncated_median=each("median", truncated, judged) if lacks else None,
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
    """What is read, with the parameters that are not sent as they were."""
    return np.where([field is None for field in message.fields], mean, read)


def _rounding_kl(message: Message, lines: Gaussians) -> tuple[float, ...]:
    mean, cov = lines
    read, clipped = message.rounded(mean)
    fits = np.asarray(~clipped.any(axis=1))
    if not fits.any():
        return (np.nan,) * len(KL_QUANTILES)
    m, S, decoded = mean[fits], cov[fits], _rounded_alone(message, mean, read)[fits]
    kl = evaluate(m, S, decoded, S, np.zeros(len(STATES))).kl
    return _floats(np.quantile(kl, KL_QUANTILES, method="inverted_cdf"))  # also of infinite ones


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _lateral_error(read: Array, mean: Array, x: Array) -> Array:
    return np.asarray(lateral(read[:, None, :], x) - lateral(mean[:, None, :], x))


def _sigma(mean: Array, cov: Array, x: Array) -> Array:
    """(N, X) standard deviation of y(x) [m], to first order."""
    J = lateral_jacobian(mean[:, None, :], x)
    return np.asarray(np.sqrt(np.einsum("nxi,nij,nxj->nx", J, cov, J).clip(0)))


def _reaches(mean: Array, x: Array) -> NDArray[np.bool_]:
    """(N, X) which lines stay within 45 deg of the car's axis from 0 m as far as x."""
    way = np.linspace(0, 1, 81) * x[:, None]  # (X, 81)
    beta, c0, c1 = (mean[:, i, None, None] for i in (1, 2, 3))
    slope = np.tan(beta) + way * (c0 + way * c1 / 2)
    return np.asarray((np.abs(slope) < 1).all(axis=2))
