"""The server of the page: who may read, what, and how many at a time."""

import contextlib
import json
import socket
import time
import zlib
from http.client import HTTPConnection
from typing import Any

import pytest

from maplines_can import Codec
from maplines_can.desk import server as server_module
from maplines_can.desk.history import FactHistory
from maplines_can.desk.server import FILES, HEADERS, MAX_CLIENTS, MAX_CONNECTIONS, about
from maplines_can.values.errors import BusError

FACTS = {"t": 1.0, "slots": {}, "messages": {}, "counts": {}}
ABOUT = about(Codec.from_dbc(), "a bus", is_live=True)


@pytest.fixture
def server(serving: Any) -> Any:
    history = FactHistory()
    history.add(FACTS)
    with serving(history, ABOUT) as started:
        yield started


def ask(server: Any, path: str, method: str = "GET", **headers: str) -> tuple[int, Any, bytes]:
    """Return status, headers and body of an answer."""
    connection = HTTPConnection("127.0.0.1", server.port, timeout=10)
    names = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, headers={"Host": f"127.0.0.1:{server.port}"} | names)
    answer = connection.getresponse()
    with contextlib.closing(connection):
        return answer.status, answer.headers, answer.read()


def test_what_there_is(server: Any) -> None:
    """The files of the page, and facts as JSON; all with the headers that protect them."""
    for path in FILES:
        status, headers, body = ask(server, path)
        assert status == 200
        assert len(body) > 100
        assert HEADERS.items() <= dict(headers).items()
    info = json.loads(ask(server, "/info")[2])
    assert {"name": "a bus", "is_live": True, "count": 1, "first": 0}.items() <= info.items()
    _, headers, packed = ask(server, "/parts/0")
    assert headers["Content-Encoding"] == "deflate"
    assert json.loads(zlib.decompress(packed)) == [FACTS | {"changes": []}]
    assert json.loads(ask(server, "/changes/0")[2]) == {"next": 0, "changes": []}


@pytest.mark.parametrize(
    ("path", "method", "status"),
    [
        pytest.param("/view.py", "GET", 404, id="no-file"),
        pytest.param("/../server.py", "GET", 404, id="upward"),
        pytest.param("/page/../../server.py", "GET", 404, id="upward-inside"),
        pytest.param("/%2e%2e/server.py", "GET", 404, id="upward-encoded"),
        pytest.param("//etc/passwd", "GET", 404, id="absolute"),
        pytest.param("/view.js/", "GET", 404, id="slash"),
        pytest.param("/view.js?x", "GET", 404, id="query"),
        pytest.param("http://127.0.0.1/info", "GET", 404, id="proxy"),
        pytest.param("/parts/1", "GET", 404, id="not-kept"),
        pytest.param("/parts/-1", "GET", 404, id="negative"),
        pytest.param("/parts/1e3", "GET", 404, id="not-a-number"),
        pytest.param("/parts/" + "9" * 40, "GET", 404, id="huge"),
        pytest.param("/" + "a" * 70_000, "GET", 414, id="long"),
        pytest.param("/info", "POST", 405, id="post"),
        pytest.param("/info", "HEAD", 405, id="head"),
        pytest.param("/info", "OPTIONS", 405, id="preflight"),
        pytest.param("/info", "DELETE", 405, id="delete"),
    ],
)
def test_what_there_is_not(server: Any, path: str, method: str, status: int) -> None:
    """No other path, and no method but GET."""
    found, headers, body = ask(server, path, method)
    assert found == status
    assert b"import" not in body
    assert headers["Content-Security-Policy"] == HEADERS["Content-Security-Policy"]


EVERYWHERE = "0.0.0.0"  # noqa: S104 - what --host takes
HOST = "127.0.0.1:PORT"


@pytest.mark.parametrize(
    ("headers", "is_ours"),
    [
        pytest.param({"Host": HOST}, True, id="plain"),
        pytest.param({"Host": "localhost:PORT"}, True, id="name"),
        pytest.param({"Host": "[::1]:PORT"}, True, id="v6"),
        pytest.param({"Host": HOST, "Origin": f"http://{HOST}"}, True, id="own-origin"),
        pytest.param({"Host": HOST, "Sec_Fetch_Site": "same-origin"}, True, id="own-fetch"),
        pytest.param({"Host": HOST, "Sec_Fetch_Site": "none"}, True, id="typed"),
        pytest.param({"Host": "evil.example:PORT"}, False, id="rebinding"),
        pytest.param({"Host": "evil.example"}, False, id="no-port"),
        pytest.param({"Host": "127.0.0.1:1"}, False, id="other-port"),
        pytest.param({"Host": "127.0.0.1.evil.example:PORT"}, False, id="begins-alike"),
        pytest.param({"Host": "192.0.2.1:PORT"}, False, id="other-address"),
        pytest.param({"Host": ""}, False, id="empty"),
        pytest.param({"Host": HOST, "Origin": "http://evil.example"}, False, id="other-origin"),
        pytest.param({"Host": HOST, "Origin": "null"}, False, id="sandbox"),
        pytest.param({"Host": HOST, "Origin": "http://127.0.0.1:1"}, False, id="other-server"),
        pytest.param({"Host": HOST, "Origin": f"https://{HOST}"}, False, id="other-scheme"),
        pytest.param({"Host": HOST, "Sec_Fetch_Site": "cross-site"}, False, id="cross-site"),
        pytest.param({"Host": HOST, "Sec_Fetch_Site": "same-site"}, False, id="same-site"),
    ],
)
@pytest.mark.parametrize("path", ["/", "/info", "/events", "/parts/0"])
def test_whose_requests_are_answered(
    server: Any, headers: dict[str, str], path: str, *, is_ours: bool
) -> None:
    """Those of our page, or of an address that was typed."""
    if path == "/events" and is_ours:
        return  # it does not end: see below
    given = {name: text.replace("PORT", str(server.port)) for name, text in headers.items()}
    assert ask(server, path, **given)[0] == (200 if is_ours else 403)


