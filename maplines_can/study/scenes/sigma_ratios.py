"""What a receiver of scenes is more uncertain of than its sender: ratios of standard deviations.

Of the lateral position of each line, and of the width and the centre of the ego lane, decoded over
computed. Width and centre of an exact map may be known to less than a millimetre, so 2 mm of the
sender's own count as computed, in each coefficient of T_0 .. T_3 (``RESOLUTION``).
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...values.coding_loss import LATERAL_X
from ...values.errors import EncodeError
from ...values.line import Slot, lateral_jacobian
from ...values.scene import Scene
from ...values.text_table import aligned, percent
from ..comparison import AnyCodec, sent_scene
from .carriers import WITH_POSE, codec_of
from .map_scenes import DrawnScene
from .random_scenes import RESOLUTION, noise_floor

Array = NDArray[np.float64]

#: Places where lines are compared; a line that is fitted for less ahead, at its end if that is
#: farther than the place before [m].
LINE_AT = LATERAL_X
#: Places where width and centre of the ego lane are compared [m].
LANE_AT = (0.0, 20.0, 40.0)
#: Median and 99 % that a layout is to reach, of what is compared.
TARGETS = {"y": (1.01, 1.05), "width": (1.03, 1.15), "centre": (1.01, 1.05)}
#: Share of lines left out that it is to keep to.
MOST_LEFT_OUT = 0.01
#: A line is sent wider if sigma of y is larger by this factor somewhere.
WIDER = 1.05
#: Quantiles that are averaged for the end of a tail in ``excess``.
TAIL = (0.97, 0.98, 0.99, 0.995)
#: Reason why a line is left out: the pose error does not fit the message.
POSE = "POSE"
#: Ego lane.
LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)


@dataclass
class Ratios:
    """Counts of lines, and ratios of standard deviations."""

    lines: int = 0
    wider: int = 0  #: of these, sent with a sigma that is larger by ``WIDER``
    left_out: Counter[str] = field(default_factory=Counter)  #: of these, by the reason
    #: of ``y``, ``width`` and ``centre``, with the place [m]
    ratios: defaultdict[tuple[str, float], list[float]] = field(
        default_factory=lambda: defaultdict(list)
    )

    @property
    def left_out_share(self) -> float:
        """Share of the lines that are left out."""
        return self.left_out.total() / max(self.lines, 1)

    @property
    def wider_share(self) -> float:
        """Share of the lines that are sent wider."""
        return self.wider / max(self.lines, 1)

    def quantile(self, what: str, x: float, share: float) -> float:
        """Return a quantile of the ratios; NaN without any."""
        found = self.ratios.get((what, x))
        return float(np.quantile(found, share)) if found else np.nan

    def cells(self, places: Iterable[tuple[str, float]]) -> list[str]:
        """Return the medians and 99 % of what is compared at places, for a table."""
        return [
            " ".join(f"{self.quantile(what, x, share):.4g}" for share in (0.5, 0.99))
            for what, x in places
        ]

    @classmethod
    def sum(cls, several: Iterable[Ratios]) -> Ratios:
        """Return the figures of several."""
        found = cls()
        for ratios in several:
            found.add(ratios)
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return the figures, for JSON: medians and 99 %."""
        return {
            "lines": self.lines,
            "wider": self.wider_share,
            "left_out": dict(self.left_out),
            **{
                f"{what} at {x:g} m": [self.quantile(what, x, share) for share in (0.5, 0.99)]
                for what, x in sorted(self.ratios)
            },
        }

    def add(self, other: Ratios) -> None:
        """Add those of others."""
        self.lines += other.lines
        self.wider += other.wider
        self.left_out += other.left_out
        for key, values in other.ratios.items():
            self.ratios[key] += values

    def add_scene(self, codec: AnyCodec, scene: Scene, *, fd: bool = True) -> Scene | None:
        """Send a scene, add what is received, and return it; None if no line is."""
        self.lines += len(scene.lines)
        try:
            sent = sent_scene(codec, scene, fd=fd)
        except EncodeError:  # the pose error does not fit, and so none of the lines
            self.left_out[POSE] += len(scene.lines)
            return None
        self.left_out.update(reason.name for reason in sent.prepared.unfit.values())
        decoded = sent.received
        if decoded is None or not decoded.lines:
            return None
        self._compare(scene, decoded)
        return decoded

    def _compare(self, scene: Scene, decoded: Scene) -> None:
        true = scene.subset([line.slot for line in decoded.lines])
        means, ranges = decoded.means, decoded.fit_ranges
        for i, (mean, fit_range) in enumerate(zip(means, ranges, strict=True)):
            names, x = places_of(*fit_range.tolist())
            J, own = lateral_jacobian(mean, x), np.s_[4 * i : 4 * i + 4]
            ratios = sigma_ratios(J, decoded.cov[own, own], true.cov[own, own])
            self.wider += bool((ratios > WIDER).any())
            for place, ratio in zip(names, ratios.tolist(), strict=True):
                self.ratios["y", place].append(ratio)
        if tuple(line.slot for line in decoded.lines[:2]) == LANE:
            floor = noise_floor(means[:2], ranges[:2], RESOLUTION)
            cov, computed = decoded.cov[:8, :8], true.cov[:8, :8] + floor
            low, high = ranges[:2, 0].max(), ranges[:2, 1].min()
            x = np.array([x for x in LANE_AT if low <= x <= high])
            left, right = (lateral_jacobian(mean, x) for mean in means[:2])
            both = {"width": np.hstack([left, -right]), "centre": np.hstack([left, right]) / 2}
            for what, J in both.items():
                ratios = sigma_ratios(J, cov, computed)
                for place, ratio in zip(x.tolist(), ratios.tolist(), strict=True):
                    self.ratios[what, place].append(ratio)


