"""The page in headless Chromium: what it draws is what was on the bus."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can import Codec, GaussianMixture, Kind, MapLine, Slot, Status
from maplines_can.bus import read_log
from maplines_can.cli import main
from maplines_can.desk.facts import facts_of, line_facts
from maplines_can.desk.history import FactHistory
from maplines_can.desk.log_facts import facts_of_log
from maplines_can.desk.server import about
from maplines_can.recordings.plots.log_panels import COLOURS
from maplines_can.wire import default_dbc_path

READY = "globalThis.maplines?.view.shown"
DRAWN = "new Promise(done => { maplines.view.draw(); setTimeout(done, 150) })"
X = [-60.0, -3.0, 0.0, 7.5, 20.0, 47.0, 79.0, 120.0]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20 s of a drive with its pose error; nothing comes from 8 s to 9 s."""
    path = tmp_path_factory.mktemp("log") / "drive.log"
    words = "drive --as-fast-as-possible --seconds 20 --dbc maplines-pose.dbc --faults loss=1@8-9"
    assert main([*words.split(), "--record", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def codec() -> Any:
    return Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))


@pytest.fixture(scope="module")
def facts(log: Path, codec: Any) -> list[Any]:
    return list(facts_of_log(read_log(log), codec))


@pytest.fixture(scope="module")
def page(browser: Any, serving: Any, facts: Any, codec: Any) -> Iterator[Any]:
    """The page of the log, at its 100th facts."""
    history = FactHistory()
    for one in facts:
        history.add(one)
    history.end()
    with serving(history, about(codec, "drive.log", is_live=False)) as server:
        browser.requests.clear()
        browser.errors.clear()
        browser.call("Page.navigate", url=server.url)
        browser.wait_for(READY)
        yield browser
        assert [text for text in browser.errors if "willReadFrequently" not in text] == []
        assert {url.split("/")[2] for url in browser.requests if url[:5] != "blob:"} == {
            server.url.split("/")[2]
        }


def test_bands_of_lines(page: Any, log: Path, codec: Any, facts: Any) -> None:
    """They are those of MapLine and Scene, at any x, also outside of the range."""
    decoder = codec.decoder()
    frames = read_log(log)
    page.run(f"globalThis.X = {X}")
    for number in (20, 100, 399):
        t_ns = round(facts[number]["t"] * 1e9)
        for frame in frames:
            if frame.t_ns >= t_ns:
                break
            decoder.feed(frame.can_id, frame.data, frame.t_ns)
        now = facts_of(decoder, codec.layout, t_ns)
        page.run(f"globalThis.now = {json.dumps(now)}")
        for name, slot in now["slots"].items():
            line = decoder.latest(Slot[name], t_ns).line
            found = page.run(f"X.map(x => maplines.facts.at(now.slots.{name}.line, x))")
            for x, shown in zip(X, found, strict=True):
                assert (shown is None) == bool(np.isnan(line.y(x)))
                if shown and slot["line"]:
                    assert shown["value"] == pytest.approx(line.y(x), abs=1e-6)
                    assert shown["sigma"] == pytest.approx(line.y_sigma(x), rel=1e-6)
        scene = decoder.latest_scene(t_ns).scene
        width = page.run("X.map(x => maplines.facts.width(now, x))")
        expected = scene.width(X)
        for k, shown in enumerate(width):
            assert (shown is None) == bool(np.isnan(expected.value[k]))
            if shown:
                assert shown["value"] == pytest.approx(expected.value[k], abs=1e-6)
                assert shown["sigma"] == pytest.approx(expected.sigma[k], rel=1e-5)


# ---- what is drawn --------------------------------------------------------------------------


def show(page: Any, lines: Any, consumer: Any = None, **slot: Any) -> None:
    """Show lines, as if each came just now, in the middle of what is drawn."""
    row = {"state": "VALID", "status": "OK", "age": 0.01, "stale": False, "usable": True}
    row |= {"two_senders": False, "left_out": None} | slot
    slots = {line.slot.name: row | {"line": line_facts(line)} for line in lines}
    traffic = {"load": 0.1, "frames": 1, "error_frames": 0, "beyond": 0, "messages": {}}
    traffic |= {"others": {"ids": 0, "frames": 0}}
    rest: Any = {"scene": None, "messages": {}, "counts": {}, "lines": 1, "changes": []}
    now = {"t": 1e9, "slots": slots, "traffic": traffic} | rest
    now |= {} if consumer is None else {"consumer": consumer}
    page.run(
        f"""(async ({{view}}) => {{
            view.store._facts.set(view.number, {json.dumps(now)});
            view.go(view.number);
            await {DRAWN};
            view.store._facts.delete(view.number); // asked for again
            view.store._whole.clear();
        }})(maplines)"""
    )


