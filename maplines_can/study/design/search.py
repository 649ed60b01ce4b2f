"""Search for the widths, factors and row order of a message layout that meets a target.

The first step uses the sensitivities (``planner``): the best widths for each order of the rows.
The second step measures: the best orders go through their DBC and the codec on the sets, and the
best of them is improved by one range or one bit at a time, as long as that helps. The reported
figures come from lines that the search has not seen.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...generation.dbc.dbc_writer import DbcWriter, write_dbc
from ...values.coding_loss import LATERAL_X, evaluate
from ...values.errors import LayoutError
from ...values.line import Status
from ...values.text_table import aligned, markdown, percent
from ...wire import Codec
from ...wire.layout.record_signals import PARAMETER_SIGNALS
from ..sets import Gaussians, paper, road, survey
from .planner import ENDS_AIM, MAX_FRAMES, MIN_GAIN, PRICES, Planner, Prediction, Targets, WidthPlan


@dataclass(frozen=True)
class LayoutFigures:
    """Figures of a message layout on a set."""

    cases: int
    kl_mean: float  #: of the covered target, with the inflation [nat]
    kl_p99: float
    kl_max: float
    kl_untouched_mean: float  #: of the true covariance, which the mean's grid blurs [nat]
    kl_untouched_median: float
    saturated: float  #: share of lines
    out_of_range: float  #: share of lines
    not_definite: int
    overconfident: int
    lateral_error: float  #: largest at 80 m [m]


@dataclass(frozen=True, eq=False)
class Design:
    """A message layout and its figures."""

    writer: DbcWriter
    targets: Targets
    order: tuple[str, ...]  #: rows of the covariance, as signals of the mean
    mean_bits: int
    covariance_bits: int
    spare_bits: int  #: of no signal
    predicted: Prediction
    measured: Mapping[str, LayoutFigures]  #: by set, of lines that the search has not seen

    @property
    def frames(self) -> int:
        """Number of classic frames of a line."""
        return len(self.writer.pages)

    @property
    def _bits(self) -> str:
        return (
            f"{self.mean_bits} bits of mean, {self.covariance_bits} of covariance, "
            f"{self.spare_bits} spare"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return all figures and all fields, for JSON."""
        fields = [
            {"name": spec.name, "page": page, "bits": spec.bits, "factor": spec.factor}
            | {"offset": spec.offset, "signed": spec.signed}
            for page, specs in enumerate(self.writer.pages)
            for spec in specs
        ]
        return {
            "targets": asdict(self.targets),
            "frames": self.frames,
            "order": list(self.order),
            "mean_bits": self.mean_bits,
            "covariance_bits": self.covariance_bits,
            "spare_bits": self.spare_bits,
            "predicted": asdict(self.predicted),
            "measured": {name: asdict(figures) for name, figures in self.measured.items()},
            "fields": fields,
        }

    def text(self) -> str:
        """Return bits, figures and fields for a terminal."""
        lines = [
            f"{self.frames} classic frames: {self._bits}",
            f"rows of the covariance: {', '.join(self.order)}",
            "",
            aligned(self._figures(), left=1),
            "",
        ]
        for spec in chain(*self.writer.pages):
            if spec.name.startswith(("Pivot", "Ratio", "Inflation", *PARAMETER_SIGNALS)):
                low, high = spec.range
                lines.append(
                    f"{spec.name:<14}{spec.bits:>3} bits{spec.factor:>13.6g}  "
                    f"{low:.6g} .. {high:.6g} {spec.unit}".rstrip()
                )
        return "\n".join(lines)

    def page(self, name: str, command: str = "") -> str:
        """Return the page for the DBC, in Markdown.

        Args:
            name: of the DBC's file.
            command: that made it.
        """
        made_by = f"Made by\n\n    {command}\n\n" if command else ""
        targets = "\n".join(f"- {text}" for text in self._targets_text())
        return (
            f"# {name}\n\n"
            f"A map line in {self.frames} classic CAN frames: {self._bits}. Rows of the "
            f"covariance: {', '.join(self.order)}. The README of dbc/ explains how the fields "
            f"represent a Gaussian, and the other signals.\n\n{made_by}"
            f"## Targets\n\n{targets}\n\n"
            f"## Figures\n\n{markdown(self._figures())}\n"
            f"## Fields\n\n{self.writer.table()}\n"
        )

    def _targets_text(self) -> list[str]:
        t = self.targets
        texts = [
            (t.frames, f"{t.frames} classic frames"),
            (t.max_kl, f"KL of the covered target, mean over each set: {t.max_kl} nat at most"),
            (t.ranges, "ranges: " + ", ".join(f"{k} +-{v:g}" for k, v in t.ranges.items())),
            (t.sigmas, "sigmas up to " + ", ".join(f"{k} {v:g}" for k, v in t.sigmas.items())),
            (t.keep_mean, "the mean as in the project's own DBC"),
            (True, f"rounding of the mean at 80 m: {1000 * t.max_lateral:g} mm at most"),
            (True, f"saturated lines: {100 * t.max_saturated:g} % at most"),
        ]
        return [text for given, text in texts if given]

    def _figures(self) -> list[list[str]]:
        p = self.predicted
        blurred = "KL with the blur by the mean's grid, median"
        number = "{:.3g}".format
        #: Heading, predicted text, name of the measured figure, and its format.
        rows: list[tuple[str, str, str, Callable[[float], str]]] = [
            ("lines", "-", "cases", str),
            ("KL, mean", number(p.kl_mean), "kl_mean", number),
            ("KL, 99 %", number(p.kl_p99), "kl_p99", number),
            ("KL, worst", "-", "kl_max", number),
            (blurred, number(p.kl_mean + p.blur), "kl_untouched_median", number),
            ("saturated lines", percent(p.saturated), "saturated", percent),
            ("lines out of range", "-", "out_of_range", percent),
            (
                "worst lateral error at 80 m [mm]",
                number(1000 * p.lateral_error),
                "lateral_error",
                lambda length: number(1000 * length),
            ),
            ("not definite", "0", "not_definite", str),
            ("overconfident", "0", "overconfident", str),
        ]
        return [["", "predicted", *(f"measured: {name}" for name in self.measured)]] + [
            [heading, predicted, *(text(getattr(f, name)) for f in self.measured.values())]
            for heading, predicted, name, text in rows
        ]

    def write(self, path: str | Path, command: str = "") -> tuple[Path, Path]:
        """Write the DBC, and its page with the same name and the suffix ``.md``."""
        return write_dbc(self.writer, path, lambda name: self.page(name, command))


