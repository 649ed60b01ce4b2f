#!/usr/bin/env python3
"""Show what the wire promises, with figures.

    evidence_wire.py guarantee   1e6 random covariances: all definite, none overconfident
    evidence_wire.py quality     KL, lateral bands and saturation on the sets paper and road
    evidence_wire.py frames      1e7 damaged and random frames: nothing wrong, all accounted for
    evidence_wire.py mixtures    1e6 random mixtures: as guarantee, of parts and whole; and a
                                 tenth of them under loss, duplication and reordering

Run it in the project's environment: python3 tools/run.py python tools/evidence_wire.py ...

Ends with a nonzero status where a bound is missed.
"""

import sys
import time
from collections import Counter
from itertools import product

import numpy as np
from reporting import bar, parser_of, progress, report

from maplines_can.line import MapLine, Slot, Status
from maplines_can.study import LATERAL_X, adversarial, evaluate, paper, road
from maplines_can.wire import Codec

CHUNK = 50_000
MS = 1_000_000
#: Share of the mixed bursts that have one burst number: only the checksum tells their pages
#: apart, and passes one in 65536. On a bus they are 16 periods apart and the time-out does.
AGES_APART = 0.002
PARTS = range(2, 9)
#: Of the mixtures on a disturbed bus: shares of frames lost and doubled, how far frames are thrown
#: out of order [ms], whether slots fall silent for a while, and the pace: 20 Hz, or 50 Hz on a
#: faster bus, where the next mixture comes before the last one has timed out.
TROUBLES = list(product([0, 0.01, 0.1, 0.3], [0, 0.01, 0.3], [0, 0.3, 3], [False, True], [1, 2.5]))
#: Mixtures of one trouble, eight in a period, with a rest after them that ends all time-outs.
SPELL, PERIOD_MS, REST_MS, FRAME_MS = 400, 50, 200, 0.25


def guarantee(n, seed):
    """Random covariances that spare nothing: none not definite, none overconfident."""
    codec, statuses = Codec.from_dbc(), Counter()
    not_definite = overconfident = refused = 0
    largest = 0.0
    for start in progress(range(0, n, CHUNK), "covariances"):
        means, covs = adversarial(min(CHUNK, n - start), seed + start)
        batch = codec.decode_batch(codec.encode_batch(means, covs))
        verdict = evaluate(means, covs, batch.mean, batch.cov, codec.resolution)
        stated = batch.status != Status.OUT_OF_RANGE
        not_definite += int((~verdict.positive_definite).sum())
        overconfident += int(verdict.overconfident[stated].sum())
        refused += int((~batch.accepted).sum())
        largest = max(largest, float(verdict.largest_ratio[stated].max()))
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


def quality(n, seed):
    """What the receiver loses, on pose error alone (paper) and with map error (road)."""
    codec, result = Codec.from_dbc(), {}
    for name, make in (("paper", paper), ("road", road)):
        means, covs = make(n, seed)
        batch = codec.decode_batch(codec.encode_batch(means, covs))
        verdict = evaluate(means, covs, batch.mean, batch.cov, codec.resolution)
        figures = {
            "cases": len(means),
            "KL mean": verdict.kl_covered.mean(),
            "KL 99 %": np.quantile(verdict.kl_covered, 0.99),
            "KL max": verdict.kl_covered.max(),
            "untouched KL median": np.median(verdict.kl),
            "not positive definite": int((~verdict.positive_definite).sum()),
            "overconfident": int(verdict.overconfident.sum()),
            "saturated": (batch.status == Status.SATURATED).mean(),
            "out of range": (batch.status == Status.OUT_OF_RANGE).mean(),
        }
        for i, x in enumerate(LATERAL_X):
            ratio = verdict.sigma_ratio[:, i]
            figures[f"worst mean error at {x:g} m [mm]"] = (
                1e3 * np.abs(verdict.lateral_error[:, i]).max()
            )
            figures[f"sigma ratio at {x:g} m, least"] = ratio.min()
            figures[f"sigma ratio at {x:g} m, median"] = np.median(ratio)
            figures[f"sigma ratio at {x:g} m, 99 %"] = np.quantile(ratio, 0.99)
        figures["met"] = bool(
            figures["KL mean"] <= 5e-3
            and figures["KL 99 %"] <= 1.2e-2
            and figures["saturated"] <= 5e-3
            and not (figures["not positive definite"] or figures["overconfident"])
            and np.abs(verdict.lateral_error).max() <= 5e-3
            and np.quantile(verdict.sigma_ratio, 0.99, axis=0).max() <= 1.06
            and np.quantile(verdict.sigma_ratio, 0.01, axis=0).min() >= 1
        )
        result[name] = {key: plain(value) for key, value in figures.items()}
    return result | {"met": all(figures["met"] for figures in result.values())}


