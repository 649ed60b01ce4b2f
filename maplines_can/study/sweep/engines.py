"""Engines: run the tasks of a study in this process, or on Dask workers here or elsewhere.

An engine takes an iterator of tasks and yields ``(key, result)`` as tasks finish, in any order. It
draws only a few tasks ahead of its workers, so that memory use stays flat. If a worker dies, Dask
runs its tasks again on another one.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

from ...errors import MissingExtraError, StudyError

__all__ = ["Result", "Results", "Task", "in_this_process", "on_dask"]

#: Tasks in flight for each worker thread, so that none waits for the next one.
AHEAD = 2
#: Time limit for a Dask scheduler to answer, and to have a worker [s].
PATIENCE = 30.0

#: The result of a task, as JSON values.
Result = dict[str, Any]


class Task(NamedTuple):
    """A piece of work for any process."""

    key: str  #: unique within a study
    work: Callable[[], Result]  #: can be pickled


#: (key, result) of each task as it finishes; to be closed if not exhausted.
Results = Generator[tuple[str, Result], None, None]


def in_this_process(tasks: Iterator[Task]) -> Results:
    """Run one task after the other."""
    for task in tasks:
        yield task.key, task.work()


def on_dask(tasks: Iterator[Task], name: str, *, jobs: int = 1, address: str = "") -> Results:
    """Run tasks on processes of this machine, or on the workers of a Dask scheduler.

    The workers of a scheduler need this package too, but no files.

    Args:
        tasks: to run.
        name: of the study, for the scheduler's dashboard.
        jobs: processes, if there is no address.
        address: of a scheduler, such as tcp://10.0.0.1:8786.

    Raises:
        MissingExtraError: dask.distributed is not installed.
        StudyError: the scheduler or its workers cannot be reached, or a task kills each worker.
    """
    try:
        import distributed
    except ImportError as error:
        option = "--scheduler" if address else "--jobs above 1"
        raise MissingExtraError(
            f"{option} needs Dask; pip install 'maplines_can[study]'"
        ) from error
    with _client(distributed, jobs, address) as client:
        try:
            yield from _flow(distributed, client, tasks, name)
        except distributed.KilledWorker as error:
            raise StudyError(
                f"a task killed each worker that took it ({error}); make chunks smaller (--chunk) "
                "or take fewer jobs (--jobs) if memory is short. Finished tasks are kept"
            ) from error
        except (CancelledError, OSError) as error:
            raise StudyError(
                f"the Dask scheduler at {client.scheduler.address} is lost ({error}); run the same "
                "command again to go on"
            ) from error


@contextmanager
def _client(distributed: Any, jobs: int, address: str) -> Iterator[Any]:
    if not address:
        with _interrupts_blocked():
            cluster = distributed.LocalCluster(
                n_workers=jobs,
                threads_per_worker=1,
                memory_limit=0,
                dashboard_address="127.0.0.1:0",
            )
        with cluster, distributed.Client(cluster) as client:
            yield client
        return
    try:
        client = distributed.Client(address, timeout=PATIENCE)
    except (OSError, ValueError, TimeoutError) as error:
        raise StudyError(f"there is no Dask scheduler at {address}: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise StudyError(
                f"the Dask scheduler at {address} has no workers; start some: dask worker {address}"
            ) from None
        _check_versions(client, address)
        yield client


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT in threads and processes started within: Ctrl-C then reaches only the parent.

    There is no signal mask on Windows, where Ctrl-C prints a traceback for each worker.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _check_versions(client: Any, address: str) -> None:
    here = version("maplines_can")
    try:
        there = set(client.run(version, "maplines_can").values())
    except PackageNotFoundError:
        there = {"none"}
    if there != {here}:
        raise StudyError(
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
