"""Streams for the functions that an ECU calls to send, and for the settings of its receiver.

A third of the inputs has a fault, which must be refused with its name. Otherwise frames, status and
counters must be those of the model, also of frames with a MAC.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ..core import ffi, lib
from ..model import settings as model
from ..model import writer
from ..model.e2e import Windows
from ..model.lines import Curve
from ..model.matrices import Vector, matrix
from ..model.places import Candidate, Places, chosen
from ..model.records import WITHOUT
from ..model.scene_sender import SceneDraft, SceneSender
from ..model.signals import read
from ..values.line import Kind, Slot, Status
from ..wire import POSE, Layout, Owner
from ..wire.core_tables import tables_of
from ..wire.layout.pose_layout import OWNERS, SCENE, SCENE2
from ..wire.layout.record_signals import PAGE_BYTES
from ..wire.layout.slot_messages import RecordMessages, SecuredLayout
from .sender_streams import SenderStream, random_draft, random_scene, scene_draft

#: Rows of a matrix, as lists.
Rows = Any
#: Key IDs that the signer has; others are refused.
KEY_IDS = range(128)
LAST_US = 2**63 - 1
#: Largest entry of a covariance, and what is rounding in units of its standard deviations.
MOST, ROUNDING = 1e307, 1e-9
NAN, INF = math.nan, math.inf


class Way(NamedTuple):
    """How frames are sent."""

    is_fd: bool
    counters: dict[Owner, int]
    key_id: int | None  #: of the signer; None: there is none
    last_us: int  #: freshness value before
    now_us: int
    last: Places  #: of the last whole scene

    @property
    def is_secured(self) -> bool:
        """Whether frames are authenticated."""
        return self.key_id is not None


class Components(NamedTuple):
    """Components of a mixture."""

    weights: list[float]
    means: list[list[float]]
    covs: list[Rows]


def _choice(rng: np.random.Generator, *values: Any) -> Any:
    return values[rng.integers(len(values))]


def _random_way(rng: np.random.Generator, layout: Layout) -> Way:
    counters = {owner: int(rng.integers(_modulus(layout, owner))) for owner in OWNERS}
    key_id = None
    if layout.secured is not None and rng.random() < 0.5:
        key_id = int(_choice(rng, 0, 1, 127, 128, 255))
    last = int(_choice(rng, 0, 10**15, 10**15, LAST_US - 1, LAST_US - 2, LAST_US))
    now = int(_choice(rng, 0, 10**15, 10**15 + 1, last, rng.integers(2**62)))
    is_fd = bool(rng.random() < (0.4 if layout.scene is None else 0.9)) or key_id is not None
    return Way(is_fd, counters, key_id, last, now, _random_places(rng, layout))


def _modulus(layout: Layout, owner: Owner) -> int:
    """Return the number of counters of an owner; 1 if the DBC has no records of it."""
    has = owner in layout.messages_of
    return 2 ** layout.record_of(owner)["Counter"].length if has else 1


def _random_places(rng: np.random.Generator, layout: Layout) -> Places:
    """Return the places that some lines may have had in the last cycle."""
    if layout.scene is None:
        return Places()
    lines = [
        Candidate(Slot(int(slot)), Curve(Vector([float(y), 0.0, 0.0, 0.0]), 0.0, 1.0))
        for slot, y in zip(rng.permutation(8), rng.uniform(-9, 9, rng.integers(9)), strict=False)
    ]
    messages = SceneSender(layout, layout.scene).messages(secured=bool(rng.random() < 0.3))
    return chosen(messages, lines, Places()) if messages else Places()


def _mac(key_id: int, data: bytes) -> bytes:
    """Return what stands for a MAC: all of its bits depend on the key and the data."""
    return hashlib.blake2b(data, digest_size=16, key=bytes([key_id])).digest()


# ---- frames by the model ----------------------------------------------------------------------


def _frames(layout: Layout, way: Way, records: Sequence[tuple[Owner, bytes]]) -> Any:
    """Return the frames of records, and the last freshness value; None if one is not signed."""
    frames, last_us = list[Any](), way.last_us
    for owner, record in records:
        messages, secured = layout.messages_of[owner], layout.record_of(owner).secured
        if way.key_id is not None and secured is not None:
            if last_us == LAST_US or way.key_id not in KEY_IDS:
                return None
            last_us = max(way.now_us, last_us + 1)
            frames.append(signed(secured, messages, record, way.key_id, last_us))
        elif way.is_fd:
            data = record.ljust(messages.fd_length, b"\0")
            frames.append([messages.fd_can_id, messages.fd_is_extended, True, data])
        else:
            for i in range(0, len(record), PAGE_BYTES):
                page = record[i : i + PAGE_BYTES]
                frames.append([messages.can_id, messages.is_extended, False, page])
    return [frames, last_us]


def signed(
    secured: SecuredLayout, messages: RecordMessages, record: bytes, key_id: int, time_us: int
) -> Any:
    """Return the authenticated frame of a record with a freshness value [us]."""
    authentic = record.ljust(secured.authentic_bytes - 1, b"\0") + bytes([key_id])
    freshness, data_id = time_us.to_bytes(8, "big"), messages.secured_data_id.to_bytes(2, "big")
    mac = _mac(key_id, data_id + authentic + freshness)[: secured.mac_bytes]
    data = authentic + freshness[-secured.freshness_bytes :] + mac
    return [messages.secured_can_id, messages.secured_is_extended, True, data]


def _has_message(layout: Layout, owner: Owner, way: Way) -> bool:
    messages = layout.messages_of.get(owner)
    if messages is None:
        return False
    if way.key_id is not None:
        return way.is_fd and messages.secured_can_id is not None
    return (messages.fd_can_id if way.is_fd else messages.can_id) is not None


def _state(
    layout: Layout, way: Way, sent: Sequence[Owner] = (), places: Places | None = None
) -> Any:
    """Return the counters after some records, and the places."""
    counters = {str(o): (n + sent.count(o)) % _modulus(layout, o) for o, n in way.counters.items()}
    return [counters, _numbers(way.last if places is None else places)]


def _numbers(places: Places) -> Any:
    """Return places as the core has them, and whether ``Scene2`` is sent."""
    numbers = [[0 if slot is None else slot + 1 for slot in s or ()] for s in places]
    return [[(own + [0] * 8)[:8] for own in numbers], places.scene2 is not None]


# ---- refusals by the model --------------------------------------------------------------------


def _of_line(line: Any) -> str | None:
    """Return what is wrong with the values of a line besides its Gaussian."""
    if not 0 <= line.kind < len(Kind):
        return "BAD_KIND"
    if not 0 <= line.status < len(Status):
        return "BAD_STATUS"
    if not (math.isfinite(line.x_min) and math.isfinite(line.x_max) and line.x_min <= line.x_max):
        return "BAD_RANGE"
    return None if line.age >= 0 else "BAD_AGE"


def _of_gaussian(status: int, mean: Sequence[float], cov: Rows) -> str | None:
    if not all(map(math.isfinite, mean)):
        return "BAD_MEAN"
    return None if status in WITHOUT else _of_covariance(cov)


def _of_covariance(cov: Rows) -> str | None:
    n, variances = len(cov), [row[i] for i, row in enumerate(cov)]
    if not all(abs(x) <= MOST for row in cov for x in row):
        return "BAD_COVARIANCE"
    if min(variances, default=0) < 0:
        return "BAD_VARIANCE"
    scale = [math.sqrt(x or 1.0) for x in variances]
    for i in range(n):
        for j in range(n):
            if abs(cov[i][j] - cov[j][i]) > ROUNDING * scale[i] * scale[j]:
                return "ASYMMETRIC"
    return None


def _of_joint(cov: Rows) -> str | None:
    """Return what is wrong with a covariance that must be positive semidefinite."""
    found = _of_covariance(cov)
    if found is not None or not cov:
        return found
    scale = [math.sqrt(row[i] or 1.0) for i, row in enumerate(cov)]
    S = [[x / (scale[i] * scale[j]) for j, x in enumerate(row)] for i, row in enumerate(cov)]
    for i, row in enumerate(S):
        row[i] += ROUNDING
    return None if matrix(S).is_definite() else "INDEFINITE"


# ---- faults -----------------------------------------------------------------------------------


def _faulty(rng: np.random.Generator, line: writer.Draft) -> writer.Draft:
    """Return a line with a value that no line has, or with one at the edge of that."""
    mean, cov = Vector(line.mean), matrix(line.cov)
    i, j = map(int, rng.integers(4, size=2))
    edge = ROUNDING * math.sqrt(cov[i][i] or 1.0) * math.sqrt(cov[j][j] or 1.0)
    kinds = ("kind", "status", "x_min", "x_max", "age", "slot", "mean", "entry", "entry", "skew")
    match _choice(rng, *kinds):
        case "kind":
            return replace(line, kind=int(_choice(rng, 7, 8, -1, 2**31 - 1)))
        case "status":
            return replace(line, status=int(_choice(rng, 5, 6, -1, 255)))
        case "x_min":
            return replace(line, x_min=_choice(rng, NAN, INF, -INF, line.x_max, line.x_max + 1e-9))
        case "x_max":
            return replace(line, x_max=_choice(rng, NAN, INF, -INF, line.x_min, line.x_min - 1e-9))
        case "age":
            return replace(line, age=_choice(rng, NAN, -1e-300, -0.0, -INF, -1.0))
        case "slot":
            return replace(line, slot=_choice(rng, -1, 8, 255, *Slot))
        case "mean":
            mean[i] = _choice(rng, NAN, INF, -INF, 1e308)
        case "entry":
            cov[i][j] = _choice(rng, NAN, INF, -INF, MOST, 1.01 * MOST, -MOST, -1e-300, 0.0)
        case "skew":
            cov[i][j] += _choice(rng, 0.9, 1.1, -0.9, -1.1) * edge
    return replace(line, mean=mean, cov=cov)


# ---- the core ---------------------------------------------------------------------------------


class _Sender:
    """An encoder of an ECU with its memory, at a moment.

    Args:
        dbc: tables.
        way: has the counters and the key.
        room: most frames.
    """

    def __init__(self, dbc: Any, way: Way, room: int) -> None:
        self.frames = ffi.new("maplines_frame_t[]", room)
        self.encoder = ffi.new("maplines_encoder_t *")
        lib.maplines_encoder_init(self.encoder, dbc, ffi.NULL)
        for place, owner in enumerate(OWNERS):
            self.encoder.counter[place] = way.counters[owner]
        slots, self.encoder.places.sends_scene2 = _numbers(way.last)
        self.encoder.places.slots = slots
        self._signer: Any = ffi.NULL
        if way.key_id is not None:
            self._signer = ffi.new("maplines_signer_t *")
            self._call = ffi.callback(
                "bool(void *, uint8_t, const uint8_t *, size_t, uint8_t *)", write_mac
            )
            self._signer.mac, self._signer.key_id = self._call, way.key_id
            self._signer.last_us = way.last_us
            self.encoder.signer = self._signer

    def answer(self, sent: Any, *more: Any) -> Any:
        """Return what was sent: a refusal, or frames; and the counters and places."""
        refusal = ffi.string(lib.maplines_refusal_name(sent.refusal)).decode()
        counters = {str(o): self.encoder.counter[i] for i, o in enumerate(OWNERS)}
        places = self.encoder.places
        state = [counters, [[[*slots] for slots in places.slots], places.sends_scene2]]
        if refusal != "SENT":
            return [refusal, sent.count, state]
        frames = [
            [one.can_id, one.is_extended, one.is_fd, bytes(one.data)[: one.length]]
            for one in self.frames[0 : sent.count]
        ]
        last_us = self._signer.last_us if self._signer else None
        return [frames, last_us, *more, state]


def write_mac(_: Any, key_id: int, data: Any, length: int, mac: Any) -> bool:
    """Write what stands for a MAC, as ``maplines_signer_t`` asks for it."""
    if key_id not in KEY_IDS:
        return False
    ffi.buffer(mac, 16)[:] = _mac(key_id, bytes(ffi.buffer(data, length)))
    return True


def _given(line: writer.Draft) -> dict[str, Any]:
    names = ("slot", "kind", "status", "x_min", "x_max", "age", "mean", "cov")
    given = {name: getattr(line, name) for name in names} | {"has_age": line.age != INF}
    return given | {name: given[name] % 2**32 for name in names[:3]}  # as an enumeration


# ---- lines ------------------------------------------------------------------------------------

#: Pages of a record, and components of a mixture, that the library has room for.
PAGES, COMPONENTS = 16, 64


def _refused(layout: Layout, way: Way, refusal: str) -> Any:
    return [refusal, 0, _state(layout, way)]


def _of_message(layout: Layout, line: writer.Draft, way: Way) -> str | None:
    """Return why a line cannot be sent, whatever its Gaussian."""
    if layout.is_conditional:
        return "NO_COVARIANCE"
    if line.slot not in layout.messages or not _has_message(layout, Slot(line.slot), way):
        return "NO_MESSAGE"
    return _of_line(line)


def _sent(
    layout: Layout,
    way: Way,
    records: Sequence[tuple[Owner, bytes]],
    *more: Any,
    places: Places | None = None,
) -> Any:
    found = _frames(layout, way, records)
    if found is None:
        return _refused(layout, way, "NO_SIGNATURE")
    frames, last_us = found
    state = _state(layout, way, [owner for owner, _ in records], places)
    return [frames, last_us if way.is_secured else None, *more, state]


def _lines(layout: Layout, rng: np.random.Generator) -> Iterator[Any]:
    while True:
        line = replace(random_draft(rng, layout), index=0, count=1, weight=1.0)
        line = _faulty(rng, line) if rng.random() < 0.35 else line
        yield line, _random_way(rng, layout)


def _line_by_core(dbc: Any, given: Any) -> Any:
    line, way = given
    sender = _Sender(dbc, way, PAGES)
    content = ffi.new("maplines_input_t *", _given(line))
    sent = lib.maplines_encode_line(sender.encoder, content, way.is_fd, way.now_us, sender.frames)
    return sender.answer(sent, sent.status)


def _line_by_model(layout: Layout, given: Any) -> Any:
    line, way = given
    fault = _of_message(layout, line, way) or _of_gaussian(line.status, line.mean, line.cov)
    if fault is not None:
        return _refused(layout, way, fault)
    slot = Slot(line.slot)
    record = writer.write(
        layout, replace(line, slot=slot, cov=matrix(line.cov).symmetric()), way.counters[slot]
    )
    return _sent(layout, way, [(slot, record)], read(layout["Status"], record))


# ---- mixtures ---------------------------------------------------------------------------------

#: Statuses from the best to the worst one.
WORST = (Status.FULL, Status.REPAIRED, Status.SATURATED, Status.DIAGONAL, Status.UNKNOWN,
         Status.OUT_OF_RANGE)  # fmt: skip


def _most_components(layout: Layout) -> int:
    return int(layout["ComponentCount"].physical_range[1])


def _mixtures(layout: Layout, rng: np.random.Generator) -> Iterator[Any]:
    most = _most_components(layout)
    for line, way in _lines(layout, rng):
        k = int(_choice(rng, 1, 2, rng.integers(1, most + 1)))
        weights = np.maximum(rng.dirichlet(np.full(k, _choice(rng, 0.1, 1, 10))), 1e-6)
        weights /= weights.sum()
        drafts = [random_draft(rng, layout) for _ in range(k)]
        if rng.random() < 0.2:
            i = rng.integers(k)
            weights[i] = _choice(
                rng, 0.0, -weights[i], NAN, 2.0, weights[i] + 0.9e-5, weights[i] - 1.1e-5
            )
        if rng.random() < 0.2 and line.status not in WITHOUT:
            i = rng.integers(k)
            drafts[i] = _faulty(rng, drafts[i])
        count = 0 if rng.random() < 0.03 else k
        if rng.random() < 0.03:
            weights, count = np.full(most + 1, 1 / (most + 1)), most + 1
            drafts = (drafts * count)[:count]
        parts = Components(
            weights.tolist(), [one.mean for one in drafts], [one.cov for one in drafts]
        )
        yield line, way, parts, count


def _mixture_by_core(dbc: Any, given: Any) -> Any:
    line, way, parts, count = given
    sender = _Sender(dbc, way, PAGES * COMPONENTS)
    names = ("weight", "mean", "cov")
    content = [dict(zip(names, one, strict=True)) for one in zip(*parts, strict=True)]
    components = ffi.new("maplines_component_t[]", content)
    shared = ffi.new("maplines_input_t *", _given(line))
    sent = lib.maplines_encode_mixture(
        sender.encoder, shared, components, count, way.is_fd, way.now_us, sender.frames
    )
    return sender.answer(sent, sent.status)


def _mixture_by_model(layout: Layout, given: Any) -> Any:
    line, way, parts, count = given
    fault = _of_message(layout, line, way) or _of_weights(layout, parts.weights, count)
    for mean, cov in zip(parts.means, parts.covs, strict=True):
        fault = fault or _of_gaussian(line.status, mean, cov)
    if fault is not None:
        return _refused(layout, way, fault)
    slot, covs = Slot(line.slot), [matrix(cov).symmetric() for cov in parts.covs]
    own = replace(line, slot=slot), parts.weights, parts.means, covs, way.counters[slot]
    records = writer.write_mixture(layout, *own)
    status = max((read(layout["Status"], one) for one in records), key=WORST.index)
    return _sent(layout, way, [(slot, one) for one in records], status)


def _of_weights(layout: Layout, weights: Sequence[float], count: int) -> str | None:
    if not 1 <= count <= _most_components(layout):
        return "BAD_COUNT"
    total = 0.0
    for weight in weights:
        total += weight
    is_good = all(0 < weight < 2 for weight in weights) and abs(total - 1) <= 1e-5
    return None if is_good else "BAD_WEIGHTS"


# ---- scenes -----------------------------------------------------------------------------------


class _SceneGiven(NamedTuple):
    """A scene to be sent by an ECU."""

    draft: SceneDraft
    ages: dict[Owner, float]
    line_count: int
    way: Way


def _scenes(layout: Layout, rng: np.random.Generator) -> Iterator[Any]:
    while True:
        try:
            scene = random_scene(rng, layout)
        except ValueError:  # a line is no function of x, or a range is empty
            continue
        draft = scene_draft(scene)
        ages = {o: float(_choice(rng, rng.uniform(0, 0.1), INF)) for o in OWNERS}
        draft = _faulty_scene(rng, draft) if rng.random() < 0.35 else draft
        if rng.random() < 0.05:
            ages[_choice(rng, *ages)] = _choice(rng, -1.0, NAN, -1e-300)
        count = 9 if rng.random() < 0.03 else len(draft.lines)
        lines = [replace(line, age=ages.get(line.slot, 0.0)) for line in draft.lines]
        yield _SceneGiven(replace(draft, lines=lines), ages, count, _random_way(rng, layout))


def _faulty_scene(rng: np.random.Generator, draft: SceneDraft) -> SceneDraft:
    """Return a scene with a fault, or at the edge of one."""
    kinds = ("pose", "time", "offset", "heading", "line", "slot", "range", "cov", "specific")
    kind = _choice(rng, *kinds)
    if kind == "pose":
        return replace(draft, pose_cov=_faulty_matrix(rng, draft.pose_cov))
    if kind == "time":
        return replace(draft, correlation_time=_choice(rng, 0.0, -1.0, NAN, 1e-300))
    if kind == "offset":
        return replace(draft, offset_sigma=_choice(rng, -1e-300, NAN, INF, 1e300))
    if kind == "heading":
        return replace(draft, heading_sigma=_choice(rng, -1e-300, NAN, INF, 1e300))
    if not draft.lines:
        return draft
    i = int(rng.integers(len(draft.lines)))
    if kind in ("line", "slot"):
        lines, other = [*draft.lines], _choice(rng, *draft.lines).slot
        own = lines[i]
        lines[i] = _faulty(rng, own) if kind == "line" else replace(own, slot=other)
        return replace(draft, lines=lines)
    if kind == "range":
        ranges, quartics = [*draft.fit_ranges], [*draft.quartics]
        low, high = ranges[i]
        others = (NAN, high), (low, NAN), (-INF, high), (low, INF), (low, low), (high, low)
        ranges[i] = _choice(rng, *others, ranges[i])
        quartics[i] = quartics[i] if ranges[i] != (low, high) else _choice(rng, NAN, INF, -INF)
        return replace(draft, fit_ranges=ranges, quartics=quartics)
    if kind == "specific" and draft.specific is not None:
        specific = [*draft.specific]
        specific[i] = _faulty_matrix(rng, specific[i])
        return replace(draft, specific=specific)
    return replace(draft, cov=_faulty_matrix(rng, draft.cov))


def _faulty_matrix(rng: np.random.Generator, cov: Rows) -> Rows:
    """Return a matrix that is no covariance, or hardly one."""
    changed = matrix(cov)
    i, j = map(int, rng.choice(len(cov), 2, replace=False))
    sigma = [math.sqrt(abs(row[k]) or 1.0) for k, row in enumerate(cov)]
    match rng.integers(5):
        case 0:
            changed[i][j] = _choice(rng, NAN, INF, 1.01 * MOST)
        case 1:
            changed[i][i] = _choice(rng, -1e-300, -1.0, NAN)
        case 2:
            changed[i][j] += 1.1 * ROUNDING * sigma[i] * sigma[j] * _choice(rng, 1, -1)
        case _:
            more = _choice(rng, 1.0, 1.5, 1 + 1e-8) * sigma[i] * sigma[j]
            changed[i][j] = changed[j][i] = more
    return changed


def _scene_by_core(dbc: Any, given: _SceneGiven) -> Any:
    draft, way = given.draft, given.way
    sender = _Sender(dbc, way, PAGES * len(OWNERS))
    scene = ffi.new("maplines_scene_input_t *")
    scene.count = given.line_count
    for i, line in enumerate(draft.lines):
        own = scene.lines[i]
        for name, value in _given(line).items():
            if name != "cov":
                setattr(own, name, value)
        own.fit_range, own.quartic = draft.fit_ranges[i], draft.quartics[i]
        if draft.specific is not None:
            own.specific = draft.specific[i]
    for i, row in enumerate(draft.cov):
        scene.cov[i][0 : len(row)] = row
    scene.has_specific, scene.pose_cov = draft.specific is not None, draft.pose_cov
    scene.pose_age, scene.correlation_time = given.ages[POSE], draft.correlation_time
    scene.has_pose_age = scene.pose_age != INF
    scene.offset_sigma, scene.heading_sigma = draft.offset_sigma, draft.heading_sigma
    space = ffi.new("maplines_scene_workspace_t *")
    sent = lib.maplines_encode_scene(
        sender.encoder, scene, way.is_fd, way.now_us, space, sender.frames
    )
    n = len(draft.lines)
    names = [ffi.string(lib.maplines_left_out_name(why)).decode() for why in sent.left_out[0:n]]
    answer = sender.answer(sent, names, [*sent.is_sent[0:n]], [*sent.status[0:n]])
    return ["UNSENT", *answer[1:]] if answer[0] in ("BAD_POSE", "UNSEEN") else answer


def _scene_by_model(layout: Layout, given: _SceneGiven) -> Any:
    draft, way = given.draft, given.way
    fault = _of_scene(layout, given)
    if fault is not None:
        return _refused(layout, way, "UNSENT" if fault == "BAD_POSE" else fault)
    assert layout.pose is not None  # noqa: S101 - else it has no message
    S = draft.cov
    blocks = [[row[i : i + 4] for row in S[i : i + 4]] for i in range(0, len(S), 4)]
    lines = [
        replace(line, slot=Slot(line.slot), cov=matrix(block).symmetric())
        for line, block in zip(draft.lines, blocks, strict=True)
    ]
    ages = given.ages | dict.fromkeys((SCENE, SCENE2), given.ages[POSE])
    sent = SceneSender(layout, layout.pose).send(
        replace(draft, lines=lines),
        way.counters,
        ages,
        full=way.is_fd,
        last=way.last,
        secured=way.is_secured,
    )
    if sent is None:
        return _refused(layout, way, "UNSENT")
    names, are_sent, statuses = list[str](), list[bool](), list[int]()
    for line in lines:
        names.append(sent.left_out.get(line.slot, "IN_SCENE"))
        are_sent.append(not layout.is_conditional or names[-1] == "IN_SCENE")
        status = int(Status.FULL) if are_sent[-1] else 0
        if not layout.is_conditional:
            status = read(layout["Status"], sent.records[line.slot])
        statuses.append(status)
    records = [*sent.records.items()]
    places = None if layout.scene is None else sent.places
    return _sent(layout, way, records, names, are_sent, statuses, places=places)


def _of_scene(layout: Layout, given: _SceneGiven) -> str | None:
    """Return why a scene cannot be sent, before it is encoded."""
    draft, way = given.draft, given.way
    is_whole = layout.scene is not None
    if layout.pose is None or not _has_message(layout, SCENE if is_whole else POSE, way):
        return "NO_MESSAGE"
    if given.line_count > len(Slot):
        return "BAD_COUNT"
    sigmas = draft.offset_sigma, draft.heading_sigma
    if not (draft.correlation_time > 0 and all(0 <= x < INF for x in sigmas)):
        return "BAD_POSE"
    if not given.ages[POSE] >= 0:
        return "BAD_AGE"
    fault, used = _of_joint(draft.pose_cov), set[int]()
    for i, line in enumerate(draft.lines):
        if fault is not None:
            return fault
        is_slot = line.slot in [*Slot]
        if not is_slot or not (is_whole or _has_message(layout, Slot(line.slot), way)):
            return "NO_MESSAGE"
        if line.slot in used:
            return "SAME_SLOT"
        used.add(line.slot)
        if not all(map(math.isfinite, line.mean)):
            return "BAD_MEAN"
        numbers = *draft.fit_ranges[i], draft.quartics[i]
        if not all(map(math.isfinite, numbers)) or not numbers[0] < numbers[1]:
            return "BAD_RANGE"
        fault = _of_line(line)
        if fault is None and draft.specific is not None:
            fault = _of_joint(draft.specific[i])
    return fault or _of_joint(draft.cov)


# ---- settings of a receiver -------------------------------------------------------------------


class _Asked(NamedTuple):
    """Settings that are asked for, and changes to what was found."""

    timeout_ms: float
    cycle_ms: float
    windows: Windows | None
    stale_cycles: float
    timeout_ns: dict[int, int]  #: of owners by number
    cycle_ns: dict[int, int]
    authenticator: tuple[bool, bool, int, int] | None  #: has MAC, has clock, window, not before


MAX_MS, MAX_NS = 3_600_000.0, 3_600_000_000_000


def _random_windows(rng: np.random.Generator) -> Windows:
    """Return windows that obey AUTOSAR's constraints, or nearly do."""
    valid = int(_choice(rng, 1, 10, 255, rng.integers(1, 256)))
    sizes = [int(rng.integers(1, valid + 1)), valid, int(rng.integers(1, valid + 1))]
    most = min(sizes)
    oks = np.sort(rng.integers(1, most + 1, 3)).tolist()
    room = most - oks[2]
    errors = np.sort(rng.integers(0, room + 1, 3)).tolist()
    values = [
        int(_choice(rng, 1, 16, 127, rng.integers(1, 128))), *sizes,
        oks[1], oks[0], oks[2], errors[1], errors[2], errors[0],
    ]  # fmt: skip
    if rng.random() < 0.6:
        i = int(_choice(rng, 0, rng.integers(len(values)), rng.integers(4, len(values))))
        values[i] = int(_choice(rng, 0, 1, values[i] + 1, max(values[i] - 1, 0), 127, 128, 255))
    names = Windows._fields[:-1]
    found = dict(zip(names, (min(value, 255) for value in values), strict=True))
    return Windows(**found, clear_to_invalid=bool(rng.integers(2)))


