"""DBCs of whole scenes: read as they are, or refused with the reason."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import cantools
import pytest
from cantools.database.can import Database
from dbc_witness import check_codec
from scene_layouts import layout_of

from maplines_can.dbc_files.parser import default_dbc_path
from maplines_can.generation.dbc.record_spec import CONDITIONAL, SCENES, WHOLE_SCENES
from maplines_can.values.errors import LayoutError
from maplines_can.values.line import Slot
from maplines_can.wire import Codec, Layout
from maplines_can.wire.layout.pose_layout import SCENE, SCENE2
from maplines_can.wire.layout.record_signals import SECURED_SIGNALS
from maplines_can.wire.layout.scene_layout import SceneLayout

#: CAN IDs of the messages.
IDS = {"Scene2": 888, "Scene": 889, "Scene2SecOC": 890, "SceneSecOC": 891}


@cache
def text() -> str:
    """Return the DBC of the package without comments, which take half of the time of a parser."""
    dbc = default_dbc_path("maplines-scene.dbc").read_text("utf-8")
    return re.sub(r'^CM_ [^"]*"[^"]*";\n', "", dbc, flags=re.MULTILINE)


def scene_of(layout: Layout) -> SceneLayout:
    assert layout.scene is not None
    return layout.scene


def changed(name: str, signal: str, change: Callable[[Any], None]) -> Database:
    """Return the database with a change of signals of messages, of names as regular expressions."""
    database, count = WHOLE_SCENES.database(), 0
    for message in database.messages:
        for own in message.signals:
            if re.fullmatch(name, message.name) and re.fullmatch(signal, own.name):
                change(own)
                count += 1
        message.refresh(strict=False)
    assert count
    return database


def renamed(name: str, old: str, new: str) -> Database:
    """Return the database with other starts of the names of signals, in messages of a name."""

    def change(signal: Any) -> None:
        signal.name = re.sub(f"^{old}", new, signal.name)

    return changed(name, rf"{old}.*", change)


def moved(name: str, signal: str, by: int) -> Database:
    """Return the database with a signal moved by some bits."""

    def change(own: Any) -> None:
        own.start += by

    return changed(name, signal, change)


def edited(pattern: str, replacement: str, dbc: str = "", count: int = 0) -> str:
    """Return the DBC with a regular expression replaced, which must be found."""
    result, found = re.subn(pattern, replacement, dbc or text(), count=count, flags=re.MULTILINE)
    assert found, pattern
    return result


def without(*names: str) -> str:
    """Return the DBC without messages."""
    dbc = text()
    for name in names:
        dbc = edited(rf"^BO_ \d+ {name}:(?:.*\n)+?\n", "", dbc)
        dbc = edited(rf"^(?:BA_|VAL_)[^\n]* {IDS[name]} [^;]*;\n", "", dbc)
    return dbc


def layout_from(dbc: str | Database) -> Layout:
    return Layout.from_text(dbc, "my.dbc") if isinstance(dbc, str) else Layout.from_dbc(dbc)


# ---- the DBC of the package ------------------------------------------------------------------


def test_the_layout_of_the_package() -> None:
    """A frame of 64 bytes, of four lines at equal distances; an authenticated one has three."""
    layout = layout_of("maplines-scene.dbc")
    scene = scene_of(layout)

    assert layout.pose is scene
    assert (layout.is_conditional, layout.messages, layout.pages) == (True, {}, 0)
    assert (scene.record_bytes, scene.places, scene.stride_bytes) == (64, 4, 13)
    assert (scene.secured_bytes, scene.secured_places) == (51, 3)
    assert scene.fixed == {
        SCENE: (Slot.EGO_LEFT, Slot.EGO_RIGHT, None, None),
        SCENE2: (Slot.EDGE_LEFT, Slot.EDGE_RIGHT, None, None),
    }
    assert layout.slots == tuple(Slot)
    assert layout.message_of_id.keys() == {(number, False) for number in IDS.values()}
    assert layout.record_of(SCENE2) is scene
    assert layout.max_age == scene.max_age == 0.24


# ---- DBCs that are accepted ------------------------------------------------------------------


@pytest.mark.parametrize(
    "dbc",
    [
        pytest.param(lambda: without("Scene2", "Scene2SecOC"), id="no-scene2"),
        pytest.param(lambda: without("Scene2SecOC", "SceneSecOC"), id="no-secoc"),
        pytest.param(lambda: edited(r"^(BO_ \d+) Scene", r"\1 Lanes"), id="other-names"),
        pytest.param(lambda: edited(' 9 "LEFT_OUT_ACROSS"', ' 9 "QUER"'), id="other-language"),
        pytest.param(
            lambda: renamed("Scene2.*", "EdgeLeft", "NextLeft"), id="other-slots"
        ),
    ],
)  # fmt: skip
def test_a_dbc_may_be_otherwise(dbc: Callable[[], str | Database]) -> None:
    """It is read, and what is sent arrives."""
    given = dbc()
    database: Any = cantools.database.load_string(given, "dbc") if isinstance(given, str) else given
    check_codec(Codec(layout_from(given)), database)


def test_only_authenticated_messages() -> None:
    """The record is then that of them."""
    layout = Layout.from_text(without("Scene2", "Scene"))
    scene = scene_of(layout)

    assert (scene.places, scene.secured_places, scene.record_bytes) == (3, 3, 51)
    assert {own.fd_can_id for own in scene.messages.values()} == {None}
    assert layout.slots == tuple(Slot)


# ---- refusals --------------------------------------------------------------------------------


def with_slot() -> str:
    """Return the DBC with the attribute MapLineSlot of Scene2."""
    definition = 'BA_DEF_ BO_  "MapLineSlot" INT 0 7;'
    dbc = edited('^BA_DEF_ BO_  "MapLineSlot" .*\n', "")
    dbc = edited("^(?=BA_DEF_ )", f"{definition}\n", dbc, count=1)
    return edited('^(BA_ "MapLineScene" BO_ 888 .*)', '\\1\nBA_ "MapLineSlot" BO_ 888 5;', dbc)


@pytest.mark.parametrize(
    ("dbc", "words"),
    [
        # messages and their attributes
        pytest.param(
            lambda: without("Scene", "SceneSecOC"), "no message Scene beside Scene2", id="no-scene"
        ),
        pytest.param(
            lambda: without("Scene2SecOC"), "in the same frame formats", id="no-scene2-secoc"
        ),
        pytest.param(
            lambda: edited('"MapLineScene" BO_ 888 2', '"MapLineScene" BO_ 888 1'),
            "Scene has two messages in one frame format", id="scene-twice",
        ),
        pytest.param(
            lambda: edited('"MapLineScene" BO_ 888 2', '"MapLineScene" BO_ 888 3'),
            "MapLineScene must be a whole number from 0 to 2, got 3", id="scene-3",
        ),
        pytest.param(with_slot, "MapLineSlot and MapLineScene, but it carries", id="also-a-slot"),
        pytest.param(
            lambda: edited('"CovarianceCode" "Scene"', '"CovarianceCode" "PoseConditional"'),
            "code is PoseConditional, but messages with the attribute MapLineScene need Scene",
            id="code",
        ),
        pytest.param(
            lambda: CONDITIONAL.dbc().replace('"PoseConditional"', '"Scene"'),
            "code is Scene, but messages .* and others need another one", id="code-of-lines",
        ),
        pytest.param(
            lambda: edited('"E2EDataId" BO_ 8(88|90) .*;', r'"E2EDataId" BO_ 8\1 7;',
                           edited('"E2EDataId" BO_ 8(89|91) .*;', r'"E2EDataId" BO_ 8\1 7;')),
            "Scene2? and Scene2? have the same E2EDataId, 7", id="data-id",
        ),
        pytest.param(
            lambda: edited('"E2EDataId" BO_ 891 .*;', '"E2EDataId" BO_ 891 7;'),
            "Scene: its messages need the same attribute E2EDataId", id="data-id-of-secoc",
        ),
        pytest.param(
            lambda: edited('VFrameFormat" BO_ 889 14', 'VFrameFormat" BO_ 889 0'),
            "message Scene: a page must have 8 bytes, got 64; .* CAN FD", id="classic",
        ),
        pytest.param(
            lambda: edited(r'10 "LEFT_OUT_RANGE"', '10 "LEFT_OUT_MEAN"'),
            "value 10 the name LEFT_OUT_MEAN, which belongs to the value 11", id="names-of-kinds",
        ),
        # lines
        pytest.param(
            lambda: renamed(".*", "Line4", "Line5"),
            "the names of line 4 begin with Line5; write Line4", id="number",
        ),
        pytest.param(
            lambda: renamed("Scene2.*", "EdgeLeft", "EgoRight"),
            "Scene and Scene2 have a place for EgoRight", id="slot-in-both",
        ),
        pytest.param(
            lambda: renamed("SceneSecOC", "EgoRight", "Route"),
            "SceneSecOC has the lines EgoLeft, Route, Line3, but it needs the first ones of "
            "EgoLeft, EgoRight, Line3, Line4", id="other-line-in-secoc",
        ),
        pytest.param(
            lambda: renamed("Scene2", "Line4", "xLine4"),
            "Scene, Scene2 must have the same length and as many lines", id="fewer-lines",
        ),
        pytest.param(
            lambda: renamed(".*", "(?=[EL](go|dge|ine))", "x"),
            "needs 1 to 8 lines, with signals such as EgoLeftYOff and Line3YOff, got 0", id="none",
        ),
        pytest.param(
            lambda: moved(".*", "Line4Slot", -8 * 3),
            "signal Line4Slot is .*, but it needs .* equal distances", id="slots-moved",
        ),
        pytest.param(
            lambda: moved(".*", "Line[34]Slot", -400),
            "signal Line3Slot is .*, but it needs to be 26 bytes or more from the start",
            id="before-the-record",
        ),
        # signals of the record
    ],
)  # fmt: skip
def test_a_wrong_dbc_is_refused_with_the_reason(
    dbc: Callable[[], str | Database], words: str
) -> None:
    """Each refusal names the file, or says that it is a database."""
    with pytest.raises(LayoutError, match=f"^(my.dbc|the cantools database): .*{words}"):
        layout_from(dbc())


def test_scenes_and_lines_need_dbcs_of_their_own() -> None:
    """A receiver has one way to know the newest line of a slot."""
    database = WHOLE_SCENES.database()
    database.messages.extend(CONDITIONAL.database().messages)
    database.refresh()
    with pytest.raises(
        LayoutError, match=r"\(MapLineScene\), and of slot EGO_LEFT, .* the pose err"
    ):
        Layout.from_dbc(database)


def test_an_authenticated_record_ends_before_its_trailer() -> None:
    """cantools does not check a database, so that a MAC could lie over a line."""
    longer = replace(SCENES, secured_places=4)
    signals = longer.signals(SCENE, 4), longer.signals(SCENE2, 4)
    database = WHOLE_SCENES.database()
    for own, name in zip(signals, ("SceneSecOC", "Scene2SecOC"), strict=True):
        message = database.get_message_by_name(name)
        trailer = [signal for signal in message.signals if signal.name in SECURED_SIGNALS]
        message.signals[:] = [*own, *trailer]
        message.refresh(strict=False)
    with pytest.raises(LayoutError, match="signal Line4Kind must lie in the record of 51 bytes"):
        Layout.from_dbc(database)


def test_an_authenticated_message_has_no_line_of_its_own() -> None:
    """It is the same message, and shorter."""
    database = WHOLE_SCENES.database()
    for name in ("Scene", "Scene2"):
        message = database.get_message_by_name(name)
        message.signals[:] = [s for s in message.signals if not s.name.startswith("Line")]
        message.refresh(strict=False)
    with pytest.raises(LayoutError, match=r"SecOC has the lines .*, Line3, but it needs the first"):
        Layout.from_dbc(database)


def test_a_message_has_a_whole_number_of_eight_bytes() -> None:
    """The C core reads records in words of eight bytes; 12 and 20 are lengths of CAN FD, too."""
    database = WHOLE_SCENES.database()
    for message in database.messages[:2]:
        message._length = 20
    with pytest.raises(LayoutError, match="of 8, 16, 24, 32, 48 or 64 bytes, got 20"):
        Layout.from_dbc(database)
