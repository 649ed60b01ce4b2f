"""Server of the page: the facts of a bus or a log over HTTP, for this machine.

It answers GET of the paths of `FILES` and of these, all of them JSON:

=================  =================================================================================
``/info``          what the facts are of, and `FactHistory.contents`
``/events``        server-sent events: the newest facts, each with its number as ``id``; a client
                   that is slow gets fewer
``/parts/N``       facts 100 N to 100 N + 99
``/changes/N``     ``next`` and ``changes``: see `FactHistory.changes`
=================  =================================================================================

A page of another site can neither read nor do anything here: there is nothing to do but to read;
a request whose ``Host`` is a name that is not ours is refused, as one after DNS rebinding is, and
so is one with the ``Origin`` of another site or a ``Sec-Fetch-Site`` that says so.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import re
import secrets
import socket
import sys
import threading
from functools import cached_property
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from socketserver import TCPServer
from typing import Any

from .. import __version__
from ..values.errors import BusError
from ..wire import LineCodec
from .facts import Facts
from .history import PART, FactHistory

#: Files of the page by their paths, and their types.
FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
    "/view.css": ("view.css", "text/css; charset=utf-8"),
    **{
        f"/{name}.js": (f"{name}.js", "text/javascript; charset=utf-8")
        for name in ("view", "facts", "charts", "tables", "controls")
    },
}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
#: Most clients that get events, and most connections in all.
MAX_CLIENTS, MAX_CONNECTIONS = 32, 96
#: Time after which a client that takes nothing, or asks nothing, is dropped [s].
TIMEOUT = 10.0
#: Names of this machine as seen from itself.
LOOPBACK = ("localhost", "127.0.0.1", "::1")


def about(codec: LineCodec, name: str, *, is_live: bool) -> Facts:
    """Return what the page has to know of its facts.

    Args:
        codec: of the lines.
        name: of the bus or the log.
        is_live: whether they are of a bus.
    """
    return {
        "name": name,
        "is_live": is_live,
        "slots": [slot.name for slot in codec.layout.slots],
        "has_scene": codec.layout.pose is not None,
        "error": None,
    }


class ViewServer(ThreadingHTTPServer):
    """HTTP server of the page; ``serve_forever`` runs it, each connection in a thread.

    Args:
        history: of the facts.
        about: what they are of, for the page.
        host: address to listen on; other machines reach one that is not of the loopback.
        port: number; 0 for one that is free.

    Raises:
        BusError: the address cannot be used.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = 128
    allow_reuse_address = sys.platform != "win32"  # there, it would share the port of another

    def __init__(
        self, history: FactHistory, about: Facts, host: str = "127.0.0.1", port: int = 0
    ) -> None:
        self.history = history
        self.about = about | {"session": secrets.token_hex(8), "part": PART, "version": __version__}
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._host = host
        self._free = threading.Semaphore(MAX_CONNECTIONS)
        self.event_clients = threading.Semaphore(MAX_CLIENTS)
        self.over = threading.Event()
        try:
            super().__init__((host, port), _Handler)
        except (OSError, OverflowError) as error:
            raise BusError(
                f"--host {host} --port {port}: cannot be listened on: {error}; "
                "another --port, or 0 for one that is free"
            ) from error

    @property
    def port(self) -> int:
        """Port on which it listens."""
        return int(self.server_address[1])

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{f'[{self._host}]' if ':' in self._host else self._host}:{self.port}/"

    @cached_property
    def is_loopback(self) -> bool:
        """Whether only this machine reaches it."""
        return self._host in LOOPBACK

    def knows(self, host: str) -> bool:
        """Return whether a ``Host`` is ours.

        That is a name of this machine; or any address if it is not for the loopback only: a name
        may have been bound anew to our address by another site, an address may not.
        """
        match = re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[^:\[\]]+)(?::(\d{1,5}))?", host)
        if match is None or int(match[2] or 80) != self.port:
            return False
        name = match[1].strip("[]").lower()
        if name in LOOPBACK or name == self._host.lower():
            return True
        return not self.is_loopback and (_is_address(name) or name == socket.gethostname().lower())

    def server_bind(self) -> None:
        """Bind the address, without a look-up of its name, which may take long."""
        TCPServer.server_bind(self)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Give a connection a thread; close it at once if there are too many."""
        if not self._free.acquire(blocking=False):
            with contextlib.suppress(OSError):
                request.settimeout(0.0)
                request.send(b"HTTP/1.0 503 Service Unavailable\r\nContent-Length: 0\r\n\r\n")
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing about a client that has gone; print a fault of the server."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)

    def close(self) -> None:
        """End ``serve_forever``, the event streams and the listening."""
        self.over.set()
        self.history.end()
        self.shutdown()
        self.server_close()


class _Handler(BaseHTTPRequestHandler):
    """Answer to one request."""

    server: ViewServer
    server_version = "maplines"
    sys_version = ""
    timeout = TIMEOUT

    def do_GET(self) -> None:
        """Answer a request."""
        path = self.path
        number = re.fullmatch(r"/(parts|changes)/(\d{1,9})", path)
        if (why := self._foreign()) is not None:
            self._refuse(HTTPStatus.FORBIDDEN, why)
        elif path in FILES:
            name, kind = FILES[path]
            self._answer((files(__package__) / "page" / name).read_bytes(), kind)
        elif path == "/info":
            self._answer_json(self.server.about | self.server.history.contents())
        elif path == "/events":
            self._events()
        elif number is None:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such path")
        elif number[1] == "changes":
            following, found = self.server.history.changes(int(number[2]))
            self._answer_json({"next": following, "changes": found})
        elif (packed := self.server.history.part(int(number[2]))) is None:
            self._refuse(HTTPStatus.NOT_FOUND, "these facts are not kept")
        else:
            self._answer(packed, "application/json", **{"Content-Encoding": "deflate"})

    def _foreign(self) -> str | None:
        """Return why a request is none of our page; None if it may be."""
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1 or not self.server.knows(hosts[0]):
            return "this server does not have that name; give the address that it printed"
        origin = self.headers.get("Origin")
        if origin is not None and origin.lower() != f"http://{hosts[0].lower()}":
            return "a page of another site has no access"
        if self.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
            return "a page of another site has no access; type the address"
        return None

    def _events(self) -> None:
        """Send the newest facts as they come, until there are no more or the client has gone."""
        if not self.server.event_clients.acquire(blocking=False):
            self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_CLIENTS} pages are open already")
            return
        try:
            self._start(HTTPStatus.OK, "text/event-stream")
            number, history = -1, self.server.history
            while True:
                newest = history.after(number, TIMEOUT / 2)
                if newest is not None:
                    number = newest.number
                    self.wfile.write(b"id: %d\ndata: %b\n\n" % newest)
                elif history.is_over:
                    return
                else:
                    self.wfile.write(b": nothing new\n\n")  # fails if the client has gone
        finally:
            self.server.event_clients.release()

    def _answer_json(self, content: Any) -> None:
        self._answer(json.dumps(content, separators=(",", ":")).encode(), "application/json")

    def _answer(self, body: bytes, kind: str, **headers: str) -> None:
        self._start(HTTPStatus.OK, kind, **headers, **{"Content-Length": str(len(body))})
        self.wfile.write(body)

    def _refuse(self, status: HTTPStatus, why: str, **headers: str) -> None:
        body = f"{why}\n".encode()
        headers |= {"Content-Length": str(len(body))}
        self._start(status, "text/plain; charset=utf-8", **headers)
        self.wfile.write(body)

    def _start(self, status: HTTPStatus, kind: str, **headers: str) -> None:
        self.send_response(status)
        for name, value in (HEADERS | {"Content-Type": kind} | headers).items():
            self.send_header(name, value)
        self.end_headers()

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse a request that is not HTTP, or none of GET."""
        del explain
        status = HTTPStatus(code)
        if status is HTTPStatus.NOT_IMPLEMENTED:
            self._refuse(HTTPStatus.METHOD_NOT_ALLOWED, "there is only GET", Allow="GET")
        else:
            self._refuse(status, message or status.phrase)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - of the base class
        """Keep the terminal for what a person should see."""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
