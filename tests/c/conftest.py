"""Tests of the C core: what it is compared with is Python, not the extension module."""

from __future__ import annotations

import pytest

from maplines_can.wire import c_tables
from maplines_can.wire.layout import validation


@pytest.fixture(autouse=True)
def python_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Codecs that a test makes have no tables for C."""
    monkeypatch.setattr(c_tables, "core", None)
    monkeypatch.setattr(validation, "core", None)
