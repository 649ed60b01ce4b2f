"""How two logs differ over time, as panels of a plot."""

from __future__ import annotations

import numpy as np

from ...values.line import Slot
from ..difference import Difference
from .log_panels import COLOURS, MOST_POINTS, STATES, Band, Dots, Panel, Strip, thinned


def difference_panels(found: Difference) -> list[Panel]:
    """Return positions of B minus those of A at each x, and when lines differ or are missing.

    Times are from the first line of A on.
    """
    return [*(_position_panel(found, x) for x in found.at), _part_panel(found)]


def _position_panel(found: Difference, x: float) -> Panel:
    t, slots = found.a.t[found.alignment.a], found.pairs[0]["slot"]
    is_in, away, sigma = found.position(x)
    bands = []
    for slot in np.unique(slots[is_in]):
        own = is_in & (slots == slot)
        points, _ = thinned(t[own], away[own], sigma[own])
        bands.append(Band(_text(slot), COLOURS[Slot(slot)], False, *points))
    title = f"position of B minus that of A at {x:g} m, with 1, 2 and 3 sigma of the difference"
    return Panel(title, "time [s]", "y [m]", bands)


def _part_panel(found: Difference) -> Panel:
    """Return in rows when lines differ, and when only one log has them."""
    rows, strips, dots = list[str](), list[Strip](), list[Dots]()
    t, slots = found.a.t[found.alignment.a], found.pairs[0]["slot"]
    for slot in np.unique(slots[found.differing]):
        here = np.sort(t[found.differing[slots[found.differing] == slot]])
        here = here[:: len(here) // MOST_POINTS + 1]
        rows.append(f"{_text(slot)} differs")
        y = np.full(len(here), len(rows) - 1.0)
        dots.append(Dots(rows[-1], COLOURS[Slot(slot)], here, y))
    for of, name in enumerate("AB"):
        parts = found.parts(of)
        for part in parts[:MOST_POINTS]:
            begin, end = (found.time_in_a(of, t) for t in (part.begin, part.end + found.a.cycle))
            strips.append(Strip(len(rows), begin, end, STATES["INVALID"], f"only in {name}"))
        rows += [f"only in {name}"] * bool(parts)
    title = "lines that differ, and lines of one log only"
    return Panel(
        title, "time [s]", "", dots=dots, strips=strips, rows=rows or ["the lines are equal"]
    )


def _text(slot: int) -> str:
    return Slot(slot).name.replace("_", " ").lower()
