"""A server of facts, and a browser that shows them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from support.browser import CHROMIUM, Browser

from maplines_can.desk.history import FactHistory
from maplines_can.desk.server import ViewServer


@contextmanager
def serving(history: FactHistory, what: Any, **settings: Any) -> Iterator[ViewServer]:
    """Serve facts on a port that is free."""
    server = ViewServer(history, what, **settings)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield server
    finally:
        server.close()
        thread.join()


@pytest.fixture(scope="session", name="serving")
def _serving() -> Callable[..., Any]:
    return serving


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no chromium here: apt-get install chromium")
    with Browser(tmp_path_factory.mktemp("profile")) as started:
        yield started
