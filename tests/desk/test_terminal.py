"""The screen of a terminal: it fits, tells what the facts are, and only its changes are written."""

import re
from itertools import chain
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support.scene_streams import CONDITIONAL, new_codec, road_scene

from maplines_can import Slot
from maplines_can.desk.facts import facts_of
from maplines_can.desk.screen import Painter, cells, clean, plain
from maplines_can.desk.terminal import ASCII, Look, Shown, screen
from maplines_can.desk.traffic import Traffic
from maplines_can.desk.watch import Watch
from maplines_can.logs.first_frames import CanId

FOUR = (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.NEXT_LEFT, Slot.NEXT_RIGHT)
T_NS = 1_700_000_000_000_000_000
NOTHING: Any = {"slots": {}, "messages": {}, "counts": {}}
LOOK = Look("virtual a", "maplines.dbc", at=(10.0, 20.0))

names = st.text(max_size=40) | st.sampled_from(["EGO_LEFT", "EGO_RIGHT", "車線の左側", "pose"])
numbers = st.none() | st.floats() | st.floats(-10, 10)
counts = st.integers(0, 10**30)


def upper(n: int) -> Any:
    return st.lists(numbers, min_size=n * (n + 1) // 2, max_size=n * (n + 1) // 2)


lines = st.fixed_dictionaries(
    {
        "t": numbers,
        "kind": names,
        "status": names,
        "x": st.lists(numbers, min_size=2, max_size=2),
        "mean": st.lists(numbers, min_size=4, max_size=4),
        "cov": upper(4),
        "mixture": st.none() | st.just([[1.0, [], []]] * 3),
    }
)
slots = st.fixed_dictionaries(
    {
        "state": names,
        "age": numbers,
        "stale": st.booleans(),
        "usable": st.booleans(),
        "two_senders": st.booleans(),
        "left_out": st.none() | names,
        "line": lines,
    }
)
records = st.fixed_dictionaries(
    {"state": names}
    | dict.fromkeys(("lost", "repeated", "wrong_sequence", "errors", "no_new_data"), counts)
    | {"two_senders": st.booleans()}
)
scenes = st.fixed_dictionaries(
    {
        "age": numbers,
        "usable": st.booleans(),
        "slots": st.just(["EGO_LEFT", "EGO_RIGHT"]),
        "joint": upper(8),
        "pose": upper(3),
    }
)
frames = st.fixed_dictionaries(
    {"owner": st.none() | names, "frames": counts, "length": st.integers(0, 64), "spacing": numbers}
)
any_facts = st.fixed_dictionaries(
    {
        "t": st.floats(),
        "slots": st.dictionaries(names, slots, max_size=8),
        "scene": st.none() | scenes,
        "messages": st.dictionaries(names, records, max_size=9),
        "counts": st.dictionaries(names, counts, max_size=20),
        "lines": counts,
        "traffic": st.fixed_dictionaries(
            {
                "load": numbers,
                "frames": counts,
                "error_frames": counts,
                "messages": st.dictionaries(names, frames, max_size=60),
            }
        ),
        "link": st.fixed_dictionaries({"name": names, "up": st.booleans()}),
    }
)
any_shown = st.builds(
    Shown,
    facts=any_facts,
    since=st.just(NOTHING) | any_facts,
    before=st.none() | any_facts,
    changes=st.lists(st.tuples(st.floats(), names), max_size=60),
    filter=names,
    is_typing=st.booleans(),
    is_paused=st.booleans(),
)
looks = st.builds(
    Look,
    name=names,
    dbc=names,
    at=st.lists(st.floats(-1000, 1000), min_size=1, max_size=5).map(tuple),
    span=st.floats(0.1, 1000),
)


def facts_of_bus(dbc: str = "maplines.dbc", foreign: int = 0) -> Any:
    """Return facts of four lines on a bus, and the scene that was received last."""
    codec = new_codec(dbc)
    decoder, traffic, encoder = codec.decoder(), Traffic(codec.layout), codec.encoder()
    scene = road_scene(FOUR)
    traffic.facts(T_NS)
    for k in range(12):
        t_ns = T_NS + 50_000_000 * k
        for frame in chain.from_iterable(encoder.encode_scene(scene).values()):
            traffic.add(CanId(frame.can_id, False), len(frame.data), t_ns)
            decoder.feed(frame.can_id, bytes(frame.data), t_ns)
    for _ in range(foreign):
        decoder.feed(0x7FF, b"foreign", t_ns)
    facts = facts_of(decoder, codec.layout, t_ns) | {"traffic": traffic.facts(t_ns)}
    return facts, [decoder.latest(slot, t_ns).line for slot in FOUR], decoder.latest_scene(t_ns)


def texts(shown: Any, look: Any = LOOK, width: int = 80, height: int = 24) -> list[str]:
    return [plain(row) for row in screen(shown, look, width, height)]


@given(shown=any_shown, look=looks, width=st.integers(1, 250), height=st.integers(1, 70))
@example(Shown(NOTHING | {"t": None, "scene": None, "lines": 0}, NOTHING), LOOK, 20, 5)
def test_rows_fit_any_size(shown: Any, look: Any, width: int, height: int) -> None:
    """Whatever the facts are; nothing in them moves the cursor."""
    rows = screen(shown, look, width, height)
    assert len(rows) <= height
    for row in rows:
        text = plain(row)
        assert cells(text) <= width
        assert text == clean(text)


@pytest.mark.parametrize(("width", "height"), [(80, 24), (200, 60), (80, 8), (40, 24), (20, 5)])
def test_what_matters_most_stays(width: int, height: int) -> None:
    """Head, keys and as many lines as fit, with the pose error."""
    facts, lines, _ = facts_of_bus()
    found = texts(Shown(facts, NOTHING), LOOK, width, height)
    assert found[0].startswith("virtual a")
    assert found[-1].startswith("q quit")
    shown = {
        line.slot.name
        for line in lines
        if any(row.startswith(line.slot.name.replace("_", " ").lower()) for row in found)
    }
    assert len(shown) == min(len(lines), max(1, height - 5))


def test_numbers_are_those_of_the_lines() -> None:
    """Positions, sigmas, correlations and states, as the values themselves tell them."""
    facts, lines, _ = facts_of_bus(foreign=3)
    found = texts(Shown(facts, NOTHING), LOOK, 250, 60)
    for line in lines:
        row = next(row for row in found if row.startswith(line.slot.name.replace("_", " ").lower()))
        sigma = line.gaussian.sigma
        told = [f"{line.gaussian.mean[0]:+.2f}±{sigma[0]:.2f}", " VALID ", " yes "]
        told += [f"{1e3 * line.gaussian.mean[1]:+.1f}±{1e3 * sigma[1]:.1f}"]
        told += [f"{float(line.y(x)):+.2f}±{float(line.y_sigma(x)):.2f}" for x in LOOK.at]
        told += [f"{r:+.3f}" for r in line.gaussian.correlation[0, 1:]]
        assert all(text in row for text in told), (row, told)
    assert "FOREIGN 3" in "\n".join(found)


def test_the_road_has_each_line_at_its_place() -> None:
    """Left is left; a row for each x, the farthest first."""
    facts, lines, _ = facts_of_bus()
    look = LOOK._replace(**ASCII)  # type: ignore[arg-type]
    rows = [row for row in texts(Shown(facts, NOTHING), look) if re.match(r"\d+ m ", row)]
    assert [row.split()[0] for row in rows] == ["20", "10", "0"]
    for row, x in zip(rows, (20, 10, 0), strict=True):
        drawn = [k - 6 for k, mark in enumerate(row) if mark == "|"]
        inside = [y for line in lines if abs(y := float(line.y(x))) < look.span]
        assert drawn == sorted(round((1 - y / look.span) / 2 * 73) for y in inside)


def test_lane_from_the_joint_covariance() -> None:
    """As the scene itself computes it; without a joint covariance no sigma is told."""
    facts, _, view = facts_of_bus(CONDITIONAL)
    xs = [0.0, 10.0, 20.0]
    found = texts(Shown(facts, NOTHING))
    for name, told in (("lane width", view.scene.width(xs)), ("centre", view.scene.centre(xs))):
        row = next(row for row in found if row.startswith(name))
        each = zip(told.value, told.sigma, strict=True)
        assert re.findall(r"\S+±\S+", row) == [f"{y:+.2f}±{sigma:.2f}" for y, sigma in each]
    pose = np.sqrt(np.diag(view.scene.pose_error.cov))
    row = next(row for row in found if row.startswith("pose error"))
    assert f"sigma {pose[0]:.2f}, {pose[1]:.2f} m, {1e3 * pose[2]:.1f} mrad" in row
    row = next(row for row in texts(Shown(facts | {"scene": None}, NOTHING)) if "lane" in row)
    assert len(re.findall(r"±\?", row)) == row.count("±") == 3


@given(st.lists(st.lists(st.text(st.characters(categories=["L", "N"]), max_size=9), max_size=6)))
def test_only_changed_rows_are_written(screens: Any) -> None:
    """And they make each screen from the one before."""
    painter, shown = Painter(colours=True), [""] * 6
    for rows in screens:
        written = painter.paint([[(clean(text), "good")] for text in rows], 80, 6)
        wanted = rows + [""] * (6 - len(rows))
        for number, text in re.findall(
            r"\x1b\[(\d+);1H([^;]*?)\x1b\[K", written.replace("\x1b[2J", "")
        ):
            found = re.sub(r"\x1b\[\d*(;\d+)?m", "", text)
            assert shown[int(number) - 1] != found
            shown[int(number) - 1] = found
        assert shown == wanted
        assert (written == "") or written.endswith("\x1b[?2026l")


def moment(k: int, **counts: int) -> Any:
    """Return facts of a second k, in which 100 k frames and 20 k lines have come."""
    facts, _, _ = BUS
    traffic = facts["traffic"] | {"frames": 100 * k}
    return facts | {"t": 1e9 + k, "lines": 20 * k, "counts": counts, "traffic": traffic}


BUS: Any = facts_of_bus()


def test_rates_pause_and_reset() -> None:
    """A pause keeps the picture while counting goes on; a reset counts from there."""
    watch = Watch(LOOK)

    def head() -> str:
        return plain(watch.rows(120, 24)[1])

    watch.add(moment(1, CRC=1))
    watch.add(moment(2, CRC=3))
    assert re.search(r"  100 frames/s    20 lines/s  rejects 3  .*frames 200  lines 40", head())
    assert watch.press("p")
    watch.add(moment(3, CRC=7, FOREIGN=2))
    assert head().startswith("PAUSED")
    assert "rejects 3" in head()
    watch.press("p")
    assert "rejects 7" in head()
    watch.press("p" + "fright\n" + "r")
    watch.add(moment(4, CRC=9, FOREIGN=2))
    assert re.match(r"load .*rejects 2 .*frames 100  lines 20", head())
    assert [text for _, text in watch.shown.changes] == ["2 frames dropped: CRC"]
    assert (watch.shown.filter, watch.shown.is_paused) == ("", False)


@pytest.mark.parametrize(
    ("keys", "wanted", "goes_on"),
    [
        pytest.param("fleft\r", "left", True, id="kept"),
        pytest.param("/LEFT\n", "LEFT", True, id="slash"),
        pytest.param("fegoq", "egoq", True, id="q-is-text"),
        pytest.param("fego\rfx\x7f\x7f", "eg", True, id="goes-on-from-the-last"),
        pytest.param("fego\rfxyz\x1b", "ego", True, id="escape"),
        pytest.param("fego\x15a", "a", True, id="all-anew"),
        pytest.param("fego\x03", "ego", False, id="ctrl-c"),
        pytest.param("xyz\x1b", "", True, id="other-keys"),
        pytest.param("q", "", False, id="quit"),
    ],
)
def test_keys(keys: str, wanted: str, goes_on: bool) -> None:
    """The filter is a text of names, in any case."""
    watch = Watch(LOOK)
    watch.add(moment(1))
    assert watch.press(keys) is goes_on
    assert watch.shown.filter == wanted
    rows = [plain(row)[:10].strip() for row in watch.rows(80, 24)]
    found = {slot for slot in BUS[0]["slots"] if slot.replace("_", " ").lower() in rows}
    assert found == {
        slot for slot in BUS[0]["slots"] if wanted.lower() in slot.replace("_", " ").lower()
    }
