"""Number of mixture components of the lines of a sender, within a share of the time of its bus."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import chain
from typing import Literal, NamedTuple

import numpy as np

from ..bus import bus_load, transfers_within
from ..propagation import Refit, component_counts, nonlinearity
from ..propagation.component_counts import remaining_nonlinearity
from ..values.errors import IllPosedError
from ..values.gaussian import Gaussian
from ..values.line import Slot
from ..values.polyline import Polyline
from ..values.scene import PoseError, Scene
from ..wire import SCENE, SCENE2, LineCodec
from ..wire.layout.scene_layout import SceneLayout
from .scenarios import Scenario

#: Limit of the bus load if the number of components is chosen.
MAX_LOAD = 0.3


class BusShare(NamedTuple):
    """Bus of a sender, and the share of its time that the lines may take."""

    rate: float = 20.0  #: how often each line is sent [1/s]
    fd: bool = False  #: whether the frames are CAN FD, with a data phase 4 times as fast
    bitrate: int = 500_000  #: nominal bit rate [bit/s]
    #: largest share of the bus time, with the most stuff bits; None for no limit
    max_load: float | None = None

    @property
    def bitrates(self) -> tuple[int, int | None]:
        """Nominal bit rate, and that of the data phase of CAN FD [bit/s]."""
        return self.bitrate, 4 * self.bitrate if self.fd else None


@dataclass(frozen=True)
class LineComponents:
    """Number of mixture components of a line, and its nonlinearity."""

    components: int
    nonlinearity: float  #: of the line as a single Gaussian; see ``Nonlinearity.amount``
    remaining_nonlinearity: float  #: within each component


def choose_components(
    scenario: Scenario,
    codec: LineCodec,
    lines: int = 4,
    components: int | Literal["auto"] = "auto",
    bus: BusShare = BusShare(),  # noqa: B008 - a value
) -> dict[Slot, LineComponents]:
    """Choose the number of mixture components of each line within a bus load.

    Args:
        scenario: the scenario.
        codec: codec of the sender.
        lines: number of lines, the first of the scenario.
        components: of every line; "auto": as many as the nonlinearity of each line needs.
        bus: of the sender. Without a limit, that of "auto" is ``MAX_LOAD``.

    Raises:
        ValueError: the lines exceed the limit, for "auto" even with one component each.
    """
    first = scenario.first_lines(lines)
    auto = components == "auto"
    least = 1 if components == "auto" else components
    if auto and bus.max_load is None:
        bus = bus._replace(max_load=MAX_LOAD)
    budget = component_budget(codec, first, least, bus)
    amounts = [line_nonlinearity(line, scenario.ego, scenario.window) for line in first.values()]
    counts = component_counts(amounts, budget=budget) if auto else [least] * len(first)
    return {
        slot: LineComponents(k, amount, remaining_nonlinearity(amount, k))
        for slot, k, amount in zip(first, counts, amounts, strict=True)
    }


def component_budget(
    codec: LineCodec, slots: Collection[Slot], least: int, bus: BusShare
) -> int | None:
    """Return how many components all lines together may have; None for no limit.

    Args:
        codec: codec of the sender.
        slots: of the lines.
        least: components that each line has at least.
        bus: of the sender.

    Raises:
        ValueError: the lines exceed the limit with the least components.
    """
    if bus.max_load is None:
        return None
    timing = 1 / bus.rate, *bus.bitrates
    blank = np.zeros(codec.layout.record_bytes, dtype=np.uint8)
    encoder = codec.encoder()
    transfers = [encoder.frames(blank, slot, fd=bus.fd) for slot in slots]
    budget = min(transfers_within(bus.max_load, transfer, *timing) for transfer in transfers)
    total = least * len(slots)
    if budget < total:
        load = total * max(bus_load(transfer, *timing) for transfer in transfers)
        raise ValueError(
            f"{len(slots)} lines with {total} components take {100 * load:.3g} % of the "
            f"bus at {bus.rate:g} Hz and {bus.bitrate / 1000:g} kbit/s, and "
            f"{100 * bus.max_load:g} % are allowed; use fewer lines or components, a lower rate, "
            "fd=True, a higher bitrate or a higher max_load"
        )
    return budget


def check_scene_load(codec: LineCodec, slots: Collection[Slot], bus: BusShare) -> None:
    """Check the bus load of the pose error and of lines, with the longest records.

    Raises:
        ValueError: it exceeds the limit.
    """
    if bus.max_load is None:
        return
    blank = np.zeros(codec.layout.record_bytes, dtype=np.uint8)
    encoder, scene = codec.encoder(), codec.layout.scene
    empty = Scene((), np.zeros((0, 0)), PoseError(np.eye(3) * 0.01), np.zeros((0, 2)))
    frames = [*chain(*encoder.encode_scene(empty, fd=bus.fd, counters={}).values())]
    if scene is None:
        frames += chain(*(encoder.frames(blank, slot, fd=bus.fd) for slot in slots))
    else:
        frames *= _message_count(scene, slots, codec)
    load = bus_load(frames, 1 / bus.rate, *bus.bitrates)
    if load > bus.max_load:
        raise ValueError(
            f"{len(slots)} lines and the pose error take up to {100 * load:.3g} % of the bus at "
            f"{bus.rate:g} Hz and {bus.bitrate / 1000:g} kbit/s, and {100 * bus.max_load:g} % "
            "are allowed; use fewer lines, a lower rate, fd=True, a higher bitrate or a higher "
            "max_load"
        )


def _message_count(scene: SceneLayout, slots: Collection[Slot], codec: LineCodec) -> int:
    """Return how many messages of whole scenes are sent for the lines of these slots."""
    places = scene.places if codec.authenticator is None else scene.secured_places
    fixed = scene.fixed[SCENE][:places]
    free = [slot for slot in slots if slot not in fixed]
    is_enough = SCENE2 not in scene.messages or len(free) <= fixed.count(None)
    return 1 if is_enough else 2


def line_nonlinearity(line: Polyline, ego: Gaussian, window: tuple[float, float]) -> float:
    """Return the nonlinearity of a line: 0 if it is not seen, 1 if some poses do not see it."""
    amount = 0.0
    try:
        refit = Refit(line, ego.mean, window)
        amount = 1.0
        amount = nonlinearity(refit, ego).amount
    except IllPosedError:
        pass
    return amount
