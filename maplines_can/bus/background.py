"""A thread whose errors reach the caller, and a lock that survives a fork."""

from __future__ import annotations

import os
import threading
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self
from weakref import WeakSet


class ForkSafeCondition(threading.Condition):
    """Condition whose lock is not held in a forked child.

    A fork copies the lock but not the thread that holds it, so nothing would release it there.
    """

    def __init__(self) -> None:
        super().__init__()
        _conditions.add(self)


_conditions: WeakSet[ForkSafeCondition] = WeakSet()


def _free_conditions() -> None:
    for condition in _conditions:
        threading.Condition.__init__(condition)


if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=_free_conditions)


class BackgroundThread(ABC):
    """Thread that runs from `start`, or ``with``, until `stop`, and keeps its error.

    A subclass implements `start` and `_run`. `_run` returns soon after `_stopping` is set.
    An exception that it raises is raised again in the caller's thread, by `wait` and `stop`.

    The thread is a daemon: it does not keep a program from ending. It does not run in a forked
    child, where `stop` and `wait` return at once.

    Args:
        name: of the thread.
    """

    def __init__(self, name: str) -> None:
        self._changed = ForkSafeCondition()  # guards the state of the subclass, too
        self._stopping = False  # the thread shall end
        self._ended = False  # the thread has ended, or will never start
        self._error: Exception | None = None
        self._error_raised = False
        self._name = name
        # Made when it is started: in a forked child, Python 3.13 takes each thread object of the
        # parent for one that has ended, even if it was never started.
        self._thread: threading.Thread | None = None
        self._process: int | None = None  # the process in which the thread was started

    def __reduce__(self) -> str:
        name = type(self).__name__
        raise TypeError(
            f"a {name} cannot be pickled or copied, since it has a thread; pickle the Codec, and "
            f"make a {name} in the other process"
        )

    @abstractmethod
    def start(self) -> Self:
        """Start the thread; ``with`` calls this."""

    @abstractmethod
    def _run(self) -> None:
        """Do the work of the thread until `_stopping` is set; `_changed` is notified then."""

    def stop(self) -> None:
        """Finish what is in progress and end; from any thread, any number of times.

        Raises:
            Exception: the error that ended the thread, unless it was raised before.
        """
        self._end()
        if not self._error_raised:
            self._raise_error()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the end of the thread, for at most ``timeout`` [s].

        Returns:
            Whether the thread has ended, was never started, or runs in the parent process only.

        Raises:
            Exception: the error that ended the thread.
        """
        self._join(timeout)
        self._raise_error()
        return not self._alive

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.stop()
        else:
            self._end()  # the exception of the body matters more than that of the thread

    @property
    def _alive(self) -> bool:
        # Not Thread.is_alive: if Ctrl-C interrupts it, Python 3.11 marks the thread as ended.
        return self._is_started and self._process == os.getpid() and not self._ended

    @property
    def _is_started(self) -> bool:
        return self._thread is not None and self._thread.ident is not None

    @property
    def _is_stopped(self) -> bool:
        """Whether the thread was told to end, or runs in the parent process only."""
        return self._stopping or self._process not in (None, os.getpid())

    def _start_thread(self) -> Self:
        if self._is_started:
            name = type(self).__name__
            raise RuntimeError(f"a {name} can be started only once; make a new one")
        self._process = os.getpid()
        self._thread = threading.Thread(target=self._run_and_end, name=self._name, daemon=True)
        self._thread.start()
        return self

    def _end(self) -> None:
        with self._changed:
            self._stopping = True
            self._ended = not self._alive
            self._changed.notify_all()
        self._join()

    def _join(self, timeout: float | None = None) -> None:
        """Wait for the end; return at once in the thread itself or if it never started."""
        if self._thread is not threading.current_thread():
            # Not Thread.join, for the same reason as in _alive.
            with self._changed:
                self._changed.wait_for(lambda: not self._alive, timeout)

    def _raise_error(self) -> None:
        if self._error is not None:
            self._error_raised = True
            raise self._error

    def _run_and_end(self) -> None:
        try:
            self._run()
        except Exception as error:  # noqa: BLE001 - kept, and raised where the caller sees it
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()