def frames(n, seed):
    """Random bytes and damaged bursts: no exception, no line that was not sent, sums right."""
    codec, rng = Codec.from_dbc(), np.random.default_rng(seed)
    decoder = codec.decoder()
    means, covs = road(512, seed)
    bursts, known = [], set()
    for i, (m, S) in enumerate(zip(means, covs, strict=True)):
        slot = Slot(i % len(Slot))
        payload = codec.encode_batch(m[None], S[None], slot=slot, counter=i // len(Slot))
        known.add(lookup(codec.decode_one(payload.tobytes(), slot)))
        bursts.append([codec.frames(payload[0], slot), codec.frames(payload[0], slot, fd=True)])
    made = Counter()
    wrong = 0
    t_ns, done = 0, 0
    with bar(n, unit=" frames") as fed:
        while done < n:
            kind, batch = damaged(rng, bursts)
            made[kind] += len(batch)
            t_ns += 6 * MS
            for can_id, data in batch:
                answer = decoder.feed(can_id, data, t_ns)
                t_ns += 250_000
                if isinstance(answer, MapLine):
                    key = lookup(answer)
                    wrong += key not in known
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


def damaged(rng, bursts):
    """One kind of damage and the frames (CAN ID, data) that it makes."""
    kind = int(rng.integers(8))
    first, fd = int(rng.integers(len(bursts))), int(rng.random() < 0.3)
    frames_ = [(frame.can_id, frame.data) for frame in bursts[first][fd]]
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
        return "shuffled and doubled", [
            frames_[i] for i in rng.permutation(np.repeat(np.arange(len(frames_)), 2))
        ]
    if kind == 5:  # pages of another counter of the same slot; 16 apart the burst number is one
        apart = 16 if rng.random() < AGES_APART else int(rng.integers(1, 16))
        other = (first + len(Slot) * apart) % len(bursts)
        a, b = bursts[first][0], bursts[other][0]
        pick = rng.random(len(a)) < 0.5
        mixed = [x if p else y for p, x, y in zip(pick, a, b, strict=True)]
        return "mixed counters", [(frame.can_id, frame.data) for frame in mixed]
    if kind == 6:
        cut = int(rng.integers(len(frames_[0][1])))
        return "cut short", [(can_id, data[:cut]) for can_id, data in frames_]
    joined = bytearray(b"".join(data for _, data in frames_))  # an FD record of two counters
    other = bytearray(
        b"".join(frame.data for frame in bursts[(first + len(Slot)) % len(bursts)][0])
    )
    page = 8 * int(rng.integers(4))
    joined[page : page + 8] = other[page : page + 8]
    return "mixed FD record", [(0x348 + first % len(Slot), bytes(joined))]


def mixtures(n, seed):
    """Random mixtures, in bulk and on a disturbed bus."""
    bulk = mixtures_in_bulk(n, seed)
    bus = mixtures_on_a_bus(n // 10, seed)
    return {"in bulk": bulk, "on a bus": bus, "met": bulk["met"] and bus["met"]}


def mixtures_in_bulk(n, seed):
    """Of parts and wholes: none not definite, none overconfident."""
    codec, counts, failures = Codec.from_dbc(), Counter(), Counter()
    largest = {"part": 0.0, "whole": 0.0}
    judged = bar(n, unit=" mixtures")
    for k in PARTS:
        count = n // len(PARTS) + (k - PARTS[0] < n % len(PARTS))
        for start in range(0, count, CHUNK // k):
            w, m, S = random_mixtures(min(CHUNK // k, count - start), k, [seed, k, start])
            batch = codec.decode_batch(codec.encode_mixtures(w, m, S).reshape(-1, 32))
            decoded_w = batch.component_weight.reshape(-1, k)
            decoded = batch.mean.reshape(m.shape), batch.cov.reshape(S.shape)
            stated = (batch.status != Status.OUT_OF_RANGE).reshape(-1, k)
            of_parts = m.reshape(-1, 4), S.reshape(-1, 4, 4), batch.mean, batch.cov
            of_wholes = *moments(w, m, S), *moments(decoded_w, *decoded)
            for what, pair, in_range in (
                ("part", of_parts, stated.ravel()),
                ("whole", of_wholes, stated.all(axis=1)),
            ):
                verdict = evaluate(*pair, codec.resolution)
                counts[f"{what}s"] += len(in_range)
                counts[f"{what}s out of range"] += int((~in_range).sum())
                failures[f"{what}s not positive definite"] += int(
                    (~verdict.positive_definite).sum()
                )
                failures[f"{what}s overconfident"] += int(verdict.overconfident[in_range].sum())
                ratio = verdict.largest_ratio[in_range].max(initial=largest[what])
                largest[what] = float(ratio)
            failures["records refused"] += int((~batch.accepted).sum())
            failures["weights not of sum 1"] += int((decoded_w.sum(axis=1) != 1).sum())
            judged.update(len(w))
    judged.close()
    ratios = {f"largest eigenvalue of S'^-1 (S + d d^T), {what}": largest[what] for what in largest}
    return {**counts, **failures, **ratios, "met": not any(failures.values())}


def mixtures_on_a_bus(n, seed):
    """Lost, doubled and displaced frames: no mixture but those sent, each once and in order."""
    codec, rng = Codec.from_dbc(), np.random.default_rng([seed, 9])
    decoder, counters, made, wrong = codec.decoder(), Counter(), Counter(), Counter()
    t_ms = 0.0
    for spell in progress(range(-(-n // SPELL)), "spells of mixtures"):
        trouble = TROUBLES[37 * spell % len(TROUBLES)]  # each in turn, the calm one first
        sent, known = sent_mixtures(codec, rng, counters)
        order, arrived = disturbed(rng, sent, trouble)
        delivered, last = set(), {}
        for at, frame in order:
            answer = decoder.feed(frame.can_id, frame.data, round((t_ms + at) * MS))
            if isinstance(answer, MapLine):
                parts = answer.mixture.weights, answer.mixture.means, answer.mixture.covs
                place = known.get((answer.slot, *(values.tobytes() for values in parts)))
                wrong["delivered, not sent"] += place is None
                wrong["delivered twice"] += place in delivered
                wrong["delivered out of order"] += (place or 0) < last.get(answer.slot, 0)
                delivered.add(place)
                last[answer.slot] = place or 0
        whole = {i for i in range(SPELL) if arrived[i] == len(sent[i])}
        made["mixtures sent"] += SPELL
        made["delivered"] += len(delivered)
        made["not delivered, a frame lost"] += len(set(range(SPELL)) - whole - delivered)
        made["not delivered, frames displaced or doubled"] += len(whole - delivered)
        made["frames sent"] += sum(map(len, sent))
        wrong["delivered, though a frame was lost"] += len(delivered - whole)
        wrong["not delivered on a calm bus"] += 0 if any(trouble[:-1]) else len(whole - delivered)
        t_ms += SPELL / len(Slot) * PERIOD_MS + REST_MS
    decoder.expire(round((t_ms + REST_MS) * MS))
    accounted = decoder.line_frames + sum(decoder.counts.values()) + decoder.pending
    wrong["frames not accounted for"] = decoder.frames - accounted
    dropped = {reason.name: count for reason, count in decoder.counts.items()}
    fates = {**made, "frames received": decoder.frames, "dropped": dropped}
    return {**fates, **wrong, "met": not any(wrong.values())}


def random_mixtures(n, k, seed):
    """(n, k) weights down to 1e-13, and parts that spare nothing, next to each other or far."""
    rng = np.random.default_rng(seed)
    means, covs = adversarial(n * k, rng)
    means = means.reshape(n, k, 4)
    apart = 10 ** rng.uniform(-5, 0, (n, 1, 1))  # of the range of each parameter
    evenness = 10 ** rng.uniform(-2, 1, (n, 1))
    weights = rng.standard_gamma(np.broadcast_to(evenness, (n, k))).clip(1e-12)
    weights /= weights.sum(axis=1, keepdims=True)
    return weights, means[:, :1] + apart * (means - means[:, :1]), covs.reshape(n, k, 4, 4)


def moments(weights, means, covs):
    """Mean (n, 4) and covariance (n, 4, 4) of mixtures."""
    mean = np.einsum("nk,nki->ni", weights, means)
    d = means - mean[:, None]
    return mean, np.einsum("nk,nkij->nij", weights, covs + d[..., :, None] * d[..., None, :])


def sent_mixtures(codec, rng, counters):
    """The frames of a spell of mixtures, their slots in turn, and what each must be read as."""
    sizes = rng.choice(PARTS, SPELL)
    frames, known = [None] * SPELL, {}
    first = np.zeros(SPELL, dtype=int)
    for i, k in enumerate(sizes):
        first[i] = counters[i % len(Slot)]
        counters[i % len(Slot)] += int(k)
    for k in PARTS:
        (places,) = np.nonzero(sizes == k)
        slots = places % len(Slot)
        w, m, S = random_mixtures(len(places), k, rng)
        payloads = codec.encode_mixtures(w, m, S, slot=slots, counter=first[places])
        batch = codec.decode_batch(payloads.reshape(-1, 32), slot=np.repeat(slots, k))
        for j, (place, slot) in enumerate(zip(places, slots, strict=True)):
            of_it = slice(j * k, (j + 1) * k)
            values = batch.component_weight[of_it], batch.mean[of_it], batch.cov[of_it]
            known[Slot(slot), *(value.tobytes() for value in values)] = int(place)
            records = [codec.frames(p, Slot(slot), fd=slot % 2 == 0) for p in payloads[j]]
            frames[place] = [frame for record in records for frame in record]
    return frames, known


def disturbed(rng, sent, trouble):
    """(time [ms], frame) in the order of arrival, and how many frames of each mixture came."""
    loss, doubled, displaced_ms, silences, pace = trouble
    arrivals, arrived = [], Counter()
    silent_until = dict.fromkeys(range(len(Slot)), -1)
    for cycle in range(SPELL // len(Slot)):
        queue = []
        for slot in range(len(Slot)):
            i = cycle * len(Slot) + slot
            if silences and rng.random() < 0.05:
                silent_until[slot] = cycle + int(rng.integers(1, 30))
            if cycle >= silent_until[slot]:
                # Two senders at once, each with its slots one after the other.
                at = slot // 2 + np.sort(rng.random(len(sent[i])))
                queue += [(x, i, frame) for x, frame in zip(at, sent[i], strict=True)]
        queue.sort(key=lambda entry: entry[:2])
        for place, (_, i, frame) in enumerate(queue):
            at = (cycle * PERIOD_MS + place * FRAME_MS) / pace
            if rng.random() >= loss:
                arrived[i] += 1
                arrivals.append((at + rng.exponential(displaced_ms), frame))
                if rng.random() < doubled:
                    arrivals.append((at + FRAME_MS + rng.exponential(3 + displaced_ms), frame))
    arrivals.sort(key=lambda entry: entry[0])
    return arrivals, arrived


def lookup(line):
    """What tells two lines apart."""
    return line.slot, line.gaussian.mean.tobytes(), line.gaussian.cov.tobytes()


def plain(value):
    return value if isinstance(value, (bool, int)) else float(value)


def main():
    parser = parser_of(__doc__)
    jobs = {
        "guarantee": (guarantee, 10**6),
        "quality": (quality, 20_000),
        "frames": (frames, 10**7),
        "mixtures": (mixtures, 10**6),
    }
    parser.add_argument("what", choices=jobs)
    parser.add_argument("-n", type=int, help="how many; by default 1e6, 2e4, 1e7 and 1e6")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="for machines")
    arguments = parser.parse_args()
    job, n = jobs[arguments.what]
    started = time.perf_counter()
    result = job(arguments.n or n, arguments.seed)
    result["seconds"] = time.perf_counter() - started
    return report(result, arguments.json, 48)


if __name__ == "__main__":
    sys.exit(main())
