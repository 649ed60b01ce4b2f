"""What a car sends of a scene: its lines, and in how many parts where it may choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ..bus import bus_load, transfers_within
from ..gaussian import Gaussian
from ..line import MapLine
from ..mixture import GaussianMixture
from ..propagation import (
    MapError,
    Mixture,
    Refit,
    SigmaPoints,
    Transform,
    nonlinearity,
)
from ..propagation import (
    component_counts as component_counts,
)
from ..propagation.component_counts import remaining_nonlinearity
from ..scenarios import Scenario
from ..wire import Codec

__all__ = [
    "MAX_LOAD",
    "LineComponents",
    "bus_pace",
    "carrier_text",
    "choose_components",
    "scene_lines",
]

#: Most of the bus's time for lines whose parts are chosen.
MAX_LOAD = 0.3


@dataclass(frozen=True)
class LineComponents:
    """In how many parts a line is sent, and why."""

    slot: str
    parts: int
    nonlinearity: float  #: of the line as one Gaussian: ``Nonlinearity.amount``
    remaining_nonlinearity: float  #: of its parts


def scene_lines(
    scenario: Scenario,
    lines: int = 4,
    *,
    components: int | Sequence[int] = 1,
    transform: Transform | None = None,
    map_error: MapError | None = None,
) -> list[MapLine]:
    """The first lines of a scene as the car sends them.

    Args:
        scenario: the scene.
        lines: how many.
        components: parts of a Gaussian mixture, for all lines or for each; 1 is a plain Gaussian.
        transform: sigma points by default.
        map_error: error of the map beside the pose's.
    """
    scene = scenario.lines[:lines]
    counts = [components] * len(scene) if isinstance(components, int) else components
    result = []
    for line, k in zip(scene, counts, strict=True):
        refit = Refit(line.polyline, scenario.ego.mean, scenario.window, map_error)
        weights, means, covs = Mixture(k, transform or SigmaPoints()).moments(refit, scenario.ego)
        parts = tuple(Gaussian(m, S) for m, S in zip(means, covs, strict=True))
        low, high = (float(x) for x in refit.x_range)
        extent: dict[str, Any] = {"x_min": low, "x_max": high, "kind": line.kind}
        if k == 1:
            result.append(MapLine(line.slot, parts[0], **extent))
        else:
            result.append(MapLine.of_mixture(line.slot, GaussianMixture(weights, parts), **extent))
    return result


def choose_components(
    scenario: Scenario,
    codec: Codec,
    lines: int = 4,
    *,
    components: int | Literal["auto"] = "auto",
    rate: float = 20.0,
    fd: bool = False,
    bitrate: int = 500_000,
    max_load: float | None = None,
) -> list[LineComponents]:
    """In how many parts each of the first lines of a scene is sent, within a bus load.

    Args:
        scenario: the scene.
        codec: of the sender.
        lines: how many.
        components: of all lines; "auto": as many as the bend of each line asks for.
        rate: lines of each slot a second [1/s].
        fd: CAN FD frames.
        bitrate: of the bus [bit/s].
        max_load: most of the bus's time that the lines may take, in the worst case of bit
            stuffing; by default no bound, and ``MAX_LOAD`` for "auto".

    Raises:
        ValueError: the lines do not keep within the bound, with one part each for "auto".
    """
    scene, auto = scenario.lines[:lines], components == "auto"
    least = [1 if components == "auto" else components] * len(scene)
    if auto and max_load is None:
        max_load = MAX_LOAD
    budget = None
    if max_load is not None:
        pace = bus_pace(rate, bitrate, fd=fd)
        blank = np.zeros(codec.layout.record_bytes, dtype=np.uint8)
        transfers = [codec.frames(blank, line.slot, fd=fd) for line in scene]
        budget = min(transfers_within(max_load, transfer, *pace) for transfer in transfers)
        if budget < sum(least):
            load = sum(least) * max(bus_load(transfer, *pace) for transfer in transfers)
            raise ValueError(
                f"{len(scene)} lines in {sum(least)} parts take {100 * load:.3g} % of the bus at "
                f"{rate:g} Hz and {bitrate / 1000:g} kbit/s, and {100 * max_load:g} % are allowed; "
                "send fewer lines or parts, lower the rate, take CAN FD or a faster bus, or allow "
                "more"
            )
    amounts = [
        nonlinearity(Refit(line.polyline, scenario.ego.mean, scenario.window), scenario.ego).amount
        for line in scene
    ]
    counts = component_counts(amounts, budget=budget) if auto else least
    return [
        LineComponents(line.slot.name, k, amount, remaining_nonlinearity(amount, k))
        for line, k, amount in zip(scene, counts, amounts, strict=True)
    ]


def carrier_text(codec: Codec, *, fd: bool) -> str:
    """What the lines travel on, for reports."""
    authenticated = ", authenticated" if codec.authenticator else ""
    return f"{'CAN FD' if fd else 'classic CAN'}{authenticated}"


def bus_pace(rate: float, bitrate: int, *, fd: bool) -> tuple[float, float, float | None]:
    """Period [s], and bit rates of the arbitration and of the data phase, four times as fast."""
    return 1 / rate, bitrate, 4 * bitrate if fd else None
