"""Fixtures of several test files."""

import pytest
from dbcs import default_codec
from hypothesis import settings

# No test depends on how busy the machine is.
settings.register_profile("no-deadline", deadline=None)
settings.load_profile("no-deadline")


@pytest.fixture
def codec():
    return default_codec()
