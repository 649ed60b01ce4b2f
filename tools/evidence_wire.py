#!/usr/bin/env python3
"""Measure the guarantees and the accuracy of the wire format.

    evidence_wire.py guarantee   1e6 random covariances: all definite, none overconfident
    evidence_wire.py quality     KL, lateral bands and saturation on the sets paper and road
    evidence_wire.py frames      1e7 damaged and random frames: no wrong line, all counted
    evidence_wire.py mixtures    1e6 random mixtures: the guarantee for each component and for
                                 the overall moments; a tenth of them with frames lost,
                                 duplicated and reordered

Run it in the environment of the project: python3 tools/run.py python tools/evidence_wire.py ...

The exit status is 1 if a bound is missed.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from reporting import bar, parser_of, progress, report

from maplines_can.study import LATERAL_X, adversarial, evaluate, paper, road
from maplines_can.values.line import MapLine, Slot, Status
from maplines_can.wire import Codec, Frame

Array = NDArray[np.float64]
Mixtures = tuple[Array, Array, Array]  #: weights (n, k), means (n, k, 4), covariances (n, k, 4, 4)
Disturbance = tuple[float, float, float, bool, float]

CHUNK = 50_000
MS = 1_000_000
#: Share of the mixed transfers with equal transfer IDs. Only the checksum separates their pages,
#: and it misses one in 65536. On a bus they are 16 periods apart, and the time-out separates them.
SAME_ID_SHARE = 0.002
#: Numbers of components.
COMPONENTS = range(2, 9)
#: Disturbances of a bus: share of frames lost, share duplicated, mean delay that reorders [ms],
#: whether slots fall silent for a while, and the pace: 1 is 20 Hz, 2.5 is 50 Hz on a faster bus,
#: where the next mixture comes before the time-out of the last one.
DISTURBANCES: list[Disturbance] = list(
    product([0, 0.01, 0.1, 0.3], [0, 0.01, 0.3], [0, 0.3, 3], [False, True], [1, 2.5])
)
#: Mixtures sent under one disturbance, eight in a period; the pause after them ends all time-outs.
RUN, PERIOD_MS, PAUSE_MS, FRAME_MS = 400, 50, 200, 0.25


def guarantee(n: int, seed: int) -> dict[str, Any]:
    """Check adversarial covariances: all stay positive definite, none gets overconfident."""
    codec, statuses = Codec.from_dbc(), Counter[str]()
    not_definite = overconfident = refused = 0
    largest = 0.0
    for start in progress(range(0, n, CHUNK), "covariances"):
        means, covs = adversarial(min(CHUNK, n - start), seed + start)
        batch = codec.decode_batch(codec.encode_batch(means, covs))
        evaluation = evaluate(means, covs, batch.mean, batch.cov, codec.resolution)
        stated = batch.status != Status.OUT_OF_RANGE
        not_definite += int((~evaluation.positive_definite).sum())
        overconfident += int(evaluation.overconfident[stated].sum())
        refused += int((~batch.accepted).sum())
        largest = max(largest, float(evaluation.largest_ratio[stated].max()))
        statuses.update(Status(int(s)).name for s in batch.status)
    return {
        "covariances": n,
        "not positive definite": not_definite,
        "overconfident": overconfident,
        "largest eigenvalue of S'^-1 (S + d d^T)": largest,
        "records refused": refused,
        "status": dict(statuses),
        "met": not_definite == overconfident == refused == 0,
    }


def quality(n: int, seed: int) -> dict[str, Any]:
    """Measure the loss of accuracy for pose error alone (paper) and with map error (road)."""
    codec = Codec.from_dbc()
    result: dict[str, Any] = {}
    for name, make in (("paper", paper), ("road", road)):
        means, covs = make(n, seed)
        batch = codec.decode_batch(codec.encode_batch(means, covs))
        evaluation = evaluate(means, covs, batch.mean, batch.cov, codec.resolution)
        figures: dict[str, Any] = {
            "cases": len(means),
            "KL mean": evaluation.kl_covered.mean(),
            "KL 99 %": np.quantile(evaluation.kl_covered, 0.99),
            "KL max": evaluation.kl_covered.max(),
            "untouched KL median": np.median(evaluation.kl),
            "not positive definite": int((~evaluation.positive_definite).sum()),
            "overconfident": int(evaluation.overconfident.sum()),
            "saturated": (batch.status == Status.SATURATED).mean(),
            "out of range": (batch.status == Status.OUT_OF_RANGE).mean(),
        }
        for i, x in enumerate(LATERAL_X):
            ratio = evaluation.sigma_ratio[:, i]
            figures[f"worst mean error at {x:g} m [mm]"] = (
                1e3 * np.abs(evaluation.lateral_error[:, i]).max()
            )
            figures[f"sigma ratio at {x:g} m, least"] = ratio.min()
            figures[f"sigma ratio at {x:g} m, median"] = np.median(ratio)
            figures[f"sigma ratio at {x:g} m, 99 %"] = np.quantile(ratio, 0.99)
        figures["met"] = bool(
            figures["KL mean"] <= 5e-3
            and figures["KL 99 %"] <= 1.2e-2
            and figures["saturated"] <= 5e-3
            and not (figures["not positive definite"] or figures["overconfident"])
            and np.abs(evaluation.lateral_error).max() <= 5e-3
            and np.quantile(evaluation.sigma_ratio, 0.99, axis=0).max() <= 1.06
            and np.quantile(evaluation.sigma_ratio, 0.01, axis=0).min() >= 1
        )
        result[name] = {key: plain(value) for key, value in figures.items()}
    return result | {"met": all(figures["met"] for figures in result.values())}


def frames(n: int, seed: int) -> dict[str, Any]:
    """Feed random bytes and damaged transfers: no exception, no wrong line, all frames counted."""
    codec, rng = Codec.from_dbc(), np.random.default_rng(seed)
    decoder = codec.decoder()
    means, covs = road(512, seed)
    transfers: list[list[list[Frame]]] = []
    known: set[Any] = set()
    for i, (m, S) in enumerate(zip(means, covs, strict=True)):
        slot = Slot(i % len(Slot))
        payload = codec.encode_batch(m[None], S[None], slot=slot, counter=i // len(Slot))
        line = codec.decode_one(payload.tobytes(), slot)
        if isinstance(line, MapLine):
            known.add(identity(line))
        transfers.append([codec.frames(payload[0], slot), codec.frames(payload[0], slot, fd=True)])
    made = Counter[str]()
    wrong = 0
    t_ns, done = 0, 0
    with bar(n, unit=" frames") as fed:
        while done < n:
            kind, batch = damaged(rng, transfers)
            made[kind] += len(batch)
            t_ns += 6 * MS
            for can_id, data in batch:
                answer = decoder.feed(can_id, data, t_ns)
                t_ns += 250_000
                if isinstance(answer, MapLine):
                    wrong += identity(answer) not in known
            done += len(batch)
            fed.update(len(batch))
    accounted = decoder.line_frames + sum(decoder.counts.values()) + decoder.pending
    return {
        "frames": decoder.frames,
        "made": dict(made),
        "lines delivered": decoder.lines,
        "lines that were not sent": wrong,
        "dropped": {reason.name: count for reason, count in decoder.counts.items()},
        "pending": decoder.pending,
        "frames not accounted for": decoder.frames - accounted,
        "met": wrong == 0 and decoder.frames == accounted,
    }


def damaged(
    rng: np.random.Generator, transfers: Sequence[Sequence[Sequence[Frame]]]
) -> tuple[str, list[tuple[int, bytes]]]:
    """Return a random kind of damage and a transfer (CAN ID, data) with it.

    Args:
        rng: the source of randomness.
        transfers: the frames of each line, on classic CAN and on CAN FD.
    """
    kind = int(rng.integers(8))
    first, fd = int(rng.integers(len(transfers))), int(rng.random() < 0.3)
    frames_ = [(frame.can_id, frame.data) for frame in transfers[first][fd]]
    if kind == 0:
        return "whole", frames_
    if kind == 1:
        length = int(rng.choice([0, 1, 7, 8, 8, 8, 32, 32, 48, 64]))
        return "random bytes", [
            (int(rng.integers(0x33E, 0x352)), rng.bytes(length)) for _ in range(8)
        ]
    if kind == 2:  # one to three bits flipped
        place = int(rng.integers(len(frames_)))
        data = bytearray(frames_[place][1])
        for bit in rng.integers(8 * len(data), size=int(rng.integers(1, 4))):
            data[bit // 8] ^= 1 << bit % 8
        frames_[place] = (frames_[place][0], bytes(data))
        return "flipped bits", frames_
    if kind == 3:
        del frames_[int(rng.integers(len(frames_)))]
        return "lost frame", frames_ or [(0x348, b"")]
    if kind == 4:
        return "shuffled and duplicated", [
            frames_[i] for i in rng.permutation(np.repeat(np.arange(len(frames_)), 2))
        ]
    if kind == 5:  # pages of two counters of one slot; 16 apart, the transfer IDs are equal
        apart = 16 if rng.random() < SAME_ID_SHARE else int(rng.integers(1, 16))
        other = (first + len(Slot) * apart) % len(transfers)
        a, b = transfers[first][0], transfers[other][0]
        pick = rng.random(len(a)) < 0.5
        mixed = [x if p else y for p, x, y in zip(pick, a, b, strict=True)]
        return "mixed counters", [(frame.can_id, frame.data) for frame in mixed]
    if kind == 6:
        cut = int(rng.integers(len(frames_[0][1])))
        return "cut short", [(can_id, data[:cut]) for can_id, data in frames_]
    joined = bytearray(b"".join(data for _, data in frames_))  # an FD record of two counters
    next_transfer = transfers[(first + len(Slot)) % len(transfers)][0]
    page = 8 * int(rng.integers(4))
    joined[page : page + 8] = b"".join(frame.data for frame in next_transfer)[page : page + 8]
    return "mixed FD record", [(0x348 + first % len(Slot), bytes(joined))]


def mixtures(n: int, seed: int) -> dict[str, Any]:
    """Check random mixtures, in bulk and on a disturbed bus."""
    bulk = mixtures_in_bulk(n, seed)
    bus = mixtures_on_a_bus(n // 10, seed)
    return {"in bulk": bulk, "on a bus": bus, "met": bulk["met"] and bus["met"]}


def mixtures_in_bulk(n: int, seed: int) -> dict[str, Any]:
    """Check components and overall moments: all positive definite, none overconfident."""
    codec, counts, failures = Codec.from_dbc(), Counter[str](), Counter[str]()
    largest = {"component": 0.0, "overall": 0.0}
    done = bar(n, unit=" mixtures")
    for k in COMPONENTS:
        count = n // len(COMPONENTS) + (k - COMPONENTS[0] < n % len(COMPONENTS))
        for start in range(0, count, CHUNK // k):
            w, m, S = random_mixtures(min(CHUNK // k, count - start), k, [seed, k, start])
            batch = codec.decode_batch(codec.encode_mixtures(w, m, S).reshape(-1, 32))
            decoded_w = batch.component_weight.reshape(-1, k)
            decoded = batch.mean.reshape(m.shape), batch.cov.reshape(S.shape)
            stated = (batch.status != Status.OUT_OF_RANGE).reshape(-1, k)
            components = m.reshape(-1, 4), S.reshape(-1, 4, 4), batch.mean, batch.cov
            overall = *moments(w, m, S), *moments(decoded_w, *decoded)
            for what, pair, in_range in (
                ("component", components, stated.ravel()),
                ("overall", overall, stated.all(axis=1)),
            ):
                evaluation = evaluate(*pair, codec.resolution)
                counts[f"{what}, checked"] += len(in_range)
                counts[f"{what}, out of range"] += int((~in_range).sum())
                not_definite = ~evaluation.positive_definite
                failures[f"{what}, not positive definite"] += int(not_definite.sum())
                overconfident = evaluation.overconfident[in_range]
                failures[f"{what}, overconfident"] += int(overconfident.sum())
                ratio = evaluation.largest_ratio[in_range].max(initial=largest[what])
                largest[what] = float(ratio)
            failures["records refused"] += int((~batch.accepted).sum())
            failures["sum of the weights not 1"] += int((decoded_w.sum(axis=1) != 1).sum())
            done.update(len(w))
    done.close()
    ratios = {f"largest eigenvalue of S'^-1 (S + d d^T), {what}": largest[what] for what in largest}
    return {**counts, **failures, **ratios, "met": not any(failures.values())}


def mixtures_on_a_bus(n: int, seed: int) -> dict[str, Any]:
    """Disturb the frames of mixtures: only what was sent is delivered, once and in order."""
    codec, rng = Codec.from_dbc(), np.random.default_rng([seed, 9])
    decoder, counters = codec.decoder(), Counter[int]()
    made, wrong = Counter[str](), Counter[str]()
    t_ms = 0.0
    for run in progress(range(-(-n // RUN)), "runs of mixtures"):
        disturbance = DISTURBANCES[37 * run % len(DISTURBANCES)]  # all in turn; none at first
        sent, known = sent_mixtures(codec, rng, counters)
        order, arrived = disturbed(rng, sent, disturbance)
        delivered: set[int | None] = set()
        last: dict[Slot, int] = {}
        for at, frame in order:
            answer = decoder.feed(frame.can_id, frame.data, round((t_ms + at) * MS))
            if isinstance(answer, MapLine):
                place = known.get(mixture_identity(answer))
                wrong["delivered, not sent"] += place is None
                wrong["delivered twice"] += place in delivered
                wrong["delivered out of order"] += (place or 0) < last.get(answer.slot, 0)
                delivered.add(place)
                last[answer.slot] = place or 0
        complete = {i for i in range(RUN) if arrived[i] == len(sent[i])}
        missed = len(complete - delivered)
        made["mixtures sent"] += RUN
        made["delivered"] += len(delivered)
        made["not delivered, a frame lost"] += len(set(range(RUN)) - complete - delivered)
        made["not delivered, frames reordered or duplicated"] += missed
        made["frames sent"] += sum(map(len, sent))
        wrong["delivered, though a frame was lost"] += len(delivered - complete)
        wrong["not delivered on an undisturbed bus"] += 0 if any(disturbance[:-1]) else missed
        t_ms += RUN / len(Slot) * PERIOD_MS + PAUSE_MS
    decoder.expire(round((t_ms + PAUSE_MS) * MS))
    accounted = decoder.line_frames + sum(decoder.counts.values()) + decoder.pending
    wrong["frames not accounted for"] = decoder.frames - accounted
    dropped = {reason.name: count for reason, count in decoder.counts.items()}
    counts = {**made, "frames received": decoder.frames, "dropped": dropped}
    return {**counts, **wrong, "met": not any(wrong.values())}


def random_mixtures(n: int, k: int, seed: Any) -> Mixtures:
    """Return n mixtures of k adversarial components, near to or far from each other.

    The weights go down to 1e-13. The seed is one of ``numpy.random.default_rng``.
    """
    rng: Any = np.random.default_rng(seed)
    means, covs = adversarial(n * k, rng)
    means = means.reshape(n, k, 4)
    apart = 10 ** rng.uniform(-5, 0, (n, 1, 1))  # share of the range of each parameter
    evenness = 10 ** rng.uniform(-2, 1, (n, 1))
    weights = rng.standard_gamma(np.broadcast_to(evenness, (n, k))).clip(1e-12)
    weights /= weights.sum(axis=1, keepdims=True)
    return weights, means[:, :1] + apart * (means - means[:, :1]), covs.reshape(n, k, 4, 4)


def moments(weights: Array, means: Array, covs: Array) -> tuple[Array, Array]:
    """Return the means (n, 4) and covariances (n, 4, 4) of mixtures."""
    mean = np.einsum("nk,nki->ni", weights, means)
    d = means - mean[:, None]
    return mean, np.einsum("nk,nkij->nij", weights, covs + d[..., :, None] * d[..., None, :])


def sent_mixtures(
    codec: Codec, rng: np.random.Generator, counters: Counter[int]
) -> tuple[list[list[Frame]], dict[Any, int]]:
    """Return the frames of a run of mixtures, and the index of each by its decoded values."""
    sizes = rng.choice(COMPONENTS, RUN)
    frames: list[list[Frame]] = [[]] * RUN
    known = {}
    first = np.zeros(RUN, dtype=int)
    for i, k in enumerate(sizes):
        first[i] = counters[i % len(Slot)]
        counters[i % len(Slot)] += int(k)
    for k in COMPONENTS:
        (places,) = np.nonzero(sizes == k)
        slots = places % len(Slot)
        w, m, S = random_mixtures(len(places), k, rng)
        payloads = codec.encode_mixtures(w, m, S, slot=slots, counter=first[places])
        batch = codec.decode_batch(payloads.reshape(-1, 32), slot=np.repeat(slots, k))
        for j, (place, slot) in enumerate(zip(places.tolist(), slots.tolist(), strict=True)):
            rows = slice(j * k, (j + 1) * k)
            values = batch.component_weight[rows], batch.mean[rows], batch.cov[rows]
            known[Slot(slot), *(value.tobytes() for value in values)] = place
            records = [codec.frames(p, Slot(slot), fd=slot % 2 == 0) for p in payloads[j]]
            frames[place] = [frame for record in records for frame in record]
    return frames, known


def disturbed(
    rng: np.random.Generator, sent: Sequence[Sequence[Frame]], disturbance: Disturbance
) -> tuple[list[tuple[float, Frame]], Counter[int]]:
    """Return the arrivals (time [ms], frame) in order, and the number of frames of each mixture."""
    loss, duplicated, delay_ms, silences, pace = disturbance
    arrivals: list[tuple[float, Frame]] = []
    arrived = Counter[int]()
    silent_until = dict.fromkeys(range(len(Slot)), -1)
    for cycle in range(RUN // len(Slot)):
        queue: list[tuple[float, int, Frame]] = []
        for slot in range(len(Slot)):
            i = cycle * len(Slot) + slot
            if silences and rng.random() < 0.05:
                silent_until[slot] = cycle + int(rng.integers(1, 30))
            if cycle >= silent_until[slot]:
                # Two senders at once; each sends its slots one after the other.
                times = slot // 2 + np.sort(rng.random(len(sent[i])))
                queue += [(at, i, frame) for at, frame in zip(times, sent[i], strict=True)]
        queue.sort(key=lambda entry: entry[:2])
        for place, (_, i, frame) in enumerate(queue):
            sent_ms = (cycle * PERIOD_MS + place * FRAME_MS) / pace
            if rng.random() >= loss:
                arrived[i] += 1
                arrivals.append((sent_ms + rng.exponential(delay_ms), frame))
                if rng.random() < duplicated:
                    arrivals.append((sent_ms + FRAME_MS + rng.exponential(3 + delay_ms), frame))
    arrivals.sort(key=lambda entry: entry[0])
    return arrivals, arrived


def identity(line: MapLine) -> tuple[Any, ...]:
    """Return a key that is equal for equal lines only."""
    return line.slot, line.gaussian.mean.tobytes(), line.gaussian.cov.tobytes()


def mixture_identity(line: MapLine) -> tuple[Any, ...]:
    """Return a key that is equal for equal mixtures only."""
    if line.mixture is None:
        return (line.slot,)
    values = line.mixture.weights, line.mixture.means, line.mixture.covs
    return line.slot, *(value.tobytes() for value in values)


def plain(value: Any) -> float | bool | int:
    """Return a number of NumPy as one of Python, for JSON."""
    return value if isinstance(value, (bool, int)) else float(value)


def main() -> int:
    """Run the command and return its exit status."""
    parser = parser_of(__doc__)
    jobs: Mapping[str, tuple[Callable[[int, int], dict[str, Any]], int]] = {
        "guarantee": (guarantee, 10**6),
        "quality": (quality, 20_000),
        "frames": (frames, 10**7),
        "mixtures": (mixtures, 10**6),
    }
    parser.add_argument("what", choices=jobs)
    parser.add_argument("-n", type=int, help="number of cases; by default 1e6, 2e4, 1e7 and 1e6")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    job, n = jobs[arguments.what]
    started = time.perf_counter()
    result = job(arguments.n or n, arguments.seed)
    result["seconds"] = time.perf_counter() - started
    return report(result, arguments.json, 52)


if __name__ == "__main__":
    sys.exit(main())