def _settings(layout: Layout, rng: np.random.Generator) -> Iterator[Any]:
    edges = 1e-7, 1e-6, MAX_MS, MAX_MS + 1e-3, -1e-300, NAN, INF
    usual = 0.0, 0.0, 20.0, 50.0, 1000.0
    most = 0 if layout.secured is None else 2 ** (8 * layout.secured.freshness_bytes - 1) - 1
    while True:
        changes: list[dict[int, int]] = [{}, {}]
        if rng.random() < 0.3:
            owner = int(rng.integers(len(OWNERS)))
            changes[rng.integers(2)][owner] = int(_choice(rng, 0, 1, MAX_NS, MAX_NS + 1, -1))
        authenticator = None
        if rng.random() < 0.5:
            window = int(_choice(rng, 10**6, 1, 0, -1, most, most + 1, most, most + 1))
            since = int(_choice(rng, 0, 0, 0, 10**15, -1))
            authenticator = bool(rng.random() < 0.9), bool(rng.random() < 0.6), window, since
        yield _Asked(
            float(_choice(rng, *usual, rng.uniform(1, 1e4), _choice(rng, *edges))),
            float(_choice(rng, *usual, rng.uniform(1, 1e4), _choice(rng, *edges))),
            _random_windows(rng) if rng.random() < 0.6 else None,
            float(_choice(rng, *9 * [3.0], 0.0, -1e-300, NAN, INF)),
            changes[0],
            changes[1],
            authenticator,
        )


