"""Logs that many tests read."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.recordings import record


@pytest.fixture(scope="session")
def faulty_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Lines of ``maplines.dbc`` on a faulty bus; the truth is beside it."""
    folder = tmp_path_factory.mktemp("drive")
    faults = "loss=0.05,dup=0.02,corrupt=0.02,reorder=0.01"
    return record(folder / "faulty.log", "--faults", faults, "--truth", str(folder / "truth.csv"))


@pytest.fixture(scope="session")
def scene_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes of ``maplines-pose.dbc``."""
    folder = tmp_path_factory.mktemp("scenes")
    return record(folder / "scenes.blf", "--dbc", "maplines-pose.dbc", "--pose-error")
