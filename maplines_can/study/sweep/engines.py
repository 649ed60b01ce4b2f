"""Who does the work of a study: this process, processes of this machine, or a Dask cluster.

An engine takes an iterator of tasks and yields ``(key, content)`` as they are done, in any order.
It draws a few tasks ahead of its workers and no more, so that memory stays flat. A worker that dies
changes nothing in the end: its tasks are done again.
"""

from __future__ import annotations

import os
import signal
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.connection import wait as wait_for_end
from typing import Any

from ...errors import MissingExtraError, StudyError

__all__ = ["Task", "in_processes", "in_this_process", "on_dask"]

#: Times that workers may die one after the other with no task done in between.
DEATHS = 3
#: Tasks that wait for each worker, so that it need not wait for them.
AHEAD = 2
#: How long a Dask cluster may take to answer, and to have a worker [s].
PATIENCE = 30.0


class Task(ABC):
    """A piece of work that any process can do."""

    key: str  #: no two tasks of a study have the same
    weight: int  #: of the progress

    @abstractmethod
    def content(self) -> bytes:
        """Do the work."""


#: (key, content) of each task, as it is done; to be closed where they are not all taken.
Results = Generator[tuple[str, bytes], None, None]


def in_this_process(tasks: Iterator[Task]) -> Results:
    """One after the other."""
    for task in tasks:
        yield task.key, task.content()


# ---- processes of this machine --------------------------------------------------------


def in_processes(tasks: Iterator[Task], jobs: int) -> Results:
    """On so many processes, which are started anew where one dies.

    Raises:
        StudyError: they die again and again.
    """
    owed: deque[Task] = deque()
    deaths = 0
    while True:
        others = set(active_children())
        pool = ProcessPoolExecutor(jobs, get_context("spawn"), initializer=_begin)
        running: dict[Future[bytes], Task] = {}
        try:
            while True:
                while len(running) < AHEAD * jobs and (owed or _draw(tasks, owed)):
                    with _no_interrupts():
                        running[pool.submit(_work, owed[0])] = owed[0]
                    owed.popleft()
                if not running:
                    return
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    content = future.result()
                    task = running.pop(future)
                    deaths = 0
                    yield task.key, content
        except BrokenProcessPool:
            deaths += 1
            owed.extendleft(reversed(running.values()))
            if deaths > DEATHS:
                raise StudyError(
                    f"the workers died {deaths} times in a row; make chunks smaller (--chunk) or "
                    "take fewer jobs (--jobs) if memory is short. What is done is kept"
                ) from None
        except BaseException:  # Ctrl-C above all: nobody waits for what is half done
            for child in set(active_children()) - others:
                child.terminate()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _draw(tasks: Iterator[Task], owed: deque[Task]) -> bool:
    """Whether there is another task; it is put with those that are owed."""
    task = next(tasks, None)
    if task is not None:
        owed.append(task)
    return task is not None


def _work(task: Task) -> bytes:
    return task.content()


def _begin() -> None:
    """In each new process: Ctrl-C is the parent's affair, and without a parent there is no work."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    wait_for_end([sentinel])
    os._exit(1)


@contextmanager
def _no_interrupts() -> Iterator[None]:
    """A process that is started in here is deaf to Ctrl-C from its first instruction on."""
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
    """On the workers of a Dask scheduler, which need this package too, and no files.

    Args:
        tasks: to be done.
        address: of the scheduler, such as tcp://10.0.0.1:8786.
        name: of the study, for the scheduler's dashboard.

    Raises:
        MissingExtraError: dask.distributed is not installed.
        StudyError: there is no scheduler or no worker, or they are lost.
    """
    distributed = _distributed()
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
        try:
            yield from _flow(distributed, client, tasks, name)
        except distributed.KilledWorker as error:
            raise StudyError(
                f"a task killed each Dask worker that took it ({error}); make chunks smaller "
                "(--chunk) if memory is short. What is done is kept"
            ) from error
        except (CancelledError, OSError) as error:
            raise StudyError(
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
            future = client.submit(_work, task, key=f"{name}-{task.key}", pure=False)
            keys[future] = task.key
            flow.add(future)

    refill()
    for future in flow:
        content = future.result()
        key = keys.pop(future)
        future.release()
        refill()
        yield key, content


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise MissingExtraError(
            "--scheduler needs Dask; pip install 'maplines_can[study]'"
        ) from error
    return distributed
