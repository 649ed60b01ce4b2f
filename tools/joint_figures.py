"""Figures of the joint covariance of scenes, their bounds, and their tables."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from line_witness import POSES, Array
from scene_layouts import COMPLETE, CONDITIONAL

from maplines_can.bus import frame_bits

CARRIERS = {"conditional": CONDITIONAL, "complete": COMPLETE}
SIGMAS = ("width", "centre", "direction")
#: Bounds of the 99 % quantiles of the ratios of width, centre and difference of the directions.
RATIO = {"conditional": 1.1, "complete": 1.3}
#: Bounds of the conditional records with a map error: mean and 99 % of KL; of all, lateral ratio.
KL_MEAN, KL_99, LATERAL_99 = 3e-3, 1.2e-2, 1.03
#: Bounds of the witness: largest share of |z| > 3 and largest rms, and draws for which they hold.
BEYOND, RMS, MIN_VALUES = 0.005, 1.08, 20_000
BITRATE, RATES, LINES = 500_000.0, (20, 50), (4, 8)


@dataclass
class Figures:
    """Counts, and values by carrier, group of scenes and quantity."""

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    values: dict[tuple[str, str, str], list[float]] = field(
        default_factory=lambda: defaultdict(list)
    )

    def add(self, other: Figures) -> None:
        """Add the figures of other scenes."""
        self.counts.update(other.counts)
        for key, values in other.values.items():
            self.values[key] += values

    def of(self, carrier: str, what: str, *groups: str) -> Array:
        """Return the values of a quantity, of all groups whose names have these words."""
        found = [
            values
            for (who, group, name), values in self.values.items()
            if (who, name) == (carrier, what) and all(word in group for word in groups)
        ]
        return np.concatenate([[], *found])


def summary(figures: Figures) -> dict[str, Any]:
    """Return the figures by carrier, as they are printed."""
    return {
        "scenes": figures.counts["", "scenes"],
        "scenes without a line": figures.counts["", "no line"],
    } | {carrier: carrier_summary(figures, carrier) for carrier in CARRIERS}


def carrier_summary(figures: Figures, carrier: str) -> dict[str, Any]:
    """Return the figures of a carrier."""
    counts = {
        what: figures.counts[carrier, what]
        for what in (
            *("checked", "indefinite", "overconfident", "checked exactly"),
            *("indefinite, exactly", "overconfident, exactly", "lines", "lines left out"),
        )
    }
    groups: dict[str, Any] = {}
    for words in ((), ("map error",), *((p, e) for p in POSES for e in ("map error", "no error"))):
        row: dict[str, Any] = {
            what: quantiles(figures.of(carrier, what, *words))
            for what in (*SIGMAS, "lateral at 80 m", "KL")
        }
        for what in SIGMAS:
            row[f"{what}, excess"] = quantiles(figures.of(carrier, f"{what}, excess", *words))
        row["all entries"] = mean_of(figures.of(carrier, "all entries", *words))
        for what in ("width", "centre"):
            z = figures.of(carrier, f"z of {what}", *words)
            row[f"z of {what}"] = z_figures(z)
        groups[", ".join(words) or "all"] = row
    load = {}
    for lines in LINES:
        number = mean_of(figures.of(carrier, f"frames, {lines} lines"))
        load[f"{lines} lines"] = {"frames": number, "today": 4 * lines} | {
            f"bus load at {rate} Hz": [bus_load(number, rate), bus_load(4 * lines, rate)]
            for rate in RATES
        }
    times = {
        what: float(np.median(values)) if len(values := figures.of(carrier, what)) else None
        for what in ("encode [us]", "decode [us]")
    }
    return counts | {"groups": groups, "frames a cycle": load, "median": times}


def bus_load(frames: float | None, rate: int) -> float | None:
    """Return the share of the bus time of classic frames of 8 bytes, each cycle."""
    return None if frames is None else frames * frame_bits(8).nominal * rate / BITRATE


def quantiles(values: Array) -> list[float] | None:
    """Return mean, median, 99 % quantile and maximum."""
    if not len(values):
        return None
    return [float(values.mean()), *np.quantile(values, [0.5, 0.99, 1.0]).tolist()]


def mean_of(values: Array) -> float | None:
    """Return the mean; None without values."""
    return float(values.mean()) if len(values) else None


def z_figures(z: Array) -> dict[str, Any] | None:
    """Return the number of values, the share of |z| > 3, and the rms; no crossing is beyond."""
    if not len(z):
        return None
    rms = float(np.sqrt(np.nanmean(z**2)))
    return {"values": len(z), "beyond": float((~(np.abs(z) <= 3)).mean()), "rms": rms}


def missed(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield the bounds that are missed."""
    for carrier, limit in RATIO.items():
        row = result[carrier]
        for what in ("indefinite", "overconfident"):
            for how in ("", ", exactly"):
                if row[what + how]:
                    yield f"{carrier}: {row[what + how]} are {what}{how}"
        for what in SIGMAS:
            value = (row["groups"]["all"][what] or [0] * 4)[2]
            if value > limit:
                yield f"{carrier}: ratio of the {what}: 99 % is {value:.3f}, more than {limit}"
        for group, figures in row["groups"].items():
            for what in ("z of width", "z of centre"):
                z = figures[what]
                if z and z["values"] >= MIN_VALUES and (z["beyond"] > BEYOND or z["rms"] > RMS):
                    yield (
                        f"{carrier}, {group}: {what}: {z['beyond']:.2%} beyond 3 sigma, "
                        f"rms {z['rms']:.2f}"
                    )
    groups = result["conditional"]["groups"]
    kl, lateral = groups["map error"]["KL"], groups["map error"]["lateral at 80 m"]
    if kl and (kl[0] > KL_MEAN or kl[2] > KL_99):
        yield f"conditional: KL with a map error: mean {kl[0]:.2g}, 99 % {kl[2]:.2g}"
    if lateral and lateral[2] > LATERAL_99:
        yield f"conditional: lateral ratio at 80 m: 99 % is {lateral[2]:.3f}"