def places_of(low: float, high: float) -> tuple[list[float], Array]:
    """Return the places of ``LINE_AT`` where a line is compared, as named and as they are [m].

    >>> places_of(-20.0, 65.0)
    ([0.0, 20.0, 40.0, 80.0], array([ 0., 20., 40., 65.]))
    """
    names = [x for x in LINE_AT if low <= x <= high]
    if LINE_AT[-2] < high < LINE_AT[-1]:
        return [*names, LINE_AT[-1]], np.array([*names, high])
    return names, np.array(names)


def sigma_ratios(J: Array, decoded: Array, computed: Array) -> Array:
    """Return the (K,) ratios of standard deviations of what the (K, n) rows of J are of."""
    variances = [np.einsum("ki,ij,kj->k", J, cov, J) for cov in (decoded, computed)]
    return np.asarray(np.sqrt(variances[0] / variances[1]))


#: Where scenes are from, and the kinds of errors of pose and map.
Kind = tuple[str, str, str]


def measured(
    codec: AnyCodec, drawn: Iterable[DrawnScene], *, fd: bool = True
) -> dict[Kind, Ratios]:
    """Send scenes, and return their figures by source, error of the pose and error of the map."""
    found: dict[Kind, Ratios] = {}
    for one in drawn:
        found.setdefault(one[:3], Ratios()).add_scene(codec, one.scene, fd=fd)
    return found


def merged(found: Mapping[Kind, Ratios], place: int) -> dict[str, Ratios]:
    """Return figures by one of the parts of their kinds: 0 source, 1 pose, 2 map."""
    sums: dict[str, Ratios] = {}
    for kind, ratios in found.items():
        sums.setdefault(kind[place], Ratios()).add(ratios)
    return sums


def excess(ratios: Ratios) -> float:
    """Return the mean of what figures are above 1, in units of what the targets are above it.

    The end of the tail is a mean of quantiles about that of the target, so that it changes with
    the fields and not only with the one scene that happens to be there. Lines left out count as
    much as the medians.
    """
    medians, tails = [], []
    for (name, _), values in ratios.ratios.items():
        median, tail = TARGETS[name]
        medians.append((float(np.median(values)) - 1) / (median - 1))
        tails.append((float(np.quantile(values, TAIL).mean()) - 1) / (tail - 1))
    return (float(np.mean([*medians, *tails])) if medians else math.inf) + (
        ratios.left_out_share / MOST_LEFT_OUT
    )


# ---- the table of maps --------------------------------------------------------------------------

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
        of_maps = merged(measured(codec_of(name), drawn, fd=carrier.fd), 0)
        found[name] = of_maps | {ALL: Ratios.sum(of_maps.values())}
    progress(len(WITH_POSE), len(WITH_POSE))
    return found


def headings(places: Iterable[tuple[str, float]]) -> list[str]:
    """Return the headings of ``Ratios.cells``."""
    return [f"{what} {x:g} m" for what, x in places]


def ratios_text(found: Mapping[str, Mapping[str, Ratios]]) -> str:
    """Return the table, map by map."""
    head = ("", "lines", "wider", "left out", *headings(PLACES))
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
        percent(ratios.wider_share),
        percent(ratios.left_out_share) + (f" ({reasons})" if reasons else ""),
        *ratios.cells(PLACES),
    )
