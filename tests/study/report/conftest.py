"""The tables of a sweep, and the report on them."""

from typing import Any

import pytest

pytest.importorskip("pyarrow.parquet")
pytest.importorskip("bokeh")

from support.sweep_tables import sweep_rows, write

from maplines_can.study.report.page import write_report


@pytest.fixture(scope="session")
def rows() -> Any:
    return sweep_rows()


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory, rows: Any) -> Any:
    return write(tmp_path_factory.mktemp("report") / "sweep", rows)


@pytest.fixture(scope="session")
def report(folder: Any) -> Any:
    return write_report(folder, folder.parent / "new" / "report.html")