def _settings_by_core(dbc: Any, asked: _Asked) -> Any:
    found = ffi.new("maplines_settings_t *")
    windows = ffi.NULL if asked.windows is None else ffi.new("maplines_e2e_config_t *",
                                                             [*asked.windows])  # fmt: skip
    problem = lib.maplines_settings_for(dbc, asked.timeout_ms, asked.cycle_ms, windows, found)
    settings = {
        owner: [found.timeout_ns[i], found.cycle_ns[i], _windows_of(found.e2e[i])]
        for i, owner in enumerate(OWNERS)
        if dbc.messages[i].is_present
    }
    standard = ffi.new("maplines_settings_t *")
    lib.maplines_default_settings(dbc, standard)
    is_standard = ffi.buffer(standard)[:] == ffi.buffer(found)[:]
    found.stale_cycles = asked.stale_cycles
    for owner, value in asked.timeout_ns.items():
        found.timeout_ns[owner] = value
    for owner, value in asked.cycle_ns.items():
        found.cycle_ns[owner] = value
    if asked.authenticator is not None:
        has_mac, has_clock, window_us, not_before_us = asked.authenticator
        mac = ffi.cast("bool (*)(void *, uint8_t, const uint8_t *, size_t, uint8_t *)", has_mac)
        clock = ffi.cast("int64_t (*)(void *)", has_clock)
        found.authenticator = authenticator = ffi.new("maplines_authenticator_t *")
        authenticator.mac, authenticator.now_us = mac, clock
        authenticator.window_us, authenticator.not_before_us = window_us, not_before_us
    decoder = ffi.new("maplines_decoder_t *")
    refused = lib.maplines_decoder_init(decoder, dbc, found)
    is_ready = decoder.is_ready
    return [_text(problem), settings, is_standard, _text(refused), bool(is_ready)]


