"""The page of a bus in headless Chromium."""

from __future__ import annotations

import threading
from typing import Any

from support.lines import scenario_lines

from maplines_can import Codec
from maplines_can.bus import Link, Transmitter
from maplines_can.desk.history import FactHistory
from maplines_can.desk.live import live_facts
from maplines_can.desk.server import about
from maplines_can.simulation import scenario


def test_a_bus(browser: Any, serving: Any) -> None:
    """It follows 20 facts a second; a pause keeps what is shown, and the past can be seen."""
    codec, channel = Codec.from_dbc(), "page of view"
    lines = scenario_lines(scenario("highway"))
    history = FactHistory(max_facts=6000)
    settings: dict[str, Any] = {"interface": "virtual", "channel": channel}
    with (
        live_facts(codec, **settings) as live,
        Link(**settings) as link,
        Transmitter(link, codec) as transmitter,
        serving(history, about(codec, live.link.name, is_live=True)) as server,
    ):
        filling = threading.Thread(
            target=lambda: [history.add(one) for one in live.each(server.over.wait)]
        )
        filling.start()
        transmitter.publish(lines)
        try:
            browser.call("Page.navigate", url=server.url)
            browser.wait_for("globalThis.maplines?.view.shown && maplines.view.number > 40")
            check_following(browser)
            assert set(browser.run("Object.keys(maplines.view.shown.slots)")) == {
                line.slot.name for line in lines
            }
        finally:
            server.over.set()
            filling.join()


def check_following(browser: Any) -> None:
    wait = "new Promise(done => setTimeout(done, 1500))"
    before = browser.run("[maplines.view.number, maplines.view.draws]")
    browser.run(wait)
    number, draws = browser.run("[maplines.view.number, maplines.view.draws]")
    assert number - before[0] > 10
    assert draws - before[1] > 5
    browser.run("document.getElementById('play').click()")
    paused = browser.run("maplines.view.shown.t")
    browser.run(wait)
    assert browser.run("maplines.view.shown.t") == paused
    assert browser.run("maplines.view.store.last") > number + 10
    browser.run("maplines.view.go(3)")
    browser.wait_for("maplines.view.shown === maplines.view.store.get(3)")
    browser.run("document.getElementById('live').click()")
    assert browser.run("maplines.view.number") > number
    browser.wait_for("document.getElementById('status').textContent === 'live'", 5)
    assert browser.errors == []
