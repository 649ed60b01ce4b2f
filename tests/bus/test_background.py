"""A background thread ends when it is told to, and its error reaches the caller."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from importlib.util import module_from_spec
from typing import Any

import pytest
from support.fake_bus import LONG

from maplines_can.bus import background
from maplines_can.bus.background import BackgroundThread


class Waiting(BackgroundThread):
    """A thread that waits for an event, and then raises an error if it has one."""

    def __init__(self, error: Any = None) -> None:
        super().__init__("test")
        self.go, self.error = threading.Event(), error

    def start(self) -> Any:
        return self._start_thread()

    def _run(self) -> None:
        self.go.wait()
        if self.error:
            raise self.error


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Let Ctrl-C interrupt this process; Python ignores it if it was started in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_while_waiting_leaves_a_thread_that_is_known_to_run() -> None:
    """A later call still waits for its end, and for all that it counts."""
    thread = Waiting().start()
    main = threading.main_thread().ident
    ctrl_c = threading.Timer(0.2, lambda: signal.pthread_kill(main, signal.SIGINT))  # type: ignore[arg-type]

    with pytest.raises(KeyboardInterrupt):  # noqa: PT012 - not before the block on a busy machine
        ctrl_c.start()
        thread.wait(LONG)

    assert not thread.wait(0.0)
    thread.go.set()
    assert thread.wait(LONG)
    ctrl_c.join()


def test_an_error_is_raised_until_stop_by_wait_and_once_by_stop() -> None:
    """The caller sees it at least once, and stop does not repeat what was raised before."""
    silent = Waiting(KeyError("a")).start()
    silent.go.set()
    with pytest.raises(KeyError):
        silent.stop()
    silent.stop()

    seen = Waiting(KeyError("b")).start()
    seen.go.set()
    for _ in range(2):
        with pytest.raises(KeyError):
            seen.wait(LONG)
    seen.stop()


def test_a_thread_that_the_system_refuses_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """There are too many threads; nobody waits for one that does not exist."""

    def refuse(self: Any) -> None:
        raise RuntimeError("can't start new thread")

    thread = Waiting()
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        with pytest.raises(RuntimeError, match="can't start"):
            thread.start()
    assert thread.wait(0.0)
    thread.go.set()
    assert thread.start().wait(LONG)
    thread.stop()


def test_a_thread_starts_once() -> None:
    """Also after its end; if the system refused it, it may be started again."""
    thread = Waiting().start()
    for _ in range(2):
        with pytest.raises(RuntimeError, match="a Waiting can be started only once"):
            thread.start()
        thread.go.set()
        assert thread.wait(LONG)


class Finishing(BackgroundThread):
    """A thread that has something left to do when it is told to end."""

    def __init__(self) -> None:
        super().__init__("test")
        self.finished = False

    def start(self) -> Any:
        return self._start_thread()

    def _run(self) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._stopping)
        for _ in range(100):
            time.sleep(0)  # lets other threads run
        self.finished = True


def test_stop_returns_after_the_last_action_of_the_thread() -> None:
    thread = Finishing().start()
    thread.stop()
    assert thread.finished


def test_an_exception_of_the_body_ends_the_thread_too() -> None:
    with pytest.raises(KeyError), Finishing() as thread:
        raise KeyError
    assert thread.finished
    assert thread.wait(0.0)


def new_module() -> Any:
    """Return the module, executed once more."""
    spec = background.__spec__
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_after_a_fork_every_condition_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever held it: the function that does this is registered when the module is imported."""
    hooks: list[Any] = []
    monkeypatch.setattr(os, "register_at_fork", lambda **hook: hooks.append(hook), raising=False)
    condition = new_module().ForkSafeCondition()
    holder = threading.Thread(target=condition.acquire)
    holder.start()
    holder.join()
    assert not condition.acquire(blocking=False)
    (hook,) = hooks
    hook["after_in_child"]()
    assert condition.acquire(blocking=False)