def _windows_of(e2e: Any) -> list[int]:
    return [int(getattr(e2e, name)) for name in Windows._fields]


def _text(text: Any) -> str | None:
    return ffi.string(text).decode() if text else None


def _settings_by_model(layout: Layout, asked: _Asked) -> Any:
    problem, standard = None, model.settings_of(layout)
    for name in ("timeout_ms", "cycle_ms"):
        if not 0 <= getattr(asked, name) <= MAX_MS:
            text = f"{name} must be from 0 (the default) to an hour, 3600000 ms"
            problem = problem or text
    found = standard
    if problem is None:
        windows = asked.windows
        wanted = model.settings_of(layout, asked.timeout_ms, asked.cycle_ms, windows)
        problem = _of_settings(layout, wanted, 3.0, None)
        found = standard if problem is not None else wanted
    settings = {
        owner: [own.timeout_ns, own.cycle_ns, [int(x) for x in own.windows]]
        for owner, own in found.items()
    }
    order = OWNERS
    for name in ("timeout_ns", "cycle_ns"):
        for i, value in getattr(asked, name).items():
            if order[i] in found:
                found = found | {order[i]: found[order[i]]._replace(**{name: value})}
    refused = _of_settings(layout, found, asked.stale_cycles, asked.authenticator)
    texts = {str(owner): own for owner, own in settings.items()}
    is_standard = texts == {
        str(owner): [own.timeout_ns, own.cycle_ns, [int(x) for x in own.windows]]
        for owner, own in standard.items()
    }
    return [problem, settings, is_standard, refused, refused is None]


