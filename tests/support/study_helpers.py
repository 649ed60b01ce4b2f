"""Helpers of the tests of the study: small studies, and files of Gaussians, poses and maps."""

from typing import Any

import numpy as np

from maplines_can.study.sets import DrawnSet
from maplines_can.study.sweep.plan import Study
from maplines_can.study.sweep.summary import TABLES, read_table


def small(**changes: Any) -> Any:
    """Return a study of 400 Gaussians in 8 chunks."""
    values = {"codes": ("Cholesky", "Sigmas"), "finer_bits": (0,), "n": 400, "chunk_size": 50}
    values |= {"sets": [DrawnSet("road")], "fields_n": 0, "limit_n": 0}
    values |= {"scenes_n": 0, "seed": 3}
    return Study(**(values | changes))  # type: ignore[arg-type]


def tables(directory: Any) -> Any:
    """Return all tables without the measured times."""
    result = {name: read_table(directory.path, name) for name in TABLES}
    for row in result["summary"]:
        del row["seconds"], row["gaussians_per_second"]
    return result


def table_of(mean: Any, cov: Any) -> Any:
    """Return the columns of a table of Gaussians by name."""
    d = mean.shape[1]
    columns = {f"mean_{i}": mean[:, i] for i in range(d)}
    return columns | {f"cov_{i}{j}": cov[:, i, j] for i in range(d) for j in range(i, d)}


def write_csv(path: Any, mean: Any, cov: Any) -> None:
    """Write Gaussians as CSV."""
    table = table_of(mean, cov)
    rows = np.column_stack(list(table.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(table), comments="", fmt="%.17g")


def write_map(path: Any, lines: Any) -> None:
    """Write the points of lines, by name, as a map."""
    rows = [f"{name},{x},{y}" for name, points in lines.items() for x, y in points]
    path.write_text("\n".join(["line,x,y", *rows]))
