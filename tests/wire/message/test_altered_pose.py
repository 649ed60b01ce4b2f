"""An altered pose error or conditional record gives a right result or a refusal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cantools
import numpy as np
import pytest
from dbc_alterations import conditional_original, fields_of, of_field_in, pose_original

from maplines_can.errors import LayoutError
from maplines_can.line import Kind, Slot
from maplines_can.wire import E2EConfig, Layout
from maplines_can.wire.covariance import CholeskyCode
from maplines_can.wire.message.dbc_reader import parse_database
from maplines_can.wire.message.frames import Frame, FrameWriter
from maplines_can.wire.message.pose_records import (
    ConditionalRecord,
    ConditionalRecords,
    PoseRecord,
    PoseRecords,
)
from maplines_can.wire.message.signals import (
    CONDITIONAL_SIGNALS,
    OWN_SIGNALS,
    PARAMETER_SIGNALS,
    POSE_ROWS,
)
from maplines_can.wire.reception.poses import PoseReceiver, ReceivedPose
from maplines_can.wire.reception.reassembly import Reassembler, Record
from maplines_can.wire.reception.settings import decoder_settings, pose_settings

POSE, LINES = pose_original(), conditional_original()
RECORDS = 2


def decoded(database: Any, frames: list[Frame]) -> dict[str, float]:
    """The physical values of the frames of a record, as cantools decodes them."""
    signals: dict[str, float] = {}
    for frame in frames:
        message = database.get_message_by_frame_id(frame.can_id)
        signals |= message.decode(frame.data, decode_choices=False)
    return signals


def check_signals(layout: Any, raw: dict[str, int], signals: dict[str, float]) -> None:
    """Compare raw values with the physical values of cantools."""
    for name, value in raw.items():
        assert layout[name].physical_one(value) == pytest.approx(signals[name], rel=1e-12), name


def drawn(layout: Any, names: list[str], rng: np.random.Generator) -> dict[str, int]:
    """Random raw values in the ranges of the signals."""
    return {n: int(rng.integers(layout[n].raw_min, layout[n].raw_max + 1)) for n in names}


def check_pose(layout: Layout, database: Any) -> None:
    """Send records of the pose error in both frame formats."""
    pose = layout.pose
    assert pose is not None
    covariance = CholeskyCode(pose, POSE_ROWS)
    records, writer = PoseRecords(pose), FrameWriter(layout, None)
    names = ["Age", "CorrelationTime", "MapOffset", "MapHeading"]
    names += [signal.name for signal in covariance.signals]
    names += [f"{slot}{name}" for slot in ("EgoLeft", "EgoRight") for name in OWN_SIGNALS]
    rng = np.random.default_rng(3)
    for fd in (False, True):
        receiver = PoseReceiver(pose, None, *pose_settings(pose), E2EConfig())
        for i in range(RECORDS):
            counters = {slot: int(rng.integers(256)) for slot in pose.counters}
            record = PoseRecord(drawn(pose, names, rng), i, counters)
            frames = writer.write_pose(records.write(record), fd)
            answers = [receiver.feed(f.can_id, f.data, i * 50_000_000) for f in frames]
            got = answers[-1]
            assert isinstance(got, ReceivedPose)
            assert (got.record.raw, got.record.counter) == (record.raw, i)
            signals = decoded(database, frames)
            check_signals(pose, dict(record.raw), signals)
            for slot, signal in pose.counters.items():
                assert signals[signal.name] == counters[slot] % 2**signal.length
                assert got.record.slot_counters[slot] == signals[signal.name]
            assert np.linalg.eigvalsh(_correlation(covariance.decode_one(record.raw)))[0] > 0


def check_lines(layout: Layout, database: Any) -> None:
    """Send conditional records of both forms in both frame formats."""
    covariance = CholeskyCode(layout)
    records, writer = ConditionalRecords(layout), FrameWriter(layout, None)
    rng = np.random.default_rng(4)
    for fd in (False, True):
        state: Reassembler[Slot, ConditionalRecord] = Reassembler(
            layout, lambda data, slot, _: records.read(data, slot), decoder_settings(layout)[0]
        )
        for i in range(RECORDS):
            raw = drawn(layout, [*PARAMETER_SIGNALS, "XMin", "XMax", *OWN_SIGNALS], rng)
            raw |= {"XMin": layout["XMin"].raw_min, "XMax": layout["XMax"].raw_max}
            if i % 2:
                raw |= drawn(layout, [signal.name for signal in covariance.signals], rng)
                raw |= dict.fromkeys(OWN_SIGNALS, 0)
            record = ConditionalRecord(raw, i, Kind(i % 8), Slot.EGO_RIGHT)
            frames = writer.write(records.write(record), record.slot, fd)
            answer = [state.feed(f.can_id, f.data, i * 50_000_000) for f in frames][-1]
            assert isinstance(answer, Record)
            assert answer.content == record
            signals = decoded(database, frames)
            check_signals(layout, raw, signals)
            assert (signals["Kind"], signals["HasCovariance"]) == (i % 8, i % 2)


def _correlation(cov: Any) -> Any:
    sigma = np.sqrt(cov.diagonal())
    return cov / np.outer(sigma, sigma)


@pytest.mark.parametrize(
    ("text", "message", "field", "check", "named"),
    [
        *(
            pytest.param(POSE, "Pose(Fd)?", field, check_pose, "Pose", id=f"pose-{field}")
            for field in fields_of(POSE, "Pose")
        ),
        *(
            pytest.param(LINES, r"Ego\w+", field, check_lines, "EgoLeft", id=f"line-{field}")
            for field in fields_of(LINES, "EgoLeft")
        ),
    ],
)
def test_an_altered_signal_gives_a_right_result_or_a_refusal(
    text: str, message: str, field: str, check: Callable[[Layout, Any], None], named: str
) -> None:
    """Each alteration of each signal; a refusal names the signal or its message."""
    results = set()
    for alteration in of_field_in(text, field, message):
        try:
            database = parse_database(alteration.text, "DBC")  # once, since it takes the time
            check(Layout.from_dbc(database), database)
        except LayoutError as error:
            is_named = field in str(error) or named in str(error)
            results.add("refused" if is_named else f"{alteration.name}: {error}")
        except Exception as error:
            raise AssertionError(f"{alteration.name}: {error!r}") from error
        else:
            results.add("right")
    assert results == {"right", "refused"}


@pytest.mark.parametrize(("text", "check"), [(POSE, check_pose), (LINES, check_lines)])
def test_the_originals_are_right(text: str, check: Callable[[Layout, Any], None]) -> None:
    """Without an alteration."""
    check(Layout.from_text(text), cantools.database.load_string(text, "dbc"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('BA_ "MapLinePose" BO_ 860 1;', 'BA_ "MapLinePose" BO_ 860 2;', "MapLinePose must be"),
        ('BA_ "E2EDataId" BO_ 860 19804;', 'BA_ "E2EDataId" BO_ 860 7;', "pose error: its messag"),
        (
            'BA_ "MapLinePose" BO_ 860 1;',
            'BA_ "MapLinePose" BO_ 860 1;\nBA_ "MapLineSlot" BO_ 860 3;',
            "MapLineSlot and MapLinePose",
        ),
        ("BO_ 861 PoseFd: 48", "BO_ 861 PoseFd: 32", "PoseFd"),
    ],
)
def test_a_wrong_message_of_the_pose_error_is_refused(old: str, new: str, words: str) -> None:
    """The refusal says what is wrong."""
    assert old in POSE
    with pytest.raises(LayoutError, match=words):
        Layout.from_text(POSE.replace(old, new))


def test_the_pose_error_has_its_own_ids() -> None:
    """A frame of it could otherwise be delivered as one of a line."""
    layout = Layout.from_text(POSE)
    assert layout.pose is not None
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"can_id": 0x341}, "the same CAN ID, 833"),
        ({"data_id": layout.messages[Slot.EGO_LEFT].data_id}, "the same E2EDataId"),
    )
    for change, words in cases:
        messages = replace(layout.pose.messages, **change)
        with pytest.raises(LayoutError, match=words):
            replace(layout, pose=replace(layout.pose, messages=messages))


def test_a_conditional_record_needs_the_pose_error() -> None:
    """Without the attribute, its message is one of others."""
    text = LINES.replace('BA_ "MapLinePose"', 'BA_ "GenMsgStartDelayTime"')
    text = text.replace('"MapLinePose"', '"GenMsgStartDelayTime"')
    with pytest.raises(LayoutError, match="need a message of the pose error"):
        Layout.from_text(text)


def test_a_pose_error_without_a_slot_is_refused() -> None:
    """Each slot of the DBC needs its counter, and complete lines their levels."""
    for name in ("EgoRightCounter", "EgoRightOwnPoints"):
        with pytest.raises(LayoutError, match=f"there is no signal '{name}'"):
            Layout.from_text(POSE.replace(f" {name} ", f" {name}X "))


def test_a_dbc_without_a_pose_error_is_as_before() -> None:
    """Its layout has none, and nothing is conditional."""
    for name in ("float16", "meanonly"):
        layout = Layout.from_dbc(f"maplines_can/study/dbc/maplines-{name}.dbc")
        assert layout.pose is None
        assert layout.short_pages == layout.pages
    assert set(CONDITIONAL_SIGNALS) - set(Layout.from_text(LINES).signals) == set()