def _of_settings(
    layout: Layout,
    settings: dict[Owner, model.Settings],
    stale_cycles: float,
    authenticator: tuple[bool, bool, int, int] | None,
) -> str | None:
    """Return what is wrong with settings."""
    if not stale_cycles >= 0:
        return "stale_cycles must be 0 or more"
    for owner in OWNERS:
        if owner not in settings:
            continue
        own = settings[owner]
        for name in ("timeout_ns", "cycle_ns"):
            if not 1 <= getattr(own, name) <= MAX_NS:
                return f"{name} must be from 1 ns to an hour for each owner of the DBC"
        fault = _of_windows(own.windows)
        if fault is not None:
            return fault
        if 2 * own.windows.max_delta_counter >= _modulus(layout, owner):
            return "max_delta_counter must be less than half the modulus of the DBC's Counter"
    return None if authenticator is None else _of_authenticator(layout, *authenticator)


def _of_windows(own: Windows) -> str | None:
    if not 1 <= own.max_delta_counter <= 127:
        return "max_delta_counter must be from 1 to 127"
    for state in ("INIT", "VALID", "INVALID"):
        size, ok = own.of("window_size", state), own.of("min_ok_state", state)
        if size < 1 or ok < 1:
            return "each window_size and min_ok_state must be 1 or more"
        if ok + own.of("max_error_state", state) > size:
            return "min_ok_state + max_error_state must fit into the window_size of its state"
        if size > own.window_size_valid:
            return "no window_size may exceed window_size_valid"
    if not own.min_ok_state_valid <= own.min_ok_state_init <= own.min_ok_state_invalid:
        return "min_ok_state_valid <= min_ok_state_init <= min_ok_state_invalid must hold"
    if not own.max_error_state_invalid <= own.max_error_state_init <= own.max_error_state_valid:
        return "max_error_state_invalid <= max_error_state_init <= max_error_state_valid must hold"
    return None


