"""A run over a bus in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from ..study.round_trip import LineResult, RoundTrip
from .listing import slot_text
from .sending import LineComponents

__all__ = ["components_text", "counts_text", "faults_text", "trip_text"]


def trip_text(trip: RoundTrip) -> str:
    """The table of the lines, then what was sent and received."""
    scales = (1, np.degrees(1), 1e3, 1e6)
    head = ("y_off [m]", "beta [deg]", "c0 [1/km]", "c1 [1/km^2]")
    out = [
        f"{trip.scenario} over {trip.carrier}, {trip.rate:g} Hz, {trip.seconds:.1f} s",
        "",
        " " * 22 + "".join(f"{h:>21}" for h in head) + f"{'y at 80 m [m]':>21}",
    ]
    for line, parts in zip(trip.lines, trip.parts, strict=True):
        out.append(f"{slot_text(line.slot):<12}{'true':<10}" + _row(line, scales, is_true=True))
        if line.mean is None:
            out.append(f"{'':<12}nothing received")
            continue
        out.append(f"{'':<12}{'received':<10}" + _row(line, scales, is_true=False))
        ratio = _known(line.sigma_80m) / _known(line.true_sigma_80m) if line.true_sigma_80m else 1
        out.append(
            f"{'':<12}{(line.status or '').lower()}; KL {line.kl_covered:.4f} nat "
            f"(untouched {line.kl:.4f}); at 80 m: mean {1e3 * _known(line.lateral_error_80m):+.2f} "
            f"mm, sigma x{ratio:.3f}"
        )
        out.append(f"{'':<12}{components_text(parts)}")
    jitter = trip.period_jitter
    out += [
        "",
        f"sent      {trip.sent['lines']} lines, {trip.sent['frames']} frames",
        f"received  {trip.received['lines']} lines, {trip.received['frames']} frames; "
        f"dropped: {counts_text(trip.received['counts'])}",
        f"lost      {trip.lines_lost} lines, {trip.frames_lost} frames"
        + "".join(
            f"; {trip.sent[key]} {words}"
            for key, words in (
                ("overruns", "periods skipped because the sender was late"),
                ("down", "lines given up while the interface was down"),
                ("full", "lines given up with a full queue"),
            )
            if trip.sent[key]
        ),
        *([f"faults    {faults_text(trip.faults)}"] if trip.faults else []),
        f"bus load  {100 * trip.bus_load:.1f} % at {trip.bitrate / 1000:g} kbit/s"
        + (f" and {4 * trip.bitrate / 1e6:g} Mbit/s" if trip.carrier.startswith("CAN FD") else ""),
        f"period    {1e3 / trip.rate:g} ms, off by {1e3 * jitter['median']:.2f} ms in the median, "
        f"{1e3 * jitter['p99']:.2f} ms at 99 %",
    ]
    if trip.cpu_share is not None:
        out.append(f"CPU       {100 * trip.cpu_share:.0f} % of one core, sender and receiver")
    return "\n".join(out)


def faults_text(done: Mapping[str, int]) -> str:
    """What faults did to the frames, those that did anything."""
    kinds = {name: n for name, n in done.items() if name not in ("frames", "passed", "held")}
    return (
        f"of {done['frames']} frames: {counts_text(kinds)}; {done['passed']} passed on, "
        f"{done['held']} held back"
    )


def components_text(line: LineComponents) -> str:
    """In how many parts a line goes, and how far from straight it is before and after."""
    if line.parts == 1:
        return f"1 part, nonlinearity {line.nonlinearity:.2f}"
    return (
        f"{line.parts} parts, nonlinearity {line.nonlinearity:.2f}, "
        f"{line.remaining_nonlinearity:.2f} within them"
    )


def _row(line: LineResult, scales: Iterable[float], is_true: bool) -> str:
    mean, sigma = (line.true_mean, line.true_sigma) if is_true else (line.mean, line.sigma)
    cells = [
        f"{m * k:.3f} ± {s * k:.3f}"
        for m, s, k in zip(mean or (), sigma or (), scales, strict=True)
    ]
    at_80m = line.true_sigma_80m if is_true else line.sigma_80m
    cells.append(f"± {at_80m:.3f}" if at_80m is not None else "")
    return "".join(f"{cell:>21}" for cell in cells)


def _known(value: float | None) -> float:
    return np.nan if value is None else value


def counts_text(counts: Mapping[str, int]) -> str:
    """Counts by name, those that are not zero."""
    return ", ".join(f"{n} {name.lower()}" for name, n in sorted(counts.items()) if n) or "none"
