"""Streams of frames for the tests of fault injection."""

from typing import Any

from maplines_can.wire import Frame

MIX = "loss=0.1,dup=0.05,reorder=0.05,corrupt=0.02"


def numbered(n: Any, size: int = 8) -> Any:
    """Frames that carry their numbers, all different."""
    return [Frame(0x340 + i % 8, i.to_bytes(size, "big")) for i in range(n)]


def number_of(frame: Any) -> Any:
    return int.from_bytes(frame.data, "big")


def run(injector: Any, frames: Any, step: float = 0.0) -> Any:
    """All frames that come out of an injector, if ``step`` [s] are between two that go in."""
    out = [f for i, frame in enumerate(frames) for f in injector.apply(frame, i * step)]
    return out + injector.flush()


def bits_apart(a: Any, b: Any) -> Any:
    return (int.from_bytes(a, "big") ^ int.from_bytes(b, "big")).bit_count()


def content(line: Any) -> Any:
    """Slot and Gaussian of a line, to the last bit."""
    return line.slot, line.gaussian.mean.tobytes(), line.gaussian.cov.tobytes()
