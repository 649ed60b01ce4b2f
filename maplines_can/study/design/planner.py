"""Plans of a message layout from the sensitivities alone, without encoding a line.

Each bit goes to the field where it reduces the loss most. The loss is the KL divergence of the
covered target, mean over each set, plus the blur by the mean's grid, median of each set; both are
averaged over the sets. (The blur of a nearly singular covariance is large for any grid, so that
its mean says little.)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...generation.dbc import cholesky_signals
from ...generation.dbc.cholesky_signals import pivot_signal, ratio_signal
from ...generation.dbc.dbc_writer import TRANSFER_ID_BITS, DbcWriter, SignalSpec, paged
from ...generation.dbc.record_spec import SERVICE
from ...values.line import PARAMETERS, lateral_jacobian
from ...values.text_table import percent
from ...wire.layout.record_signals import PAGE_BYTES, PARAMETER_SIGNALS
from ..sets import Gaussians
from .sensitivity import (
    MIN_BITS,
    RatioSpread,
    Width,
    blurs,
    conservative,
    inflation_width,
    pivot_widths,
    rows_of,
)

Array = NDArray[np.float64]

#: The longest record that also fits into a CAN FD frame.
MAX_FRAMES = 8
INFLATION = "Inflation"


@dataclass(frozen=True)
class Targets:
    """Targets of a design.

    Args:
        frames: classic frames of a line; None for as few as ``max_kl`` needs.
        max_kl: largest KL divergence of the covered target, mean over each set [nat]; None for
            the least that the frames allow.
        ranges: ends of the mean's ranges by state; the others as in the project's own DBC.
        sigmas: greatest standard deviations by state; the others are twice the sets' greatest.
        keep_mean: leave the mean's widths as they are in the project's own DBC.
        max_lateral: largest effect of the mean's rounding on the lateral position at 80 m of a
            straight line [m].
        max_saturated: largest share of saturated lines of each set, which a range limits.

    Raises:
        ValueError: neither frames nor max_kl is given, or a value is out of range.
    """

    frames: int | None = None
    max_kl: float | None = None
    ranges: Mapping[str, float] = field(default_factory=dict)
    sigmas: Mapping[str, float] = field(default_factory=dict)
    keep_mean: bool = False
    max_lateral: float = 0.05
    max_saturated: float = 5e-3

    def __post_init__(self) -> None:
        if self.frames is None and self.max_kl is None:
            raise ValueError("frames or max_kl must be given: the length of a line, or its KL")
        if self.frames is not None and self.frames not in range(1, MAX_FRAMES + 1):
            raise ValueError(
                f"frames must be from 1 to {MAX_FRAMES}, as one CAN FD frame holds, "
                f"got {self.frames!r}"
            )
        for name in ("max_kl", "max_lateral", "max_saturated"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise ValueError(f"{name} must be positive, got {value!r}")
        if self.max_saturated > 1:
            raise ValueError(f"max_saturated is a share, at most 1, got {self.max_saturated!r}")
        for what in ("ranges", "sigmas"):
            for state, value in getattr(self, what).items():
                if state not in PARAMETERS or not 0 < value < np.inf:
                    raise ValueError(
                        f"{what} must be positive numbers of {', '.join(PARAMETERS)}, "
                        f"got {state}={value!r}"
                    )
        if self.keep_mean and self.ranges:
            raise ValueError("ranges must not be given with keep_mean, which keeps them")


@dataclass(frozen=True)
class Prediction:
    """Figures of a plan as predicted by the sensitivities."""

    kl_mean: float  #: of the covered target, with inflation and saturation [nat]
    kl_p99: float  #: of the rounding and its inflation alone [nat]
    saturated: float  #: share of the lines of the set where it is greatest
    lateral_error: float  #: largest at 80 m on a straight line [m]
    blur: float  #: median of the set [nat]


@dataclass(frozen=True)
class WidthPlan:
    """Widths of the mean and of the covariance."""

    order: tuple[int, ...]  #: rows of the covariance, as indices into the mean
    mean: tuple[int, ...]  #: bits
    fields: Mapping[str, Width]  #: pivots, ratios and inflation, by signal
    price: float  #: of a share of 1 of lines beyond the end of a range [nat]

    @property
    def bits(self) -> int:
        """Number of bits of mean and covariance."""
        return sum(self.mean) + sum(width.bits for width in self.fields.values())

    @property
    def steps(self) -> tuple[Array, Array]:
        """(4,) of the pivots and (6,) of the ratios, row by row."""
        pivots = [self.fields[pivot].factor for pivot, _ in names_of(self.order)]
        ratios = [self.fields[ratio].factor for _, row in names_of(self.order) for ratio in row]
        return np.array(pivots), np.array(ratios)

    def changed(self, **fields: Width) -> WidthPlan:
        """Return a plan with other widths, and the inflation that their steps need."""
        plan = replace(self, fields={**self.fields, **fields})
        inflation = inflation_width(plan.fields[INFLATION].bits, *plan.steps)
        return replace(plan, fields={**plan.fields, INFLATION: inflation})


def names_of(order: Sequence[int]) -> Iterator[tuple[str, list[str]]]:
    """Yield the signals of each row: its pivot and its ratios."""
    for i, row in enumerate(order):
        name = PARAMETER_SIGNALS[row]
        yield f"Pivot{name}", [f"Ratio{name}{PARAMETER_SIGNALS[column]}" for column in order[:i]]


#: Least and most bits of each state of the mean.
MEAN_BITS = (6, 40)
INFLATION_BITS = (2, 3, 4, 5)
#: Order of the rows for which the mean's bits are found; other orders need nearly the same.
ORDER = ("C1", "C0", "YOff", "Beta")
#: Inflation of a first plan; the steps of the other fields determine its factor later.
FIRST_INFLATION = Width(3, 1.0, 0.0)
#: Number of orders that are optimized.
PROMISING = 6
#: Greatest standard deviation of the range over the greatest of the sets.
SPARE = 2.0
#: Prices of a saturated line, tried until few enough lines are saturated [nat].
PRICES = (0.0, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6)
#: Share of the allowed saturated lines to aim at: a set does not show its own tails well.
ENDS_AIM = 0.5
#: Lines of a log are decoded with the factors of a DBC, which has them in decimals.
ROUNDING = 1e-9
#: Lines of each set from which the blur is estimated.
BLUR_ROWS = 1000
#: Least relative improvement; smaller ones are noise of the set.
MIN_GAIN = 2e-3
#: Error of the lateral position at 80 m on a straight line, per unit of each state.
LEVERS = lateral_jacobian(np.zeros(4), np.array(80.0))


class Planner:
    """Plans for some sets and targets.

    Args:
        sets: by name.
        targets: of the design.

    Raises:
        ValueError: the ranges of the targets are too narrow for the sets.
    """

    def __init__(self, sets: Mapping[str, Gaussians], targets: Targets) -> None:
        self.targets = targets
        self._counts = [len(lines.mean) for lines in sets.values()]
        self._cov = np.concatenate([lines.cov for lines in sets.values()])
        self._weights = np.repeat(1 / np.array(self._counts), self._counts) / len(sets)
        self._sparse = [lines.cov[:: -(-len(lines.cov) // BLUR_ROWS)] for lines in sets.values()]
        own = {spec.name: spec for spec in SERVICE}
        self._own_mean = [own[name] for name in PARAMETER_SIGNALS]
        self._service = [spec for spec in SERVICE if spec.name not in PARAMETER_SIGNALS]
        ends = [2.0 ** (spec.bits - 1) * spec.factor for spec in self._own_mean]
        self._ends = self._checked(
            "ranges",
            targets.ranges,
            ends,
            np.abs(np.concatenate([lines.mean for lines in sets.values()])),
        )
        sigma = np.sqrt(np.einsum("nii->ni", self._cov))
        most = (SPARE * sigma.max(axis=0)).tolist()
        self._sigmas = self._checked("sigmas", targets.sigmas, most, sigma)
        self._spreads: dict[Any, dict[str, RatioSpread]] = {}
        self._tables: dict[Any, dict[str, list[Width]]] = {}
        self._blurs: dict[Any, float] = {}

    def _checked(
        self, what: str, given: Mapping[str, float], default: Sequence[float], values: Array
    ) -> Array:
        """Return the (4,) ends of ranges; raise if they do not include the values of the sets."""
        ends = np.array([given.get(*pair) for pair in zip(PARAMETERS, default, strict=True)])
        share = self._weights @ (values > ends * (1 + ROUNDING))
        if share.max() > self.targets.max_saturated:
            i = int(share.argmax())
            raise ValueError(
                f"{what}: {PARAMETERS[i]} of {percent(share[i])} of the lines is beyond "
                f"{ends[i]:g}, but at most {100 * self.targets.max_saturated:g} % may be; the "
                f"greatest is {values[:, i].max():.3g}; choose {PARAMETERS[i]} of {what} above it, "
                "or a greater max_saturated"
            )
        return ends

    # -- bits and signals ---------------------------------------------------------

    def room(self, frames: int) -> int:
        """Return the bits for mean and covariance in a number of frames."""
        page_bits = max(1, (frames - 1).bit_length())
        taken = page_bits * frames + TRANSFER_ID_BITS * (frames - 1)
        return 8 * PAGE_BYTES * frames - taken - sum(spec.bits for spec in self._service)

    def writer(self, plan: WidthPlan) -> DbcWriter:
        """Return the DBC of a plan, with as few pages as possible."""
        signals = [*self._mean_signals(plan), *self._covariance_signals(plan)]
        return DbcWriter(paged([*self._service[:2], *signals, *self._service[2:]]))

    def _mean_signals(self, plan: WidthPlan) -> list[SignalSpec]:
        if self.targets.keep_mean:
            return self._own_mean
        steps = self.steps(plan.mean).tolist()
        rows = zip(self._own_mean, plan.mean, steps, LEVERS, self._ends, strict=True)
        return [
            replace(
                spec,
                bits=bits,
                factor=step,
                why=f"half a step is {500 * step * lever:.2g} mm at 80 m; +-{end:g} {spec.unit}",
            )
            for spec, bits, step, lever, end in rows
        ]

    def _covariance_signals(self, plan: WidthPlan) -> Iterator[SignalSpec]:
        names = [PARAMETER_SIGNALS[i] for i in plan.order]
        for i, (pivot, ratios) in enumerate(names_of(plan.order)):
            width, given = plan.fields[pivot], tuple(names[:i])
            yield pivot_signal(names[i], given, width.bits, width.factor, width.offset)
            for column, ratio in zip(names[:i], ratios, strict=True):
                width = plan.fields[ratio]
                why = "range of the set"
                if width.beyond:
                    why = f"range of all but {100 * width.beyond:.1g} % of the set"
                yield ratio_signal(names[i], column, width.bits, width.factor, width.zero, why)
        width = plan.fields[INFLATION]
        step, most = (100 * (2**octaves - 1) for octaves in (width.factor, width.end))
        why = f"steps of {step:.2g} % of the variance; up to {most:.2g} %, what the rounding needs"
        spec = cholesky_signals.INFLATION
        yield replace(spec, bits=width.bits, factor=width.factor, why=why)

    def steps(self, bits: Sequence[int]) -> Array:
        """Return the (4,) steps of the mean."""
        return np.asarray(2 * self._ends / 2.0 ** np.array(bits))

    # -- predictions --------------------------------------------------------------

    def blur(self, bits: Sequence[int]) -> float:
        """Return the blur by the mean's grid: median of each set, averaged over sets [nat]."""
        key = tuple(bits)
        if key not in self._blurs:
            F = self.steps(bits) ** 2 / 12
            self._blurs[key] = float(np.mean([np.median(blurs(cov, F)) for cov in self._sparse]))
        return self._blurs[key]

    def lateral_error(self, bits: Sequence[int]) -> float:
        """Return the largest effect of the mean's rounding on the position at 80 m [m]."""
        return float(self.steps(bits) / 2 @ LEVERS)

    def predicted(self, plan: WidthPlan) -> Prediction:
        """Return the figures of a plan."""
        kl = conservative(*plan.steps, plan.fields[INFLATION])
        _, ratios = rows_of(*self._target(plan.mean), plan.order)
        beyond = np.zeros(len(self._cov), dtype=bool)
        for i, (_, row) in enumerate(names_of(plan.order)):
            for j, name in enumerate(row):
                width, values = plan.fields[name], ratios[:, i, j]
                half = width.factor / 2
                beyond |= (values < width.offset - half) | (values > width.end + half)
        of_sets = np.split(beyond, np.cumsum(self._counts)[:-1])
        return Prediction(
            kl_mean=float(kl.mean()) + sum(width.beyond_loss for width in plan.fields.values()),
            kl_p99=float(np.quantile(kl, 0.99)),
            saturated=max(float(of_set.mean()) for of_set in of_sets),
            lateral_error=self.lateral_error(plan.mean),
            blur=self.blur(plan.mean),
        )

    def loss(self, plan: WidthPlan) -> float:
        """Return the divergence plus the price of saturated lines, without the blur [nat]."""
        kl = float(conservative(*plan.steps, plan.fields[INFLATION]).mean())
        widths = plan.fields.values()
        return kl + sum(width.beyond_loss + plan.price * width.beyond for width in widths)

    def _target(self, bits: Sequence[int]) -> tuple[Array, Array]:
        F = self.steps(bits) ** 2 / 12
        return self._cov + np.diag(F), F

    def _spread(self, order: tuple[int, ...], bits: tuple[int, ...]) -> dict[str, RatioSpread]:
        if (order, bits) not in self._spreads:
            _, ratios = rows_of(*self._target(bits), order)
            self._spreads[order, bits] = {
                name: RatioSpread(ratios[:, i, j], self._weights)
                for i, (_, row) in enumerate(names_of(order))
                for j, name in enumerate(row)
            }
        return self._spreads[order, bits]

    def _widths(
        self, order: tuple[int, ...], bits: tuple[int, ...], price: float
    ) -> dict[str, list[Width]]:
        """Return the best width of MIN_BITS, MIN_BITS + 1, ... bits of each pivot and ratio."""
        key = (order, bits, price)
        if key not in self._tables:
            spreads = self._spread(order, bits)
            tables = {name: spread.widths(price) for name, spread in spreads.items()}
            # No target is thinner than the grid of the mean.
            low = np.floor(2 * np.log2(self.steps(bits) / np.sqrt(12))) / 2
            for row, (pivot, _) in zip(order, names_of(order), strict=True):
                tables[pivot] = pivot_widths(float(low[row]), float(np.log2(self._sigmas[row])))
            self._tables[key] = tables
        return self._tables[key]

    # -- plans --------------------------------------------------------------------

    @property
    def least_bits(self) -> int:
        """Fewest bits of mean and covariance of any plan."""
        return sum(self._least_mean()) + 10 * MIN_BITS + FIRST_INFLATION.bits

    def plans(self, room: int) -> list[WidthPlan]:
        """Return plans of the best orders of the rows in a number of bits, the best first.

        The price rises until the best plan saturates few enough lines.
        """
        plans: list[WidthPlan] = []
        for price in PRICES:
            mean = self._mean_for(room, price)
            filled = [self._filled(order, mean, room, price) for order in permutations(range(4))]
            found = sorted(
                (plan for plan in filled if plan is not None),
                key=lambda plan: sum(width.loss for width in plan.fields.values()),
            )
            plans = sorted((plan.changed() for plan in found[:PROMISING]), key=self.loss)
            if not plans:
                break
            if self.predicted(plans[0]).saturated <= ENDS_AIM * self.targets.max_saturated:
                break
        return plans

    def _filled(
        self, order: tuple[int, ...], mean: tuple[int, ...], room: int, price: float
    ) -> WidthPlan | None:
        """Return the best plan of an order and a mean, with a first inflation; None if too big."""
        left = room - sum(mean) - FIRST_INFLATION.bits
        chosen = allocated(self._widths(order, mean, price), left)
        if chosen is None:
            return None
        return WidthPlan(order, mean, {**chosen, INFLATION: FIRST_INFLATION}, price)

    def _mean_for(self, room: int, price: float) -> tuple[int, ...]:
        """Return the bits of the mean: a bit goes there as long as the covariance gains less."""
        bits = tuple(self._least_mean())
        if self.targets.keep_mean:
            return bits
        order = tuple(map(PARAMETER_SIGNALS.index, ORDER))
        while True:
            tables = self._widths(order, bits, price)
            finer = [tuple(b + (i == k) for i, b in enumerate(bits)) for k in range(4)]
            finer = [other for other in finer if max(other) <= MEAN_BITS[1]]
            if not finer:
                return bits
            other = min(finer, key=self.blur)
            left = room - sum(bits) - FIRST_INFLATION.bits
            now, then = allocated(tables, left), allocated(tables, left - 1)
            if now is None or then is None:
                return bits
            paid = sum(then[name].loss - now[name].loss for name in now)
            if self.blur(bits) - self.blur(other) <= paid:
                return bits
            bits = other

    def _least_mean(self) -> list[int]:
        """Return the bits of the mean that meet max_lateral, a quarter of it for each state."""
        if self.targets.keep_mean:
            return [spec.bits for spec in self._own_mean]
        steps = self.targets.max_lateral / 2 / LEVERS
        bits = np.ceil(np.log2(2 * self._ends / steps) - 1e-9).astype(int)
        return bits.clip(*MEAN_BITS).tolist()

    def shifted(self, plan: WidthPlan) -> WidthPlan:
        """Move bits between fields of the covariance as long as the loss decreases."""
        loss = self.loss(plan)
        while True:
            moves = [
                move
                for giver in plan.fields
                for less in self._with_bits(plan, giver, -1)
                for taker in plan.fields
                if taker != giver
                for move in self._with_bits(less, taker, 1)
            ]
            losses = [self.loss(move) for move in moves]
            if min(losses, default=np.inf) > loss * (1 - MIN_GAIN):
                return plan
            best = int(np.argmin(losses))
            plan, loss = moves[best], losses[best]

    def _with_bits(self, plan: WidthPlan, name: str, more: int) -> Iterator[WidthPlan]:
        """Yield the plan with more bits in one field, if that width exists."""
        bits = plan.fields[name].bits + more
        if name == INFLATION:
            if bits in INFLATION_BITS:
                yield plan.changed(Inflation=replace(plan.fields[name], bits=bits))
        else:
            table = self._widths(plan.order, plan.mean, plan.price)[name]
            if 0 <= bits - MIN_BITS < len(table):
                yield plan.changed(**{name: table[bits - MIN_BITS]})

    def neighbours(self, plan: WidthPlan) -> Iterator[WidthPlan]:
        """Yield plans with another range, or with a bit moved between mean and covariance."""
        spreads = self._spread(plan.order, plan.mean)
        for name, spread in spreads.items():
            width = plan.fields[name]
            for times, shift in ((0.5, 0), (2, 0), (1, -1), (1, 1)):
                eighths = round(8 * width.zero) + shift
                if 1 <= eighths <= 7:
                    factor = times * width.factor
                    other = spread.width(width.bits, factor, eighths / 8, plan.price)
                    if other.loss < np.inf:
                        yield plan.changed(**{name: other})
        if self.targets.keep_mean:
            return
        for i in range(4):
            for more in (1, -1):
                bits = tuple(b + more * (k == i) for k, b in enumerate(plan.mean))
                others = [p for name in plan.fields for p in self._with_bits(plan, name, -more)]
                if others and MEAN_BITS[0] <= bits[i] <= MEAN_BITS[1]:
                    best = replace(min(others, key=self.loss), mean=bits)
                    tables = self._widths(best.order, bits, best.price)
                    pivots = {
                        name: tables[name][best.fields[name].bits - MIN_BITS]
                        for name, _ in names_of(best.order)
                    }
                    yield best.changed(**pivots)


def allocated(tables: Mapping[str, list[Width]], bits: int) -> dict[str, Width] | None:
    """Distribute bits over fields, each to where it reduces the loss most; None if too few.

    One step gives one bit or two: a range that is too narrow for the set may need both at once.
    """
    place = dict.fromkeys(tables, 0)
    left = bits - MIN_BITS * len(tables)
    if left < 0:
        return None
    while left:
        best = (0.0, "", 0)
        for name, table in tables.items():
            for more in range(1, min(left, 2, len(table) - 1 - place[name]) + 1):
                gain = (table[place[name]].loss - table[place[name] + more].loss) / more
                best = max(best, (gain, name, more))
        if not best[2]:
            break
        place[best[1]] += best[2]
        left -= best[2]
    return {name: table[place[name]] for name, table in tables.items()}
