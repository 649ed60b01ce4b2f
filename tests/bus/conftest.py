"""Fixtures of the tests of the bus."""

import itertools
from collections.abc import Iterator
from typing import Any

import pytest
from support.kernel_can import has_vcan, set_up
from support.scene_streams import codec_of
from support.transmitter_bench import Bench

from maplines_can.bus import Link

CHANNELS = (f"test-{number}" for number in itertools.count())


@pytest.fixture
def channel() -> Any:
    """A channel of the virtual interface that no other test uses."""
    return next(CHANNELS)


@pytest.fixture
def link(channel: Any) -> Iterator[Any]:
    with Link(interface="virtual", channel=channel) as link:
        yield link


@pytest.fixture
def other(channel: Any) -> Iterator[Any]:
    """Another link on the channel of `link`."""
    with Link(interface="virtual", channel=channel) as link:
        yield link


@pytest.fixture
def vcan() -> Iterator[str]:
    """An interface of the kernel, restored after the test."""
    if not has_vcan():
        pytest.skip("there is no vcan0; run this inside tools/vcan")
    yield "vcan0"
    set_up("vcan0")


@pytest.fixture
def make_bench() -> Iterator[Any]:
    """Return a function that makes a bench for a DBC; their links are closed at the end."""
    made: list[Bench] = []

    def make(dbc: str, **settings: Any) -> Bench:
        codec = settings.pop("codec", None) or codec_of(dbc)  # a transmitter counts by itself
        if codec.layout.scene is not None:
            settings["settings"] = {"fd": True} | settings.get("settings", {})
        made.append(Bench(codec, **settings))
        return made[-1]

    yield make
    for bench in made:
        bench.link.close()
