"""A wire to order: widths, factors and the order of the rows for sets of lines and a target.

First by the sensitivities (``wire_plan``): the best widths for each order of the rows. Then by the
measured merit: the best orders go through their DBC and the codec over the sets, and the best of
them is improved, a range or a bit at a time, for as long as that helps. The figures that are told
come from lines that the search has not seen.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import LayoutError
from ...line import Slot, Status
from ...wire import Codec, Layout
from ...wire.message.signals import STATE_SIGNALS
from ..dbc.dbc_writer import DbcWriter
from ..metrics import LATERAL_X, evaluate
from ..sets import Gaussians, paper, road
from .wire_plan import (
    ENDS_AIM,
    LEAST_GAIN,
    MOST_FRAMES,
    PRICES,
    Plan,
    Planner,
    Prediction,
    Targets,
)

__all__ = ["SETS", "Design", "Figures", "Targets", "design", "figures_of", "sets_of"]

#: Sets of lines that a wire can be made for, by the name of the choice.
SETS = {"paper": (paper,), "road": (road,), "both": (paper, road)}
#: Orders of the rows that are measured.
MEASURED = 3
#: A divergence that is asked for is aimed at with this: the lines to come are others.
AIM = 0.97
#: What the last improvements never make up for.
HOPELESS = 1.25
#: Bits that may be left over where the fields cannot be cut into full pages.
CUTTINGS = 6


@dataclass(frozen=True)
class Figures:
    """What a wire makes of a set."""

    cases: int
    kl_mean: float  #: of the covered target, with the inflation [nat]
    kl_p99: float
    kl_max: float
    kl_untouched_mean: float  #: of the covariance as it is, which the mean's grid blurs [nat]
    kl_untouched_median: float
    saturated: float  #: share of lines
    out_of_range: float  #: share of lines
    not_definite: int
    overconfident: int
    lateral_error: float  #: worst at 80 m [m]


@dataclass(frozen=True, eq=False)
class Design:
    """A wire, and how good it is."""

    writer: DbcWriter
    targets: Targets
    order: tuple[str, ...]  #: rows of the covariance, as signals of the mean
    mean_bits: int
    covariance_bits: int
    spare_bits: int  #: that no signal uses
    predicted: Prediction
    measured: Mapping[str, Figures]  #: by set, of lines that the search has not seen

    @property
    def frames(self) -> int:
        """Classic frames of a line."""
        return len(self.writer.pages)

    def as_dict(self) -> dict[str, Any]:
        """All figures and all fields, for JSON."""
        fields = [
            {"name": spec.name, "page": page, "bits": spec.bits, "factor": spec.factor}
            | {"offset": spec.offset, "signed": spec.signed}
            for page, specs in enumerate(self.writer.pages)
            for spec in specs
        ]
        targets = asdict(self.targets)
        return {
            "targets": targets,
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
        """What it is and how good, for a terminal."""
        lines = [
            f"{self.frames} classic frames: {self.mean_bits} bits of mean, "
            f"{self.covariance_bits} of covariance, {self.spare_bits} spare",
            f"rows of the covariance: {', '.join(self.order)}",
            "",
        ]
        rows = self._figures()
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        for what, *values in rows:
            cells = [v.rjust(w) for v, w in zip(values, widths[1:], strict=True)]
            lines.append("  ".join([what.ljust(widths[0]), *cells]))
        lines.append("")
        for spec in chain(*self.writer.pages):
            if spec.name in STATE_SIGNALS or spec.name.startswith(("Pivot", "Ratio", "Inflation")):
                low, high = spec.range
                lines.append(
                    f"{spec.name:<14}{spec.bits:>3} bits{spec.factor:>13.6g}  "
                    f"{low:.6g} .. {high:.6g} {spec.unit}".rstrip()
                )
        return "\n".join(lines)

    def page(self, name: str, command: str = "") -> str:
        """The page beside the DBC, in Markdown.

        Args:
            name: of the DBC's file.
            command: that made it.
        """
        lines = [
            f"# {name}",
            "",
            f"A map line in {self.frames} classic CAN frames: {self.mean_bits} bits of mean, "
            f"{self.covariance_bits} of covariance, {self.spare_bits} spare. Rows of the "
            f"covariance: {', '.join(self.order)}. How the fields become a Gaussian, and what the "
            "others mean, is told in the README of dbc/.",
            "",
        ]
        if command:
            lines += ["Made by", "", f"    {command}", ""]
        lines += ["## Targets", "", *(f"- {text}" for text in self._targets_text()), ""]
        lines += ["## Figures", "", *self._figures_table(), "", "## Fields", ""]
        return "\n".join([*lines, self.writer.table(), ""])

    def _targets_text(self) -> list[str]:
        t = self.targets
        said = [
            (t.frames, f"{t.frames} classic frames"),
            (t.max_kl, f"divergence of the covered target, mean over each set: {t.max_kl} at most"),
            (t.ranges, "ranges: " + ", ".join(f"{k} +-{v:g}" for k, v in t.ranges.items())),
            (t.sigmas, "sigmas up to " + ", ".join(f"{k} {v:g}" for k, v in t.sigmas.items())),
            (t.keep_mean, "the mean as in the project's own DBC"),
            (True, f"rounding of the mean at 80 m: {1000 * t.max_lateral:g} mm at most"),
            (True, f"lines that meet the end of a range: {100 * t.max_saturated:g} % at most"),
        ]
        return [text for asked, text in said if asked]

    def _figures_table(self) -> list[str]:
        head, *rows = [f"| {' | '.join(row)} |" for row in self._figures()]
        return [head, "|---" * (2 + len(self.measured)) + "|", *rows]

    def _figures(self) -> list[list[str]]:
        p, measured = self.predicted, self.measured.values()
        share, small = "{:.2g} %".format, "{:.3g}".format
        return [
            ["", "predicted", *(f"measured: {name}" for name in self.measured)],
            ["lines", "-", *(f"{f.cases}" for f in measured)],
            ["KL, mean", small(p.kl_mean), *(small(f.kl_mean) for f in measured)],
            ["KL, 99 %", small(p.kl_p99), *(small(f.kl_p99) for f in measured)],
            ["KL, worst", "-", *(small(f.kl_max) for f in measured)],
            [
                "KL with what the grid of the mean blurs, median",
                small(p.kl_mean + p.blur),
                *(small(f.kl_untouched_median) for f in measured),
            ],
            [
                "lines that meet the end of a range",
                share(100 * p.saturated),
                *(share(100 * f.saturated) for f in measured),
            ],
            ["lines out of range", "-", *(share(100 * f.out_of_range) for f in measured)],
            [
                "worst lateral error at 80 m [mm]",
                small(1000 * p.lateral_error),
                *(small(1000 * f.lateral_error) for f in measured),
            ],
            ["not definite", "0", *(f"{f.not_definite}" for f in measured)],
            ["overconfident", "0", *(f"{f.overconfident}" for f in measured)],
        ]

    def write(self, path: str | Path, command: str = "") -> tuple[Path, Path]:
        """Write the DBC and the page beside it, with the same name and the suffix ``.md``."""
        dbc = Path(path).with_suffix(".dbc")
        page = dbc.with_suffix(".md")
        dbc.write_text(self.writer.dbc())
        page.write_text(self.page(dbc.name, command))
        return dbc, page


def sets_of(choice: str, n: int, seed: int = 0) -> dict[str, Gaussians]:
    """The sets of a choice of ``SETS``, with n lines each.

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
    """The wire that meets the targets on some sets of lines.

    Given ``frames`` alone it fills them; given ``max_kl`` it takes as few bits as reach it. The
    same sets and targets give the same wire.

    Args:
        sets: by name; each counts alike. Some thousand lines each, or their tails tell nothing.
        targets: what it is to do.
        held_out: lines of the same kinds, for the figures that are told; by default every other
            line of the sets, which the search then does without.
        progress: called with how much is done, and of how much.

    Raises:
        ValueError: the targets cannot be met; the message says what can.
    """
    if held_out is None:
        held_out = {name: Gaussians(s.mean[1::2], s.cov[1::2]) for name, s in sets.items()}
        sets = {name: Gaussians(s.mean[::2], s.cov[::2]) for name, s in sets.items()}
    if not sets or any(len(s.mean) < LEAST_LINES for s in (*sets.values(), *held_out.values())):
        raise ValueError(f"sets must have {LEAST_LINES} lines or more to search with, and to judge")
    search = _Search(sets, targets, _Progress(progress))
    plan = search.full() if targets.max_kl is None else search.least()
    writer = search.planner.writer(plan)
    codec = _codec(writer)
    covariance_bits = sum(width.bits for width in plan.fields.values())
    result = Design(
        writer=writer,
        targets=targets,
        order=tuple(STATE_SIGNALS[i] for i in plan.order),
        mean_bits=sum(plan.mean),
        covariance_bits=covariance_bits,
        spare_bits=search.planner.room(len(writer.pages)) - plan.bits,
        predicted=search.planner.predicted(plan),
        measured={name: figures_of(codec, lines) for name, lines in held_out.items()},
    )
    search.progress.end()
    return result


