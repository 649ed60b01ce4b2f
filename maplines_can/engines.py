"""Engines: run tasks in this process, on processes of this machine, or on Dask.

An engine takes an iterator of tasks and yields ``(key, result)`` as tasks finish, in any order. It
draws only a few tasks ahead of its workers, so that memory use stays flat. If a worker dies, its
tasks are run again.
"""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from itertools import islice
from multiprocessing import active_children, get_context, parent_process
from typing import Any, NamedTuple

from .values.errors import EngineError, missing_extra

#: Number of times in a row that a process may die before the work is given up.
DEATHS = 3
#: Tasks in flight for each worker, so that none waits for the next one.
AHEAD = 2
#: Time limit for a Dask scheduler to answer, and to have a worker [s].
PATIENCE = 30.0

#: The result of a task, as JSON values.
Result = dict[str, Any]


class Task(NamedTuple):
    """A piece of work for any process."""

    key: str  #: unique
    work: Callable[[], Result]  #: can be pickled


#: (key, result) of each task as it finishes; to be closed if not exhausted.
Results = Generator[tuple[str, Result], None, None]


def processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_this_process(tasks: Iterator[Task]) -> Results:
    """Run one task after the other."""
    for task in tasks:
        yield task.key, task.work()


# ---- processes of this machine --------------------------------------------------------


def in_processes(tasks: Iterator[Task], jobs: int) -> Results:
    """Run tasks on processes of this machine, which are replaced if they die.

    Raises:
        EngineError: they die again and again.
    """
    waiting: deque[Task] = deque()
    deaths = 0
    while deaths <= DEATHS:
        running: dict[Future[Result], Task] = {}
        try:
            with _pool(jobs) as pool:
                for finished in _finished(running, pool, waiting, tasks, AHEAD * jobs):
                    deaths = 0
                    yield finished
        except BrokenProcessPool:
            waiting.extend(running.values())
            deaths += 1
        else:
            return
    raise EngineError(
        f"the workers died {deaths} times in a row; make tasks smaller, or take fewer jobs "
        "(--jobs), if memory is short. Finished tasks are kept"
    )


def _finished(
    running: dict[Future[Result], Task],
    pool: ProcessPoolExecutor,
    waiting: deque[Task],
    tasks: Iterator[Task],
    most: int,
) -> Results:
    """Keep up to ``most`` tasks running, first those that wait, and yield them as they finish."""
    while True:
        waiting.extend(islice(tasks, most - len(running) - len(waiting)))
        while waiting and len(running) < most:
            with _interrupts_blocked():  # a process may start here
                running[pool.submit(waiting[0].work)] = waiting[0]
            waiting.popleft()
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            result = future.result()
            yield running.pop(future).key, result


@contextmanager
def _pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Open a pool of processes; after an error or Ctrl-C, do not wait for unfinished tasks."""
    others = set(active_children())
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), initializer=_begin)
    try:
        yield pool
    except BaseException:
        for child in set(active_children()) - others:
            child.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _begin() -> None:
    """Ignore Ctrl-C, which is for the parent, and end with the parent, even if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if (parent := parent_process()) is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C, so that a process started here does not see one before it can ignore it."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# ---- a Dask cluster -------------------------------------------------------------------


def on_dask(tasks: Iterator[Task], address: str, name: str) -> Results:
    """Run tasks on the workers of a Dask scheduler, which need this package too, but no files.

    Args:
        tasks: to run.
        address: of the scheduler, such as tcp://10.0.0.1:8786.
        name: of the work, for the scheduler's dashboard.

    Raises:
        MissingExtraError: dask.distributed is not installed.
        EngineError: the scheduler or its workers cannot be reached, or a task kills each worker.
    """
    distributed = _distributed()
    try:
        client = distributed.Client(address, timeout=PATIENCE)
    except (OSError, ValueError, TimeoutError) as error:
        raise EngineError(f"there is no Dask scheduler at {address}: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise EngineError(
                f"the Dask scheduler at {address} has no workers; start some: dask worker {address}"
            ) from None
        _check_versions(client, address)
        try:
            yield from _flow(distributed, client, tasks, name)
        except distributed.KilledWorker as error:
            raise EngineError(
                f"a task killed each Dask worker that took it ({error}); make tasks smaller "
                "if memory is short. Finished tasks are kept"
            ) from error
        except (CancelledError, OSError) as error:
            raise EngineError(
                f"the Dask scheduler at {address} is lost ({error}); run the same command again to "
                "go on"
            ) from error


def _check_versions(client: Any, address: str) -> None:
    here = version("maplines_can")
    try:
        there = set(client.run(version, "maplines_can").values())
    except PackageNotFoundError:
        there = {"none"}
    if there != {here}:
        raise EngineError(
            f"the workers of {address} need maplines_can {here}, as there is here; they have "
            f"{', '.join(sorted(there))}"
        )


def _flow(distributed: Any, client: Any, tasks: Iterator[Task], name: str) -> Results:
    keys: dict[Any, str] = {}
    flow = distributed.as_completed()

    def refill() -> None:
        threads = sum(client.nthreads().values())
        while len(keys) < AHEAD * max(threads, 1):
            task = next(tasks, None)
            if task is None:
                return
            future = client.submit(task.work, key=f"{name}-{task.key}", pure=False)
            keys[future] = task.key
            flow.add(future)

    refill()
    for future in flow:
        result = future.result()
        key = keys.pop(future)
        future.release()
        refill()
        yield key, result


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise missing_extra("--scheduler needs Dask", "study") from error
    return distributed
