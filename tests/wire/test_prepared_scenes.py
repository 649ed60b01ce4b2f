"""Scenes that were prepared: given to another encoder, copied, or with values that no scene has."""

import pickle
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.dbcs import edited_text
from support.scene_streams import COMPLETE, CONDITIONAL, beyond, new_codec, road_scene

from maplines_can import Codec, EncodeError, Gaussian, Slot
from maplines_can.bus import Link, Transmitter
from maplines_can.bus.tx_queue import TxQueue
from maplines_can.wire import POSE, Layout, default_dbc_path

OTHER = {COMPLETE: CONDITIONAL, CONDITIONAL: COMPLETE}


def edited(dbc: str, *edits: tuple[str, str]) -> Layout:
    """Return the layout of a DBC of the package with changes."""
    return Layout.from_text(edited_text(default_dbc_path(dbc).read_text(), *edits), "edited.dbc")


def check_refused(own: Codec, strange: Codec) -> None:
    """Check that all that takes a prepared scene refuses that of another DBC."""
    prepared = strange.encoder().prepare_scene(road_scene())
    names = rf"another DBC, .*{strange.layout.source}.*{own.layout.source}; prepare it with"
    queue = TxQueue(own, 0.05, fd=False, count=None, max_age=0.2)
    with Link(interface="virtual", channel="prepared") as link:
        transmitter = Transmitter(link, own)
        for give in (
            own.encoder().encode_scene,
            own.encoder().prepare_scene,
            transmitter.publish,
            lambda scene: queue.put_scene(scene, 0.0),
        ):
            with pytest.raises(EncodeError, match=names):
                give(prepared)
        assert queue.wait(0.0) is transmitter._tx_queue.wait(0.0) is None


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_a_scene_of_another_dbc_is_refused(dbc: str) -> None:
    """The message has both DBCs and the cure."""
    check_refused(new_codec(dbc), new_codec(OTHER[dbc]))


@pytest.mark.parametrize(
    "edit",
    [
        pytest.param((r"(?<=BO_ |SG_ |AL_ )832\b", "1832"), id="can-id-of-a-line"),
        pytest.param((r"(?<=BO_ |SG_ |AL_ )860\b", "1860"), id="can-id-of-the-pose-error"),
        pytest.param((r'(BA_ "E2EDataId" BO_ 8(?:32|40)) \d+', r"\1 4711"), id="data-id"),
        pytest.param(
            (r"(MapOffset .*)\(0.125,-8\)", r"\1(0.0625,-8)"), id="factor-of-the-pose-error"
        ),
    ],
)
def test_one_difference_makes_another_dbc(edit: tuple[str, str]) -> None:
    """IDs, and signals of both kinds of records."""
    own, strange = Codec(new_codec(COMPLETE).layout), Codec(edited(COMPLETE, edit))
    check_refused(own, strange)
    check_refused(strange, own)


def test_the_same_dbc_may_be_read_twice() -> None:
    """Also from a pickle, and with another comment."""
    own = new_codec(COMPLETE)
    expected = own.encoder().encode_scene(road_scene())
    comment = (r'(CM_ SG_ 832 YOff ")', r"\1Lateral. ")
    for layout in (
        Layout.from_dbc(),
        pickle.loads(pickle.dumps(own.layout)),  # noqa: S301
        edited(COMPLETE, comment),
    ):
        prepared = Codec(layout).encoder().prepare_scene(road_scene())
        assert own.encoder().encode_scene(prepared) == expected


@pytest.mark.parametrize("wrong", [None, 5, "scene", [road_scene()]])
def test_what_is_no_scene_is_refused(wrong: object) -> None:
    """The message says what is one."""
    encoder = new_codec(COMPLETE).encoder()
    for give in (encoder.encode_scene, encoder.prepare_scene):
        with pytest.raises(TypeError, match="scene must be a Scene.*got a " + type(wrong).__name__):
            give(wrong)  # type: ignore[arg-type]


def changed(given: Any, name: str, value: Any) -> Any:
    """Return a copy with an attribute that no constructor has checked."""
    one = object.__new__(type(given))
    vars(one).update(vars(given) | {name: value})
    return one


SCENE = road_scene([Slot.EGO_LEFT, Slot.CENTRE])
FIRST, SECOND = SCENE.lines
WRONG: dict[str, tuple[str, Any, str]] = {
    "a line twice": ("lines", (FIRST, FIRST), "lines must be of different slots"),
    "fewer lines": ("lines", (FIRST,), r"cov must be \(4, 4\) for 1 lines"),
    "no line": ("lines", (FIRST, None), "slot"),
    "nan": ("lines", (FIRST, changed(SECOND, "x_max", np.nan)), "x_max"),
    "three parameters": (
        "lines",
        (FIRST, changed(SECOND, "gaussian", Gaussian(np.zeros(3), np.eye(3)))),
        "gaussian must be over",
    ),
    "other shape": ("cov", SCENE.cov[:4, :4], r"cov must be \(8, 8\)"),
    "not finite": ("cov", SCENE.cov * np.nan, "cov must be finite"),
    "empty range": ("fit_ranges", SCENE.fit_ranges[:, ::-1], "fit_ranges must be finite and not"),
    "infinite range": ("fit_ranges", SCENE.fit_ranges * np.inf, "fit_ranges must be finite"),
    "quartics": ("quartics", np.array([np.nan, 0.0]), "quartics must be finite"),
    "own": ("specific_covs", np.full((2, 4, 4), np.nan), "each of specific_covs must be finite"),
    "pose": ("pose_error", SimpleNamespace(cov=np.eye(3)), "correlation_time"),
    "time": (
        "pose_error",
        SimpleNamespace(cov=np.eye(3) * 1e-4, correlation_time=-1.0),
        "correlation_time must be more than 0 s",
    ),
}


@pytest.mark.parametrize(("name", "value", "message"), WRONG.values(), ids=WRONG)
def test_a_value_that_no_scene_has_is_named(name: str, value: Any, message: str) -> None:
    """As by its constructor, which did not see it; no counter advances."""
    encoder = new_codec(CONDITIONAL).encoder()
    with pytest.raises((ValueError, AttributeError), match=message):
        encoder.encode_scene(changed(SCENE, name, value))
    assert encoder.encode_scene(SCENE) == new_codec(CONDITIONAL).encoder().encode_scene(SCENE)


def test_the_order_of_the_slots_is_that_of_the_scene() -> None:
    """Of whatever slots a caller selects; those that are no lines of it are not sent."""
    encoder = new_codec(CONDITIONAL).encoder()
    prepared = encoder.prepare_scene(road_scene([Slot.ROUTE, Slot.EGO_LEFT, Slot.CENTRE]))
    some = replace(prepared, sent_slots=(Slot.CENTRE, Slot.ROUTE, Slot.EDGE_LEFT))
    assert [*encoder.encode_scene(some)] == [POSE, Slot.ROUTE, Slot.CENTRE]
    unfit = encoder.prepare_scene(beyond(road_scene(), Slot.EGO_RIGHT))
    assert [*unfit.unfit] == [Slot.EGO_RIGHT]
    with pytest.raises(EncodeError, match=r"sent_slots.*has no record"):
        encoder.encode_scene(replace(unfit, sent_slots=(Slot.EGO_LEFT, Slot.EGO_RIGHT)))