#: Fewer lines than this tell nothing of a set.
LEAST_LINES = 100


def figures_of(codec: Codec, lines: Gaussians) -> Figures:
    """What a codec makes of lines; those that say OUT_OF_RANGE count as that and nothing else."""
    batch = codec.decode_batch(codec.encode_batch(lines.mean, lines.cov))
    verdict = evaluate(lines.mean, lines.cov, batch.mean, batch.cov, codec.resolution)
    stated = batch.status != Status.OUT_OF_RANGE
    none = np.array([np.inf])
    kl, untouched, error = (
        values[stated] if stated.any() else none
        for values in (
            verdict.kl_covered,
            verdict.kl,
            np.abs(verdict.lateral_error[:, LATERAL_X.index(80.0)]),
        )
    )
    return Figures(
        cases=len(lines.mean),
        kl_mean=float(kl.mean()),
        kl_p99=float(np.quantile(kl, 0.99)),
        kl_max=float(kl.max()),
        kl_untouched_mean=float(untouched.mean()),
        kl_untouched_median=float(np.median(untouched)),
        saturated=float((batch.status == Status.SATURATED).mean()),
        out_of_range=float((~stated).mean()),
        not_definite=int((~verdict.positive_definite).sum()),
        overconfident=int((verdict.overconfident & stated).sum()),
        lateral_error=float(error.max()),
    )


