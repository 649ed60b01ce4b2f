"""Fixtures of several test files."""

from typing import Any

import pytest
from dbcs import default_codec
from hypothesis import settings

# No test depends on how busy the machine is.
settings.register_profile("no-deadline", deadline=None)
settings.load_profile("no-deadline")


@pytest.fixture
def codec() -> Any:
    return default_codec()
