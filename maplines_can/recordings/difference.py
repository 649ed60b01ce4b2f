"""How the lines of two logs differ: which, in what, and by how many sigmas."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b
from itertools import pairwise, zip_longest
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..logs.log_part import ALL, Time, Window, of_channel
from ..logs.log_summary import LogSummary, Times
from ..values.errors import LogError
from ..values.line import Kind, Slot, Status, are_within
from ..wire import E2EState, LineCodec, Owner, Reason, SlotStats
from ..wire.layout.message_layout import Layout
from ..wire.reception.rows import LINE_ROW
from .block_reception import LineBlock, LogReceiver
from .blocks import read_blocks
from .fitting import misfit
from .line_tables import checked_at, position
from .read_lines import Log, name_of
from .record_matching import Alignment, Array, Lines, align, matched

#: Most lines and parts that are named.
MAX_NAMED = 1000
#: Members of a line that both logs must have alike, and their tolerance if means may differ.
EXACT, WITHIN_STEP = ("kind", "status", "components"), ("x_min", "x_max", "age")
#: What the receiver says of a line.
RECEIVED = ("state", "two_senders")
#: What is compared of the counters of an owner.
COUNTERS = ("state", "ok", "lost", "repeated", "wrong_sequence", "errors", "no_new_data")
#: Time between the lines of a cycle, and more, that parts the lines of one log only [cycles].
_APART = 2.5
#: Greatest difference of the times of a scene in both logs [cycles]; counters repeat after more.
_SCENE_REACH = 4.0


class Scenes(NamedTuple):
    """Scenes of a log, of which there are digests only; n scenes.

    Args:
        channel: (n,) names.
        counter: (n,) of their pose errors.
        t_ns: (n,) times of these [ns].
        digest: (n,) of lines, joint covariance, correlation time, and what is left out.
    """

    channel: Array
    counter: Array
    t_ns: Array
    digest: Array

    @classmethod
    def of(cls, block: LineBlock) -> Scenes:
        """Return the scenes of a block."""
        rows = block.scenes
        digests = np.array([_digest(row) for row in rows], np.int64)
        names = np.array([*block.channels, ""])[block.scene_channel]
        return cls(names, rows["counter"].astype(np.int64), rows["t_ns"], digests)

    @classmethod
    def joined(cls, parts: Sequence[Scenes]) -> Scenes:
        """Return the scenes of all blocks."""
        return cls(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _digest(row: np.void) -> int:
    n = int(row["count"])
    parts = (row["slots"][:n], row["left_out"], row["mean"][:n], row["cov"][: 4 * n, : 4 * n])
    data = b"".join(np.ascontiguousarray(one).tobytes() for one in parts)
    data += np.float64(row["correlation_time"]).tobytes()
    return int.from_bytes(blake2b(data, digest_size=8).digest(), "little", signed=True)


@dataclass(frozen=True, eq=False)
class LoggedLines:
    """All lines of a log, and the counters at its end.

    Args:
        name: of the log.
        layout: of its DBC.
        rows: (n,) of `LINE_ROW`.
        channel: (n,) places in ``channels``.
        channels: names of those that have lines, in the order of their first ones.
        has_time: whether the log has times.
        rejects: frames of lines that were dropped, by reason.
        owners: counters of each owner, by channel.
        pose_errors: number of them.
        scenes: counters, times and contents of the scenes; none without a message of pose errors.
        summary: of the log.
        damage: why the rest was not read; empty if all was.
    """

    name: str
    layout: Layout
    rows: NDArray[np.void]
    channel: NDArray[np.uint16]
    channels: tuple[str, ...]
    has_time: bool
    rejects: Mapping[str, int]
    owners: Mapping[str, Mapping[Owner, SlotStats]]
    pose_errors: int
    scenes: Scenes
    summary: LogSummary
    damage: str

    @classmethod
    def of(
        cls,
        log: Log,
        codec: LineCodec,
        *,
        cycle_ms: float | None = None,
        timeout_ms: float | None = None,
        times: Times = "auto",
        channel: str | None = None,
    ) -> LoggedLines:
        """Read a log.

        Raises:
            LogError: it cannot be opened, or has no line; the message says which DBC fits; or it
                has no such channel.
        """
        has_scenes = codec.layout.pose is not None
        receiver = LogReceiver(codec, cycle_ms=cycle_ms, timeout_ms=timeout_ms, scenes=has_scenes)
        blocks = of_channel(read_blocks(log, times=times), channel, name_of(log))
        found, damage = list[LineBlock](), ""
        scenes = list[Scenes]()
        try:
            for block in blocks:
                lines = receiver.feed(block)
                scenes.append(Scenes.of(lines))
                found.append(replace(lines, scenes=lines.scenes[:0].copy()))  # they are large
        except LogError as error:
            damage = str(error)
            if not found:
                raise
        scenes.append(Scenes.of(receiver.finish()))
        rows = np.concatenate([np.empty(0, LINE_ROW), *(one.lines for one in found)])
        if not len(rows):
            why = damage or misfit(receiver.first, [codec], blocks.summary).text
            raise LogError(f"{name_of(log)}: has no line to compare; {why}")
        places = np.concatenate([one.channel for one in found])
        there, first = np.unique(places, return_index=True)
        there = there[np.argsort(first)]
        numbers = np.zeros(int(there.max()) + 1, np.uint16)
        numbers[there] = np.arange(len(there))
        names = tuple(found[-1].channels[number] for number in there)
        rejects = {reason.name: n for reason, n in receiver.counts.items()
                   if reason not in (Reason.FOREIGN, Reason.PENDING)}  # fmt: skip
        owners = {name: receiver.decoders[name].messages(receiver.last_ns) for name in names}
        errors = sum(one.pose_errors for one in receiver.decoders.values())
        return cls(
            name_of(log), codec.layout, rows, numbers[places], names, receiver.has_time, rejects,
            owners, errors, Scenes.joined(scenes), blocks.summary, damage,
        )  # fmt: skip

    @cached_property
    def stream(self) -> Array:
        """(n,) number of channel and slot of each line."""
        return self.channel.astype(np.int64) * len(Slot) + self.rows["slot"]

    @cached_property
    def cycle(self) -> float:
        """Time of one count of the counters [s]."""
        order = np.argsort(self.stream, kind="stable")
        rows, stream = self.rows[order], self.stream[order]
        step = np.diff(rows["t_ns"]) / 1e9
        ahead = rows["ahead"][1:].astype(float)
        good = (np.diff(stream) == 0) & (ahead > 0) & (step > 0)
        if good.any():
            return float(np.median(step[good] / ahead[good]))
        stated = [own.cycle_ms for own in self.layout.messages_of.values() if own.cycle_ms]
        return min(stated, default=50) / 1000

    @cached_property
    def t(self) -> Array:
        """(n,) time of each line from the first one on [s]; by the order if the log has none."""
        if self.has_time:
            return (self.rows["t_ns"] - self.rows["t_ns"][0]) / 1e9
        order = np.argsort(self.stream, kind="stable")
        stream = self.stream[order]
        begins = np.flatnonzero(np.diff(stream, prepend=-1))
        number = np.arange(len(stream)) - np.repeat(begins, np.diff([*begins, len(stream)]))
        t = np.empty(len(stream))
        t[order] = number * self.cycle
        return t

    def to_align(self, streams: Array) -> Lines:
        """Return what `align` needs, with other numbers of the streams."""
        scene = self.layout.scene
        bits = (self.layout if scene is None else scene)["Counter"].length
        counter = self.rows["counter"].astype(np.int64)
        begin = int(self.rows["t_ns"][0])
        mean = np.array(self.rows["mean"])
        return Lines(streams, counter, self.t, mean, begin, 1 << bits, self.cycle, self.has_time)


class Position(NamedTuple):
    """Differences of the lateral positions of one slot at one x, those of B minus those of A.

    Args:
        x: distance [m].
        lines: that are valid there in both logs.
        mean: mean difference [m].
        largest: that of the greatest magnitude [m].
        mean_sigma: mean difference over the sigma of the difference.
        largest_sigma: that of the greatest magnitude.
    """

    x: float
    lines: int
    mean: float
    largest: float
    mean_sigma: float
    largest_sigma: float


class SceneDifference(NamedTuple):
    """How the scenes of two logs differ.

    Args:
        matched: scenes of both.
        differing: times of those that differ, from the first line of A on [s].
        only_a: scenes that only A has.
        only_b: scenes that only B has.
    """

    matched: int
    differing: Sequence[float]
    only_a: int
    only_b: int


class Part(NamedTuple):
    """Lines that follow each other and are in one log only.

    Args:
        begin: time of the first one, from the first line of the log on [s].
        end: time of the last one [s].
        lines: by slot.
    """

    begin: float
    end: float
    lines: Mapping[Slot, int]


@dataclass(frozen=True, eq=False)
class Difference:
    """How two logs differ, see `difference`; m matched lines.

    Args:
        a: lines of one log.
        b: of the other.
        alignment: of both.
        only: places of the lines that only A has, and only B.
        sigma: within which lines count as equal.
        at: distances of positions [m].
        part: of the lines; but for all, counters and dropped frames are not compared.
    """

    a: LoggedLines
    b: LoggedLines
    alignment: Alignment
    only: tuple[Array, Array]
    sigma: float
    at: tuple[float, ...]
    part: _Part

    @cached_property
    def pairs(self) -> tuple[NDArray[np.void], NDArray[np.void]]:
        """(m,) rows of the matched lines of A and of B."""
        return self.a.rows[self.alignment.a], self.b.rows[self.alignment.b]

    @cached_property
    def are_known(self) -> Array:
        """(m,) whether both lines have values."""
        known = [
            (rows["status"] != Status.OUT_OF_RANGE) & np.isfinite(rows["age"])
            for rows in self.pairs
        ]
        return known[0] & known[1]

    @cached_property
    def distance(self) -> Array:
        """(m,) Mahalanobis distance of the means, by the sum of both covariances; 0 if equal."""
        a, b = self.pairs
        away = b["mean"] - a["mean"]
        distance = np.zeros(len(a))
        here = np.flatnonzero((away != 0).any(axis=1) & self.are_known)
        cov, away = a["cov"][here] + b["cov"][here], away[here]
        scale = np.sqrt(np.einsum("nii->ni", cov))
        away = away / scale
        cov = cov / (scale[:, :, None] * scale[:, None, :])
        solved = np.linalg.solve(cov, away[:, :, None])[:, :, 0]
        distance[here] = np.sqrt(np.einsum("ni,ni->n", away, solved).clip(0))
        return distance

    @cached_property
    def ratio(self) -> Array:
        """(m, 2) least and greatest ratio of the sigmas of B and of A, of all directions."""
        a, b = self.pairs
        ratio = np.ones((len(a), 2))
        here = np.flatnonzero((a["cov"] != b["cov"]).any(axis=(1, 2)) & self.are_known)
        first, second = a["cov"][here], b["cov"][here]
        scale = np.sqrt(np.einsum("nii->ni", first))
        scale = scale[:, :, None] * scale[:, None, :]
        root = np.linalg.cholesky(first / scale)
        half = np.linalg.solve(root, second / scale)
        whole = np.linalg.solve(root, half.transpose(0, 2, 1))
        values = np.linalg.eigvalsh((whole + whole.transpose(0, 2, 1)) / 2)
        ratio[here] = np.sqrt(values[:, [0, -1]].clip(0))
        return ratio

    @cached_property
    def differs(self) -> dict[str, Array]:
        """(m,) whether each kind of value differs: mean, covariance, and other members."""
        a, b = self.pairs
        found = {
            "mean": (a["mean"] != b["mean"]).any(axis=1) & self.are_known,
            "covariance": (a["cov"] != b["cov"]).any(axis=(1, 2)) & self.are_known,
        }
        step = dict.fromkeys(WITHIN_STEP, 0.0)
        if self.sigma > 0:
            found["mean"] = self.distance > self.sigma
            greatest = np.maximum(self.ratio[:, 1], 1 / self.ratio[:, 0].clip(1e-300))
            found["covariance"] = greatest > 1 + self.sigma
            layouts = self.a.layout, self.b.layout
            step = {name: max(_step(one, name) for one in layouts) for name in WITHIN_STEP}
        found |= {name: a[name] != b[name] for name in EXACT}
        for name, most in step.items():
            away = np.abs(np.where(a[name] == b[name], 0.0, a[name] - b[name]))
            found[name] = away > most * (1 + 1e-9)
        found |= {name: a[name] != b[name] for name in RECEIVED}
        return found

    @cached_property
    def differing(self) -> Array:
        """Places among the pairs of lines that differ, the most different first."""
        any_of = np.zeros(len(self.alignment.a), bool)
        for one in self.differs.values():
            any_of |= one
        here = np.flatnonzero(any_of)
        spread = np.abs(np.log(self.ratio[here].clip(1e-300))).max(axis=1)
        return here[np.lexsort((here, -spread, -self.distance[here]))]

    @cached_property
    def owners(self) -> list[tuple[str, Owner, SlotStats | None, SlotStats | None]]:
        """Counters of each owner in A and in B; the channel is that of A."""
        rows: list[tuple[str, Owner, SlotStats | None, SlotStats | None]] = []
        for name_a, name_b in _channel_pairs(self.a.channels, self.b.channels):
            one = {} if name_a is None else self.a.owners[name_a]
            two = {} if name_b is None else self.b.owners[name_b]
            channel = str(name_b if name_a is None else name_a)
            rows += [(channel, own, one.get(own), two.get(own)) for own in {**one, **two}]
        return rows

    @cached_property
    def differing_owners(self) -> list[Owner]:
        """Owners of both DBCs whose states or counters differ at the end."""
        known = self.a.layout.messages_of.keys() & self.b.layout.messages_of.keys()
        return [
            owner
            for _, owner, one, two in self.owners
            if owner in known and _compared(one) != _compared(two)
        ]

    @cached_property
    def scenes(self) -> SceneDifference | None:
        """How the scenes differ; None if they are not compared: with a tolerance, or two DBCs."""
        logs = self.a, self.b
        if self.sigma > 0 or self.part.slots is not None:
            return None
        if not all(len(log.scenes.t_ns) and log.has_time for log in logs):
            return None
        if not self.a.layout.is_same_as(self.b.layout):
            return None
        keys, t = [], []
        for log, names in zip(logs, zip(*_channel_pairs(*_names(logs)), strict=True), strict=True):
            number = {name: k for k, name in enumerate(names)}
            channel = np.array([number[name] for name in log.scenes.channel.tolist()])
            keys.append(channel << 32 | log.scenes.counter)
            t.append((log.scenes.t_ns - log.rows["t_ns"][0]) / 1e9)
        found = self.alignment
        moved = t[0] * (1 + found.drift) + found.offset - _between(*logs, found)
        reach = max(log.cycle for log in logs) * _SCENE_REACH
        in_a, in_b = matched(keys[0], moved, keys[1], t[1], reach)
        inside = self.part.are_in(t[0]), self.part.are_in(self.time_in_a(1, t[1]))
        here = inside[0][in_a]
        differs = (self.a.scenes.digest[in_a] != self.b.scenes.digest[in_b]) & here
        only = (int(one.sum()) - int(here.sum()) for one in inside)
        return SceneDifference(int(here.sum()), t[0][in_a[differs]].tolist(), *only)

    @property
    def is_equal(self) -> bool:
        """Whether the logs are equal within ``sigma``, also in what was dropped and in states."""
        if self.scenes is not None and any(self.scenes[1:]):
            return False
        if len(self.differing) or len(self.only[0]) or len(self.only[1]):
            return False
        return not self.part.is_all or not (
            self.differing_owners
            or self.a.rejects != self.b.rejects
            or self.a.pose_errors != self.b.pose_errors
        )

    def position(self, x: float) -> tuple[Array, Array, Array]:
        """Return where both lines of a pair are valid at x [m], and the positions of B minus those
        of A there, with the sigma of this difference [m].
        """
        a, b = self.pairs
        (y_a, sigma_a), (y_b, sigma_b) = (position(r["mean"], r["cov"], x) for r in (a, b))
        is_in = are_within(a["x_min"], a["x_max"], x) & are_within(b["x_min"], b["x_max"], x)
        return is_in & self.are_known, y_b - y_a, np.hypot(sigma_a, sigma_b)

    def time_in_a(self, of: int, t: Any) -> Any:
        """Return times of A (0) or B (1), each from its first line on, in A [s]."""
        return t if of == 0 else _time_in_a(self.a, self.b, self.alignment, t)

    def positions(self) -> dict[str, list[Position]]:
        """Return the differences of positions, by the name of a slot."""
        a, _ = self.pairs
        found: dict[str, list[Position]] = {}
        for x in self.at:
            is_in, away, sigma = self.position(x)
            for slot in np.unique(a["slot"][is_in]):
                here = np.flatnonzero(is_in & (a["slot"] == slot))
                each, scaled = away[here], away[here] / np.maximum(sigma[here], 1e-300)
                row = Position(
                    x, len(here), float(each.mean()), _largest(each), float(scaled.mean()),
                    _largest(scaled),
                )  # fmt: skip
                found.setdefault(Slot(slot).name, []).append(row)
        return found

    def parts(self, of: int) -> list[Part]:
        """Return the parts of time with lines that only one log has: A (0) or B (1)."""
        log = (self.a, self.b)[of]
        here = self.only[of]
        here = here[np.argsort(log.t[here], kind="stable")]
        if not len(here):
            return []
        matches = (self.alignment.a, self.alignment.b)[of]
        t = log.t[here]
        apart = _APART * log.cycle
        # A part ends with a gap, or where each slot of its lines has a line of both logs again.
        is_cut = np.diff(t) > apart
        both = np.sort(log.t[matches])
        if len(both):
            is_cut &= np.searchsorted(both, t[1:]) > np.searchsorted(both, t[:-1], "right")
        bounds = [0, *(np.flatnonzero(is_cut) + 1).tolist(), len(here)]
        slots = log.rows["slot"][here]
        return [
            Part(float(t[low]), float(t[high - 1]),
                 {Slot(s): n for s, n in sorted(Counter(slots[low:high].tolist()).items())})
            for low, high in pairwise(bounds)
        ]  # fmt: skip

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON; times are from the first line of A, or of B for lines of B only."""
        found = self.alignment
        parts = [self.parts(0), self.parts(1)]
        differs = self.differs
        return {
            "a": _log_dict(self.a),
            "b": _log_dict(self.b),
            "equal": self.is_equal,
            "sigma": self.sigma,
            "alignment": {
                "method": found.method,
                "lines": len(found.a),
                "offset": found.offset if found.has_time else None,
                "drift": found.drift if found.has_time else None,
                "rest_median": found.rest[0],
                "rest_p99": found.rest[1],
            },
            "identical": len(found.a) - len(self.differing),
            "differing": len(self.differing),
            "differs": {name: int(one.sum()) for name, one in differs.items()},
            "covariance_only": int((differs["covariance"] & ~differs["mean"]).sum()),
            "largest_distance": float(self.distance.max(initial=0.0)),
            "slots": self.slots(),
            "lines": [self.line_dict(k) for k in self.differing[:MAX_NAMED].tolist()],
            "scenes": None if self.scenes is None else self.scenes._asdict(),
            "positions": {
                slot: [one._asdict() for one in rows] for slot, rows in self.positions().items()
            },
            "only_a": _parts_dict(parts[0]),
            "only_b": _parts_dict(parts[1]),
            "e2e": [
                {"channel": channel, "owner": getattr(owner, "name", owner)}
                | {"a": _compared(one), "b": _compared(two)}
                for channel, owner, one, two in self.owners
            ],
            "rejects": {"a": dict(self.a.rejects), "b": dict(self.b.rejects)},
        }

    def slots(self) -> dict[str, dict[str, int]]:
        """Return how many lines of each slot are matched, differ, or are in one log only."""
        found = {}
        a, _ = self.pairs
        differing = np.isin(np.arange(len(a)), self.differing)
        only = [log.rows["slot"][here] for log, here in zip((self.a, self.b), self.only,
                                                            strict=True)]  # fmt: skip
        for slot in np.unique(np.concatenate([self.a.rows["slot"], self.b.rows["slot"]])):
            own = a["slot"] == slot
            found[Slot(slot).name] = {
                "matched": int(own.sum()),
                "differing": int((own & differing).sum()),
                **{name: int((own & one).sum()) for name, one in self.differs.items()},
                "only_a": int((only[0] == slot).sum()),
                "only_b": int((only[1] == slot).sum()),
            }
        return found

    def line_dict(self, k: int) -> dict[str, Any]:
        """Return the difference of a pair, for JSON."""
        a, b = (rows[k] for rows in self.pairs)
        low, high = self.ratio[k].tolist()
        names = [name for name, one in self.differs.items() if one[k]]
        row: dict[str, Any] = {
            "t": float(self.a.t[self.alignment.a[k]]),
            "slot": Slot(a["slot"]).name,
            "counter": int(a["counter"]),
            "differs": names,
            "distance": float(self.distance[k]),
            "sigma_ratio": [low, high],
        }
        enums = {"kind": Kind, "status": Status, "state": E2EState}
        for name in names:
            if name in enums:
                row[name] = [enums[name](one[name]).name for one in (a, b)]
            elif name not in ("mean", "covariance"):
                row[name] = [_finite(float(one[name])) for one in (a, b)]
        return row


