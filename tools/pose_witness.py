"""Check of records of the pose error and of conditional records against cantools."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from dbc_witness import CYCLE_NS, WrongResultError
from scene_layouts import pose_record

from maplines_can.wire import POSE, Layout
from maplines_can.wire.covariance import CholeskyCode
from maplines_can.wire.layout.signals import (
    FINE_SIGNALS,
    OWN_SIGNALS,
    PARAMETER_SIGNALS,
    POSE_ROWS,
    SLOT_SIGNALS,
)
from maplines_can.wire.reception.reassembly import Reassembler, Record
from maplines_can.wire.reception.settings import decoder_settings
from maplines_can.wire.records.frames import Frame, FrameWriter
from maplines_can.wire.records.raw_format import RawFormat
from maplines_can.wire.records.record import RawRecord, RecordReader


def require(holds: Any, message: str) -> None:
    """Raise WrongResultError if a result is not right."""
    if not holds:
        raise WrongResultError(message)


def decoded(database: Any, frames: list[Frame]) -> dict[str, float]:
    """Return the physical values of the frames of a record, as cantools decodes them."""
    signals: dict[str, float] = {}
    for frame in frames:
        message = database.get_message_by_frame_id(frame.can_id)
        signals |= message.decode(frame.data, decode_choices=False)
    return signals


def check_signals(layout: Any, raw: dict[str, int], signals: dict[str, float]) -> None:
    """Compare raw values with the physical values of cantools."""
    for name, value in raw.items():
        own = layout[name].physical_one(value)
        close = math.isclose(own, signals[name], rel_tol=1e-12, abs_tol=1e-12)
        require(close, f"{name} is {own:g}, and {signals[name]:g} by cantools")


def drawn(layout: Any, names: list[str], rng: np.random.Generator) -> dict[str, int]:
    """Return random raw values in the ranges of the signals."""
    return {n: int(rng.integers(layout[n].raw_min, layout[n].raw_max + 1)) for n in names}


def reassembler(layout: Layout, records: RawFormat) -> Reassembler[RawRecord]:
    """Return a reassembler of the records of a layout, which reads those of a format."""
    timeouts_ns = {owner: own.timeout_ns for owner, own in decoder_settings(layout).items()}
    return Reassembler(layout, RecordReader(records), timeouts_ns)


def check_pose(layout: Layout, database: Any, count: int) -> None:
    """Send records of the pose error in both frame formats.

    Raises:
        WrongResultError: a record is not received as sent, or cantools decodes other values.
    """
    pose = layout.pose
    if pose is None:
        raise WrongResultError("there is no message of the pose error")
    covariance = CholeskyCode(pose, POSE_ROWS)
    records, writer = RawFormat.of_pose(pose), FrameWriter(layout, None)
    names = ["Age", "CorrelationTime", "MapOffset", "MapHeading"]
    names += [signal.name for signal in covariance.signals]
    names += [f"{slot}{name}" for slot in ("EgoLeft", "EgoRight") for name in SLOT_SIGNALS]
    rng = np.random.default_rng(3)
    for fd in (False, True):
        state = reassembler(layout, records)
        for i in range(count):
            counters = {slot: int(rng.integers(256)) for slot in pose.counters}
            number = i % 2 ** pose["Counter"].length
            record = pose_record(pose, number, drawn(pose, names, rng), counters)
            frames = writer.write(records.write(record), POSE, fd=fd)
            got = [state.feed(f.can_id, f.data, i * CYCLE_NS) for f in frames][-1]
            if not isinstance(got, Record) or not isinstance(got.content, RawRecord):
                raise WrongResultError(f"a pose error is dropped: {got}")
            found = got.content
            require((found.raw, found.counter) == (record.raw, number), f"{found} of {record}")
            signals = decoded(database, frames)
            check_signals(pose, dict(record.raw), signals)
            for slot, signal in pose.counters.items():
                low = counters[slot] % 2**signal.length
                require(low == signals[signal.name], f"{signal.name} by cantools")
                require(low == pose.slot_counters(found.raw)[slot], signal.name)
            least = np.linalg.eigvalsh(_correlation(covariance.decode_one(record.raw)))[0]
            require(least > 0, "the covariance is not positive definite")


def check_conditional(layout: Layout, database: Any, count: int) -> None:
    """Send conditional records of both forms in both frame formats.

    Raises:
        WrongResultError: a record is not received as sent, or cantools decodes other values.
    """
    covariance = CholeskyCode(layout)
    records, writer = RawFormat.of_lines(layout), FrameWriter(layout, None)
    rng, slot = np.random.default_rng(4), min(layout.messages)
    for fd in (False, True):
        state = reassembler(layout, records)
        for i in range(count):
            raw = drawn(layout, [*PARAMETER_SIGNALS, "XMin", "XMax", "Quartic", *OWN_SIGNALS], rng)
            raw |= {"XMin": layout["XMin"].raw_min, "XMax": layout["XMax"].raw_max}
            if i % 2:
                names = [*(signal.name for signal in covariance.signals), *FINE_SIGNALS]
                raw |= drawn(layout, names, rng)
                raw |= dict.fromkeys(OWN_SIGNALS, 0)
            number = i % 2 ** layout["Counter"].length
            record = RawRecord(slot, number, raw | {"Kind": i % 8})
            frames = writer.write(records.write(record), slot, fd)
            got = [state.feed(f.can_id, f.data, i * CYCLE_NS) for f in frames][-1]
            if not isinstance(got, Record):
                raise WrongResultError(f"a line is dropped: {got}")
            require(got.content == record, f"{got.content} of {record}")
            signals = decoded(database, frames)
            check_signals(layout, raw, signals)
            own = signals["Kind"], signals["HasCovariance"]
            require(own == (i % 8, i % 2), f"Kind and HasCovariance are {own} by cantools")


def _correlation(cov: Any) -> Any:
    sigma = np.sqrt(cov.diagonal())
    return cov / np.outer(sigma, sigma)
