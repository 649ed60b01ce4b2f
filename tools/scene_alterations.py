"""DBCs with scenes in which a signal is misspelt or missing, and the check of their scenes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from cantools.database.can import Database, Signal
from dbc_witness import CYCLE_NS, FRAME_NS, WrongResultError

from maplines_can.propagation import map_scene
from maplines_can.study.dbc.pose_spec import CONDITIONAL
from maplines_can.study.dbc.record_spec import DEFAULT
from maplines_can.values.errors import LayoutError
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import MapLine, Slot
from maplines_can.values.polyline import Polyline
from maplines_can.values.scene import Scene
from maplines_can.wire import Codec, Layout
from maplines_can.wire.layout.dbc_reader import parse_database

#: Writers of DBCs with scenes: beside complete records, and beside those conditional on the pose.
FORMS = {"complete": DEFAULT, "conditional": CONDITIONAL}
#: Offset of the line of each slot from the car [m].
OFFSETS = (1.75, -1.75, 5.25, -5.25, 0.0, 7.0, -7.0, 0.4)


class SceneAlteration(NamedTuple):
    """A signal that is misspelt or removed."""

    field: str
    messages: tuple[str, ...]
    misspelt: bool


def original(form: str, slots: tuple[Slot, ...]) -> Database:
    """Return a DBC with lines in these slots, and a pose error with the signals of all slots."""
    text = replace(FORMS[form], slots=slots, first_secured_can_id=None).dbc()
    return parse_database(text, form)


def alterations_in(database: Database) -> Iterator[SceneAlteration]:
    """Yield each signal misspelt and removed, in one frame format of its message and in both."""
    for message in database.messages:
        if message.is_fd:
            continue
        both = (message.name, f"{message.name}Fd")
        for signal in message.signals:
            for messages in (both[:1], both[1:], both):
                yield SceneAlteration(signal.name, messages, misspelt=True)
                yield SceneAlteration(signal.name, messages, misspelt=False)


@contextmanager
def altered(database: Database, alteration: SceneAlteration) -> Iterator[None]:
    """Alter the signal in the database, which takes a tenth of the time of parsing a text."""
    before = {name: [*_signals(database, name)] for name in alteration.messages}
    try:
        for name, signals in before.items():
            others = [s for s in signals if s.name != alteration.field]
            own = [copy(s) for s in signals if s.name == alteration.field]
            for signal in own:
                signal.name = f"{signal.name[:-1]}_"
            _signals(database, name)[:] = [*others, *(own if alteration.misspelt else ())]
        yield
    finally:
        for name, signals in before.items():
            _signals(database, name)[:] = signals


def _signals(database: Database, name: str) -> list[Signal]:
    signals: list[Signal] = database.get_message_by_name(name).signals
    return signals


def scenes_outcome(database: Database, alteration: SceneAlteration) -> str:
    """Return "refused", "right", or what is wrong."""
    with altered(database, alteration):
        try:
            codec = Codec(Layout.from_dbc(database))
        except LayoutError:
            return "refused"
        try:
            check_scenes(codec)
        except Exception as error:  # noqa: BLE001 - any error after loading is wrong
            return f"{type(error).__name__}: {error}"
        return "right"


@cache
def _scene(slots: tuple[Slot, ...]) -> Scene:
    lines = {slot: Polyline([[-100.0, OFFSETS[slot]], [200.0, OFFSETS[slot]]]) for slot in slots}
    return map_scene(lines, Gaussian([0, 0, 0], np.diag([0.3, 0.2, 0.005]) ** 2))


def check_scenes(codec: Codec) -> None:
    """Send a scene with a line in each slot in both frame formats, and check what arrives.

    Raises:
        WrongResultError: the scene is not delivered with all lines, or is overconfident.
    """
    sent = _scene(tuple(codec.layout.messages))
    for fd in (False, True):
        decoder = codec.decoder()
        frames = [
            f
            for own in codec.encoder().encode_scene(sent, fd=fd, counters={}).values()
            for f in own
        ]
        for j, frame in enumerate(frames):
            decoder.feed(frame.can_id, frame.data, CYCLE_NS + j * FRAME_NS)
        received = decoder.scene()
        if received is None or len(received.scene.lines) != len(sent.lines):
            raise WrongResultError(f"of {len(frames)} frames the scene is {received}")
        by_slot = {line.slot: line for line in received.scene.lines}
        for line in sent.lines:
            _check_covered(line, by_slot[line.slot])


def _check_covered(given: MapLine, got: MapLine) -> None:
    d = given.gaussian.mean - got.gaussian.mean
    sigma = np.sqrt(got.gaussian.cov.diagonal())
    excess = (got.gaussian.cov - given.gaussian.cov - np.outer(d, d)) / np.outer(sigma, sigma)
    if not np.linalg.eigvalsh(excess)[0] >= -1e-9:
        raise WrongResultError(f"overconfident: {np.linalg.eigvalsh(excess)[0]:g}")
