"""Check of a codec against cantools with the same DBC, and against its own promises."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np
from answers import one
from cantools.database.can import Database, Message

from maplines_can.model.records import intact, sealed, written
from maplines_can.model.signals import packed
from maplines_can.propagation import map_scene
from maplines_can.values.errors import EncodeError
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import PARAMETERS, Kind, MapLine, Slot, Status
from maplines_can.values.mixture import GaussianMixture
from maplines_can.values.polyline import Polyline
from maplines_can.values.scene import Scene
from maplines_can.wire import Authenticator, Codec, Key, Layout
from maplines_can.wire.layout.message_layout import AnyLayout
from maplines_can.wire.layout.record_signals import (
    PAGE,
    PAGE_BYTES,
    PARAMETER_SIGNALS,
    SECURED_SIGNALS,
    TRANSFER_ID,
)
from maplines_can.wire.layout.scene_layout import SceneLayout
from maplines_can.wire.layout.slot_messages import RecordMessages

SECRET = bytes(range(16))
#: Time between lines, and between the frames of one [ns].
CYCLE_NS, FRAME_NS = 50_000_000, 100_000
RANGES = ((0, 80), (-30.5, 50.3), (50, 80), (300, 400), (-100, -50), (3.1, 3.2), (-20, 124))
#: Offset of the line of each slot in a scene from the car [m].
OFFSETS = (1.75, -1.75, 5.25, -5.25, 0.0, 7.0, -7.0, 0.4)
AGES = (0.0, 1e-4, 0.04, 0.2399, 0.24, 0.2401, 5.0, np.inf)


class WrongResultError(Exception):
    """The codec's result differs from the DBC or from a promise."""