def show(result: Mapping[str, Any]) -> None:
    """Print the figures as tables."""
    print(f"{result['scenes']} scenes, {result['scenes without a line']} of them without a line")
    for carrier in CARRIERS:
        row = result[carrier]
        counts = (f"{value} {what}" for what, value in row.items() if isinstance(value, int))
        print(f"\n{carrier} records ({CARRIERS[carrier]})", *counts, sep="\n  ")
        heads = [*SIGMAS, "lat. at 80 m", "KL (mean)"]
        print(f"{'50 % / 99 %':24}", *(f"{head:>15}" for head in heads), end="")
        print("    all entries      z of width     z of centre  excess [mm, mm, mrad]")
        for group, figures in row["groups"].items():
            cells = []
            for what in (*SIGMAS, "lateral at 80 m", "KL"):
                q, first = figures[what], 0 if what == "KL" else 1
                digits = 4 if what == "KL" else 3
                cells.append(f"{q[first]:.{digits}f}/{q[2]:.{digits}f}" if q else "-")
            share = figures["all entries"]
            cells.append("-" if share is None else f"{share:.1%}")
            for what in ("z of width", "z of centre"):
                z = figures[what]
                cells.append(f"{z['beyond']:.2%} {z['rms']:.2f}" if z else "-")
            excess = (figures[f"{what}, excess"] for what in SIGMAS)
            cells.append(" ".join(f"{q[2]:.2f}" if q else "-" for q in excess))
            print(f"{group:24}", *(f"{cell:>15}" for cell in cells))
        for lines, load in row["frames a cycle"].items():
            if load["frames"] is not None:
                loads = ", ".join(
                    f"{what} {values[0]:.1%} (today {values[1]:.1%})"
                    for what, values in load.items()
                    if what.startswith("bus")
                )
                print(f"  {lines}: {load['frames']:.1f} frames (today {load['today']}), {loads}")
        print(", ".join(f"  {k} {v:.0f}" for k, v in row["median"].items() if v is not None))