def _codec(writer: DbcWriter) -> Codec:
    """Of one slot: all are alike, and a DBC of eight takes eight times as long to read."""
    writer = replace(writer, slots=(Slot.EGO_LEFT,))
    return Codec(Layout.from_text(writer.dbc(), "the DBC of the design"))


class _Progress:
    """Steps of a number that is not known, told as a share that nears 1."""

    def __init__(self, tell: Callable[[float, float], object] | None) -> None:
        self._tell, self._left = tell, 1.0

    def step(self) -> None:
        self._left *= 0.98
        if self._tell is not None:
            self._tell(1 - self._left, 1.0)

    def end(self) -> None:
        if self._tell is not None:
            self._tell(1.0, 1.0)


class _Found(NamedTuple):
    loss: float  #: with what the mean blurs, and the price of lines out of range [nat]
    kl: float  #: mean of the set where it is greatest; infinite if too many lines meet an end [nat]
    plan: Plan


class _Search:
    """Measures plans, and improves the best."""

    def __init__(
        self, sets: Mapping[str, Gaussians], targets: Targets, progress: _Progress
    ) -> None:
        self.planner, self.progress = Planner(sets, targets), progress
        self._sets, self._targets = sets, targets

    def full(self) -> Plan:
        """The best plan that fills the frames."""
        return self._best_in(self._targets.frames or MOST_FRAMES).plan

    def least(self) -> Plan:
        """The plan of fewest bits that meets the divergence."""
        asked = self._targets.max_kl or np.inf
        cap, enough = self._targets.frames or MOST_FRAMES, AIM * asked
        few = range(1, cap)
        frames = bisect_left(few, -enough, key=lambda n: -self._predicted(self.planner.room(n))) + 1
        while (best := self._best_in(frames, enough)).kl > asked and frames < cap:
            frames += 1
        if best.kl > asked:
            reached = (
                f"{best.kl:.2g}" if best.kl < np.inf else "none, as too many lines meet an end"
            )
            raise ValueError(
                f"max_kl: {asked:g} is not to be had in {cap} frames, which reach {reached}; "
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

    def _enough(self, room: int, enough: float) -> Plan | None:
        """A plan of so many bits with a divergence of ``enough`` or less, if one is found."""
        found = self._best(room, self._frames_of(room), enough)
        return found.plan if found is not None and found.kl <= enough else None

    def _predicted(self, room: int) -> float:
        plans = self.planner.plans(room)
        self.progress.step()
        return self.planner.predicted(plans[0]).kl_mean if plans else np.inf

    def _frames_of(self, room: int) -> int:
        frames = 1
        while self.planner.room(frames) < room:
            frames += 1
        return frames

    def _best_in(self, frames: int, enough: float = 0.0) -> _Found:
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
            f"frames: no widths of {frames} frames serve all lines of the sets; allow more frames, "
            "or more lines that meet the end of a range"
        )

    def _best(self, room: int, frames: int, enough: float = 0.0) -> _Found | None:
        """The plan of least loss in so many bits, or the first that has no more than ``enough``.

        None where no plan can be sent.
        """
        plans = [self.planner.shifted(plan) for plan in self.planner.plans(room)[:MEASURED]]
        found = [found for plan in plans if (found := self._measured(plan, frames)) is not None]
        best = min(found, key=lambda found: found.loss, default=None)
        if best is not None and enough and best.kl > HOPELESS * enough:
            return best
        while best is not None and best.kl > enough:
            for plan in self.planner.neighbours(best.plan):
                other = self._measured(plan, frames)
                if other is not None and other.loss < best.loss * (1 - LEAST_GAIN):
                    best = other
                    break
            else:
                break
        return best

    def _measured(self, plan: Plan, frames: int) -> _Found | None:
        self.progress.step()
        if self.planner.lateral_error(plan.mean) > self._targets.max_lateral:
            return None
        writer = self.planner.writer(plan)
        if len(writer.pages) > frames:
            return None
        try:
            codec = _codec(writer)
        except LayoutError:  # its ratios reach further than double precision
            return None
        figures = [figures_of(codec, lines) for lines in self._sets.values()]
        most = self._targets.max_saturated
        saturated, lost = (
            max(getattr(f, x) for f in figures) for x in ("saturated", "out_of_range")
        )
        unseen = sum(width.unseen_loss for width in plan.fields.values())
        loss = float(np.mean([f.kl_mean for f in figures])) + unseen + self.planner.blur(plan.mean)
        loss += PRICES[-1] * (max(0.0, saturated - ENDS_AIM * most) + lost)
        kl = max(f.kl_mean for f in figures)
        return _Found(loss, kl if saturated + lost <= most else np.inf, plan)
