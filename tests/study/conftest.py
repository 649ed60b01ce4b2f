"""Fixtures of the tests of the study."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.study_helpers import small, tables, write_csv, write_map

from maplines_can.study.sweep.run import run_study


@pytest.fixture
def drive(tmp_path: Path) -> Any:
    """Poses along a straight road of two lines; a third line is far aside, a fourth behind."""
    x = np.arange(0, 300, 2.0)
    straight = {name: np.column_stack([x, 0 * x + y]) for name, y in (("l", 1.8), ("r", -1.8))}
    away = {
        "far": np.column_stack([x, 0 * x + 90]),
        "behind": np.column_stack([x[:9] - 400, x[:9]]),
    }
    write_map(tmp_path / "map.csv", straight | away)
    means = np.column_stack([[50.0, 100.0, 150.0], [0.0, 0.1, -0.1], np.radians([0.0, 1.0, -1.0])])
    covs = np.tile(np.diag([0.3, 0.1, 0.01]) ** 2, (3, 1, 1))
    write_csv(tmp_path / "drive.csv", means, covs)
    return tmp_path


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The tables of the small study, computed in this process without interruption."""
    pytest.importorskip("pyarrow")
    return tables(run_study(small(), tmp_path_factory.mktemp("study"), jobs=1))