def difference(
    a: LoggedLines,
    b: LoggedLines,
    *,
    sigma: float = 0.0,
    at: Sequence[float] = (),
    time: Time = ALL,
    slots: Sequence[Slot] | None = None,
) -> Difference:
    """Return how the lines of two logs differ.

    With ``sigma`` 0, lines are equal if all of their values are, and scenes are compared, too. Else
    the means of lines may differ by so many standard deviations of the difference of two
    independent errors: by the sum of both covariances. The standard deviations of no direction may
    then differ by more than the factor 1 + ``sigma``, and range and age by no more than a step of
    the DBC.

    Args:
        a: lines of one log.
        b: of the other.
        sigma: see above.
        at: distances of positions [m].
        time: first and last time of the lines that are compared [s], from the first line of A on,
            or of the clock of A if they are more than 1e8.
        slots: lines of these only.

    Raises:
        ValueError: ``sigma`` is negative, or a distance or the time is out of range.
        LogError: A has no times for ``time``.

    >>> a = LoggedLines.of("monday.log", Codec.from_dbc())  # doctest: +SKIP
    >>> difference(a, a).is_equal  # doctest: +SKIP
    True
    """
    if not 0 <= sigma < np.inf:
        raise ValueError(f"sigma must be 0 or more and finite, got {sigma!r}")
    pairs = _channel_pairs(a.channels, b.channels)
    lines = []
    for log, names in zip((a, b), zip(*pairs, strict=True), strict=True):
        number = np.array([names.index(name) for name in log.channels])
        lines.append(log.to_align(number[log.channel] * len(Slot) + log.rows["slot"]))
    part, found = _Part.of(a, time, slots), align(*lines)
    only = []
    for log, own in ((a, found.a), (b, found.b)):
        t = log.t if log is a else _time_in_a(a, b, found, log.t)
        chosen = part.has(t, log.rows["slot"])
        chosen[own] = False
        only.append(np.flatnonzero(chosen))
    keep = part.has(a.t[found.a], a.rows["slot"][found.a])
    found = found._replace(a=found.a[keep], b=found.b[keep])
    return Difference(a, b, found, (only[0], only[1]), sigma, checked_at(at), part)