# ---- the search ---------------------------------------------------------------------------------

#: Sets of lines to design for, by the name of the choice.
SETS = {"paper": (paper,), "road": (road,), "survey": (survey,), "both": (paper, road)}
#: Fewer lines do not represent a set.
MIN_LINES = 100
#: Number of orders of the rows that are measured.
MEASURED = 3
#: Fraction of the requested divergence to aim at, since the held-out lines are others.
AIM = 0.97
#: Ratio of divergences above which further improvements cannot reach the target.
HOPELESS = 1.25
#: Most bits left unused if the fields cannot be divided into full pages.
CUTTINGS = 6


def sets_of(choice: str, n: int, seed: int = 0) -> dict[str, Gaussians]:
    """Return the sets of a choice of ``SETS``, with n lines each.

    Raises:
        ValueError: there is no such choice.
    """
    if choice not in SETS:
        raise ValueError(f"set must be one of {', '.join(SETS)}, got {choice!r}")
    return {make.__name__: make(n, seed) for make in SETS[choice]}


def design(
    sets: Mapping[str, Gaussians],
    targets: Targets,
    *,
    held_out: Mapping[str, Gaussians] | None = None,
    progress: Callable[[float, float], object] | None = None,
) -> Design:
    """Design the message layout that meets the targets on some sets of lines.

    Given ``frames`` alone, fill them; given ``max_kl``, use as few bits as possible. The same
    sets and targets give the same design.

    Args:
        sets: by name, with equal weights. Each needs some thousand lines to show its tails.
        targets: of the design.
        held_out: lines of the same kinds for the reported figures; by default every other line
            of the sets, which the search does not use.
        progress: called with the work done and the total.

    Raises:
        ValueError: the targets cannot be met; the message says which ones can.
    """
    if held_out is None:
        held_out = {name: Gaussians(s.mean[1::2], s.cov[1::2]) for name, s in sets.items()}
        sets = {name: Gaussians(s.mean[::2], s.cov[::2]) for name, s in sets.items()}
    for name, lines in (*sets.items(), *held_out.items()):
        if len(lines.mean) < MIN_LINES:
            raise ValueError(
                f"sets must have {MIN_LINES} lines or more for the search, and as many for the "
                f"figures (every other line of a set, if no others are given), but {name} has "
                f"{len(lines.mean)} for one of them; give a set of more lines"
            )
    if not sets:
        raise ValueError("there must be a set of lines")
    left = 1.0

    def step() -> None:
        """Report progress; each step is 2 % of the rest, since their number is unknown."""
        nonlocal left
        left *= 0.98
        if progress is not None:
            progress(1 - left, 1.0)

    search = _Search(sets, targets, step)
    if targets.max_kl is None:
        plan = search.best_in(targets.frames or MAX_FRAMES).plan
    else:
        plan = search.least(targets.max_kl)
    planner = search.planner
    writer = planner.writer(plan)
    codec = Codec(writer.layout(1))  # all slots are alike
    result = Design(
        writer=writer,
        targets=targets,
        order=tuple(PARAMETER_SIGNALS[i] for i in plan.order),
        mean_bits=sum(plan.mean),
        covariance_bits=sum(width.bits for width in plan.fields.values()),
        spare_bits=planner.room(len(writer.pages)) - plan.bits,
        predicted=planner.predicted(plan),
        measured={name: figures_of(codec, lines) for name, lines in held_out.items()},
    )
    if progress is not None:
        progress(1.0, 1.0)
    return result


