"""Evidence: each in its quickest form keeps its bounds, and it finds what is wrong."""

import importlib
import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evidence import epochs, fusion, harness, lines, plausibility_roads, scenes, slots
from evidence.figures import Rms, Share
from evidence.harness import Evidence, bounds_of, matching, missed, promises, settings
from evidence.roads import random_map
from support.drive_files import town

from maplines_can import Gaussian, map_lines
from maplines_can.maps import Map
from maplines_can.study.scenes.map_scenes import SLOTS
from maplines_can.wire import Encoder

ROOT = Path(__file__).parents[1]
for _name in harness.modules():
    importlib.import_module(f"evidence.{_name}")
QUICK = [one for one in harness.REGISTRY.values() if one.quick is not None]


@pytest.mark.parametrize("one", QUICK, ids=[one.name for one in QUICK])
def test_the_quickest_form_keeps_its_bounds(one: Evidence) -> None:
    """And there is something to compare, but of data that a checkout does not have."""
    figures, bounds = one.measure(**settings(one, {}, quick=True)), bounds_of(one.name, quick=True)
    assert not [*missed(figures, bounds)]
    assert not bounds or not figures or any(matching(figures, one["figure"]) for one in bounds)
    json.dumps(figures, default=lambda number: number.item())


def test_the_page_of_the_promises_is_that_of_the_table() -> None:
    for path, text in harness.pages().items():
        assert path.read_text(encoding="utf-8") == text


def test_each_promise_names_its_evidence_and_options_that_it_has() -> None:
    for promise in promises():
        assert ("evidence" in promise) != ("command" in promise)
        if "evidence" in promise:
            one = harness.REGISTRY[promise["evidence"]]
            texts = dict(word.split("=", 1) for word in promise.get("full", "").split())
            settings(one, texts, quick=False)
    # What has no promise draws a picture.
    named = {promise.get("evidence") for promise in promises()}
    assert {name for name in harness.REGISTRY if name not in named} == {
        "pictures.joint",
        "pictures.shape",
    }


def test_each_test_that_shows_a_promise_is_there() -> None:
    for promise in promises():
        for path, name in re.findall(r"(tests/[\w/.]+)(?:::(\w+))?", promise.get("command", "")):
            assert (ROOT / path).exists(), path
            assert not name or f"def {name}(" in (ROOT / path).read_text(encoding="utf-8"), name


@pytest.mark.parametrize(
    ("value", "bound", "is_kept"),
    [
        (5.0, {"max": 5}, True),
        (5.1, {"max": 5}, False),
        (4.9, {"min": 5}, False),
        (float("nan"), {"max": 5}, False),
        (None, {"max": 5}, True),
        (True, {"yes": True}, True),
        (False, {"yes": True}, False),
        (-1, {"equal": 0}, False),
        (Share(0.02, 400), {"max": 0.01}, False),
        (Share(0.02, 399), {"max": 0.01}, True),  # 4 sqrt(0.01 0.99 / 399) = 0.0199
        (Share(0.031, 399), {"max": 0.01}, False),
        (Rms(1.3, 100), {"max": 1.0}, False),  # 4 / sqrt(200) = 0.283
        (Rms(1.28, 100), {"max": 1.0}, True),
        (Rms(0.7, 100), {"min": 1.0}, False),
    ],
)
def test_bounds(value: Any, bound: dict[str, Any], is_kept: bool) -> None:
    """A statistic of few cases has four standard errors of room."""
    found = [*missed({"a": {"b": value}}, [{"figure": "*/b", **bound}])]
    assert (not found) is is_kept


def test_a_figure_that_is_excepted_is_not_compared() -> None:
    figures = {"ramp": {"b": 2}, "jump": {"b": 2}}
    bound = {"figure": "*/b", "max": 1, "but": ["ramp/*"]}
    assert [*missed(figures, [bound])] == ["jump/b is 2, max 1"]


