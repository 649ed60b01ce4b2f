#!/usr/bin/env python3
"""Show what the wire promises, with figures.

    evidence_wire.py guarantee   1e6 random covariances: all definite, none overconfident
    evidence_wire.py quality     KL, lateral bands and saturation on the sets paper and road
    evidence_wire.py frames      1e7 damaged and random frames: nothing wrong, all accounted for

Run it in the project's environment: python3 tools/run.py python tools/evidence_wire.py ...

Ends with a nonzero status where a bound is missed.
"""

import argparse
import json
import sys
import time
from collections import Counter

import numpy as np
from tqdm import tqdm

from maplines_can.line import MapLine, Slot, Status
from maplines_can.study import LATERAL_X, hostile, judge, paper, road
from maplines_can.wire import Codec

CHUNK = 50_000
MS = 1_000_000
#: Share of the mixed bursts that have one burst number: only the checksum tells their pages
#: apart, and passes one in 65536. On a bus they are 16 periods apart and the time-out does.
AGES_APART = 0.002


def guarantee(n, seed):
    """Random covariances that spare nothing: none not definite, none overconfident."""
    codec, statuses = Codec.from_dbc(), Counter()
    not_definite = overconfident = refused = 0
    largest = 0.0
    for start in progress(range(0, n, CHUNK), "covariances"):
        means, covs = hostile(min(CHUNK, n - start), seed + start)
        batch = codec.decode_batch(codec.encode_batch(means, covs))
        verdict = judge(means, covs, batch.mean, batch.cov, codec.resolution)
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
        verdict = judge(means, covs, batch.mean, batch.cov, codec.resolution)
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
    with tqdm(total=n, unit=" frames", disable=not sys.stderr.isatty()) as bar:
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
            bar.update(len(batch))
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


def lookup(line):
    """What tells two lines apart."""
    return line.slot, line.gaussian.mean.tobytes(), line.gaussian.cov.tobytes()


def plain(value):
    return value if isinstance(value, (bool, int)) else float(value)


def progress(steps, what):
    return tqdm(steps, desc=what, disable=not sys.stderr.isatty())


def show(result, indent=0):
    for key, value in result.items():
        if isinstance(value, dict):
            print(" " * indent + f"{key}:")
            show(value, indent + 4)
        else:
            text = f"{value:.6g}" if isinstance(value, float) else value
            print(" " * indent + f"{key:<44}{text}")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    jobs = {
        "guarantee": (guarantee, 10**6),
        "quality": (quality, 20_000),
        "frames": (frames, 10**7),
    }
    parser.add_argument("what", choices=jobs)
    parser.add_argument("-n", type=int, help="how many; by default 1e6, 2e4 and 1e7")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="for machines")
    arguments = parser.parse_args()
    job, n = jobs[arguments.what]
    started = time.perf_counter()
    result = job(arguments.n or n, arguments.seed)
    result["seconds"] = time.perf_counter() - started
    print(json.dumps(result, indent=2)) if arguments.json else show(result)
    return 0 if result["met"] else 1


if __name__ == "__main__":
    sys.exit(main())
