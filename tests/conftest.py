"""Fixtures of several test files."""

import pytest
from dbcs import default_codec


@pytest.fixture
def codec():
    return default_codec()
