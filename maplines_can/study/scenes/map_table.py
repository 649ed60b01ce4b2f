"""Table of what a receiver gets of scenes on maps, by the records that carry them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from ...wire.layout.message_layout import Layout
from ..comparison import codec_for
from ..text_table import aligned
from .carriers import WITH_POSE
from .map_scenes import DrawnScene
from .sigma_ratios import Ratios, measured, merged

#: What is shown, and where [m].
PLACES = (("y", 0.0), ("y", 20.0), ("y", 80.0), ("width", 20.0), ("centre", 20.0))
#: Name of all maps together.
ALL = "all"


def of_carriers(
    drawn: Sequence[DrawnScene], progress: Callable[[int, int], object]
) -> dict[str, dict[str, Ratios]]:
    """Send scenes by each of ``WITH_POSE``, and return the figures by its name and map.

    Args:
        drawn: scenes.
        progress: called with the number of records that are done, and of all.
    """
    found = {}
    for number, (name, carrier) in enumerate(WITH_POSE.items()):
        progress(number, len(WITH_POSE))
        codec = codec_for(Layout.from_dbc(carrier.writer.database()))
        of_maps = merged(measured(codec, drawn, fd=carrier.fd), 0)
        found[name] = of_maps | {ALL: Ratios.sum(of_maps.values())}
    progress(len(WITH_POSE), len(WITH_POSE))
    return found


def text(found: Mapping[str, Mapping[str, Ratios]]) -> str:
    """Return the table, map by map."""
    head = ("", "lines", "wider", "left out", *(f"{what} {x:g} m" for what, x in PLACES))
    maps = list(next(iter(found.values())))
    parts = []
    for name in maps:
        rows = [(carrier, *_cells(of_maps[name])) for carrier, of_maps in found.items()]
        parts += [name, *("  " + line for line in aligned([head, *rows], left=1).splitlines()), ""]
    return "\n".join(
        [
            *parts,
            "wider: lines with a sigma of y more than 5 % above the computed one somewhere. y, and",
            "width and centre of the ego lane: sigma, decoded over computed, median and 99 %; y at",
            "80 m or at the end of a line. With FD, frames are those of CAN FD, else classic ones.",
        ]
    )


def _cells(ratios: Ratios) -> tuple[str, ...]:
    reasons = ", ".join(f"{count} {reason}" for reason, count in ratios.left_out.most_common())
    return (
        str(ratios.lines),
        f"{100 * ratios.wider_share:.2g} %",
        f"{100 * ratios.left_out_share:.2g} %" + (f" ({reasons})" if reasons else ""),
        *(
            " ".join(f"{ratios.quantile(what, x, share):.4g}" for share in (0.5, 0.99))
            for what, x in PLACES
        ),
    )
