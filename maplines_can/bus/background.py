"""A thread whose errors reach the caller."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class BackgroundThread(ABC):
    """Thread that runs from `start`, or ``with``, until `stop`, and keeps its error.

    A subclass implements `start` and `_run`. `_run` returns soon after `_stopping` is set.
    An exception that it raises is raised again in the caller's thread, by `wait` and `stop`.

    The thread is a daemon: it does not keep a program from ending.

    Args:
        name: of the thread.
    """

    def __init__(self, name: str) -> None:
        self._changed = threading.Condition()  # guards the state of the subclass, too
        self._stopping = False  # the thread shall end
        self._ended = False  # the thread has ended, or will never start
        self._error: Exception | None = None
        self._error_raised = False
        self._thread = threading.Thread(target=self._run_and_end, name=name, daemon=True)

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
            Whether the thread has ended, or was never started.

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
        return self._thread.ident is not None and not self._ended

    def _start_thread(self) -> Self:
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
            # Not Thread.join: if Ctrl-C interrupts it, Python 3.11 marks the thread as ended.
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