@pytest.mark.parametrize(
    ("host", "name", "is_known"),
    [
        pytest.param(EVERYWHERE, "192.0.2.7", True, id="address"),
        pytest.param(EVERYWHERE, "[2001:db8::1]", True, id="v6-address"),
        pytest.param(EVERYWHERE, socket.gethostname(), True, id="own-name"),
        pytest.param(EVERYWHERE, "evil.example", False, id="rebinding"),
        pytest.param("127.0.0.1", "192.0.2.7", False, id="loopback"),
    ],
)
def test_hosts_of_other_machines(serving: Any, host: str, name: str, *, is_known: bool) -> None:
    """With --host, any address is ours, since no name can be bound to it anew."""
    with serving(FactHistory(), ABOUT, host=host) as server:
        assert server.knows(f"{name}:{server.port}") == is_known
        assert server.is_loopback == (host == "127.0.0.1")


def test_an_address_that_cannot_be_used(server: Any, serving: Any) -> None:
    """The error names host, port and the cure."""
    for settings in ({"port": server.port}, {"host": "192.0.2.1"}, {"host": "no such host"}):
        with (
            pytest.raises(BusError, match=r"--host .* --port \d+: cannot be listened on: .*; "),
            serving(FactHistory(), ABOUT, **settings),
        ):
            pass


def stream(server: Any, buffer: int | None = None) -> socket.socket:
    """Return a connection that has asked for events."""
    connection = socket.socket()
    if buffer is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
    connection.settimeout(10)
    connection.connect(("127.0.0.1", server.port))
    connection.sendall(b"GET /events HTTP/1.1\r\nHost: 127.0.0.1:%d\r\n\r\n" % server.port)
    return connection


def ids(received: bytes) -> list[int]:
    return [int(line[4:]) for line in received.split(b"\n") if line.startswith(b"id: ")]


def test_a_slow_client_gets_fewer_events(server: Any) -> None:
    """It gets the newest facts once it reads; nothing waits for it."""
    slow = stream(server, 4096)
    big = FACTS | {"padding": "x" * 200_000}
    for _ in range(200):
        server.history.add(big)
    time.sleep(0.2)
    received = b""
    while not received.endswith(b"\n\n") or 200 not in ids(received):
        received += slow.recv(1 << 20)
    found = ids(received)

    assert found == sorted(found)
    assert found[-1] == 200
    assert len(found) < 50
    slow.close()


def test_events_end_with_the_facts(server: Any) -> None:
    """The newest ones have come by then."""
    client = stream(server)
    client.recv(1)
    for _ in range(3):
        server.history.add(FACTS)
    server.history.end()
    received = b""
    while chunk := client.recv(1 << 16):
        received += chunk
    assert ids(received)[-1] == 3
    client.close()


def test_further_clients_are_refused(server: Any) -> None:
    """They hear why, and get in when others have gone; the rest of the page still works."""
    clients = [stream(server) for _ in range(MAX_CLIENTS)]
    for client in clients:
        assert client.recv(100).startswith(b"HTTP/1.0 200")
    status, _, body = ask(server, "/events")
    assert (status, body) == (503, b"32 pages are open already\n")
    assert ask(server, "/info")[0] == 200
    for client in clients:
        client.close()
    server.history.add(FACTS)  # the server sees that they have gone when it writes
    end = time.monotonic() + 10
    while time.monotonic() < end:
        server.history.add(FACTS)
        with contextlib.closing(stream(server)) as one:
            if one.recv(100).startswith(b"HTTP/1.0 200"):
                return
        time.sleep(0.05)
    pytest.fail("no client gets in")


def eventually(server: Any, status: int) -> bool:
    """Return whether the server comes to answer with this status."""
    end = time.monotonic() + 20
    while time.monotonic() < end:
        if ask(server, "/info")[0] == status:
            return True
        time.sleep(0.05)
    return False


def test_connections_that_say_nothing(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are limited in number and time, so that the page is back by itself."""
    monkeypatch.setattr(server_module._Handler, "timeout", 3.0)
    address = ("127.0.0.1", server.port)
    silent = [socket.create_connection(address) for _ in range(MAX_CONNECTIONS)]

    assert eventually(server, 503)
    assert eventually(server, 200)
    for connection in silent:
        connection.close()
