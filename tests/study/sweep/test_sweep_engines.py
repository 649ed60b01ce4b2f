"""Engines: interrupts, killed processes, and a Dask cluster change nothing in the result."""

import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import pytest
from support.study_helpers import small, tables

from maplines_can.engines import Task, _check_versions, in_processes
from maplines_can.study.sweep.run import run_study
from maplines_can.values.errors import EngineError


def kill_this_process() -> None:
    """Die as by the kernel when memory is short."""
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_task_that_kills_each_process_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is tried a few times only, and the message has advice."""
    monkeypatch.setattr("maplines_can.engines.DEATHS", 1)

    with pytest.raises(EngineError, match=r"died 2 times in a row; make tasks smaller"):
        list(in_processes(iter([Task("deadly", kill_this_process)]), 1))  # type: ignore[arg-type]


@contextlib.contextmanager
def dask_process(*arguments: Any) -> Iterator[Any]:
    """Run a program of Dask's command line; its stderr is piped."""
    command = [sys.executable, "-m", *arguments, "--host", "127.0.0.1", "--no-dashboard"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def test_a_killed_dask_worker_changes_nothing(undisturbed: Any, tmp_path: Path) -> None:
    """One of two workers is killed while it has work; the tables are the same to the last bit."""
    distributed = pytest.importorskip("distributed")
    scheduler_module, worker_module = (
        "distributed.cli.dask_scheduler",
        "distributed.cli.dask_worker",
    )
    killed: list[Any] = []
    with contextlib.ExitStack() as stack:
        scheduler = stack.enter_context(dask_process(scheduler_module, "--port", "0"))
        log = iter(scheduler.stderr.readline, "")
        address = next(line.split()[-1] for line in log if "Scheduler at:" in line)
        worker = (worker_module, address, "--nthreads", "1", "--no-nanny")
        workers = [stack.enter_context(dask_process(*worker)) for _ in range(2)]
        watcher = stack.enter_context(distributed.Client(address))
        watcher.wait_for_workers(2, timeout=30)
        pids = watcher.run(os.getpid)
        victim = next(name for name, pid in pids.items() if pid == workers[0].pid)

        def kill(done: Any, total: Any) -> None:
            if done and not killed and watcher.processing()[victim]:
                os.kill(pids[victim], signal.SIGKILL)
                assert workers[0].wait() == -signal.SIGKILL
                killed.append(done)

        result = tables(run_study(small(), tmp_path / "out", scheduler=address, progress=kill))

    assert killed
    assert killed[0] < 400
    assert undisturbed == result


@pytest.mark.parametrize("there", [{"tcp://a": "0.0.1"}, PackageNotFoundError])
def test_workers_of_another_version_are_refused(there: Any) -> None:
    """Their results would be those of another program."""

    class Client:
        def run(self, _function: Any, package: Any) -> Any:
            if isinstance(there, dict):
                return there
            raise there(package)

    with pytest.raises(EngineError, match=r"need maplines_can .*; they have (0.0.1|none)"):
        _check_versions(Client(), "tcp://b")


def test_a_missing_scheduler_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The message has its address."""
    pytest.importorskip("distributed")
    pytest.importorskip("pyarrow")
    monkeypatch.setattr("maplines_can.engines.PATIENCE", 0.2)

    with pytest.raises(EngineError, match=r"no Dask scheduler at tcp://127\.0\.0\.1:9"):
        run_study(small(), tmp_path / "out", scheduler="tcp://127.0.0.1:9")


def test_a_killed_process_changes_nothing(undisturbed: Any, tmp_path: Path) -> None:
    """All processes die once in the middle; others do their work."""
    killed: list[Any] = []

    def kill(done: Any, total: Any) -> None:
        if done and not killed:
            for child in multiprocessing.active_children():
                os.kill(child.pid, signal.SIGKILL)  # type: ignore[arg-type]
                killed.append(child.pid)

    result = tables(run_study(small(), tmp_path / "out", jobs=2, progress=kill))

    assert killed
    assert undisturbed == result


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_interrupted_study_continues_to_the_same_result(
    jobs: int, undisturbed: Any, tmp_path: Path
) -> None:
    """After Ctrl-C in the middle, finished tasks are not run again."""

    def interrupt(done: Any, total: Any) -> None:
        if done >= 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(small(), tmp_path / "out", jobs=jobs, progress=interrupt)
    assert multiprocessing.active_children() == []
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "chunks").iterdir()}
    assert 2 <= len(kept) < 8

    assert undisturbed == tables(run_study(small(), tmp_path / "out", jobs=1))
    assert kept.items() <= {path: path.stat().st_mtime_ns for path in kept}.items()
