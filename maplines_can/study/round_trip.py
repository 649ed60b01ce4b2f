"""A scene over a bus and back: what was true, what came back, and what it took."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..bus import Link, Receiver, ReceiverStats, Transmitter, TransmitterStats, bus_load
from ..cli.sending import LineComponents, bus_pace, carrier_text, choose_components, scene_lines
from ..line import MapLine
from ..propagation import MapError
from ..scenarios import Scenario
from ..testing import Faults, FaultyOpener
from ..wire import Codec
from .metrics import LATERAL_X, evaluate

__all__ = ["LineResult", "RoundTrip", "round_trip"]


@dataclass(frozen=True)
class LineResult:
    """One line: true, received, and how they differ. None received: all None."""

    slot: str
    true_mean: list[float]
    true_sigma: list[float]
    mean: list[float] | None = None
    sigma: list[float] | None = None
    status: str | None = None
    kl_covered: float | None = None  #: against the covered target [nat]
    kl: float | None = None  #: against the true Gaussian [nat]
    lateral_error_80m: float | None = None  #: [m]
    true_sigma_80m: float | None = None  #: of the lateral position [m]
    sigma_80m: float | None = None  #: [m]


@dataclass(frozen=True)
class RoundTrip:
    """What a run over a bus gave."""

    scenario: str
    carrier: str
    seconds: float
    rate: float  #: [1/s]
    lines: list[LineResult]
    parts: list[LineComponents]
    sent: dict[str, Any]
    received: dict[str, Any]
    lines_lost: int
    frames_lost: int
    bus_load: float  #: share of the bus's time, worst case of bit stuffing
    bitrate: int  #: [bit/s]
    period_jitter: dict[str, float]  #: |time between a slot's lines - period| [s]
    cpu_share: float | None  #: of one core, sender and receiver; None where it cannot be told
    faults: dict[str, int] | None = None  #: what they did; None where there were none
    received_lines: Mapping[str, MapLine] = field(repr=False, default_factory=dict)
    true_lines: Sequence[MapLine] = field(repr=False, default=())

    def as_dict(self) -> dict[str, Any]:
        """All figures, for JSON."""
        skipped = ("received_lines", "true_lines")
        figures = {key: value for key, value in vars(self).items() if key not in skipped}
        return figures | {key: [asdict(x) for x in figures[key]] for key in ("lines", "parts")}


class _Arrivals:
    """Keeps the latest line of each slot and the times between them."""

    def __init__(self, period: float) -> None:
        self._period, self._changed = period, threading.Condition()
        self._last_ns: dict[Any, int] = {}
        self.latest: dict[str, MapLine] = {}
        self.deviations: list[float] = []
        self.lines = 0

    def take(self, line: MapLine) -> None:
        with self._changed:
            t_ns = line.t_ns or 0
            if line.slot in self._last_ns:
                between = (t_ns - self._last_ns[line.slot]) * 1e-9
                self.deviations.append(abs(between - self._period))
            self._last_ns[line.slot] = t_ns
            self.latest[line.slot.name] = line
            self.lines += 1
            self._changed.notify_all()

    def wait_for(self, lines: int, timeout: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self.lines >= lines, timeout)


def round_trip(
    scenario: Scenario,
    codec: Codec,
    *,
    lines: int = 4,
    components: int | Literal["auto"] = 1,
    max_load: float | None = None,
    seconds: float = 3.0,
    rate: float = 20.0,
    fd: bool = False,
    bitrate: int = 500_000,
    interface: Mapping[str, Any] | None = None,
    map_error: MapError | None = None,
    faults: Faults | None = None,
    tick: Callable[[float], object] | None = None,
) -> RoundTrip:
    """Send the lines of a scene over a bus for a while and receive them.

    Args:
        scenario: the scene.
        codec: of both ends.
        lines: how many lines of the scene.
        components: parts of a mixture for each line; "auto": see ``choose_components``.
        max_load: most of the bus's time that the lines may take; see ``choose_components``.
        seconds: how long [s].
        rate: lines of each slot a second [1/s].
        fd: CAN FD frames.
        bitrate: for which the bus load is stated [bit/s].
        interface: settings of ``can.Bus``; None for python-can's in-process bus.
        map_error: error of the map beside the pose's.
        faults: what happens to the frames on their way: at the receiver's end, unless their
            direction is "send".
        tick: called about ten times a second with the time gone [s].

    Raises:
        BusError: the interface cannot be opened.
        ValueError: the lines do not keep within ``max_load``.
    """
    parts = choose_components(
        scenario,
        codec,
        lines,
        components=components,
        rate=rate,
        fd=fd,
        bitrate=bitrate,
        max_load=max_load,
    )
    counts = [line.parts for line in parts]
    true_lines = scene_lines(scenario, lines, components=counts, map_error=map_error)
    if interface is None:
        interface = {"interface": "virtual", "channel": f"maplines-{uuid.uuid4()}"}
    settings = {**interface, "fd": True} if fd else dict(interface)
    arrivals = _Arrivals(1 / rate)
    count = max(1, round(seconds * rate))
    cpu, start = time.process_time(), time.monotonic()
    opener = FaultyOpener(faults) if faults else None
    of_out, of_back = (opener, None) if faults and faults.direction == "send" else (None, opener)
    with Link(of_out, **settings) as out, Link(of_back, **settings) as back:
        transmitter = Transmitter(out, codec, period=1 / rate, fd=fd, count=count)
        # With faults none is filtered away, so that every frame is counted in the end.
        can_ids = None if faults else codec.can_ids
        decoder = codec.decoder(cycle_ms=1e3 / rate)
        receiver = Receiver(back, decoder, on_line=arrivals.take, can_ids=can_ids)
        with receiver:
            try:
                with transmitter:
                    transmitter.publish(true_lines)
                    while not transmitter.wait(0.1):
                        if tick is not None:
                            tick(time.monotonic() - start)
            except KeyboardInterrupt:  # what there is, is shown
                pass
            arrivals.wait_for(transmitter.stats().lines, timeout=1.0)
        done = opener.as_dict() if opener else None
    elapsed = time.monotonic() - start
    cpu = time.process_time() - cpu
    sent, received = transmitter.stats(), receiver.stats()
    jitter = np.quantile(arrivals.deviations or [0.0], [0.5, 0.99, 1.0])
    frames = chain(*codec.encode_lines(true_lines, fd=fd))
    return RoundTrip(
        scenario=scenario.name,
        carrier=carrier_text(codec, fd=fd),
        seconds=elapsed,
        rate=rate,
        lines=_results(true_lines, arrivals.latest, codec),
        parts=parts,
        sent=_sent(sent),
        received=_received(received),
        lines_lost=sent.lines - received.lines,
        frames_lost=sent.frames + _added(done) - received.frames,
        bus_load=bus_load(frames, *bus_pace(rate, bitrate, fd=fd)),
        bitrate=bitrate,
        period_jitter=dict(zip(("median", "p99", "max"), jitter.tolist(), strict=True)),
        cpu_share=cpu / elapsed if _cpu_time_is_true() else None,
        faults=done,
        received_lines=arrivals.latest,
        true_lines=true_lines,
    )


def _added(done: Mapping[str, int] | None) -> int:
    return done["duplicated"] + done["flooded"] if done else 0


def _cpu_time_is_true() -> bool:
    """User Mode Linux charges a process for hardly any of the CPU time that it takes."""
    try:
        return "User Mode Linux" not in Path("/proc/cpuinfo").read_text()
    except OSError:
        return True


def _sent(stats: TransmitterStats) -> dict[str, Any]:
    return stats._asdict() | {"lateness": stats.lateness._asdict()}


def _received(stats: ReceiverStats) -> dict[str, Any]:
    return stats._asdict() | {"counts": {reason.name: n for reason, n in stats.counts.items()}}


def _results(
    true_lines: Sequence[MapLine], latest: Mapping[str, MapLine], codec: Codec
) -> list[LineResult]:
    results = []
    for true in true_lines:
        result = LineResult(
            true.slot.name, true.gaussian.mean.tolist(), true.gaussian.sigma.tolist()
        )
        back = latest.get(true.slot.name)
        if back is not None:
            verdict = evaluate(
                true.gaussian.mean[None],
                true.gaussian.cov[None],
                back.gaussian.mean[None],
                back.gaussian.cov[None],
                codec.resolution,
            )
            at_80m = LATERAL_X.index(80.0)
            result = replace(
                result,
                mean=back.gaussian.mean.tolist(),
                sigma=back.gaussian.sigma.tolist(),
                status=back.status.name,
                kl_covered=float(verdict.kl_covered[0]),
                kl=float(verdict.kl[0]),
                lateral_error_80m=float(verdict.lateral_error[0, at_80m]),
                true_sigma_80m=float(true.y_sigma(80.0)),
                sigma_80m=float(back.y_sigma(80.0)),
            )
        results.append(result)
    return results
