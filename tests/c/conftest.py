"""Tests of the C core: what it is compared with is Python, and never the shared library."""

from __future__ import annotations

from pathlib import Path

import pytest

from maplines_can import native


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip these tests where the package computes in C itself: they would compare C with C."""
    if native.is_active:
        reason = f"compares C with Python alone: run it with {native.VARIABLE}=0"
        for item in items:
            if item.path.is_relative_to(Path(__file__).parent):
                item.add_marker(pytest.mark.skip(reason))