class _Part(NamedTuple):
    """Which lines are compared, by their times from the first line of A on, and their slots."""

    window: Window
    begin: float  # time of the first line of A [s]
    slots: tuple[Slot, ...] | None

    @classmethod
    def of(cls, a: LoggedLines, time: Time, slots: Sequence[Slot] | None) -> _Part:
        begin = int(a.rows["t_ns"][0]) / 1e9 if a.has_time else np.nan
        window = Window(time)
        window.see(begin, a.name)
        return cls(window, begin, None if slots is None else tuple(slots))

    @property
    def is_all(self) -> bool:
        return self.window.is_all and self.slots is None

    def are_in(self, t: Array) -> Array:
        return self.window.are_in(t + self.begin)

    def has(self, t: Array, slot: Array) -> Array:
        return self.are_in(t) & (self.slots is None or np.isin(slot, self.slots))


def _time_in_a(a: LoggedLines, b: LoggedLines, found: Alignment, t: Any) -> Any:
    """Return times from the first line of B on, from the first line of A on [s]."""
    return (t - found.offset + _between(a, b, found)) / (1 + found.drift)


def _between(a: LoggedLines, b: LoggedLines, found: Alignment) -> float:
    """Return the time from the first line of A to that of B by their clocks [s]."""
    return int(b.rows["t_ns"][0] - a.rows["t_ns"][0]) / 1e9 if found.has_time else 0.0