def figures_of(codec: Codec, lines: Gaussians) -> LayoutFigures:
    """Encode and decode lines, and return the figures; OUT_OF_RANGE lines are only counted."""
    batch = codec.batch.decode(codec.batch.encode(lines.mean, lines.cov))
    figures = evaluate(lines.mean, lines.cov, batch.mean, batch.cov, codec.resolution)
    in_range = batch.status != Status.OUT_OF_RANGE
    lateral_error = np.abs(figures.lateral_error[:, LATERAL_X.index(80.0)])
    kl, untouched, error = (
        values[in_range] if in_range.any() else np.array([np.inf])
        for values in (figures.kl_covered, figures.kl, lateral_error)
    )
    return LayoutFigures(
        cases=len(lines.mean),
        kl_mean=float(kl.mean()),
        kl_p99=float(np.quantile(kl, 0.99)),
        kl_max=float(kl.max()),
        kl_untouched_mean=float(untouched.mean()),
        kl_untouched_median=float(np.median(untouched)),
        saturated=float((batch.status == Status.SATURATED).mean()),
        out_of_range=float((~in_range).mean()),
        not_definite=int((~figures.positive_definite).sum()),
        overconfident=int((figures.overconfident & in_range).sum()),
        lateral_error=float(error.max()),
    )


class _Found(NamedTuple):
    """A plan that was measured."""

    loss: float  #: with the blur and the price of lines out of range [nat]
    kl: float  #: largest mean of the sets; infinite if too many lines are saturated [nat]
    plan: WidthPlan


