"""Run a study of the wire: codes x widths x sets, in chunks, on all processors.

Each chunk of a set is drawn once and goes through all codes and widths; the study keeps a small
file of sums for it. The files of all chunks, added up in order, make the tables. A study may
therefore be stopped or killed at any time and continues with the same command. Its tables are the
same from one process, from many, and from a Dask cluster, whatever workers died on the way: to the
last bit on processors of one kind, except for the measured times.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from ...engines import in_processes, in_this_process, on_dask, processors
from ...simulation.parquet_files import arrow
from .plan import Study, StudyDirectory
from .summary import write_tables
from .tasks import tasks_of


def run_study(
    study: Study,
    out: str | Path,
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> StudyDirectory:
    """Run the tasks of a study that are not done yet, and write its tables.

    A script that calls this with several jobs must do so under ``if __name__ == "__main__"``,
    since new processes import it.

    Args:
        study: to run.
        out: the directory of its files; if it holds a part of this study, the study continues.
        jobs: processes; by default as many as this one may use.
        scheduler: address of a Dask scheduler whose workers run the tasks.
        progress: called with the finished and the total number of Gaussians.

    Raises:
        StudyError: ``out`` holds another study.
        EngineError: the workers fail. Finished tasks are kept, as after Ctrl-C.
        MissingExtraError: pyarrow or Dask is not installed.
    """
    arrow()  # fail now rather than after the work
    directory = StudyDirectory(Path(out), study.describe())
    weights = study.weights()
    done = directory.done() & weights.keys()
    total, so_far = sum(weights.values()), sum(weights[key] for key in done)
    progress(so_far, total)
    if so_far < total:
        tasks = tasks_of(study, done)
        if scheduler is not None:
            results = on_dask(tasks, scheduler, f"maplines-{directory.fingerprint}")
        elif (jobs := jobs or processors()) > 1:
            results = in_processes(tasks, jobs)
        else:
            results = in_this_process(tasks)
        with closing(results):
            for key, result in results:
                directory.store(key, result)
                so_far += weights[key]
                progress(so_far, total)
    write_tables(study, directory)
    return directory