def _channel_pairs(a: Sequence[str], b: Sequence[str]) -> list[tuple[str | None, str | None]]:
    """Return which channels are compared: those of one name; the others by their order.

    >>> _channel_pairs(["can0", "can1"], ["can1", "vcan0", "vcan1"])
    [('can1', 'can1'), ('can0', 'vcan0'), (None, 'vcan1')]
    """
    same: list[tuple[str | None, str | None]] = [(name, name) for name in a if name in b]
    rest_a, rest_b = [name for name in a if name not in b], [name for name in b if name not in a]
    return [*same, *zip_longest(rest_a, rest_b)]


def _names(logs: Sequence[LoggedLines]) -> list[list[str]]:
    """Return the names of the channels with scenes, in the order of their first ones."""
    return [list(dict.fromkeys(log.scenes.channel.tolist())) for log in logs]


def _compared(stats: SlotStats | None) -> dict[str, Any] | None:
    """Return the counters of an owner that are compared."""
    if stats is None:
        return None
    return {name: getattr(stats, name) for name in COUNTERS} | {"state": stats.state.name}


def _step(layout: Layout, name: str) -> float:
    """Return the resolution of a member of a line."""
    signal = {"x_min": "XMin", "x_max": "XMax", "age": "Age"}[name]
    for one in (layout, layout.pose):
        if one is not None and signal in one.signals:
            return float(one[signal].factor)
    return 0.0


def _largest(values: Array) -> float:
    return float(values[np.abs(values).argmax()])


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _log_dict(log: LoggedLines) -> dict[str, Any]:
    return {
        "log": log.name,
        "dbc": log.layout.source,
        "lines": len(log.rows),
        "pose_errors": log.pose_errors,
        "channels": [*log.channels],
        "begin": int(log.rows["t_ns"][0]) / 1e9 if log.has_time else None,
        "damage": log.damage or None,
    }


def _parts_dict(parts: Sequence[Part]) -> dict[str, Any]:
    named = [
        {"begin": one.begin, "end": one.end, "lines": {s.name: n for s, n in one.lines.items()}}
        for one in parts[:MAX_NAMED]
    ]
    return {
        "lines": sum(sum(one.lines.values()) for one in parts),
        "count": len(parts),
        "parts": named,
    }