class _Search:
    """Search that measures plans and improves the best one; ``step`` is called for each plan."""

    def __init__(
        self, sets: Mapping[str, Gaussians], targets: Targets, step: Callable[[], None]
    ) -> None:
        self.planner, self._step = Planner(sets, targets), step
        self._sets, self._targets = sets, targets

    def least(self, max_kl: float) -> WidthPlan:
        """Return the plan with the fewest bits that meets the divergence."""
        cap, enough = self._targets.frames or MAX_FRAMES, AIM * max_kl
        few = range(1, cap)
        frames = bisect_left(few, -enough, key=lambda n: -self._predicted(self.planner.room(n))) + 1
        while (best := self.best_in(frames, enough)).kl > max_kl and frames < cap:
            frames += 1
        if best.kl > max_kl:
            reached = (
                f"{best.kl:.2g}" if best.kl < np.inf else "none, as too many lines are saturated"
            )
            raise ValueError(
                f"max_kl: {max_kl:g} cannot be reached in {cap} frames, which reach {reached}; "
                "allow more frames or a greater divergence"
            )
        rooms = range(self.planner.least_bits, best.plan.bits)
        place = bisect_left(rooms, -enough, key=lambda room: -self._predicted(room))
        found = None
        while found is None and place < len(rooms):
            found, place = self._enough(rooms[place], enough), place + 1
        if found is None:
            return best.plan
        place -= 1
        while place and (less := self._enough(rooms[place - 1], enough)) is not None:
            found, place = less, place - 1
        return found

    def _enough(self, room: int, enough: float) -> WidthPlan | None:
        """Return a plan in a number of bits that meets the divergence, if one is found."""
        frames = next(n for n in range(1, MAX_FRAMES + 1) if self.planner.room(n) >= room)
        found = self._best(room, frames, enough)
        return found.plan if found is not None and found.kl <= enough else None

    def _predicted(self, room: int) -> float:
        plans = self.planner.plans(room)
        self._step()
        return self.planner.predicted(plans[0]).kl_mean if plans else np.inf

    def best_in(self, frames: int, enough: float = 0.0) -> _Found:
        """Return the best plan that fills the frames, or the first one that is good enough.

        Raises:
            ValueError: the frames are too few.
        """
        room = self.planner.room(frames)
        if room < self.planner.least_bits:
            raise ValueError(
                f"frames: {frames} leave {max(room, 0)} bits for mean and covariance, which need "
                f"{self.planner.least_bits} or more; allow more frames, a greater lateral error or "
                "narrower ranges"
            )
        for left_over in range(CUTTINGS):
            found = self._best(room - left_over, frames, enough)
            if found is not None:
                return found
        raise ValueError(
            f"frames: no widths in {frames} frames suit all lines of the sets; allow more frames, "
            "or more saturated lines"
        )

    def _best(self, room: int, frames: int, enough: float) -> _Found | None:
        """Return the plan of least loss, or the first with a divergence of at most ``enough``.

        Return None if no plan can be sent.
        """
        plans = [self.planner.shifted(plan) for plan in self.planner.plans(room)[:MEASURED]]
        found = [found for plan in plans if (found := self._measured(plan, frames)) is not None]
        best = min(found, key=lambda found: found.loss, default=None)
        if best is not None and enough and best.kl > HOPELESS * enough:
            return best
        while best is not None and best.kl > enough:
            for plan in self.planner.neighbours(best.plan):
                other = self._measured(plan, frames)
                if other is not None and other.loss < best.loss * (1 - MIN_GAIN):
                    best = other
                    break
            else:
                break
        return best

    def _measured(self, plan: WidthPlan, frames: int) -> _Found | None:
        self._step()
        if self.planner.lateral_error(plan.mean) > self._targets.max_lateral:
            return None
        writer = self.planner.writer(plan)
        if len(writer.pages) > frames:
            return None
        try:
            codec = Codec(writer.layout(1))  # all slots are alike
        except LayoutError:  # the range of its ratios exceeds double precision
            return None
        figures = [figures_of(codec, lines) for lines in self._sets.values()]
        most = self._targets.max_saturated
        saturated, lost = max(f.saturated for f in figures), max(f.out_of_range for f in figures)
        unseen = sum(width.unseen_loss for width in plan.fields.values())
        loss = float(np.mean([f.kl_mean for f in figures])) + unseen + self.planner.blur(plan.mean)
        loss += PRICES[-1] * (max(0.0, saturated - ENDS_AIM * most) + lost)
        kl = max(f.kl_mean for f in figures)
        return _Found(loss, kl if saturated + lost <= most else np.inf, plan)
