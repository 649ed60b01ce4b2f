"""Fixtures of the tests of the bus."""

import itertools

import pytest
from kernel_can import has_vcan, set_up

from maplines_can.bus import Link

CHANNELS = (f"test-{number}" for number in itertools.count())


@pytest.fixture
def channel():
    """A channel of the virtual interface that no other test uses."""
    return next(CHANNELS)


@pytest.fixture
def link(channel):
    with Link(interface="virtual", channel=channel) as link:
        yield link


@pytest.fixture
def other(channel):
    """Another link on the channel of `link`."""
    with Link(interface="virtual", channel=channel) as link:
        yield link


@pytest.fixture
def vcan():
    """An interface of the kernel, restored after the test."""
    if not has_vcan():
        pytest.skip("there is no vcan0; run this inside tools/vcan")
    yield "vcan0"
    set_up("vcan0")
