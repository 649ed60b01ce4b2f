"""The sender as an FMU sends the frames of the Python package, at the same times."""

import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fmu_nodes import (
    CHANGED,
    NOT_YET_KNOWN,
    UNCHANGED,
    Node,
    Operation,
    frames_of,
    operations_of,
)
from support.lines import random_lines

from maplines_can import Codec, Gaussian, Kind, MapLine, Slot, Status
from maplines_can.bus.tx_queue import Transfer, TxQueue
from maplines_can.wire import Frame

pytest.importorskip("fmpy", reason="the headers of FMI and the importer come from fmpy")

from maplines_can.cli import main

CONFIRM, ARBITRATION_LOST, BUS_ERROR = 0x20, 0x30, 0x31


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fmu") / "sender.fmu"
    assert main(["generate", "fmu", "sender", "--out", str(path)]) == 0
    return path


def inputs_of(line: MapLine) -> Mapping[str, Any]:
    """Return the inputs of a line."""
    name, cov = line.slot.name, line.gaussian.cov
    return {
        f"{name}.valid": True,
        f"{name}.kind": line.kind,
        f"{name}.status": line.status,
        f"{name}.x_min": line.x_min,
        f"{name}.x_max": line.x_max,
        f"{name}.age": line.age,
        **{f"{name}.mean[{i + 1}]": line.gaussian.mean[i] for i in range(4)},
        **{f"{name}.cov[{i + 1},{j + 1}]": cov[i, j] for i in range(4) for j in range(i + 1)},
    }


