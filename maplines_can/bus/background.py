"""A thread that cannot fail in silence."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import Self

__all__ = ["Running", "Worker"]


class Worker:
    """Runs a function in a thread and keeps what it raises for the caller.

    The thread is a daemon: a program that ends without stopping it must end.

    Args:
        name: of the thread.
        work: runs until it is told to end, by means of its own.
        at_end: runs afterwards in any case, when the error is known.
    """

    def __init__(
        self, name: str, work: Callable[[], None], at_end: Callable[[], None] = lambda: None
    ) -> None:
        self._work, self._at_end = work, at_end
        self._error: Exception | None = None
        self._told = False
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def alive(self) -> bool:
        """Whether the thread is started and has not ended."""
        return self._thread.ident is not None and not self._ended.is_set()

    def start(self) -> None:
        """Start the thread, once."""
        self._thread.start()

    def join(self, timeout: float | None = None) -> None:
        """Wait for the end; returns at once in the thread itself or if it never started."""
        if self.alive and self._thread is not threading.current_thread():
            # Thread.join, ended by Ctrl-C, takes a thread that runs for dead (Python 3.11).
            self._ended.wait(timeout)

    def check(self, *, again: bool = True) -> None:
        """Raise the error of the thread, if any; with ``again=False`` only if nobody knows it.

        Raises:
            Exception: what the function raised.
        """
        if self._error is not None and (again or not self._told):
            self._told = True
            raise self._error

    def _run(self) -> None:
        try:
            self._work()
        except Exception as error:  # noqa: BLE001 - kept, and raised where the caller sees it
            self._error = error
        finally:
            try:
                self._at_end()
            finally:
                self._ended.set()


class Running(ABC):
    """Something with a worker, from ``start`` or ``with`` until ``stop``."""

    _worker: Worker

    @abstractmethod
    def start(self) -> Self:
        """Start the thread; ``with`` does it too."""

    @abstractmethod
    def _end(self) -> None:
        """Have the worker end, and wait for it."""

    def stop(self) -> None:
        """End after what is in progress; from any thread, any number of times.

        Raises:
            Exception: what ended the thread before, if nobody has been told yet.
        """
        self._end()
        self._worker.check(again=False)

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
            self._end()  # what is on its way out is the better news
