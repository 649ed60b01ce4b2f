"""Fixtures of the tests of authentication."""

from typing import Any

import pytest
from support.lines import scenario_lines
from support.secoc_streams import Clock

from maplines_can.simulation import scenario


@pytest.fixture
def clock() -> Any:
    return Clock()


@pytest.fixture
def lines() -> Any:
    return scenario_lines(scenario("highway"), 2)