def _of_authenticator(
    layout: Layout, has_mac: bool, has_clock: bool, window_us: int, not_before_us: int
) -> str | None:
    if layout.secured is None:
        return "authenticator: the DBC has no authenticated message of lines"
    if not has_mac:
        return "authenticator: mac must be a function"
    if window_us < 1:
        return "authenticator: window_us must be 1 or more"
    if not_before_us < 0:
        return "authenticator: not_before_us must be 0 or more"
    for own in (layout, layout.pose):
        secured = None if own is None else own.secured
        if secured is None:
            continue
        if not has_clock and secured.freshness_bytes < 7:
            return "authenticator: without a clock (now_us), Freshness needs 7 bytes in the DBC"
        if has_clock and window_us > 2 ** (8 * secured.freshness_bytes - 1) - 1:
            return "authenticator: window_us must be less than half of what Freshness can count"
    return None


def _of_tables(answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return the answers of the core for a codec, whose DBC has tables."""
    return lambda codec, given: answer(tables_of(codec.layout), given)


#: Streams by name.
ECU_STREAMS = {
    "lines of an ECU": SenderStream(_lines, _of_tables(_line_by_core), _line_by_model, 200),
    "mixtures of an ECU": SenderStream(
        _mixtures, _of_tables(_mixture_by_core), _mixture_by_model, 100
    ),
    "scenes of an ECU": SenderStream(_scenes, _of_tables(_scene_by_core), _scene_by_model, 10),
    "settings": SenderStream(_settings, _of_tables(_settings_by_core), _settings_by_model, 200),
}
