"""Scenes that were prepared by one encoder and are given to another."""

import pickle
import re

import pytest
from both_senders import codecs_of
from scene_streams import COMPLETE, CONDITIONAL, new_codec, road_scene

from maplines_can import Codec, EncodeError
from maplines_can.bus import Link, Transmitter
from maplines_can.bus.tx_queue import TxQueue
from maplines_can.wire import Layout, default_dbc_path

OTHER = {COMPLETE: CONDITIONAL, CONDITIONAL: COMPLETE}


def edited(dbc: str, *edits: tuple[str, str]) -> Layout:
    """Return the layout of a DBC of the package with changes; each must be found."""
    text = default_dbc_path(dbc).read_text()
    for pattern, replacement in edits:
        text, found = re.subn(pattern, replacement, text)
        assert found, pattern
    return Layout.from_text(text, "edited.dbc")


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


@pytest.mark.parametrize("prepared_in_c", [True, False])
@pytest.mark.parametrize("sent_in_c", [True, False])
@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_a_scene_of_another_dbc_is_refused(dbc: str, sent_in_c: bool, prepared_in_c: bool) -> None:
    """In C and in Python; the message has both DBCs and the cure."""
    own = codecs_of(new_codec(dbc).layout)[not sent_in_c]
    check_refused(own, codecs_of(new_codec(OTHER[dbc]).layout)[not prepared_in_c])


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


@pytest.mark.parametrize("in_c", [True, False])
def test_the_same_dbc_may_be_read_twice(in_c: bool) -> None:
    """Also from a pickle, and with another comment."""
    own = codecs_of(new_codec(COMPLETE).layout)[not in_c]
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
