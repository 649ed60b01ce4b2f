"""A sender in C and one in Python alone, in one process, and whether they send the same."""

from __future__ import annotations

import gc
import os
import resource
import sys
import tracemalloc
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import pytest

from maplines_can import Codec, Kind, Slot
from maplines_can.wire import POSE, Authenticator, Frame, Key, Layout, tables
from maplines_can.wire.encoder import Encoder


def codecs_of(layout: Layout, *, is_authenticated: bool = False) -> tuple[Codec, Codec]:
    """Return a codec with C, and one of Python alone."""

    def codec() -> Codec:
        key = Key(bytes(range(16)), key_id=1)
        return Codec(layout, Authenticator(key, clock=lambda: 10**18) if is_authenticated else None)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "lib", None)
        alone = codec()
        assert alone.encoder()._c is None  # from now on
    return codec(), alone


class Calls:
    """Calls of the sender in C, and how many of them it left to Python.

    Args:
        encoder: with C.
    """

    def __init__(self, encoder: Encoder) -> None:
        self.sent, self.left = 0, 0
        sender = encoder._c
        assert sender is not None
        encoder._c = self  # type: ignore[assignment]
        self._of = sender

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*arguments: Any, **settings: Any) -> Any:
            result = getattr(self._of, name)(*arguments, **settings)
            self.left += result is None
            self.sent += result is not None
            return result

        return call


def outcome(call: Callable[[], Any]) -> Any:
    """Return what a call returns, or the class and the message of its error."""
    with np.errstate(all="ignore"):
        try:
            return call()
        except Exception as error:  # noqa: BLE001 - it is compared
            return type(error), str(error)


def plain(sent: Any) -> Any:
    """Return frames with the classes of all that is in them."""
    if isinstance(sent, Mapping):
        return [(type(key), key, plain(value)) for key, value in sent.items()]
    if isinstance(sent, Frame):
        return type(sent), [(type(value), value) for value in sent]
    return [plain(one) for one in sent] if isinstance(sent, list | tuple) else (type(sent), sent)


def check_same(encoders: tuple[Encoder, Encoder], name: str, *given: Any, **settings: Any) -> Any:
    """Check that a method of both encoders answers alike, and that they have the same counters."""
    in_c, alone = (
        outcome(partial(getattr(encoder, name), *given, **settings)) for encoder in encoders
    )
    assert plain(in_c) == plain(alone)
    assert encoders[0]._counters == encoders[1]._counters
    return in_c


def assert_no_growth(cycle: Callable[[], None], repetitions: int) -> None:
    """Check objects, allocations and pages of the process over many cycles."""
    for _ in range(20):
        cycle()
    known = [Frame, None, Slot.EGO_LEFT, Kind.UNKNOWN, POSE]
    gc.collect()
    counts = [*map(sys.getrefcount, known)]
    tracemalloc.start()
    try:
        cycle()
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(repetitions):
            cycle()
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 20_000, f"{grown} bytes more"
    changes = [sys.getrefcount(x) - n for x, n in zip(known, counts, strict=True)]
    assert max(map(abs, changes)) < repetitions / 4, changes
    if "asan" in os.environ.get("LD_PRELOAD", ""):
        return  # the sanitizer keeps what is released for a while
    pages = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(repetitions):
        cycle()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - pages < 2000  # [kB]
