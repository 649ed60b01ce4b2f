"""A study of the wire: codes x widths x sets, in chunks, on as many processors as there are.

Each chunk of a set is drawn once and goes through all codes and widths; what remains of it is a
small file of sums. The files of all chunks, added up in their order, make the tables. So a study
may be stopped or killed anywhere, goes on from there with the same command, and comes out the same
on one process, on many, and on a Dask cluster, whichever of them died. (The same to the last bit
on processors of one kind; the times that it took are measured anew.)
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from ..files import arrow
from .directory import StudyDirectory
from .engines import in_processes, in_this_process, on_dask
from .plan import Plan, Study
from .tables import write_tables
from .tasks import tasks_of

__all__ = ["Plan", "Study", "StudyDirectory", "run_study"]


def run_study(
    study: Study,
    out: str | Path,
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> StudyDirectory:
    """Do what is left of a study, and write its tables.

    A script that calls this with several jobs does so under ``if __name__ == "__main__"``, as
    new processes import it.

    Args:
        study: what is to be found out.
        out: the directory of its files; where it holds a part of this study, that goes on.
        jobs: processes; by default as many as this one may use.
        scheduler: address of a Dask scheduler, whose workers then do the work.
        progress: is told how much of how much is done [Gaussians].

    Raises:
        StudyError: ``out`` holds another study, or the workers fail. What is done is kept, as
            after Ctrl-C.
        MissingExtraError: pyarrow or Dask is not installed.
    """
    arrow()  # rather now than when all is done
    directory = StudyDirectory(Path(out), study.describe())
    weights = study.weights()
    done = directory.done() & weights.keys()
    total, so_far = sum(weights.values()), sum(weights[key] for key in done)
    tell = progress or (lambda _done, _total: None)
    tell(so_far, total)
    tasks = tasks_of(study, done)
    if scheduler is not None:
        engine = on_dask(tasks, scheduler, f"maplines-{directory.fingerprint}")
    else:
        jobs = jobs or _processors()
        engine = in_this_process(tasks) if jobs == 1 else in_processes(tasks, jobs)
    if so_far < total:
        with closing(engine):
            for key, content in engine:
                directory.store(key, content)
                so_far += weights[key]
                tell(so_far, total)
    write_tables(study, directory)
    return directory


def _processors() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
