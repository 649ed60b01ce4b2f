"""Fixtures of the tests of the command."""

import uuid
from typing import Any

import pytest


@pytest.fixture
def channel() -> str:
    """Name of a virtual channel that no other test uses."""
    return f"test-{uuid.uuid4()}"


@pytest.fixture
def slot_notes(capsys: pytest.CaptureFixture[str]) -> Any:
    """Return a function for the rows of standard error about slots, after the total."""

    def notes() -> Any:
        rows = capsys.readouterr().err.splitlines()
        ends = [k for k, row in enumerate(rows) if "lost by their counters" in row]
        return rows[ends[-1] + 1 :]

    return notes
