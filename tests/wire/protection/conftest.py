"""Fixtures of the tests of authentication."""

import pytest
from secoc_streams import Clock

from maplines_can import scenario
from maplines_can.cli.sending import scene_lines


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def lines():
    return scene_lines(scenario("highway"), 2)
