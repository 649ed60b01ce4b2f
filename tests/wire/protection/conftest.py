"""Fixtures of the tests of authentication."""

import pytest
from scenes import scene_lines
from secoc_streams import Clock

from maplines_can import scenario


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def lines():
    return scene_lines(scenario("highway"), 2)
