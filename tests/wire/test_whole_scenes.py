"""Whole scenes as they are sent: read by cantools and NumPy alone, and the places of lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import chain
from typing import Any

import numpy as np
import pytest
from evidence.exact import covers
from evidence.roads import SHAPES, random_scene
from evidence.witness import POSES, Poses
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_layouts import layout_of
from support.scene_streams import OFFSETS, authenticated_codec, beyond, road_scene
from support.whole_scene_witness import Read, read

from maplines_can import Codec, EncodeError, Gaussian, MapError, Polyline, Scene, Slot
from maplines_can.model.lines import Curve
from maplines_can.model.matrices import Vector
from maplines_can.model.places import Candidate, Places, chosen
from maplines_can.propagation import map_scene
from maplines_can.values.line import LeftOut, MapLine
from maplines_can.values.mixture import GaussianMixture
from maplines_can.wire import SCENE, SCENE2, Encoder, Frame, default_dbc_path

DBC = "maplines-scene.dbc"
PATH = default_dbc_path(DBC)
EGO = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
#: Numbers of reasons in a record.
ACROSS, RANGE, MEAN, COVARIANCE = 1, 2, 3, 4


def straight(offsets: dict[Slot, float]) -> Scene:
    """Lines along the road at these distances from the car [m]."""
    x = np.array([-100.0, 200.0])
    lines = {slot: Polyline(np.column_stack([x, [y, y]])) for slot, y in offsets.items()}
    return map_scene(lines, Gaussian([0, 0, 0], np.diag([0.1, 0.2, 0.01]) ** 2))


def frames_of(sent: dict[Any, list[Frame]]) -> list[Frame]:
    return [*chain(*sent.values())]


def sent(encoder: Encoder, scene: Scene) -> Read:
    """What a receiver reads of a scene that an encoder sends next."""
    return read(frames_of(encoder.encode_scene(scene, fd=True)), PATH)


# ---- what is sent ----------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_a_scene_read_from_the_dbc_alone_covers_what_was_sent(shape: str) -> None:
    """In exact arithmetic, with the errors of all means; a receiver computes the same."""
    codec, counts = Codec(layout_of(DBC)), Counter[str]()
    for number in range(5):
        rng = np.random.default_rng(number)
        road = random_scene(shape, rng, int(rng.integers(1, 9)))
        poses = Poses.about(road.pose, POSES[list(POSES)[number % 2]], 0, rng)
        scene = map_scene(
            {slot: Polyline(points) for slot, points in road.lines.items()},
            Gaussian(road.pose, poses.cov),
            map_error=(None, MapError(0.05, 0.05, 0.001), MapError(0.3))[number % 3],
        )
        encoder, decoder = codec.encoder(), codec.decoder()
        frames = frames_of(encoder.encode_scene(scene, fd=True))
        found = read(frames, PATH)
        for frame in frames:
            decoder.feed(frame.can_id, frame.data, 0)
        assert {*found.slots} | {*found.left_out} == {*scene.index}
        if not found.slots:
            continue
        true = scene.joint(found.slots)
        assert covers(found.cov, found.means.ravel(), true.cov, true.mean)
        received = decoder.scene()
        assert received is not None
        own = received.scene.joint(found.slots)
        scale = np.sqrt(own.cov.diagonal())
        assert (own.mean == found.means.ravel()).all()
        assert (
            np.abs((own.cov - found.cov) / np.outer(scale, scale)).max() < 1e-5
        )  # of single precision
        assert covers(own.cov, own.mean, true.cov, true.mean)
        counts["lines"] += len(found.slots)
    assert counts["lines"] > 10


# ---- places ----------------------------------------------------------------------------------


@given(
    st.lists(
        st.dictionaries(
            st.sampled_from(Slot), st.tuples(st.integers(-40, 40), st.booleans()), max_size=8
        ),
        min_size=1,
        max_size=5,
    ),
    st.booleans(),
)
@settings(max_examples=40, deadline=None)
def test_the_places_are_those_of_the_model(
    cycles: list[dict[Slot, tuple[int, bool]]], secured: bool
) -> None:
    """Of any lines, cycle after cycle, also of those that are left out."""
    codec = authenticated_codec(DBC) if secured else Codec(layout_of(DBC))
    layout = codec.layout.scene
    assert layout is not None
    places = layout.secured_places if secured else layout.places
    fixed = [layout.fixed[SCENE][:places], layout.fixed[SCENE2][:places]]
    encoder, last = codec.encoder(), Places()
    for lines in cycles:
        scene = straight({slot: 0.5 * y for slot, (y, _) in sorted(lines.items())})
        for slot, (_, is_left_out) in lines.items():
            scene = beyond(scene, slot) if is_left_out else scene
        candidates = [
            Candidate(
                line.slot,
                Curve(Vector(line.gaussian.mean), fit[0], fit[1], 0.0),
                lines[line.slot][1],
            )
            for line, fit in zip(scene.lines, scene.fit_ranges.tolist(), strict=True)
        ]
        last = chosen(fixed, candidates, last)
        found = encoder.encode_scene(scene, fd=True)
        assert [*found] == [SCENE] if last.scene2 is None else [SCENE2, SCENE]
        placed = {slot for slots in (last.scene, last.scene2 or ()) for slot in slots}
        assert encoder.left_out(scene, fd=True) == {
            slot: LeftOut.MEAN if out else LeftOut.PLACE
            for slot, (_, out) in lines.items()
            if out or slot not in placed
        }
        for owner, expected in ((SCENE, last.scene), (SCENE2, last.scene2)):
            if expected is not None:
                own = read_secured(found[owner], places) if secured else read(found[owner], PATH)
                assert {*own.slots} | {*own.left_out} == {*expected} - {None}
                assert own.slots == [s for s in expected if s is not None and not lines[s][1]]


def read_secured(frames: Iterable[Frame], places: int) -> Read:
    """What is read of authenticated frames, with the bits of other places set to "none"."""
    plain = []
    for frame in frames:
        data = bytearray(64)
        data[: 12 + 13 * places] = frame.data[: 12 + 13 * places]
        data[12 + 13 * places] = 8
        plain.append(Frame(frame.can_id - 2, bytes(data)))
    return read(plain, PATH)


def test_a_line_without_a_place_is_left_out() -> None:
    """With a key, each message has room for three lines."""
    encoder, scene = authenticated_codec(DBC).encoder(), straight(OFFSETS)
    expected = dict.fromkeys((Slot.NEXT_RIGHT, Slot.CENTRE), LeftOut.PLACE)
    assert encoder.left_out(scene, fd=True) == expected
    prepared = encoder.prepare_scene(scene, fd=True)
    assert prepared.left_out == {}
    for _ in range(3):
        frames = encoder.encode_scene(prepared, fd=True)
        assert [len(frame.data) for frame in frames_of(frames)] == [64, 64]
        slots = read_secured(frames_of(frames), 3).slots
        assert {*slots} == {*Slot} - {*expected}
        assert encoder.left_out(prepared, fd=True) == expected


# ---- what is refused -------------------------------------------------------------------------


def test_what_is_no_scene_in_can_fd_is_refused_in_words() -> None:
    """Classic CAN, single lines, mixtures, and arrays of lines."""
    codec = Codec(layout_of(DBC))
    encoder, scene = codec.encoder(), road_scene(EGO)
    mixture = GaussianMixture([1.0], [scene.lines[0].gaussian])
    lines = [scene.lines[0], MapLine.of_mixture(Slot.ROUTE, mixture, x_max=10.0)]
    classic = r"its scenes are CAN FD frames of 64 bytes.*no message for classic CAN.*fd=True"
    for refused in (encoder.encode_scene, encoder.prepare_scene, encoder.left_out):
        with pytest.raises(EncodeError, match=classic):
            refused(scene)
    with pytest.raises(EncodeError, match=classic):
        encoder.encode_scene(encoder.prepare_scene(scene, fd=True))
    for line in lines:
        for fd in (False, True):
            with pytest.raises(EncodeError, match="lines are sent and received as scenes"):
                encoder.encode(line, fd=fd)
    with pytest.raises(EncodeError, match="lines are sent and received as scenes"):
        _ = codec.batch
