"""Tests of the C core: what it is compared with is Python, not the extension module."""

from __future__ import annotations

import pytest

from maplines_can.wire.layout import validation
from maplines_can.wire.records.batch_kernel import BatchKernel


@pytest.fixture(autouse=True)
def python_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Batches stay in NumPy."""
    monkeypatch.setattr(BatchKernel, "of", lambda *_: None)
    monkeypatch.setattr(validation, "core", None)