def lines_of(slot: Slot, n: int, most_components: int) -> list[MapLine]:
    """Return lines of each status, kind and age, some beyond all ranges, and mixtures."""
    rng = np.random.default_rng(11)
    lines = []
    for i in range(n):
        mean = rng.uniform(-1, 1, 4) * [4.0, 0.1, 2e-3, 1e-5]
        root = rng.standard_normal((4, 4)) * np.array([[0.1], [0.01], [3e-4], [1e-5]])
        match i % 8:
            case 1:
                mean[i // 8 % 4] = 1000.0 if i // 8 % 4 != 1 else 1.5
            case 2:
                root *= 1e-6
            case 3:
                root *= 1e3
            case 4:
                root[:, 1:] = 0  # singular
        x_min, x_max = RANGES[i % len(RANGES)]
        attributes: dict[str, Any] = {"kind": Kind(i % 8), "x_min": x_min, "x_max": x_max}
        attributes |= {"age": AGES[i % len(AGES)], "status": Status(1 if i % 3 else i // 3 % 6)}
        gaussian = Gaussian(mean, root @ root.T)
        lines.append(MapLine(slot, gaussian, **attributes))
    for k in {2, 3, most_components}:
        if k > most_components:
            continue
        weights = rng.uniform(0.2, 1, k)
        components = tuple(
            Gaussian(line.gaussian.mean, line.gaussian.cov) for line in lines[5 : 5 + k]
        )
        mixture = GaussianMixture(weights / weights.sum(), components)
        lines.append(MapLine.of_mixture(slot, mixture, x_max=40.0, age=0.02))
    return lines


def check_codec(codec: Codec, database: Database, records: int = 300, n: int = 24) -> None:
    """Check the signals of a codec, and lines or scenes that it sends and receives.

    Args:
        codec: of the DBC.
        database: of the DBC.
        records: number of lines in a row in each frame format.
        n: number of lines of all kinds in each frame format.

    Raises:
        WrongResultError: a result is wrong. Any other exception is also a wrong result.
    """
    layout = codec.layout
    for owner, messages in layout.messages_of.items():
        check_signals(layout.record_of(owner), messages, database)
    if layout.pose is not None:
        check_scenes(codec)
    else:
        check_lines(codec, database, records, n)


# ---- signals ---------------------------------------------------------------------------------


def check_signals(layout: AnyLayout, messages: RecordMessages, database: Database) -> None:
    """Check that cantools decodes all signals of random records in each frame format.

    Raises:
        WrongResultError: it decodes another value.
    """
    rng = np.random.default_rng(3)
    for _ in range(4):
        raw = {
            name: int(rng.integers(s.raw_min, s.raw_max, endpoint=True))
            for name, s in layout.signals.items()
        }
        record = _record(layout, raw | {"HasCovariance": 1}, messages.data_id)
        known = intact(layout, record, messages.data_id)
        if isinstance(known, str):
            raise WrongResultError(f"a record is rejected: {known}")
        pages = [record[i : i + PAGE_BYTES] for i in range(0, len(record), PAGE_BYTES)]
        for key, is_whole in messages.ids.items():
            message = _message(database, *key)
            length = message.length  # of an authenticated message it may be less
            payloads = [record[:length].ljust(length, b"\0")] if is_whole else pages
            for name, value in _decoded(message, payloads, layout).items():
                if name in known and name.rstrip("0123456789") not in (PAGE, TRANSFER_ID):
                    _equal(name, layout[name].physical_one(known[name]), value)
                    _equal(name, known[name], (raw | known)[name])


def _record(layout: AnyLayout, raw: dict[str, int], data_id: int) -> bytes:
    """Return the record of raw values, with what protects it."""
    if not isinstance(layout, SceneLayout):
        return written(layout, raw, data_id)
    record = packed(layout.signals.values(), raw, layout.record_bytes)
    return sealed(layout, record, data_id)


# ---- scenes ----------------------------------------------------------------------------------


@cache
def straight_scene(slots: tuple[Slot, ...]) -> Scene:
    """Return a scene with a straight line in each slot."""
    lines = {slot: Polyline([[-100.0, OFFSETS[slot]], [200.0, OFFSETS[slot]]]) for slot in slots}
    return map_scene(lines, Gaussian([0, 0, 0], np.diag([0.3, 0.2, 0.005]) ** 2))


def check_scenes(codec: Codec) -> None:
    """Send a scene with a line in each slot in both frame formats, and check what arrives.

    Of whole scenes, there are as many lines as places, all of which are sent in one cycle.

    Raises:
        WrongResultError: the scene is not delivered with all lines that fit into the DBC, or is
            overconfident.
    """
    layout = codec.layout
    slots = layout.slots if layout.scene is None else _with_places(layout.scene)
    sent = straight_scene(slots)
    for fd in (False, True) if layout.has_classic else (True,):
        try:
            frames_of = codec.encoder().encode_scene(sent, fd=fd, counters={})
        except EncodeError as error:
            if "pose error does not fit" in str(error):
                return
            raise
        decoder, frames = codec.decoder(), [f for own in frames_of.values() for f in own]
        for j, frame in enumerate(frames):
            t_ns, is_extended = CYCLE_NS + j * FRAME_NS, frame.is_extended
            decoder.feed(frame.can_id, frame.data, t_ns, is_extended=is_extended)
        received = decoder.scene()
        by_slot = {line.slot: line for line in received.scene.lines} if received else {}
        for line in sent.lines:
            if line.slot in by_slot:
                got = by_slot[line.slot].gaussian
                _check_covered(line.gaussian, got, line.gaussian.cov)
            elif line.slot in frames_of or _fits(layout, line):
                raise WrongResultError(f"of {len(frames)} frames the scene is {received}")


def _with_places(scene: SceneLayout) -> tuple[Slot, ...]:
    """Return as many slots as the messages have places, those with a fixed place first."""
    places = [slot for slots in scene.fixed.values() for slot in slots]
    fixed = [slot for slot in places if slot is not None]
    return tuple(
        sorted([*fixed, *(slot for slot in scene.slots if slot not in fixed)][: len(places)])
    )


def _fits(layout: Layout, line: MapLine) -> bool:
    """Return whether the values of a line are in the ranges of their signals, less a step."""
    values = dict(zip(PARAMETER_SIGNALS, line.gaussian.mean, strict=True))
    if layout.is_conditional:
        values |= {"XMin": line.x_min, "XMax": line.x_max}
    return all(
        layout[name].physical_range[0] <= value - layout[name].factor
        and value + layout[name].factor <= layout[name].physical_range[1]
        for name, value in values.items()
    )


def _check_covered(sent: Gaussian, received: Gaussian, cov: Any) -> None:
    """Check that a received Gaussian covers the sent mean with a covariance."""
    d = sent.mean - received.mean
    sigma = np.sqrt(received.cov.diagonal())
    excess = (received.cov - cov - np.outer(d, d)) / np.outer(sigma, sigma)
    if not np.linalg.eigvalsh(excess)[0] >= -1e-9:
        raise WrongResultError(f"overconfident: {np.linalg.eigvalsh(excess)[0]:g}")


# ---- lines -----------------------------------------------------------------------------------


def check_lines(codec: Codec, database: Database, records: int, n: int) -> None:
    """Send n lines in each frame format, and ``records`` in a row, and check what arrives.

    Raises:
        WrongResultError: a result is wrong.
    """
    for slot, of_slot in codec.layout.messages.items():
        most = int(codec.layout["ComponentCount"].physical_range[1])
        lines = lines_of(slot, n, min(most, 8))
        row = [line for line in lines if line.mixture is None][: 1 + 7 * (records > 0)]
        in_a_row = [row[i % len(row)] for i in range(records)]
        if of_slot.can_id is not None:
            _check_frames(codec, database, [*lines, *in_a_row], slot, len(lines))
        if of_slot.fd_can_id is not None:
            _check_frames(codec, database, [*lines, *in_a_row], slot, len(lines), fd=True)
        if of_slot.secured_can_id is not None:
            _check_authenticated(codec, database, lines[1:7], slot)
        for can_id, fd in ((of_slot.can_id, False), (of_slot.fd_can_id, True)):
            if can_id is None:
                _check_not_sent(codec, lines[0], fd)


def _check_frames(
    codec: Codec,
    database: Database,
    lines: Sequence[MapLine],
    slot: Slot,
    witnessed: int,
    *,
    fd: bool = False,
) -> None:
    decoder = codec.decoder()
    records: list[bytes] = []
    signals: list[dict[str, Any]] = []
    frames_of_lines = codec.encoder().encode_lines(lines, fd=fd, counters={})
    for i, (line, frames) in enumerate(zip(lines, frames_of_lines, strict=True)):
        answer: Any = None
        for j, frame in enumerate(frames):
            t_ns = i * CYCLE_NS + j * FRAME_NS
            answer = one(
                decoder.feed(frame.can_id, frame.data, t_ns, is_extended=frame.is_extended)
            )
        if not isinstance(answer, MapLine):
            raise WrongResultError(f"line {i} is not delivered: {answer}")
        check_line(codec, line, answer)
        if i < witnessed:
            message = _message(database, frames[0].can_id, frames[0].is_extended)
            for payloads in _records(codec, frames, fd):
                records.append(b"".join(payloads)[: codec.layout.record_bytes])
                signals.append(_decoded(message, payloads))
    _check_records(codec, records, signals, slot)


def _records(codec: Codec, frames: Sequence[Any], fd: bool) -> Iterator[list[bytes]]:
    """Yield the payloads of each record."""
    step = 1 if fd else codec.layout.pages
    for i in range(0, len(frames), step):
        yield [frame.data for frame in frames[i : i + step]]


def _message(database: Database, can_id: int, is_extended: bool) -> Message:
    """Return the message with a CAN ID."""
    for message in database.messages:
        if (message.frame_id, message.is_extended_frame) == (can_id, is_extended):
            return message
    raise WrongResultError(f"no message has the CAN ID {can_id:#x}")


def _decoded(
    message: Message, payloads: list[bytes], layout: AnyLayout | None = None
) -> dict[str, Any]:
    """Return the physical values of a record as cantools decodes them.

    Signals of Scene2 have the names of those of Scene at the same places.
    """
    signals: dict[str, Any] = {}
    for payload in payloads:
        if len(payload) != message.length:
            raise WrongResultError(f"{message.name} has {message.length} bytes, got {len(payload)}")
        signals |= message.decode(payload, decode_choices=False)  # type: ignore[arg-type]
    if isinstance(layout, SceneLayout):
        names = {signal.start: name for name, signal in layout.signals.items()}
        own = [signal for signal in message.signals if signal.name not in SECURED_SIGNALS]
        signals = {names.get(s.start, s.name): signals[s.name] for s in own}
    return signals


def _check_records(
    codec: Codec, records: list[bytes], witness: list[dict[str, Any]], slot: Slot
) -> None:
    """Compare decoded records with the physical values that cantools decodes."""
    batch = codec.batch.decode(np.array([list(record) for record in records], np.uint8), slot=slot)
    if not batch.accepted.all():
        raise WrongResultError(f"batch.decode rejects: {dict(batch.rejects)}")
    columns = {
        **dict(zip(PARAMETER_SIGNALS, batch.mean.T, strict=True)),
        "Status": batch.status,
        "Kind": batch.kind,
        "XMin": batch.x_min,
        "XMax": batch.x_max,
        "Age": batch.age * 1000,
        "ComponentIndex": batch.component_index,
        "ComponentCount": batch.component_count,
        "ComponentWeight": batch.component_weight,
        "Counter": batch.counter,
    }
    greatest_age = codec.layout["Age"].physical_range[1]
    for i, (record, signals) in enumerate(zip(records, witness, strict=True)):
        expected = {name: signals[name] for name in columns}
        if batch.status[i] == Status.OUT_OF_RANGE:  # then its range may be empty
            expected["XMin"] = min(signals["XMin"], signals["XMax"])
        if signals["Age"] >= greatest_age:  # "too old"
            expected["Age"] = np.inf
        for name, value in expected.items():
            _equal(name, columns[name][i], value)
        one: Any = codec.batch.decode_one(record, slot)
        if (one.gaussian.mean != batch.mean[i]).any():
            raise WrongResultError("decode_one differs from decode")
        if batch.status[i] not in (Status.UNKNOWN, Status.OUT_OF_RANGE):
            by_hand = covariance_by_hand(signals, codec)
            sigma = np.sqrt(by_hand.diagonal())  # entries near 0 are what is left of large ones
            if not (np.abs(by_hand - batch.cov[i]) <= 1e-9 * np.outer(sigma, sigma)).all():
                raise WrongResultError("the covariance is not that of the signals")


def covariance_by_hand(signals: Any, codec: Codec) -> Any:
    """Return the covariance from the signals that cantools decodes, as in dbc/README.md."""
    order = codec.covariance.factor.order
    names = [PARAMETER_SIGNALS[i] for i in order]
    L = np.zeros((4, 4))
    for i, row in enumerate(names):
        L[i, i] = 2.0 ** signals[f"Pivot{row}"]
        for j, column in enumerate(names[:i]):
            L[i, j] = signals[f"Ratio{row}{column}"] * L[i, i]
    cov = np.empty((4, 4))
    cov[np.ix_(order, order)] = 2.0 ** signals["Inflation"] * L @ L.T
    return cov


def _equal(name: str, value: float, expected: float) -> None:
    if value != expected and abs(value - expected) > 1e-12 * abs(expected):
        raise WrongResultError(f"{name} is {expected!r}, decoded as {value!r}")


def check_line(codec: Codec, given: MapLine, got: MapLine) -> None:
    """Check a received line against the one that was sent."""
    layout = codec.layout
    if (got.slot, got.kind) != (given.slot, given.kind):
        raise WrongResultError(f"{got.slot!r} {got.kind!r}, sent {given.slot!r} {given.kind!r}")
    _check_age(codec, given, got)
    if given.status is Status.OUT_OF_RANGE and got.status is not Status.OUT_OF_RANGE:
        raise WrongResultError(f"a line that must not be used has the status {got.status.name}")
    if got.status is Status.OUT_OF_RANGE:
        _check_out_of_range(codec, given)
        return
    if got.status not in (given.status, Status.SATURATED):
        raise WrongResultError(f"the status is {got.status.name}, requested {given.status.name}")
    _check_range(given, got)
    steps = np.array([abs(layout[name].factor) for name in PARAMETER_SIGNALS])
    d = given.gaussian.mean - got.gaussian.mean
    if got.status is Status.UNKNOWN:
        if (np.abs(d) > 0.51 * steps).any():
            raise WrongResultError(f"the mean is off by {dict(zip(PARAMETERS, d, strict=True))}")
        return
    components = 1 if given.mixture is None else len(given.mixture.weights)
    if (1 if got.mixture is None else len(got.mixture.weights)) != components:
        raise WrongResultError(f"a line of {components} components has another number of them")
    pairs = [(given.gaussian, got.gaussian)]
    if given.mixture is not None and got.mixture is not None:
        pairs += zip(given.mixture.components, got.mixture.components, strict=True)
    for sent, received in pairs:
        cov = np.diag(sent.cov.diagonal()) if got.status is Status.DIAGONAL else sent.cov
        if given.status is Status.DIAGONAL:
            cov = np.diag(sent.cov.diagonal())
        _check_covered(sent, received, cov)


def _check_age(codec: Codec, given: MapLine, got: MapLine) -> None:
    """Check that the age is rounded up by less than a step, and infinite only beyond the range."""
    signal = codec.layout["Age"]
    exact = max(given.age, signal.physical_range[0] / 1000)
    most = exact + signal.factor / 1000 if exact <= codec.layout.max_age else np.inf
    if not given.age <= got.age <= most:
        raise WrongResultError(f"the age is {got.age}, sent {given.age}")


def _check_out_of_range(codec: Codec, given: MapLine) -> None:
    """Check that the mean or the valid range of a line without a covariance does not fit."""
    if given.status is not Status.UNKNOWN:
        return
    ranges = [codec.layout[name].physical_range for name in PARAMETER_SIGNALS]
    fits = all(low <= x <= high for x, (low, high) in zip(given.gaussian.mean, ranges, strict=True))
    first, last = codec.layout["XMin"], codec.layout["XMax"]
    starts, ends = (
        signal.physical(np.arange(signal.raw_min, signal.raw_max + 1)) for signal in (first, last)
    )
    start = starts[starts >= given.x_min].min(initial=np.inf)
    if fits and ((start <= ends) & (ends <= given.x_max)).any():
        raise WrongResultError("a mean and a range that fit are OUT_OF_RANGE")


def _check_range(given: MapLine, got: MapLine) -> None:
    if got.x_min < given.x_min or got.x_max > given.x_max:
        raise WrongResultError(
            f"the range is [{got.x_min:g}, {got.x_max:g}] m, sent [{given.x_min:g}, "
            f"{given.x_max:g}] m, {got.status.name}"
        )


def _check_authenticated(
    codec: Codec, database: Database, lines: Sequence[MapLine], slot: Slot
) -> None:
    now = 1_750_000_000_000_000_000

    def clock() -> int:
        return now

    secured = Codec(codec.layout, Authenticator(Key(SECRET, key_id=5), clock=clock))
    encoder, decoder = secured.encoder(), secured.decoder()
    for line in lines:
        now += CYCLE_NS
        (frame,) = encoder.encode(line, fd=True)
        message = _message(database, frame.can_id, frame.is_extended)
        signals: Any = message.decode(frame.data, decode_choices=False)
        _equal("KeyId", 5, signals["KeyId"])
        bits = 8 * codec.layout.secured.freshness_bytes if codec.layout.secured else 0
        _equal("Freshness", now // 1000 % 2**bits, signals["Freshness"])
        answer = one(decoder.feed(frame.can_id, frame.data, now, is_extended=frame.is_extended))
        if not isinstance(answer, MapLine) or answer.slot is not slot:
            raise WrongResultError(f"an authenticated line is not delivered: {answer}")
        check_line(codec, line, answer)


def _check_not_sent(codec: Codec, line: MapLine, fd: bool) -> None:
    """Check that a line is refused in a frame format without a message."""
    try:
        codec.encoder().encode(line, fd=fd)
    except EncodeError:
        return
    raise WrongResultError(f"there is no message with fd={fd}, but the line is sent")