def lines_at(k: int, slots: list[Slot]) -> list[MapLine]:
    """Return lines of a cycle with various attributes."""
    means, covs = random_lines(8, k)
    return [
        MapLine(
            slot,
            Gaussian(means[slot], covs[slot]),
            kind=Kind((k + slot) % 8),
            status=(Status.FULL, Status.DIAGONAL, Status.UNKNOWN)[(k + slot) % 7 // 3],
            x_min=-5.0,
            x_max=60.0 + slot,
            age=0.001 * (k % 90),
        )
        for slot in slots
    ]


def taken(queue: TxQueue, now: float) -> Iterator[Transfer]:
    """Yield what a transmitter sends now; a transfer that is late states its age anew."""
    while (transfer := queue.take(now)) is not None:
        yield queue.renew(transfer, now) if now > transfer.latest else transfer


def run(node: Node, queue: TxQueue, seconds: float, late: float = 0.0) -> list[Frame]:
    """Publish lines, most of them each cycle, and compare what is sent; return all frames."""
    rng = np.random.default_rng(7)
    sent: list[Frame] = []
    k, published = 0, 0.0
    while node.t < seconds:
        if node.t >= published:
            published = 0.05 * (k + 1) + rng.uniform(-0.01, 0.01)
            slots = [slot for slot in Slot if rng.random() < 0.9] if k % 20 < 12 else []
            lines = lines_at(k, slots)
            for line in lines:
                node.set(inputs_of(line))
            queue.put(lines, node.t)
            if k % 9 == 5:
                node.set({"CENTRE.valid": False})
                queue.drop(Slot.CENTRE)
            k += 1
        interval = node.interval()
        due = np.inf if interval is None else node.t + interval + late * rng.random()
        if due <= min(published, seconds):
            if due > node.t:
                node.step(due)
            frames = frames_of(operations_of(node.send()))
            # The sum of intervals may be a little before the deadline.
            now = max(node.t, queue.first) if queue.first <= node.t + 1e-9 else node.t
            expected = [frame for each in taken(queue, now) for frame in each.frames]
            assert frames == expected
            sent += frames
        else:
            node.step(min(published, seconds))
    return sent


@pytest.mark.parametrize(("fd", "late"), [(False, 0.0), (True, 0.0), (False, 0.09)])
def test_frames_are_those_of_python(fmu: Path, fd: bool, late: float) -> None:
    """For a minute of lines that come, repeat, end, and are late: each byte, in the same order."""
    codec = Codec.from_dbc()
    node = Node(fmu, fmu.with_suffix(""), {"fd": fd})
    configuration = operations_of(node.send())
    assert [operation.code for operation in configuration] == [0x40, 0x40, 0x40]
    queue = TxQueue(codec, 0.05, fd=fd, count=None, max_age=codec.layout.max_age)
    sent = run(node, queue, 60.0 if late == 0.0 else 20.0, late)
    assert len(sent) > (5000 if fd else 15000) * (1 if late == 0.0 else 0.15)
    assert node.get("CAN.frames_sent") == len(sent)
    assert node.get("expired") > 0
    assert (node.get("overruns") > 0) == (late > 0.0)
    assert node.get("refused") == node.get("given_up") == 0
    node.close()


def ready(fmu: Path, **start: Any) -> Node:
    """Return a node whose configuration is sent, with a line that is due now."""
    node = Node(fmu, fmu.with_suffix(""), start)
    node.send()
    node.set(inputs_of(lines_at(1, [Slot.EGO_LEFT])[0]))
    return node


def notification(code: int, can_id: int, *more: int) -> bytes:
    return Operation(code, struct.pack("<I", can_id) + bytes(more)).packed()


def test_with_notifications_frames_wait_for_their_confirmations(fmu: Path) -> None:
    """One that was not sent is sent again, and the frames are in order."""
    first = ready(fmu)
    expected = frames_of(operations_of(first.send()))
    assert len(expected) == 4
    node = ready(fmu, **{"CAN.BusNotifications": True})
    for k, frame in enumerate(expected):
        assert frames_of(operations_of(node.send())) == [frame]
        lost = (None, ARBITRATION_LOST, None, BUS_ERROR)[k % 4]
        if lost is not None:
            more = (4, 1, 1) if lost == BUS_ERROR else ()
            node.take(notification(lost, frame.can_id, *more))
            assert node.interval() == 0.0
            assert frames_of(operations_of(node.send())) == [frame]
        node.take(notification(CONFIRM, 0x7FF))  # of another frame
        node.take(notification(CONFIRM, frame.can_id))
    assert node.get("lines") == 1
    assert node.get("CAN.arbitrations_lost") == 1
    assert node.get("CAN.bus_errors") == 1
    assert node.get("CAN.transmit_error_counter") == max(0, 8 - 1 - 1)
    first.close()
    node.close()


def test_a_line_that_is_not_confirmed_is_given_up_after_a_period(fmu: Path) -> None:
    node = ready(fmu, **{"CAN.BusNotifications": True})
    frames = frames_of(operations_of(node.send()))
    assert len(frames) == 1
    assert node.interval() == pytest.approx(0.05)
    node.step(0.05)
    again = frames_of(operations_of(node.send()))
    assert len(again) == 1
    assert again != frames
    assert node.get("given_up") == 1
    node.close()


def test_intervals_of_the_clock_have_the_qualifiers_of_fmi(fmu: Path) -> None:
    """FMI 3.0.2, 2.2.9: none is unknown after one was known; one unchanged has its value."""
    node = Node(fmu, fmu.with_suffix(""))
    node.send()  # the configuration of the bus
    assert node.announcement()[0] == NOT_YET_KNOWN
    line = lines_at(1, [Slot.EGO_LEFT])[0]
    node.set(inputs_of(line))
    assert node.announcement() == (CHANGED, 0.0)
    node.send()
    qualifier, interval = node.announcement()
    assert qualifier == CHANGED
    assert interval == pytest.approx(0.05)
    assert node.announcement() == (UNCHANGED, interval)
    node.step(0.02)
    assert node.announcement() == (UNCHANGED, interval)
    node.set({"EGO_LEFT.valid": False})
    assert node.announcement() == (UNCHANGED, interval)
    node.step(0.05)
    assert frames_of(operations_of(node.send())) == []
    assert node.announcement()[0] == NOT_YET_KNOWN
    node.close()


def test_a_node_with_too_many_errors_is_off(fmu: Path) -> None:
    """It tells the bus of each change of its state, and sends nothing until it is reset."""
    node = ready(fmu, **{"CAN.BusNotifications": True})
    states = []
    for _ in range(40):
        operations = operations_of(node.send())
        states += [operation.arguments[0] for operation in operations if operation.code == 0x41]
        for frame in frames_of(operations):
            node.take(notification(BUS_ERROR, frame.can_id, 1, 1, 1))
    assert states == [2, 3]
    assert node.get("CAN.state") == 3
    assert node.get("CAN.transmit_error_counter") == 256
    node.step(0.2)
    assert operations_of(node.send()) == []
    assert node.interval() is None
    assert node.get("given_up") == 1 + 4  # the one that found it off, and four cycles
    assert node.interval() is None
    node.step(1.2)
    assert node.get("given_up") == 1 + 4 + 20
    assert node.get("given_up") == 1 + 4 + 20
    assert node.get("overruns") == node.get("lines") == 0
    node.fmu.reset()
    assert node.get("CAN.state") == 1
    node.fmu.freeInstance()


def test_without_notifications_they_are_ignored(fmu: Path) -> None:
    node = ready(fmu)
    sent = frames_of(operations_of(node.send()))
    assert len(sent) == 4
    for code, more in ((CONFIRM, ()), (ARBITRATION_LOST, ()), (BUS_ERROR, (1, 1, 1))):
        node.take(notification(code, sent[0].can_id, *more))
    names = ("confirmed", "arbitrations_lost", "bus_errors", "malformed", "transmit_error_counter")
    assert [node.get(f"CAN.{name}") for name in names] == [0] * 5
    assert node.messages == []
    node.close()


@pytest.mark.parametrize(
    ("name", "value", "refusal"),
    [("mean[1]", np.nan, 3), ("cov[1,1]", -1.0, 5), ("x_min", 90.0, 7), ("age", -1.0, 8)],
)
def test_a_line_that_cannot_be_sent_is_refused(
    fmu: Path, name: str, value: float, refusal: int
) -> None:
    """It is counted and logged, and the next one is sent."""
    node = ready(fmu)
    node.set({f"EGO_LEFT.{name}": value})
    assert operations_of(node.send()) == []
    assert node.get("refused") == 1
    assert node.get("refusal") == refusal
    assert "EGO_LEFT" in node.messages[0][1]
    node.set(inputs_of(lines_at(1, [Slot.EGO_LEFT])[0]))
    node.step(0.1)
    assert len(frames_of(operations_of(node.send()))) == 4
    node.close()
