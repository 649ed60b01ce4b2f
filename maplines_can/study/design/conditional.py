"""Design of the records that are conditional on the pose error, on random scenes.

The ranges of all fields stay as they are; their widths are found. From the widths of
``dbc/maplines-pose.dbc``, the field that costs least loses a bit, as long as the mean divergence of
a line allows it. All figures are measured: the scenes go through the DBC and the codec, whose
encoder chooses the levels. The decoded joint covariance is definite and covers the true one with
any widths.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import indent
from typing import Any, NamedTuple

import numpy as np

from ...generation.dbc.dbc_writer import DbcWriter, SignalSpec, write_dbc
from ...generation.dbc.record_spec import CONDITIONAL, POSE
from ...values.errors import LayoutError
from ...values.scene import Scene
from ...values.text_table import aligned
from ...wire import Codec
from ...wire.layout.record_signals import FINE, FINE_SIGNALS, OWN_SIGNALS, PARAMETER_SIGNALS
from ..scenes.carriers import with_pose
from ..scenes.random_scenes import random_scene

#: Lines of a scene.
LINES = 4
#: Least bits of a field.
MIN_BITS = 2


@dataclass(frozen=True)
class SceneFigures:
    """What some scenes lose as sent with some widths."""

    kl_mean: float  #: of the covered target of a line [nat]; infinite if a line does not fit
    kl_p99: float  #: [nat]
    all_entries: float  #: share of lines with all entries of a covariance
    joint_bits: float  #: bits of the joint covariance of a scene, mean
    mean_bits: float  #: bits of the means of a scene
    overconfident: int  #: scenes whose joint covariance is not covered
    indefinite: int  #: scenes whose joint covariance is not positive definite


class Cost(NamedTuple):
    """What a bit less in a field changes; NaN if the field cannot have fewer."""

    kl: float  #: of the mean divergence of a line [nat]
    bits: float  #: of the mean bits of a scene; positive if more lines need all entries


@dataclass(frozen=True)
class SceneDesign:
    """Widths of the Pose message and of conditional records."""

    bits: Mapping[str, int]  #: of each field
    figures: SceneFigures  #: on scenes that the search has not seen
    a_bit_less: Mapping[str, Cost]  #: of each field, at these widths

    @property
    def writer(self) -> DbcWriter:
        """Writer of the DBC."""
        return writer_of(self.bits)

    def text(self) -> str:
        """Return the figures and the fields as text."""
        f, shipped = self.figures, fields()
        rows = [
            [name, str(bits), str(shipped[name].bits), f"{cost.kl:+.1e}", f"{cost.bits:+.1f}"]
            for (name, bits), cost in zip(self.bits.items(), self.a_bit_less.values(), strict=True)
        ]
        head = ("field", "bits", "shipped", "with a bit less: KL [nat]", "bits of a scene")
        return "\n".join(
            [
                f"KL of a line: mean {f.kl_mean:.3g} nat, 99 % {f.kl_p99:.3g} nat; "
                f"{100 * f.all_entries:.0f} % of the lines with all entries",
                f"a scene of {LINES} lines: {f.joint_bits:.0f} bits of the joint covariance, "
                f"{f.mean_bits:.0f} of the means; {f.overconfident} overconfident, "
                f"{f.indefinite} not definite",
                "",
                aligned([head, *rows], left=1),
            ]
        )

    def as_dict(self) -> dict[str, Any]:
        """Return all figures and fields, for JSON."""
        return {
            "figures": vars(self.figures),
            "bits": dict(self.bits),
            "a_bit_less": {name: cost._asdict() for name, cost in self.a_bit_less.items()},
        }

    def write(self, path: str | Path, command: str) -> tuple[Path, Path]:
        """Write the DBC, and its page with the same name and the suffix ``.md``."""
        figures = indent(self.text(), "    ", lambda _line: True)
        text = (
            f"Designed by\n\n    {command}\n\nRecords that are conditional on the pose error, "
            f"measured on random scenes:\n\n{figures}\n\n## The record of a line\n\n"
            f"{self.writer.table()}\n"
        )
        return write_dbc(self.writer, path, lambda name: f"# {name}\n\n{text}")


def fields() -> dict[str, SignalSpec]:
    """Return the fields whose widths are found, as in ``dbc/maplines-pose.dbc``."""
    of_pose = (spec for page in POSE.pages for spec in page)
    found = {spec.name: spec for spec in of_pose if spec.name.startswith(("Pivot", "Ratio"))}
    names = (*PARAMETER_SIGNALS, *OWN_SIGNALS, *FINE_SIGNALS)
    of_line = (spec for page in CONDITIONAL.pages for spec in page)
    return found | {spec.name: spec for spec in of_line if spec.name in names}


def writer_of(bits: Mapping[str, int]) -> DbcWriter:
    """Return the writer of the DBC with these widths of ``fields``, over the same ranges."""
    more = {name: bits[name] - spec.bits for name, spec in fields().items()}

    def resized(pages: Sequence[Sequence[SignalSpec]]) -> tuple[tuple[SignalSpec, ...], ...]:
        return tuple(tuple(map(resized_one, page)) for page in pages)

    def resized_one(spec: SignalSpec) -> SignalSpec:
        if spec.name in FINE_SIGNALS:  # they share out one step of the mean
            step = 2.0 ** -more.get(spec.name.removesuffix(FINE), 0)
            spec = replace(spec, factor=spec.factor * step)
        if change := more.get(spec.name):
            why = f"{-change} bits less than in maplines-pose.dbc over the same range ({spec.why})"
            return replace(spec.finer(change), why=why)
        return spec

    return replace(
        CONDITIONAL,
        pages=resized(CONDITIONAL.pages),
        pose=replace(POSE, pages=resized(POSE.pages)),
    )


def figures_of(bits: Mapping[str, int], scenes: Sequence[Scene]) -> SceneFigures:
    """Send scenes with these widths."""
    codec = Codec(writer_of(bits).layout(LINES))
    rows = [with_pose(codec, scene) for scene in scenes]
    kl = [value for row in rows for value in row.get("kl_lines", ())]
    whole = not any(row["left_out"] for row in rows)
    return SceneFigures(
        kl_mean=float(np.mean(kl)) if whole else np.inf,
        kl_p99=float(np.quantile(kl, 0.99)) if whole else np.inf,
        all_entries=sum(row["all_entries"] for row in rows) / (LINES * len(rows)),
        joint_bits=float(np.mean([row["joint_bits"] for row in rows])),
        mean_bits=float(np.mean([row["mean_bits"] for row in rows])),
        overconfident=sum(bool(row.get("overconfident")) for row in rows),
        indefinite=sum(bool(row.get("not_positive_definite")) for row in rows),
    )


def design_scenes(
    max_kl: float | None = None,
    *,
    n: int = 60,
    seed: int = 0,
    held_out_seed: int = 1_000_003,
    progress: Callable[[float, float], object] = lambda _done, _total: None,
) -> SceneDesign:
    """Find the fewest bits of the Pose message and of conditional records for a divergence.

    Args:
        max_kl: largest mean divergence of a line, from the covered target [nat]; None for the
            widths of maplines-pose.dbc, to see what each of their bits is for.
        n: scenes for the search, and as many for the figures.
        seed: of the scenes for the search.
        held_out_seed: of those for the figures.
        progress: called with the work done and the total.

    Raises:
        ValueError: the widths of maplines-pose.dbc do not suffice for ``max_kl``.
    """
    scenes = random_scenes(n, seed)
    bits = {name: spec.bits for name, spec in fields().items()}
    best = figures_of(bits, scenes)
    if max_kl is not None and best.kl_mean > max_kl:
        raise ValueError(
            f"max_kl must be {best.kl_mean:.2g} nat or more, what the widths of maplines-pose.dbc "
            f"reach on these scenes, got {max_kl!r}; the frames of a line hold no more bits"
        )
    total = sum(width - MIN_BITS for width in bits.values())
    # The cost of a bit hardly changes with the widths of other fields: it is measured again only
    # when the bit is about to be saved.
    costs = {name: _cost(bits, name, best, scenes) for name in bits}
    open_fields = {name for name, cost in costs.items() if cost.bits < 0}
    while max_kl is not None and open_fields:
        progress(sum(spec.bits - bits[name] for name, spec in fields().items()), total)
        name = min(sorted(open_fields), key=lambda name: costs[name].kl / -costs[name].bits)
        cost = _cost(bits, name, best, scenes)
        if not (best.kl_mean + cost.kl <= max_kl and cost.bits < 0):
            open_fields.remove(name)
            continue
        costs[name] = cost
        bits = bits | {name: bits[name] - 1}
        best = figures_of(bits, scenes)
    if max_kl is not None:
        costs = {name: _cost(bits, name, best, scenes) for name in bits}
    progress(total, total)
    return SceneDesign(bits, figures_of(bits, random_scenes(n, held_out_seed)), costs)


def random_scenes(n: int, seed: int) -> list[Scene]:
    """Draw n scenes of ``LINES`` lines."""
    rng = np.random.default_rng([seed, LINES])
    return [random_scene(LINES, rng).scene for _ in range(n)]


def _cost(bits: Mapping[str, int], name: str, now: SceneFigures, scenes: Sequence[Scene]) -> Cost:
    """Return what a bit less in a field changes."""
    if bits[name] <= MIN_BITS:
        return Cost(math.nan, math.nan)
    try:
        fewer = figures_of({**bits, name: bits[name] - 1}, scenes)
    except LayoutError:
        return Cost(math.nan, math.nan)
    saved = fewer.joint_bits + fewer.mean_bits - now.joint_bits - now.mean_bits
    return Cost(fewer.kl_mean - now.kl_mean, saved)