def row_at(page: Any, ahead: float) -> tuple[Any, Any]:
    """Return the y in metres, and the colours, of the pixels of the view from above at an x."""
    found = page.run(
        f"""(() => {{
            const c = document.getElementById("above");
            const map = maplines.charts.project(
                {{width: c.clientWidth, height: c.clientHeight}}, maplines.view.view);
            const row = Math.round(map.toY({ahead}));
            const data = c.getContext("2d").getImageData(0, row, c.width, 1).data;
            const left = [...Array(c.width).keys()].map(k => map.left(k + 0.5));
            return {{left, data: [...data]}};
        }})()"""
    )
    return np.array(found["left"]), np.array(found["data"]).reshape(-1, 4)[:, :3]


def distance(colours: Any, colour: str) -> Any:
    """Return how far colours are from one, 0 to 255."""
    rgb = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    return np.abs(colours - np.array(rgb)).max(axis=1)


LINE = MapLine.with_sigma(
    Slot.EGO_LEFT,
    [1.5, 0.02, 1e-3, 0.0],
    [0.2, 0.01, 1e-4, 1e-7],
    kind=Kind.SOLID,
    x_min=-5.0,
    x_max=45.0,
)


@pytest.mark.parametrize("ahead", [-2.0, 13.0, 33.0])
def test_a_line_is_drawn_where_it_is(page: Any, ahead: float) -> None:
    """In its colour at its mean, in steps at 1, 2 and 3 sigma; beyond, nothing is."""
    show(page, [LINE])
    left, colours = row_at(page, ahead)
    z = (left - LINE.y(ahead)) / LINE.y_sigma(ahead)
    line = distance(colours, COLOURS[Slot.EGO_LEFT])
    shade = distance(colours, "#ffffff")
    pixel = abs(left[1] - left[0]) / LINE.y_sigma(ahead)
    inside = [shade[(np.abs(z) > k + pixel) & (np.abs(z) < k + 1 - 2 * pixel)] for k in range(4)]

    assert line[np.abs(z) < pixel].max() < 60
    for inner, outer in pairwise(inside[:3]):
        assert np.median(inner) > np.median(outer) + 20
    assert np.median(inside[2]) > 20
    assert np.median(inside[3]) == 0


def test_nothing_is_drawn_outside_of_the_range(page: Any) -> None:
    show(page, [LINE])
    for ahead, is_drawn in ((-5.8, False), (-4.5, True), (44.0, True)):
        _, colours = row_at(page, ahead)
        near = distance(colours, COLOURS[Slot.EGO_LEFT]) < 60
        assert near.any() == is_drawn


def test_a_line_that_is_not_usable(page: Any) -> None:
    """Grey, without bands."""
    show(page, [LINE], usable=False, state="INVALID")
    left, colours = row_at(page, 22.0)
    z = (left - LINE.y(22.0)) / LINE.y_sigma(22.0)
    is_coloured = np.ptp(colours, axis=1) > 40
    assert not is_coloured.any()
    assert np.median(distance(colours, "#ffffff")[(np.abs(z) > 0.5) & (np.abs(z) < 2.5)]) == 0
    text = page.run("document.getElementById('line-table').tBodies[0].textContent")
    assert "no: INVALID" in text


def test_the_components_of_a_mixture(page: Any) -> None:
    """Each is drawn at its mean."""
    parts = [MapLine.with_sigma(Slot.CENTRE, [y, 0, 0, 0], [0.1] * 4).gaussian for y in (-3, 3)]
    show(page, [MapLine.of_mixture(Slot.CENTRE, GaussianMixture([0.4, 0.6], parts))])
    dark = []
    for ahead in np.arange(10, 12, 0.2):
        left, colours = row_at(page, ahead)
        shade = distance(colours, "#ffffff")
        dark.append([shade[np.abs(left - y) < 0.08].max() for y in (-3, 3)])
    assert (np.max(dark, axis=0) > np.median(dark) - 1).all()
    assert (np.max(dark, axis=0) > 120).all()


