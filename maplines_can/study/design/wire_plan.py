"""Plans of a wire: how many bits each field gets, by the sensitivities alone.

Each bit goes to the field of which it takes the most loss. The loss is the divergence of the
covered target, mean over each set, and what the mean's grid blurs, in the middle of each set; of
several sets it is the average. The middle, since where a covariance is nearly singular no grid
is fine enough.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...line import STATES, lateral_jacobian
from ...wire.message.signals import PAGE_BYTES, STATE_SIGNALS
from ..dbc.covariance_spec import covariance_signals, pivot_signal, ratio_signal
from ..dbc.dbc_writer import TRANSFER_ID_BITS, DbcWriter, SignalSpec, paged
from ..dbc.record_spec import SERVICE
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

__all__ = ["Plan", "Planner", "Prediction", "Targets"]

Array = NDArray[np.float64]

#: The longest record that a CAN FD frame carries too.
MOST_FRAMES = 8
#: Least and most bits of each number of the mean.
MEAN_BITS = (6, 40)
INFLATION = "Inflation"
INFLATION_BITS = (2, 3, 4, 5)
#: Rows of the covariance for which the mean's bits are found; other orders ask for much the same.
ORDER = ("C1", "C0", "YOff", "Beta")
#: With how many a plan begins; its factor is settled by the steps of the others.
FIRST_INFLATION = Width(3, 1.0, 0.0)
#: Orders that are looked at closely.
PROMISING = 6
#: A standard deviation may be so many times the greatest of the sets.
SPARE = 2.0
#: Prices of a line that meets the end of a range, one after the other until few enough do [nat].
PRICES = (0.0, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6)
#: Share of the allowed ones that may meet an end: the set does not know its own tails well.
ENDS_AIM = 0.5
#: Rows of each set that tell the blur.
BLUR_ROWS = 1000
#: A change is an improvement if it takes off this share: less is the set's own chance.
LEAST_GAIN = 2e-3
#: Error of the lateral position at 80 m on a straight line, of each number of the mean.
LEVERS = lateral_jacobian(np.zeros(4), np.array(80.0))


@dataclass(frozen=True)
class Targets:
    """What a wire is to do.

    Args:
        frames: classic frames of a line; None for as few as ``max_kl`` takes.
        max_kl: most divergence of the covered target, mean over each set [nat]; None for the
            least that the frames allow.
        ranges: ends of the mean's ranges by state; the others as in the project's own DBC.
        sigmas: greatest standard deviations by state; the others are twice the sets' greatest.
        keep_mean: leave the mean's widths as they are in the project's own DBC.
        max_lateral: most that the mean's rounding may do to the lateral position at 80 m of a
            straight line [m].
        max_saturated: most lines of each set that may meet the end of a range, as a share.
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
            raise ValueError("frames or max_kl must be given: how long a line may be, or how exact")
        if self.frames is not None and self.frames not in range(1, MOST_FRAMES + 1):
            raise ValueError(
                f"frames must be from 1 to {MOST_FRAMES}, as one CAN FD frame holds, "
                f"got {self.frames!r}"
            )
        for name in ("max_kl", "max_lateral", "max_saturated"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise ValueError(f"{name} must be positive, got {value!r}")
        if self.max_saturated > 1:
            raise ValueError(
                f"max_saturated must be a share, at most 1, got {self.max_saturated!r}"
            )
        for what in ("ranges", "sigmas"):
            for state, value in getattr(self, what).items():
                if state not in STATES or not 0 < value < np.inf:
                    raise ValueError(
                        f"{what} must be positive numbers of {', '.join(STATES)}, "
                        f"got {state}={value!r}"
                    )
        if self.keep_mean and self.ranges:
            raise ValueError("ranges must not be given with keep_mean, which keeps them")


@dataclass(frozen=True)
class Prediction:
    """What the sensitivities say of a plan."""

    kl_mean: float  #: of the covered target, with inflation and ends [nat]
    kl_p99: float  #: of the rounding and its inflation alone [nat]
    saturated: float  #: share of the lines of the set where it is greatest
    lateral_error: float  #: most at 80 m on a straight line [m]
    blur: float  #: in the middle of the set [nat]


@dataclass(frozen=True)
class Plan:
    """Widths of the mean and of the covariance."""

    order: tuple[int, ...]  #: rows, as indices into the mean
    mean: tuple[int, ...]  #: bits
    fields: Mapping[str, Width]  #: pivots, ratios and inflation, by signal

    @property
    def bits(self) -> int:
        """Bits of all."""
        return sum(self.mean) + sum(width.bits for width in self.fields.values())

    @property
    def steps(self) -> tuple[Array, Array]:
        """(4,) of the pivots and (6,) of the ratios, row by row."""
        pivots = [self.fields[pivot].factor for pivot, _ in names_of(self.order)]
        ratios = [self.fields[ratio].factor for _, row in names_of(self.order) for ratio in row]
        return np.array(pivots), np.array(ratios)

    def changed(self, **fields: Width) -> Plan:
        """With other widths, and the inflation that their steps ask for."""
        plan = replace(self, fields={**self.fields, **fields})
        inflation = inflation_width(plan.fields[INFLATION].bits, *plan.steps)
        return replace(plan, fields={**plan.fields, INFLATION: inflation})


def names_of(order: Sequence[int]) -> Iterator[tuple[str, list[str]]]:
    """Signals of each row: its pivot and its ratios."""
    for i, row in enumerate(order):
        name = STATE_SIGNALS[row]
        yield f"Pivot{name}", [f"Ratio{name}{STATE_SIGNALS[column]}" for column in order[:i]]


class Planner:
    """Plans for some sets and targets.

    Args:
        sets: by name.
        targets: what the wire is to do.

    Raises:
        ValueError: ranges that are asked for do not hold the sets.
    """

    def __init__(self, sets: Mapping[str, Gaussians], targets: Targets) -> None:
        self.targets = targets
        self.mean = np.concatenate([lines.mean for lines in sets.values()])
        self.cov = np.concatenate([lines.cov for lines in sets.values()])
        shares = [np.full(len(lines.mean), 1 / len(lines.mean)) for lines in sets.values()]
        self.weights = np.concatenate(shares) / len(sets)
        self._set = np.repeat(np.arange(len(sets)), [len(lines.mean) for lines in sets.values()])
        self._sparse = [lines.cov[:: -(-len(lines.cov) // BLUR_ROWS)] for lines in sets.values()]
        own = {spec.name: spec for spec in SERVICE}
        self._own_mean = [own[name] for name in STATE_SIGNALS]
        self._service = [spec for spec in SERVICE if spec.name not in STATE_SIGNALS]
        ends = [2.0 ** (spec.bits - 1) * spec.factor for spec in self._own_mean]
        self._ends = np.array(
            [targets.ranges.get(*pair) for pair in zip(STATES, ends, strict=True)]
        )
        sigma = np.sqrt(np.einsum("nii->ni", self.cov))
        most = (SPARE * sigma.max(axis=0)).tolist()
        self._sigmas = np.array(
            [targets.sigmas.get(*pair) for pair in zip(STATES, most, strict=True)]
        )
        self._price = PRICES[0]
        self._spreads: dict[Any, dict[str, RatioSpread]] = {}
        self._tables: dict[Any, dict[str, list[Width]]] = {}
        self._blurs: dict[Any, float] = {}
        self._refuse("ranges", np.abs(self.mean), self._ends)
        self._refuse("sigmas", sigma, self._sigmas)

    def _refuse(self, what: str, values: Array, ends: Array) -> None:
        share = self.weights @ (values > ends)
        if share.max() > self.targets.max_saturated:
            i = int(share.argmax())
            raise ValueError(
                f"{what}: {STATES[i]} of {100 * share[i]:.2g} % of the lines is beyond "
                f"{ends[i]:g}, and {100 * self.targets.max_saturated:g} % may be; the greatest is "
                f"{values[:, i].max():.3g}"
            )

    # -- bits and signals ---------------------------------------------------------

    def room(self, frames: int) -> int:
        """Bits that so many frames leave for the mean and the covariance."""
        page_bits = max(1, (frames - 1).bit_length())
        taken = page_bits * frames + TRANSFER_ID_BITS * (frames - 1)
        return 8 * PAGE_BYTES * frames - taken - sum(spec.bits for spec in self._service)

    def writer(self, plan: Plan) -> DbcWriter:
        """The wire of a plan, on as few pages as it fits."""
        signals = [*self._mean_signals(plan), *self._covariance_signals(plan)]
        return DbcWriter(paged([*self._service[:2], *signals, *self._service[2:]]))

    def _mean_signals(self, plan: Plan) -> list[SignalSpec]:
        if self.targets.keep_mean:
            return self._own_mean
        rows = zip(
            self._own_mean, plan.mean, self.steps(plan.mean), LEVERS, self._ends, strict=True
        )
        return [
            replace(
                spec,
                bits=bits,
                factor=float(step),
                why=f"half a step is {500 * step * lever:.2g} mm at 80 m; +-{end:g} {spec.unit}",
            )
            for spec, bits, step, lever, end in rows
        ]

    def _covariance_signals(self, plan: Plan) -> Iterator[SignalSpec]:
        names = [STATE_SIGNALS[i] for i in plan.order]
        for i, (pivot, ratios) in enumerate(names_of(plan.order)):
            width, given = plan.fields[pivot], tuple(names[:i])
            yield pivot_signal(names[i], given, width.bits, width.factor, width.offset)
            for column, ratio in zip(names[:i], ratios, strict=True):
                width = plan.fields[ratio]
                why = "as far as the set drives it"
                if width.beyond:
                    why = f"as far as all but {100 * width.beyond:.1g} % of the set drive it"
                yield ratio_signal(names[i], column, width.bits, width.factor, width.zero, why)
        width = plan.fields[INFLATION]
        (spec,) = (spec for spec in covariance_signals("Cholesky") if spec.name == INFLATION)
        step, most = (100 * (2**octaves - 1) for octaves in (width.factor, width.end))
        why = f"steps of {step:.2g} % of the variance; up to {most:.2g} %, what the rounding needs"
        yield replace(spec, bits=width.bits, factor=width.factor, why=why)

    def steps(self, bits: Sequence[int]) -> Array:
        """(4,) of the mean."""
        return np.asarray(2 * self._ends / 2.0 ** np.array(bits))

    # -- what the sensitivities say ---------------------------------------------------

    def blur(self, bits: Sequence[int]) -> float:
        """What the mean's grid blurs, in the middle of each set, on average [nat]."""
        key = tuple(bits)
        if key not in self._blurs:
            F = self.steps(bits) ** 2 / 12
            middle = [np.median(blurs(cov, F)) for cov in self._sparse]
            self._blurs[key] = float(np.mean(middle))
        return self._blurs[key]

    def lateral_error(self, bits: Sequence[int]) -> float:
        """Most that the mean's rounding does to the lateral position at 80 m [m]."""
        return float(self.steps(bits) / 2 @ LEVERS)

    def predicted(self, plan: Plan) -> Prediction:
        """What the sensitivities say of a plan."""
        kl = conservative(*plan.steps, plan.fields[INFLATION])
        _, ratios = rows_of(*self._target(plan.mean), plan.order)
        beyond = np.zeros(len(self.cov), dtype=bool)
        of_set = np.bincount(self._set)
        for i, (_, row) in enumerate(names_of(plan.order)):
            for j, name in enumerate(row):
                width, values = plan.fields[name], ratios[:, i, j]
                half = width.factor / 2
                beyond |= (values < width.offset - half) | (values > width.end + half)
        return Prediction(
            kl_mean=float(kl.mean()) + sum(width.beyond_loss for width in plan.fields.values()),
            kl_p99=float(np.quantile(kl, 0.99)),
            saturated=float((np.bincount(self._set, beyond) / of_set).max()),
            lateral_error=self.lateral_error(plan.mean),
            blur=self.blur(plan.mean),
        )

    def loss(self, plan: Plan) -> float:
        """Divergence with the price of the lines that meet an end; not what the mean blurs."""
        kl = float(conservative(*plan.steps, plan.fields[INFLATION]).mean())
        widths = plan.fields.values()
        return kl + sum(width.beyond_loss + self._price * width.beyond for width in widths)

    def _target(self, bits: Sequence[int]) -> tuple[Array, Array]:
        F = self.steps(bits) ** 2 / 12
        return self.cov + np.diag(F), F

    def _spread(self, order: tuple[int, ...], bits: tuple[int, ...]) -> dict[str, RatioSpread]:
        if (order, bits) not in self._spreads:
            _, ratios = rows_of(*self._target(bits), order)
            self._spreads[order, bits] = {
                name: RatioSpread(ratios[:, i, j], self.weights)
                for i, (_, row) in enumerate(names_of(order))
                for j, name in enumerate(row)
            }
        return self._spreads[order, bits]

    def tables(self, order: tuple[int, ...], bits: tuple[int, ...]) -> dict[str, list[Width]]:
        """Of each pivot and ratio, the best width of MIN_BITS, MIN_BITS + 1, ... bits."""
        key = (order, bits, self._price)
        if key not in self._tables:
            spreads = self._spread(order, bits)
            tables = {name: spread.widths(self._price) for name, spread in spreads.items()}
            # No target is sharper than the grid of the mean.
            low = np.floor(2 * np.log2(self.steps(bits) / np.sqrt(12))) / 2
            for row, (pivot, _) in zip(order, names_of(order), strict=True):
                tables[pivot] = pivot_widths(float(low[row]), float(np.log2(self._sigmas[row])))
            self._tables[key] = tables
        return self._tables[key]

    def ratio(self, plan: Plan, name: str, factor: float, zero: float) -> Width:
        """A ratio of a plan with another step and range."""
        spread = self._spread(plan.order, plan.mean)[name]
        return spread.width(plan.fields[name].bits, factor, zero, self._price)

    # -- plans ----------------------------------------------------------------------------

    @property
    def least_bits(self) -> int:
        """Of the mean and the covariance, below which no plan goes."""
        return sum(self._least_mean()) + 10 * MIN_BITS + FIRST_INFLATION.bits

    def plans(self, room: int) -> list[Plan]:
        """Plans of the best orders of the rows in so many bits, the best first."""
        plans: list[Plan] = []
        for self._price in PRICES:
            bits = self.mean_for(room)
            filled = [self.filled(order, bits, room) for order in permutations(range(4))]
            found = sorted((plan for plan in filled if plan is not None), key=_first_loss)
            plans = sorted((plan.changed() for plan in found[:PROMISING]), key=self.loss)
            if not plans:
                break
            if self.predicted(plans[0]).saturated <= ENDS_AIM * self.targets.max_saturated:
                break
        return plans

    def filled(self, order: tuple[int, ...], mean: tuple[int, ...], room: int) -> Plan | None:
        """The best plan of an order and a mean, but for the inflation; None if there is no room."""
        chosen = allocated(self.tables(order, mean), room - sum(mean) - FIRST_INFLATION.bits)
        return None if chosen is None else Plan(order, mean, {**chosen, INFLATION: FIRST_INFLATION})

    def mean_for(self, room: int) -> tuple[int, ...]:
        """Bits of the mean: up to where one takes no more loss there than in the covariance."""
        bits = tuple(self._least_mean())
        if self.targets.keep_mean:
            return bits
        order = tuple(map(STATE_SIGNALS.index, ORDER))
        while True:
            tables = self.tables(order, bits)
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
        """Bits of the mean that keep the lateral error, each number with a quarter of it."""
        if self.targets.keep_mean:
            return [spec.bits for spec in self._own_mean]
        steps = self.targets.max_lateral / 2 / LEVERS
        bits = np.ceil(np.log2(2 * self._ends / steps) - 1e-9).astype(int)
        return bits.clip(*MEAN_BITS).tolist()

    def shifted(self, plan: Plan) -> Plan:
        """Bits moved from field to field of the covariance for as long as the loss falls."""
        loss = self.loss(plan)
        while True:
            moves = list(self._moves(plan))
            losses = [self.loss(move) for move in moves]
            if min(losses, default=np.inf) > loss * (1 - LEAST_GAIN):
                return plan
            best = int(np.argmin(losses))
            plan, loss = moves[best], losses[best]

    def _moves(self, plan: Plan) -> Iterator[Plan]:
        for giver in plan.fields:
            for less in self._with_bits(plan, giver, -1):
                for taker in plan.fields:
                    if taker != giver:
                        yield from self._with_bits(less, taker, 1)

    def _with_bits(self, plan: Plan, name: str, more: int) -> Iterator[Plan]:
        """The plan with so many bits more in one field, if there is such a width."""
        bits = plan.fields[name].bits + more
        if name == INFLATION:
            if bits in INFLATION_BITS:
                yield plan.changed(Inflation=replace(plan.fields[name], bits=bits))
        else:
            table = self.tables(plan.order, plan.mean)[name]
            if 0 <= bits - MIN_BITS < len(table):
                yield plan.changed(**{name: table[bits - MIN_BITS]})

    def neighbours(self, plan: Plan) -> Iterator[Plan]:
        """Other ranges at the same bits, and a bit moved between the mean and the covariance."""
        for _, row in names_of(plan.order):
            for name in row:
                width = plan.fields[name]
                for times, shift in ((0.5, 0), (2, 0), (1, -1), (1, 1)):
                    eighths = round(8 * width.zero) + shift
                    if 1 <= eighths <= 7:
                        wanted = self.ratio(plan, name, times * width.factor, eighths / 8)
                        if wanted.loss < np.inf:
                            yield plan.changed(**{name: wanted})
        if self.targets.keep_mean:
            return
        for i in range(4):
            for more in (1, -1):
                bits = tuple(b + more * (k == i) for k, b in enumerate(plan.mean))
                others = [p for name in plan.fields for p in self._with_bits(plan, name, -more)]
                if others and MEAN_BITS[0] <= bits[i] <= MEAN_BITS[1]:
                    other = replace(min(others, key=self.loss), mean=bits)
                    tables = self.tables(other.order, bits)
                    pivots = {
                        name: tables[name][other.fields[name].bits - MIN_BITS]
                        for name, _ in names_of(other.order)
                    }
                    yield other.changed(**pivots)


def _first_loss(plan: Plan) -> float:
    return sum(width.loss for width in plan.fields.values())


def allocated(tables: Mapping[str, list[Width]], bits: int) -> dict[str, Width] | None:
    """Bits to fields, each to where it takes the most loss; None if they are too few.

    Looks two bits ahead: a range that does not hold the set may want both at once.
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
