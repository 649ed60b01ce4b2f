"""Round trip of lines over a bus: send them, receive them, and compare."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..bus import Link, Receiver, ReceiverStats, Transmitter, TransmitterStats, bus_load
from ..values.coding_loss import evaluate
from ..values.linalg import block_diagonal
from ..values.line import LeftOut, MapLine, Slot, Status
from ..values.scene import Scene
from ..wire import Decoder, Frame, LineCodec, Owner, PreparedScene

#: Distances at which the ego lane is compared [m].
LANE_X = (0.0, 20.0, 40.0)
#: Lines of the ego lane.
LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)


@dataclass(frozen=True)
class LaneResult:
    """Width or centre of the ego lane at a distance, as sent and as received."""

    quantity: str  #: width or centre
    x: float  #: [m]
    true_value: float  #: before encoding [m]
    true_sigma: float  #: [m]
    value: float  #: as received [m]
    sigma: float  #: [m]
    sigma_ratio: float | None  #: received over true; None if the true one is 0
    independent_sigma: float  #: of the received lines if they are taken as independent [m]


@dataclass(frozen=True)
class SceneResult:
    """Scene before encoding and as received; without a lane if that was not received."""

    lane: Sequence[LaneResult]  #: where both of its lines are valid
    #: of each cycle by the owner of the record: the pose error ("pose"), then each line; or the
    #: messages of whole scenes ("scene2", "scene")
    frames: Mapping[str, int]
    frames_of_full_records: int  #: of a cycle, if each line had a covariance of its own
    #: reasons of the lines that do not fit the message, or have no place there
    unsent: Mapping[Slot, LeftOut]

    def as_dict(self) -> dict[str, Any]:
        """Return all figures, for JSON."""
        return {
            "lane": [asdict(lane) for lane in self.lane],
            "frames": dict(self.frames),
            "frames_per_cycle": sum(self.frames.values()),
            "frames_of_full_records": self.frames_of_full_records,
            "unsent": [slot.name for slot in self.unsent],
        }


def scene_result(
    sent: PreparedScene,
    transfers: Mapping[Owner, Sequence[Frame]],
    left_out: Mapping[Slot, LeftOut],
    received: Scene | None,
    frames_of_full_records: int,
) -> SceneResult:
    """Compare a scene as sent with the scene as received.

    Args:
        sent: the scene as sent.
        transfers: frames of each record, by its owner.
        left_out: why lines are not sent.
        received: the scene as received; None if none was.
        frames_of_full_records: of a cycle, if each line had a covariance of its own.
    """
    scene = sent.scene
    return SceneResult(
        lane=[] if received is None else lane_results(scene, received),
        frames={
            owner.name if isinstance(owner, Slot) else owner: len(frames)
            for owner, frames in transfers.items()
        },
        frames_of_full_records=frames_of_full_records,
        unsent={slot: why for slot, why in left_out.items() if slot in scene.index},
    )


def lane_results(sent: Scene, received: Scene) -> list[LaneResult]:
    """Compare the width and the centre of the ego lane, where its lines are valid in both scenes.

    Returns:
        None of them if a scene lacks a line of the lane.
    """
    if not all(slot in scene.index for scene in (sent, received) for slot in LANE):
        return []
    ranges = [scene.x_range(LANE) for scene in (sent, received)]
    low, high = max(low for low, _ in ranges), min(high for _, high in ranges)
    blocks = block_diagonal(line.gaussian.cov for line in received.lines)
    apart = replace(received, cov=blocks)
    found = []
    for quantity, of in (("width", Scene.width), ("centre", Scene.centre)):
        for x in (x for x in LANE_X if low <= x <= high):
            (true, true_sigma), (value, sigma), (_, independent) = (
                [float(part) for part in of(scene, x)] for scene in (sent, received, apart)
            )
            ratio = sigma / true_sigma if true_sigma else None
            found.append(
                LaneResult(quantity, x, true, true_sigma, value, sigma, ratio, independent)
            )
    return found


if TYPE_CHECKING:
    from ..testing import Faults, FaultyOpener

#: Period of publishing the lines again [s]; they would be sent as too old after 0.24 s.
REFRESH = 0.05
#: Greatest distance at which lines are compared [m].
MAX_X = 80.0


@dataclass(frozen=True)
class BusSettings:
    """Bus of a round trip; the bit rates are for the bus load."""

    rate: float = 20.0  #: how often each line is sent [1/s]
    bitrate: int = 500_000  #: nominal [bit/s]
    data_bitrate: int | None = None  #: of the data phase of CAN FD [bit/s]; None: classic CAN
    #: Settings of ``Link``; None for a bus of its own within this process.
    interface: Mapping[str, Any] | None = None

    @property
    def fd(self) -> bool:
        """Whether the frames are CAN FD."""
        return self.data_bitrate is not None

    def link_settings(self) -> dict[str, Any]:
        """Return the settings of ``Link``; pass one result to both links."""
        interface = self.interface
        if interface is None:
            interface = {"interface": "virtual", "channel": f"maplines-{uuid.uuid4()}"}
        return {**interface, "fd": True} if self.fd else dict(interface)


@dataclass(frozen=True)
class LineResult:
    """Line before encoding and as received; if it was not received, ``mean`` and so on are None."""

    slot: str
    true_mean: list[float]  #: before encoding
    true_sigma: list[float]
    x: float  #: distance of the comparison: 80 m, or the end of the valid range before it [m]
    true_y: float  #: y at x [m]
    true_y_sigma: float  #: standard deviation of y at x [m]
    mean: list[float] | None = None  #: as received
    sigma: list[float] | None = None
    y: float | None = None
    y_sigma: float | None = None
    status: str | None = None
    kl_covered: float | None = None  #: from the covered target [nat], see ``Evaluation``
    kl: float | None = None  #: from the Gaussian before encoding [nat]


@dataclass(frozen=True)
class RoundTrip:
    """Results of a round trip."""

    bus: BusSettings
    authenticated: bool  #: whether the frames carried a MAC
    seconds: float  #: duration, with opening and closing the bus [s]
    lines: Sequence[LineResult]
    sent: TransmitterStats
    received: ReceiverStats
    bus_load: float  #: share of the bus time, with worst-case bit stuffing
    period_jitter: Mapping[str, float]  #: |time between two lines of a slot - period| [s]
    cpu_share: float | None  #: share of one core, both ends together; None if unknown
    faults: Mapping[str, int] | None  #: counters of the injected faults; None without faults
    true_lines: Sequence[MapLine] = field(repr=False)
    received_lines: Mapping[str, MapLine] = field(repr=False)  #: the latest line of each slot
    scene: SceneResult | None = None  #: None if the lines were not sent as a scene
    received_scene: Scene | None = field(default=None, repr=False)  #: the latest complete one

    @property
    def frame_format(self) -> str:
        """Frame format, and whether the frames are authenticated, as text."""
        return f"{'CAN FD' if self.bus.fd else 'classic CAN'}" + (
            ", authenticated" if self.authenticated else ""
        )

    @property
    def lines_lost(self) -> int:
        """Lines that were sent and not received."""
        return self.sent.lines - self.received.lines

    @property
    def frames_lost(self) -> int:
        """Frames that were sent, or added by faults, and not received."""
        added = self.faults["duplicated"] + self.faults["flooded"] if self.faults else 0
        return self.sent.frames + added - self.received.frames

    def as_dict(self) -> dict[str, Any]:
        """Return all figures, for JSON."""
        dropped = {reason.name: n for reason, n in self.received.counts.items()}
        return {
            "frame_format": self.frame_format,
            "seconds": self.seconds,
            "rate": self.bus.rate,
            "lines": [asdict(line) for line in self.lines],
            "sent": self.sent.as_dict(),
            "received": self.received._asdict() | {"counts": dropped},
            "lines_lost": self.lines_lost,
            "frames_lost": self.frames_lost,
            "bus_load": self.bus_load,
            "bitrate": self.bus.bitrate,
            "data_bitrate": self.bus.data_bitrate,
            "period_jitter": self.period_jitter,
            "cpu_share": self.cpu_share,
            "faults": self.faults,
            "scene": None if self.scene is None else self.scene.as_dict(),
        }


def round_trip(
    lines: Sequence[MapLine] | Scene,
    codec: LineCodec,
    *,
    bus: BusSettings | None = None,
    seconds: float = 3.0,
    faults: Faults | None = None,
    tick: Callable[[float], object] | None = None,
) -> RoundTrip:
    """Send lines over a bus for some time, receive them and compare. Ctrl-C ends it early.

    Args:
        lines: lines to send, of different slots, or a scene.
        codec: codec of both ends.
        bus: the bus; None for ``BusSettings()``.
        seconds: how long to send [s].
        faults: faults to inject into the frames: at the sender if their direction is "send",
            otherwise at the receiver.
        tick: called about twenty times a second with the elapsed time [s].

    Raises:
        BusError: the interface cannot be opened.
        EncodeError: a scene does not fit the DBC.
    """
    encoder = codec.encoder()
    bus = BusSettings() if bus is None else bus
    true_lines: Sequence[MapLine]
    published: Sequence[MapLine] | PreparedScene
    if isinstance(lines, Scene):
        true_lines, published = lines.lines, encoder.prepare_scene(lines, fd=bus.fd)
    else:
        true_lines = published = lines
    cpu, start = time.process_time(), time.monotonic()
    count = max(1, round(seconds * bus.rate))
    passed = (lambda: None) if tick is None else (lambda: tick(time.monotonic() - start))
    sent, received, fault_counts, arrivals = _run(published, codec, bus, count, faults, passed)
    duration, cpu = time.monotonic() - start, time.process_time() - cpu
    result = None
    cycle: Iterable[Sequence[Frame]]
    if isinstance(published, PreparedScene):
        transfers = encoder.encode_scene(published, fd=bus.fd)
        full = len(true_lines) * (1 if bus.fd else codec.layout.pages)
        left_out = encoder.left_out(published, fd=bus.fd)
        result = scene_result(published, transfers, left_out, arrivals.scene, full)
        cycle = transfers.values()
    else:
        cycle = encoder.encode_lines(published, fd=bus.fd)
    return RoundTrip(
        bus=bus,
        authenticated=codec.authenticator is not None,
        seconds=duration,
        lines=[_result(line, arrivals.latest.get(line.slot.name), codec) for line in true_lines],
        sent=sent,
        received=received,
        bus_load=bus_load(chain(*cycle), 1 / bus.rate, bus.bitrate, bus.data_bitrate),
        period_jitter=arrivals.jitter(),
        cpu_share=cpu / duration if _cpu_time_is_true() else None,
        faults=fault_counts,
        true_lines=true_lines,
        received_lines=arrivals.latest,
        scene=result,
        received_scene=arrivals.scene,
    )


class _Arrivals:
    """The latest line of each slot, the latest complete scene, and deviations from the period."""

    def __init__(self, period: float) -> None:
        self._period, self._changed = period, threading.Condition()
        self._last_ns: dict[Any, int] = {}
        self._deviations: list[float] = []
        self._lines = 0
        self.latest: dict[str, MapLine] = {}
        self.scene: Scene | None = None

    def take(self, line: MapLine, decoder: Decoder, last: Container[Slot]) -> None:
        """Take a line, in the thread of the receiver; with a last one, a scene may be complete."""
        if line.slot in last and (received := decoder.scene()) is not None:
            known = 0 if self.scene is None else len(self.scene.lines)
            if len(received.scene.lines) >= known:
                self.scene = received.scene
        with self._changed:
            t_ns = line.t_ns or 0
            if line.slot in self._last_ns:
                between = (t_ns - self._last_ns[line.slot]) * 1e-9
                self._deviations.append(abs(between - self._period))
            self._last_ns[line.slot] = t_ns
            self.latest[line.slot.name] = line
            self._lines += 1
            self._changed.notify_all()

    def wait_for(self, lines: int, timeout: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._lines >= lines, timeout)

    def jitter(self) -> dict[str, float]:
        quantiles = np.quantile(self._deviations or [0.0], [0.5, 0.99, 1.0])
        return dict(zip(("median", "p99", "max"), quantiles.tolist(), strict=True))


def _run(
    lines: Sequence[MapLine] | PreparedScene,
    codec: LineCodec,
    bus: BusSettings,
    count: int,
    faults: Faults | None,
    tick: Callable[[], object],
) -> tuple[TransmitterStats, ReceiverStats, dict[str, int] | None, _Arrivals]:
    """Send and receive each line ``count`` times.

    Return the counters, also those of the faults, and what arrived.
    """
    arrivals = _Arrivals(1 / bus.rate)
    opener = _faulty_opener(faults) if faults else None
    sending = opener if faults and faults.direction == "send" else None
    receiving = None if sending else opener
    settings = bus.link_settings()
    # With faults no frame is filtered out, so that the receiver counts every one.
    can_ids = None if faults else codec.can_ids
    with Link(sending, **settings) as out, Link(receiving, **settings) as back:
        transmitter = Transmitter(out, codec, period=1 / bus.rate, fd=bus.fd, count=count)
        decoder = codec.decoder(cycle_ms=1e3 / bus.rate)
        last = _last_slots(lines, codec) if isinstance(lines, PreparedScene) else ()
        take = partial(arrivals.take, decoder=decoder, last=last)
        receiver = Receiver(back, decoder, on_line=take, can_ids=can_ids)
        with receiver:
            with suppress(KeyboardInterrupt):  # the lines so far are still useful
                _send(transmitter, lines, tick)
            arrivals.wait_for(transmitter.stats().lines, timeout=1.0)
        # Read now: closing the link releases held frames.
        fault_counts = opener.as_dict() if opener else None
    return transmitter.stats(), receiver.stats(), fault_counts, arrivals


def _last_slots(scene: PreparedScene, codec: LineCodec) -> Collection[Slot]:
    """Return the slots of lines with which a scene is complete; whole scenes come at once."""
    slots = sorted(scene.members)
    return slots[-1:] if codec.layout.scene is None else slots


def _send(
    transmitter: Transmitter, lines: Sequence[MapLine] | PreparedScene, tick: Callable[[], object]
) -> None:
    with transmitter:
        transmitter.publish(lines)
        while not transmitter.wait(REFRESH):
            transmitter.publish(lines)  # as from a new pose, so that none is too old
            tick()


def _faulty_opener(faults: Faults) -> FaultyOpener:
    from ..testing import FaultyOpener

    return FaultyOpener(faults)


def _result(line: MapLine, back: MapLine | None, codec: LineCodec) -> LineResult:
    """Compare a line as sent with the same line as received, within the valid range of both."""
    # A line that a busy machine delivers too late is compared where it is valid, too.
    known = line if back is None or back.status is Status.OUT_OF_RANGE else back
    x = min(MAX_X, known.x_max)
    sent: dict[str, Any] = {
        "slot": line.slot.name,
        "true_mean": line.gaussian.mean.tolist(),
        "true_sigma": line.gaussian.sigma.tolist(),
        "x": x,
        "true_y": float(line.y(x)),
        "true_y_sigma": float(line.y_sigma(x)),
    }
    if back is None:
        return LineResult(**sent)
    figures = evaluate(
        line.gaussian.mean[None],
        line.gaussian.cov[None],
        back.gaussian.mean[None],
        back.gaussian.cov[None],
        codec.resolution,
    )
    return LineResult(
        **sent,
        mean=back.gaussian.mean.tolist(),
        sigma=back.gaussian.sigma.tolist(),
        y=float(back.y(x)),
        y_sigma=float(back.y_sigma(x)),
        status=back.status.name,
        kl_covered=float(figures.kl_covered[0]),
        kl=float(figures.kl[0]),
    )


def _cpu_time_is_true() -> bool:
    """Return False under User Mode Linux, which accounts almost no CPU time to a process."""
    try:
        return "User Mode Linux" not in Path("/proc/cpuinfo").read_text()
    except OSError:
        return True
