"""Guarantees and accuracy of the wire format."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from answers import one
from numpy.typing import NDArray

from maplines_can.study import LATERAL_X, adversarial, evaluate, paper, road
from maplines_can.values.line import MapLine, Slot, Status
from maplines_can.wire import Codec, Frame

from .figures import quantiles
from .harness import bar, evidence, progress

Array = NDArray[np.float64]
Mixtures = tuple[Array, Array, Array]  #: weights (n, k), means (n, k, 4), covariances (n, k, 4, 4)

CHUNK = 50_000
MS = 1_000_000
#: Share of the mixed transfers with equal transfer IDs. Only the checksum separates their pages,
#: and it misses one in 65536. On a bus they are 16 periods apart, and the time-out separates them.
SAME_ID_SHARE = 0.002
RATIO = "largest eigenvalue of S'^-1 (S + d d^T)"
#: Numbers of components.
COMPONENTS = range(2, 9)


@evidence(n=2000)
def guarantee(n: int = 10**6, seed: int = 0) -> dict[str, Any]:
    """Check adversarial covariances: all stay positive definite, none gets overconfident."""
    codec, statuses, counts = Codec.from_dbc(), Counter[str](), Counter[str]()
    largest = 0.0
    for start in progress(range(0, n, CHUNK), "covariances"):
        means, covs = adversarial(min(CHUNK, n - start), seed + start)
        batch = codec.batch.decode(codec.batch.encode(means, covs))
        evaluation = evaluate(means, covs, batch.mean, batch.cov, codec.resolution)
        stated = batch.status != Status.OUT_OF_RANGE
        counts["not positive definite"] += int((~evaluation.positive_definite).sum())
        counts["overconfident"] += int(evaluation.overconfident[stated].sum())
        counts["records refused"] += int((~batch.accepted).sum())
        largest = max(largest, float(evaluation.largest_ratio[stated].max()))
        statuses.update(Status(int(s)).name for s in batch.status)
    return {"covariances": n, **counts, RATIO: largest, "status": dict(statuses)}


@evidence(n=400)
def quality(n: int = 20_000, seed: int = 0) -> dict[str, Any]:
    """Measure the loss of accuracy for pose error alone (paper) and with map error (road)."""
    codec = Codec.from_dbc()
    result: dict[str, Any] = {}
    for name, make in (("paper", paper), ("road", road)):
        means, covs = make(n, seed)
        batch = codec.batch.decode(codec.batch.encode(means, covs))
        evaluation = evaluate(means, covs, batch.mean, batch.cov, codec.resolution)
        result[name] = {
            "cases": len(means),
            "KL": quantiles(evaluation.kl_covered, 0.99),
            "untouched KL, median": float(np.median(evaluation.kl)),
            "not positive definite": int((~evaluation.positive_definite).sum()),
            "overconfident": int(evaluation.overconfident.sum()),
            "saturated": float((batch.status == Status.SATURATED).mean()),
            "out of range": float((batch.status == Status.OUT_OF_RANGE).mean()),
        }
        for i, x in enumerate(LATERAL_X):
            error = np.abs(evaluation.lateral_error[:, i]).max()
            result[name][f"at {x:g} m"] = {
                "worst mean error [mm]": 1e3 * float(error),
                "sigma ratio": quantiles(evaluation.sigma_ratio[:, i], 0.01, 0.5, 0.99),
            }
    return result


@evidence(n=20_000)
def frames(n: int = 10**7, seed: int = 0) -> dict[str, Any]:
    """Feed random bytes and damaged transfers: no exception, no wrong line, all frames counted."""
    codec, rng = Codec.from_dbc(), np.random.default_rng(seed)
    decoder = codec.decoder()
    means, covs = road(512, seed)
    transfers: list[list[list[Frame]]] = []
    known: set[Any] = set()
    for i, (m, S) in enumerate(zip(means, covs, strict=True)):
        slot = Slot(i % len(Slot))
        payload = codec.batch.encode(m[None], S[None], slot=slot, counter=i // len(Slot))
        line = codec.batch.decode_one(payload.tobytes(), slot)
        if isinstance(line, MapLine):
            known.add(identity(line))
        transfers.append(
            [
                codec.encoder().frames(payload[0], slot),
                codec.encoder().frames(payload[0], slot, fd=True),
            ]
        )
    made = Counter[str]()
    wrong = 0
    t_ns, done = 0, 0
    with bar(n, unit=" frames") as fed:
        while done < n:
            kind, batch = damaged(rng, transfers)
            made[kind] += len(batch)
            t_ns += 6 * MS
            for can_id, data in batch:
                answer = one(decoder.feed(can_id, data, t_ns))
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
    }


@evidence(n=1400)
def mixtures(n: int = 10**6, seed: int = 0) -> dict[str, Any]:
    """Check components and overall moments: all positive definite, none overconfident."""
    codec, failures = Codec.from_dbc(), Counter[str]()
    result: dict[str, Counter[str]] = {"component": Counter(), "overall": Counter()}
    largest = dict.fromkeys(result, 0.0)
    with bar(n, unit=" mixtures") as done:
        for k in COMPONENTS:
            count = n // len(COMPONENTS) + (k - COMPONENTS[0] < n % len(COMPONENTS))
            for start in range(0, count, CHUNK // k):
                w, m, S = random_mixtures(min(CHUNK // k, count - start), k, [seed, k, start])
                batch = codec.batch.decode(codec.batch.encode_mixtures(w, m, S).reshape(-1, 32))
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
                    counts, ratio = result[what], evaluation.largest_ratio[in_range]
                    counts["checked"] += len(in_range)
                    counts["out of range"] += int((~in_range).sum())
                    counts["not positive definite"] += int((~evaluation.positive_definite).sum())
                    counts["overconfident"] += int(evaluation.overconfident[in_range].sum())
                    largest[what] = float(ratio.max(initial=largest[what]))
                failures["records refused"] += int((~batch.accepted).sum())
                failures["sum of the weights not 1"] += int((decoded_w.sum(axis=1) != 1).sum())
                done.update(len(w))
    return {what: {**result[what], RATIO: largest[what]} for what in result} | dict(failures)


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


def identity(line: MapLine) -> tuple[Any, ...]:
    """Return a key that is equal for equal lines only."""
    return line.slot, line.gaussian.mean.tobytes(), line.gaussian.cov.tobytes()
