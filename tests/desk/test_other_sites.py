"""A page of another site, in a browser on this machine: it sees nothing of ours."""

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from maplines_can import Codec
from maplines_can.desk.history import FactHistory
from maplines_can.desk.server import about

FACTS = {"t": 1.0, "slots": {}, "messages": {}, "counts": {}}
#: What the other page tries with an address of ours, and whether it got anything.
TRIES = {
    "fetch": "fetch(URL).then(() => true, () => false)",
    "fetch-blindly": "fetch(URL, {mode: 'no-cors'}).then(() => true, () => false)",
    "post": "fetch(URL, {method: 'POST', body: 'x'}).then(() => true, () => false)",
    "events": """new Promise(done => {
        const events = new EventSource(URL);
        events.onopen = events.onmessage = () => done(true);
        events.onerror = () => { events.close(); done(false); };
    })""",
    "script": """new Promise(done => {
        const script = document.createElement("script");
        script.onload = () => done(true);
        script.onerror = () => done(false);
        script.src = URL;
        document.head.append(script);
    })""",
    "image": """new Promise(done => {
        const image = new Image();
        image.onload = () => done(true);
        image.onerror = () => done(false);
        image.src = URL;
    })""",
}


class _Other(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>another site</title><p>hello")

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture(scope="module")
def sites(browser: Any, serving: Any) -> Any:
    """The browser on the page of another site, and our server."""
    history = FactHistory()
    history.add(FACTS)
    other = ThreadingHTTPServer(("127.0.0.1", 0), _Other)
    thread = threading.Thread(target=other.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    with serving(history, about(Codec.from_dbc(), "a bus", is_live=True)) as server:
        browser.call("Page.navigate", url=f"http://127.0.0.1:{other.server_address[1]}/")
        browser.wait_for("document.title === 'another site'")
        yield browser, server
    other.shutdown()
    thread.join()
    other.server_close()


@pytest.mark.parametrize("path", ["", "info", "events", "icon.svg", "view.js"])
@pytest.mark.parametrize("attempt", TRIES)
def test_nothing_is_read(sites: Any, attempt: str, path: str) -> None:
    browser, server = sites
    code = TRIES[attempt].replace("URL", repr(f"{server.url}{path}"))
    assert browser.run(code) is False


def test_the_page_itself_may(sites: Any) -> None:
    """The tries can succeed: from our own page, they do."""
    browser, server = sites
    back = browser.run("location.href")
    browser.call("Page.navigate", url=server.url)
    browser.wait_for("globalThis.maplines")
    tries = {"fetch": "info", "events": "events", "image": "icon.svg", "script": "view.js"}
    found = {name: browser.run(TRIES[name].replace("URL", f"'/{tries[name]}'")) for name in tries}
    browser.call("Page.navigate", url=back)
    assert found == dict.fromkeys(tries, True)
