"""The accuracy of a drive as text."""

from __future__ import annotations

from ...simulation.truth import PLACES
from ..text_table import aligned
from .consistency import consistency_of
from .evaluation import MIN_CURVATURE, REQUIREMENTS, Accuracy
from .map_part import map_consistency_of

#: Headings of the errors, with their units, and the factors from the unit of the error.
_SHOWN = {
    "lateral": ("lateral [cm]", 100.0),
    "heading": ("heading [deg]", 1.0),
    "curvature": ("curvature [%]", 1.0),
    "absolute": ("absolute [cm]", 100.0),
    "relative": ("relative [cm]", 100.0),
}


def as_text(accuracy: Accuracy) -> str:
    """Return the errors and the requirements of the survey as tables.

    The first sentence says whether the errors are as large as the sender states, and the second
    one whether those of its map are.
    """
    consistency, of_map = consistency_of(accuracy), map_consistency_of(accuracy)
    blank = [""] * (len(PLACES) + 1)
    rows = [["error", "", *(f"{x} m" for x in PLACES), "whole line"]]
    for quantity, (heading, factor) in _SHOWN.items():
        columns = accuracy.errors[quantity].shape[1]
        found = [accuracy.figures(quantity, i) for i in range(columns)]
        for k, name in enumerate(("rms", "95 %", "max")):
            cells = [f"{one[name] * factor:.3g}" if one["n"] else "-" for one in found]
            cells = [*cells, ""] if columns > 1 else [*blank[:-1], *cells]
            rows.append([heading if not k else "", name, *cells])
    rows.append(["lines", "", *(str(accuracy.figures("lateral", i)["n"]) for i in range(4)), ""])
    rows[-1][-1] = str(accuracy.figures("absolute", 0)["n"])
    verdicts = [["requirement of the survey", "", *(f"{x} m" for x in PLACES), "whole line"]]
    for requirement in REQUIREMENTS:
        met = [
            {True: "met", False: "missed", None: "-"}[m] for m in accuracy.met(requirement).values()
        ]
        cells = [*met, ""] if len(met) > 1 else [*blank[:-1], *met]
        verdicts.append([requirement.quantity, requirement.source, *cells])
    return "\n".join(
        [
            *([] if consistency is None else [consistency.text(accuracy), ""]),
            *([] if of_map is None else [of_map.text(), ""]),
            f"{accuracy.received} lines received, {accuracy.lines} compared with the truth, "
            f"{accuracy.saturated} of these saturated; not compared: {accuracy.not_usable} too old "
            f"or out of range, {accuracy.other_lane} while the car was on another lane than it "
            f"believed, {accuracy.unknown} without a true line",
            "",
            aligned(rows, left=2),
            "",
            aligned(verdicts, left=2),
            "",
            "A requirement is met if 95 % of the errors are within it. Absolute: largest deviation "
            "of a line\nfrom the true one; relative: after both are aligned (EDMap). Curvature: "
            f"lines of radii up to {1 / MIN_CURVATURE:g} m.",
        ]
    )
