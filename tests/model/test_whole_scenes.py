"""Records of whole scenes by example, core and model side by side; and which are of one scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_layouts import layout_of

from maplines_can import Slot
from maplines_can.model.whole_scenes import NONE, write_whole
from maplines_can.testing.back_to_back import Pair
from maplines_can.testing.hostile_streams import PROFILES, FrameStep, Question
from maplines_can.wire.layout.pose_layout import SCENE, SCENE2, SceneOwner

LAYOUT = layout_of("maplines-scene.dbc")
MS = 1_000_000
CYCLE = 50 * MS
LEFT, RIGHT, NEXT_LEFT, NEXT_RIGHT, CENTRE, EDGE_LEFT, EDGE_RIGHT, ROUTE = Slot
#: A straight line 20 m ahead.
LINE = {"XMin": 32, "XMax": 20, "OwnLateral": 1}

Line = Mapping[str, int]


def record_of(
    owner: SceneOwner, counter: int, lines: Mapping[Slot, Line], joint: int | None, pose: Line
) -> bytes:
    """Return a record; lines without a fixed place have the others, in their order."""
    layout = LAYOUT.scene
    assert layout is not None
    free = iter([slot for slot in lines if slot not in layout.fixed[owner]])
    places = list[dict[str, int]]()
    for fixed in layout.fixed[owner]:
        slot = next(free, None) if fixed is None else fixed
        if slot is None or slot not in lines:
            places.append({"Kind": NONE})
        else:
            places.append({**lines[slot], **({"Slot": slot} if fixed is None else {})})
    shared = {"Counter": counter, "SceneCounter": counter if joint is None else joint}
    data_id = layout.messages[owner].data_id
    return write_whole(layout, {**pose, **shared}, places, layout.record_bytes, data_id)


class Sender:
    """Frames of a sender, to core and model."""

    def __init__(self) -> None:
        self.pair = Pair(LAYOUT, PROFILES[0])

    def feed(self, owner: SceneOwner, record: bytes, t_ns: int) -> Any:
        """Return the answer to a record: a reason, or the slots of its lines."""
        can_id = LAYOUT.messages_of[owner].fd_can_id
        assert can_id is not None
        step = FrameStep(can_id, record, False, t_ns, self.pair.now_us)
        assert not [*self.pair.differences(step)]
        answer, model = self.pair.answer, self.pair.model
        assert model.frames == model.pose_frames + model.counts.total()
        return answer if isinstance(answer, str) else [line.slot for line in answer]

    def send(
        self,
        owner: SceneOwner,
        counter: int,
        t_ns: int,
        lines: Mapping[Slot, Line],
        joint: int | None = None,
        **pose: int,
    ) -> Any:
        return self.feed(owner, record_of(owner, counter, lines, joint, pose), t_ns)

    def ask(self, kind: str, t_ns: int, slot: Slot = LEFT) -> Any:
        assert not [*self.pair.differences(Question(kind, slot, t_ns))]
        return self.pair.answer

    def scene(self, t_ns: int) -> list[Slot]:
        """Return the slots of the lines of the newest scene."""
        return [line.slot for line in self.ask("scene", t_ns).content.lines]


@pytest.fixture
def sender() -> Sender:
    return Sender()


def test_all_lines_of_a_record_come_at_once(sender: Sender) -> None:
    """In the order of places; the scene has them in the order of slots."""
    assert sender.send(SCENE, 0, 0, {LEFT: LINE, RIGHT: LINE, ROUTE: LINE, NEXT_LEFT: LINE}) == [
        LEFT, RIGHT, ROUTE, NEXT_LEFT,
    ]  # fmt: skip
    assert sender.scene(0) == [LEFT, RIGHT, NEXT_LEFT, ROUTE]
    assert sender.pair.model.lines == 4
    assert sender.pair.model.pose_errors == 1


@pytest.mark.parametrize("owners", [(SCENE2, SCENE), (SCENE, SCENE2)])
def test_both_records_of_a_cycle_are_one_scene(
    sender: Sender, owners: tuple[SceneOwner, SceneOwner]
) -> None:
    """In any order; the pose error makes their lines correlated."""
    lines = {SCENE: {LEFT: LINE}, SCENE2: {EDGE_LEFT: LINE, CENTRE: LINE}}
    for i, owner in enumerate(owners):
        sender.send(owner, 9, i * MS, lines[owner], 1 if owner == SCENE2 else None)
    scene = sender.ask("scene", MS).content

    assert [line.slot for line in scene.lines] == [LEFT, CENTRE, EDGE_LEFT]
    assert scene.cov[0][8] > 0
    assert scene.pose.t_ns == MS * owners.index(SCENE)
    assert sender.scene(9 * CYCLE) == [LEFT, CENTRE, EDGE_LEFT]


#: Changes of a Scene2 that would join otherwise, and whether it does then.
CHANGES: list[Any] = [
    pytest.param({}, True, id="none"),
    pytest.param({"Age": 7}, True, id="another-age"),
    pytest.param({"t_ns": CYCLE}, True, id="a-cycle-later"),
    pytest.param({"t_ns": CYCLE + 1}, False, id="more-than-a-cycle-later"),
    pytest.param({"joint": 4}, False, id="other-bits-of-the-counter"),
    pytest.param({"counter": 30}, False, id="a-break-of-its-sequence"),
    *(
        pytest.param({name: 1}, False, id=name)
        for name in ("PivotAlong", "RatioHeadingAcross", "Inflation", "CorrelationTime",
                     "MapOffset", "MapHeading")
    ),
]  # fmt: skip


@pytest.mark.parametrize("is_early", [True, False])
@pytest.mark.parametrize(("change", "joins"), CHANGES)
def test_records_join_if_they_are_of_one_cycle(
    sender: Sender, change: Mapping[str, int], joins: bool, is_early: bool
) -> None:
    """Scene2 with other bits, another pose error, at another time or of another sequence does not.

    After a break of its own, it waits for the next Scene, which may have come after the same one.
    """
    second = {"counter": 6, "t_ns": 0, "joint": 5, **change}
    t_ns = second.pop("t_ns")
    sender.send(SCENE, 4, -CYCLE, {LEFT: LINE})
    sender.send(SCENE2, 5, -30 * CYCLE, {ROUTE: LINE}, joint=4)

    def scene2(t_ns: int) -> None:
        sender.send(SCENE2, t_ns=t_ns, lines={EDGE_LEFT: LINE}, **second)

    if is_early:
        scene2(0)
        sender.send(SCENE, 5, t_ns, {LEFT: LINE})
    else:
        sender.send(SCENE, 5, 0, {LEFT: LINE})
        scene2(t_ns)
    joins |= is_early and change.get("counter") == 30

    assert sender.scene(t_ns) == ([LEFT, EDGE_LEFT] if joins else [LEFT])


IMPOSSIBLE: list[Any] = [
    pytest.param({LEFT: LINE, ROUTE: LINE | {"Kind": 13}}, None, id="unknown-kind"),
    pytest.param({LEFT: LINE, ROUTE: LINE | {"Kind": 15}}, None, id="greatest-kind"),
    pytest.param({LEFT: LINE | {"XMin": 52, "XMax": 20}}, None, id="empty-range"),
    pytest.param({LEFT: LINE | {"C0": 2**15, "XMax": 100}}, None, id="no-function-of-x"),
    pytest.param({LEFT: LINE}, 1, id="other-bits-of-the-counter"),
]


@pytest.mark.parametrize(("lines", "joint"), IMPOSSIBLE)
def test_what_no_sender_sends_is_dropped_as_a_whole(
    sender: Sender, lines: Mapping[Slot, Line], joint: int | None
) -> None:
    assert sender.send(SCENE, 0, 0, lines, joint) == "CONTENT"
    assert sender.ask("latest", 0, LEFT).content is None


def test_a_line_that_is_left_out_keeps_the_older_one(sender: Sender) -> None:
    """Which becomes stale, until a record has it again."""
    sender.send(SCENE, 0, 0, {LEFT: LINE, ROUTE: LINE})
    sender.send(SCENE, 1, CYCLE, {LEFT: LINE, ROUTE: {"Kind": NONE + 4}})
    views = [sender.ask("latest", t * CYCLE, ROUTE) for t in (1, 4)]
    assert [(view.left_out, view.is_stale) for view in views] == [
        ("COVARIANCE", False), ("COVARIANCE", True),
    ]  # fmt: skip
    assert views[1].content.t_ns == 0
    assert sender.ask("scene", CYCLE).content.left_out == {ROUTE: "COVARIANCE"}
    sender.send(SCENE2, 0, CYCLE, {ROUTE: LINE}, joint=7)
    assert sender.ask("latest", CYCLE, ROUTE).left_out is None
    sender.send(SCENE, 2, 2 * CYCLE, {LEFT: LINE})
    assert sender.ask("latest", 2 * CYCLE, ROUTE).left_out is None


FATES = st.lists(
    st.tuples(st.integers(0, 3), st.booleans(), st.booleans()), min_size=2, max_size=24
)


@settings(max_examples=60, deadline=None)
@given(FATES)
def test_a_scene_never_has_lines_of_two_cycles(fates: list[tuple[int, bool, bool]]) -> None:
    """Whatever is lost, comes twice, or up to three cycles late; the pose error is always the same.

    YOff has the number of the cycle.
    """
    frames = list[tuple[int, int, SceneOwner, bytes]]()
    for n, (delay, is_lost, is_twice) in enumerate(fates):
        owner, k = (SCENE2, SCENE)[n % 2], n // 2
        line = LINE | {"YOff": k}
        lines = {EDGE_LEFT: line, ROUTE: line} if owner == SCENE2 else {LEFT: line, CENTRE: line}
        record = record_of(owner, k, lines, k % 8 if owner == SCENE2 else None, {})
        times = [k * CYCLE + delay * CYCLE + n] * (not is_lost) + [k * CYCLE + n] * is_twice
        frames += [(t_ns, n, owner, record) for t_ns in times]
    sender = Sender()
    for t_ns, _, owner, record in sorted(frames):
        sender.feed(owner, record, t_ns)
        scene = sender.ask("scene", t_ns).content
        if scene is not None:
            assert len({line.mean[0] for line in scene.lines}) <= 1