def test_what_a_consumer_has(page: Any) -> None:
    """The fused lane is drawn with its bands, camera lines as dots, rejected ones in grey."""
    fused = MapLine.with_sigma(Slot.EGO_LEFT, [6.0, 0, 0, 0], [0.3, 0, 0, 0])
    camera = [MapLine.with_sigma(Slot.EGO_LEFT, [y, 0, 0, 0], [0.1] * 4) for y in (-2.0, -5.0)]
    consumer = {
        "fused": {"slots": ["EGO_LEFT"], "lines": {"EGO_LEFT": line_facts(fused)}, "joint": []},
        "camera": {
            f"{k}": {"line": line_facts(line), "is_rejected": k == 1}
            for k, line in enumerate(camera)
        },
    }
    show(page, [LINE], consumer=consumer)
    rows = [row_at(page, ahead) for ahead in np.arange(22, 26, 0.2)]
    left, colours = rows[0][0], np.min([colours for _, colours in rows], axis=0)
    shade = distance(rows[0][1], "#ffffff")
    inside = np.median(shade[(np.abs(left - 6) > 0.05) & (np.abs(left - 6) < 0.85)])

    assert inside > 20
    assert np.median(shade[(np.abs(left - 6) > 0.95) & (np.abs(left - 6) < 1.2)]) == 0
    near = [colours[np.abs(left - y) < 0.05].min(axis=0) for y in (-2.0, -5.0)]
    assert np.ptp(near[0]) > 100
    assert np.ptp(near[1]) < 40
    assert near[1].max() < 160


def test_a_line_left_out_is_named(page: Any) -> None:
    show(page, [LINE], usable=False, left_out="COVARIANCE")
    assert page.run("document.getElementById('left-out').textContent") == (
        "Left out by the sender: ego left (covariance)"
    )


def test_an_unknown_covariance_has_no_bands(page: Any) -> None:
    """It would cover everything."""
    show(page, [MapLine.mean_only(Slot.EGO_LEFT, [1.5, 0, 0, 0])])
    assert Status.UNKNOWN.name.lower() in page.run("document.body.textContent")
    left, colours = row_at(page, 33.0)
    assert np.median(distance(colours, "#ffffff")[np.abs(left - 1.5) > 1]) == 0


# ---- time -----------------------------------------------------------------------------------


def number(page: Any) -> int:
    return int(page.run("maplines.view.number"))


def press(page: Any, *keys: str) -> None:
    for key in keys:
        page.run(
            f"document.body.dispatchEvent(new KeyboardEvent('keydown', {{key: {key!r}, "
            "bubbles: true, cancelable: true}))"
        )
    page.run(DRAWN)


def test_steps_and_faults(page: Any, facts: Any) -> None:
    """Keys lead facts by facts, by a second, and to the facts at which something was lost."""
    page.run("maplines.view.go(100)")
    for keys, expected in (
        (["ArrowRight"], 101),
        (["ArrowLeft", "ArrowLeft"], 99),
        (["Home"], 0),
        (["ArrowLeft"], 0),
        (["End"], len(facts) - 1),
        (["ArrowRight"], len(facts) - 1),
    ):
        press(page, *keys)
        assert number(page) == expected
    times = [one["t"] for one in facts]
    press(page, "ArrowLeft")
    page.run("maplines.view.skip(-1)")
    page.run(DRAWN)
    assert times[number(page)] == pytest.approx(times[-2] - 1, abs=0.051)
    for t in np.linspace(times[0], times[-1], 40):
        page.run(f"maplines.view.goToTime({t})")
        page.wait_for(f"maplines.view.shown.t <= {t} && maplines.view.shown.t > {t} - 0.051", 5)

    is_late = [k for k, one in enumerate(facts) if 7.9 < one["t"] - facts[0]["t"] < 10]
    page.run("maplines.view.go(100)")
    press(page, "n")
    assert number(page) in is_late
    first = number(page)
    press(page, "n", "n", "p", "p")
    assert number(page) == first
    text = page.run("document.querySelector('#changes button').textContent")
    assert "missing in their cycle" in text or "VALID ->" in text