def test_the_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """It lists, measures, prints and tells by its status whether a bound is missed."""
    assert harness.main("", []) == 0
    listed = {line.split(" ", 1)[0] for line in capsys.readouterr().out.splitlines()}
    assert {one.name for one in QUICK} <= listed
    assert harness.main("", ["slots", "n=1e1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["slots"]["figures"]
    assert [one["poses"] for one in found.values()] == [10]
    monkeypatch.setattr(harness, "bounds_of", lambda *_, **__: [{"figure": "*/poses", "max": 1}])
    assert harness.main("", ["slots", "--quick"]) == 1
    assert "/poses is 20, max 1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["nothing"], "there is no evidence 'nothing'"),
        (["speed.nothing"], "there is no evidence 'speed.nothing'; there are speed.lines"),
        (["slots", "m=3"], "slots has no option 'm'; it has maps, n, seed"),
        (["slots", "n=few"], "n: could not convert"),
        (["lines", "by=hand"], "by: must be one of line, scene"),
    ],
)
def test_wrong_words_are_named(
    words: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        harness.main("", words)
    assert text in capsys.readouterr().err


# ---- what is wrong is found ----------------------------------------------------------------------


def misses(name: str, figures: Any) -> str:
    return "\n".join(missed(figures, bounds_of(name, quick=True)))


def test_lines_that_are_too_certain_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sigmas of half the size."""

    def halved(*arguments: Any, **options: Any) -> Any:
        found = map_lines(*arguments, **options)
        for i, line in enumerate(found):
            small = Gaussian(line.gaussian.mean, line.gaussian.cov / 4)
            found[i] = replace(line, gaussian=small)
        return found

    monkeypatch.setattr(lines, "map_lines", halved)
    figures = lines.lines(n=20, shapes=("city",), poses=("production",), map_error=(0.0,))
    text = misses("lines", figures)
    for words in ("beyond 3 sigma/y at x_min", "rms/y"):
        assert words in text


def test_wrong_slots_are_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Two lines in each other's slots, and the lines of another lane."""
    lines_of, (left, right, *_) = Map.lines, SLOTS
    swap = {left: right, right: left}

    def exchanged(found: Map, pose: Any) -> Any:
        return {swap.get(slot, slot): line for slot, line in lines_of(found, pose).items()}

    def beside(found: Map, pose: Any) -> Any:
        return lines_of(found, pose + 3.5 * np.array([-np.sin(pose[2]), np.cos(pose[2]), 0]))

    path = (town(tmp_path),)
    assert not misses("slots", slots.slots(path, n=40))
    for wrong in (exchanged, beside):
        monkeypatch.setattr(Map, "lines", wrong)
        assert "right is" in misses("slots", slots.slots(path, n=40))


@pytest.mark.parametrize(("factor", "words"), [(0.5, "overconfident is"), (2.0, "width/99 %")])
def test_wrong_joints_are_found(monkeypatch: pytest.MonkeyPatch, factor: float, words: str) -> None:
    """Too certain, in floating point and exactly; and too wide."""
    compare, check = scenes.compare, scenes.check

    def wrong(scene: Any) -> Any:
        return replace(scene, cov=factor * scene.cov)

    monkeypatch.setattr(
        scenes, "compare", lambda truth, got, *rest: compare(truth, wrong(got), *rest)
    )
    monkeypatch.setattr(
        scenes, "check", lambda truth, got, *rest, **how: check(truth, wrong(got), *rest, **how)
    )
    options: Any = {"poses": ("production",), "errors": ("5 cm",), "records": ("conditional",)}
    figures = scenes.scenes(n=4, exact=2, **options)
    assert words in "\n".join(missed(figures, bounds_of("scenes", quick=False)))


def test_lines_that_are_lost_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first line of each scene is not sent."""
    prepare = Encoder.prepare_scene

    def without_first(encoder: Any, scene: Any, **options: Any) -> Any:
        prepared = prepare(encoder, scene, **options)
        if prepared is scene:  # it was prepared before
            return scene
        return replace(prepared, sent_slots=prepared.sent_slots[1:])

    monkeypatch.setattr(Encoder, "prepare_scene", without_first)
    figures = scenes.scenes(14, records=("conditional",), poses=("production",), errors=("5 cm",))
    assert "lost is" in misses("scenes", figures)


def test_a_scene_of_two_cycles_is_found() -> None:
    """By its values: its pose error and its lines show the number of the cycle."""
    chain = epochs.WholeChain("maplines-pose.dbc", epochs.SLOTS, fd=False)
    chain.write(3, epochs.SLOTS, Counter())
    scene, other = epochs.road_scene(3), epochs.road_scene(4)
    assert not +chain.check(scene)
    mixed = replace(scene, lines=other.lines)
    assert chain.check(mixed) == {"wrong joints": 1}
    for number in range(epochs.SCENES):
        sigma = epochs.MIN_SIGMA * epochs.RATIO**number
        assert epochs.scene_number(sigma) == epochs.scene_number(1.03 * sigma) == number


def test_a_fused_lane_that_is_too_certain_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here the mean of many scenes seems to have no errors of its own."""
    from maplines_can.consumers import lane_filter

    monkeypatch.setattr(lane_filter.LaneFilter, "_keep_own", lambda *_: None)
    road_map = random_map("s-bend", 0)
    car = fusion.of_car(road_map, road_map.route("1", "1"), None, 5.0, 0)
    assert "scenes/shape/NEES" in misses("fusion", {"all, exact": fusion.figures([car])})


def test_what_cubics_miss_is_found_if_it_is_not_covered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here all cubics are off by 1 m after 2 s, which nothing states; there are two cameras."""
    seen, offset = plausibility_roads.seen, iter(np.resize(np.repeat([0.0, 1.0], 80), 320))

    def wrong(*arguments: Any) -> Any:
        parts = seen(*arguments)
        return None if parts is None else (parts[0], parts[1] + next(offset), *parts[2:])

    monkeypatch.setattr(plausibility_roads, "seen", wrong)
    monkeypatch.setattr(plausibility_roads, "MAP_ERRORS", {"exact": None})
    figures = plausibility_roads.plausibility_roads(n=1, seconds=4.0, cars=40, shapes=())
    assert "z over twice" in misses("plausibility_roads", figures)