@pytest.mark.parametrize("speed", [0.5, 10])
def test_play(page: Any, speed: float) -> None:
    """It goes on at its speed, and can be paused."""
    page.run(f"maplines.view.go(20); maplines.view.speed = {speed}")
    begin = page.run("maplines.view.time")
    passed = page.run(
        """(async () => {
            const begin = performance.now();
            maplines.view.toggle();
            await new Promise(done => setTimeout(done, 1200));
            maplines.view.toggle();
            return (performance.now() - begin) / 1000;
        })()"""
    )
    shown = page.run("maplines.view.shown.t") - begin
    page.run("maplines.view.speed = 1")
    assert page.run("maplines.view.mode") == "pause"
    assert 0.5 * speed * passed < shown + 0.05
    assert shown < speed * passed + 0.1


def test_what_is_saved(page: Any, facts: Any) -> None:
    """The table has the facts of the time that is drawn; the picture, all that is drawn."""
    page.run("maplines.view.go(100)")
    page.wait_for("maplines.view.shown.t === maplines.view.store.get(100)?.t")
    page.run(DRAWN)
    low, high = page.run("maplines.view.window")
    times = [one["t"] for one in facts if low <= one["t"] <= high]
    by_time = {one["t"]: one for one in facts}
    page.run("maplines.view.whole()")
    text = page.run("import('/controls.js').then(({table}) => table(maplines.view))")
    rows = list(csv.DictReader(io.StringIO(text)))

    assert sorted({float(row["t"]) for row in rows}) == pytest.approx(times)
    for row in rows[::50]:
        line = by_time[float(row["t"])]["slots"][row["slot"]]["line"]
        assert [float(row[name]) for name in ("y_off", "beta", "c0", "c1")] == line["mean"]
        assert float(row["sigma_y_off"]) == pytest.approx(line["cov"][0] ** 0.5)
        assert (row["y"] == "") == (line["x"][1] < 20)
    width, height, colours = page.run(
        """import('/controls.js').then(({wholePicture}) => {
            const c = wholePicture(maplines.view);
            const {data} = c.getContext("2d").getImageData(0, 0, c.width, c.height);
            const colours = new Set();
            for (let k = 0; k < data.length; k += 4)
                colours.add((data[k] << 16) | (data[k + 1] << 8) | data[k + 2]);
            return [c.width, c.height, [...colours]];
        })"""
    )
    assert min(width, height) > 1000
    assert {int(COLOURS[slot][1:], 16) for slot in (Slot.EGO_LEFT, Slot.EGO_RIGHT)} <= set(colours)


# ---- what persons need ----------------------------------------------------------------------


def test_names_for_screen_readers(page: Any) -> None:
    """Each picture, button and field has a name; that of the view from above has the lines."""
    page.run("maplines.view.go(100)")
    page.run(DRAWN)
    unnamed = page.run(
        """[...document.querySelectorAll("button, select, input, canvas:not([aria-hidden])")]
            .filter(e => !e.getAttribute("aria-label") && !e.textContent.trim())
            .filter(e => !e.labels?.length)
            .map(e => e.id)"""
    )
    assert unnamed == []
    name = page.run("document.getElementById('above').getAttribute('aria-label')")
    assert "ego left at" in name


@pytest.mark.parametrize(("width", "scheme"), [(1300, "dark"), (390, "light"), (390, "dark")])
def test_phones_and_the_dark(page: Any, width: int, scheme: str) -> None:
    """Nothing is wider than the screen, and the surface has the scheme; a switch changes it."""
    page.resize(width, 800)
    page.scheme(scheme)
    show(page, [LINE])
    page.run(DRAWN)
    assert page.run("document.documentElement.scrollWidth") <= width
    _, colours = row_at(page, 60.0)
    is_dark = [bool(np.median(colours) < 128)]
    page.run("document.getElementById('theme').click()")
    page.run(DRAWN)
    is_dark.append(bool(np.median(row_at(page, 60.0)[1]) < 128))
    page.run("document.getElementById('theme').click()")
    page.resize(1300, 900)
    page.scheme("light")
    assert is_dark == [scheme == "dark", scheme != "dark"]
