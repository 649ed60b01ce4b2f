"""The tasks of a study: a chunk through all codes, scenes, the limit of a set; and their time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...engines import Result, Task
from ...values.coding_loss import evaluate
from ...values.line import Status
from ...wire import Codec
from ...wire.layout.packing import Packing
from ..comparison import transmit
from ..metrics import Figure, Score, kl_terms
from ..scenes.carriers import scenes_chunk
from ..sets import Chunk, Gaussians, LineSet
from .limit import limit_of
from .plan import DEFAULT_CODE, LIMIT_PARTS, Plan, Study, chunk_key, codec_of, limit_key, scenes_key

#: Number of worst cases to keep.
WORST = 5
#: Divergences for which the limit is computed [nat].
KLS = (1e-2, 1e-3, 1e-4)
#: States in the order of the default code, which makes ratios small.
ORDER = [3, 1, 0, 2]


def tasks_of(study: Study, done: set[str]) -> Iterator[Task]:
    """Yield the tasks whose keys are not in ``done``, the long ones first, each made on demand."""
    plans, field_plans = study.plans, study.field_plans
    for place, line_set in enumerate(study.sets) if study.limit_n else ():
        parts = [part for part in LIMIT_PARTS if limit_key(place, part) not in done]
        if not parts:
            continue
        rows = np.cumsum(line_set.sizes(study.n, study.chunk_size))
        chunks = line_set.chunks(study.n, study.chunk_size, study.seed)
        first = list(islice(chunks, int(np.searchsorted(rows, study.limit_n)) + 1))
        n = min(study.limit_n, int(rows[-1]))
        for part in parts:
            yield Task(limit_key(place, part), partial(limit_result, first, n, part, study.seed))
    for lines, scene_sizes in study.scene_sizes.items():
        for index, size in enumerate(scene_sizes):
            if (key := scenes_key(lines, index)) not in done:
                yield Task(key, partial(scenes_chunk, lines, index, size, study.codes, study.seed))
    for place, line_set in enumerate(study.sets):
        start = 0
        sizes = line_set.sizes(study.n, study.chunk_size)
        chunks_of_set = line_set.chunks(study.n, study.chunk_size, study.seed)
        for index, (size, chunk) in enumerate(zip(sizes, chunks_of_set, strict=True)):
            fields = field_plans if start < study.fields_n else []
            start += size
            key = chunk_key(place, index)
            if key not in done:
                yield Task(key, partial(chunk_result, chunk, plans, fields))


def chunk_result(chunk: Chunk, plans: Sequence[Plan], field_plans: Sequence[Plan]) -> Result:
    """Send a chunk through all codes and widths; return scores and worst cases."""
    given = chunk()
    scores, fields = [], []
    base = None
    for plan in plans:
        trial = _Trial(plan, given)
        entry = {"plan": plan, "seconds": trial.seconds, "score": trial.score().as_json()}
        if plan.code == DEFAULT_CODE:
            entry["terms"] = trial.terms_before_inflation().as_json()
        if plan == Plan(DEFAULT_CODE):
            base = trial
        if plan.finer_bits == 0:
            entry["worst"] = trial.worst()
        scores.append(entry)
    if field_plans:
        base = base or _Trial(Plan(DEFAULT_CODE), given)
        for plan in field_plans:
            score = _Trial(plan, given).score_of_field(base)
            fields.append({"plan": plan, "score": score.as_json()})
    return {"scores": scores, "fields": fields}


class _Trial:
    """A set of Gaussians, encoded and decoded by the codec of one plan, and evaluated."""

    def __init__(self, plan: Plan, given: Gaussians) -> None:
        self.codec, self.given = codec_of(plan), given
        started = time.perf_counter()
        self.batch = transmit(self.codec, *given)
        decoded = self.batch.mean, self.batch.cov
        self.evaluation = evaluate(*given, *decoded, self.codec.resolution)
        self.seconds = time.perf_counter() - started

    @property
    def good(self) -> NDArray[np.bool_]:
        """(N,) rows whose covariance may be used."""
        stated = self.batch.accepted & (self.batch.status != Status.OUT_OF_RANGE)
        return stated & self.evaluation.positive_definite

    def score(self) -> Score:
        """Return all counts and figures."""
        d = np.abs(self.given.mean - self.batch.mean)
        beyond_rounding = d > 0.51 * np.sqrt(12 * self.codec.resolution)
        clipped = np.asarray(beyond_rounding.any(axis=1))
        return Score.of(self.evaluation, self.batch.status, self.batch.accepted, clipped)

    def score_of_field(self, base: _Trial) -> Score:
        """Return counts, KL, and its change against the base plan."""
        whole = self.score()
        kl, good, both = self.evaluation.kl_covered, self.good, self.good & base.good
        figures = {
            "kl": Figure.of(kl[good]),
            "kl_change": Figure.of(kl[both] - base.evaluation.kl_covered[both]),
            "mean_error_80": whole.figures["mean_error_80"],
        }
        return Score(whole.counts, figures)

    def terms_before_inflation(self) -> Score:
        """Return the KL of the covered target by field, with the covariance before inflation.

        For the default code, over the rows where nothing saturates. The figure "kl" is the sum of
        all terms; the count of a ratio's name is the number of those that are rounded to zero.
        """
        if not isinstance(self.codec, Codec):
            raise TypeError(f"only {DEFAULT_CODE} is inflated, not {self.codec.covariance.name}")
        layout, code = self.codec.layout, self.codec.covariance
        rows = self.batch.status == Status.FULL
        payloads = self.codec.batch.encode(*self.given)
        inflation = Packing([layout["Inflation"]], layout.record_bytes).unpack(payloads)
        factor = np.exp2(layout["Inflation"].physical(inflation["Inflation"]))
        mean, cov = self.given
        d = mean - self.batch.mean
        target = cov + d[:, :, None] * d[:, None, :] + np.diag(self.codec.resolution)
        decoded = self.batch.cov / factor[:, None, None]
        order = code.factor.order
        target, decoded = (S[rows][:, order][:, :, order] for S in (target, decoded))
        terms = kl_terms(target, decoded)
        L = np.linalg.cholesky(decoded)
        figures = {"kl": Figure.of(terms.sum(axis=(1, 2)))}
        counts = {"n": int(rows.sum())}
        for i, pivot in enumerate(code.factor.pivots):
            figures[pivot.name] = Figure.of(terms[:, i, i])
            for j, ratio in enumerate(code.factor.ratios[i]):
                figures[ratio.name] = Figure.of(terms[:, i, j])
                zero = np.abs(L[:, i, j]) < ratio.factor / 2 * L[:, i, i]
                counts[ratio.name] = int(zero.sum())
        return Score(counts, figures)

    def worst(self) -> list[dict[str, Any]]:
        """Return the rows of the largest KL with all their values."""
        kl = np.where(self.good, self.evaluation.kl_covered, -np.inf)
        rows = np.argsort(-kl, kind="stable")[:WORST]
        return [
            {
                "kl": float(kl[i]),
                "status": Status(int(self.batch.status[i])).name,
                "mean": self.given.mean[i].tolist(),
                "cov": self.given.cov[i].ravel().tolist(),
                "decoded_mean": self.batch.mean[i].tolist(),
                "decoded_cov": self.batch.cov[i].ravel().tolist(),
            }
            for i in rows
            if self.good[i]
        ]


def limit_result(chunks: Sequence[Chunk], n: int, part: str, seed: int) -> Result:
    """Return rows of the table ``limit`` for the first n Gaussians, or why there is no limit."""
    means, covs = zip(*(chunk() for chunk in chunks), strict=True)
    mean, cov = (np.concatenate(arrays)[:n] for arrays in (means, covs))
    try:
        limit = limit_of(
            mean[:, ORDER],
            cov[:, ORDER][:, :, ORDER],
            part=part,  # type: ignore[arg-type]
            resolution=codec_of(Plan(DEFAULT_CODE)).resolution[ORDER],
            seed=seed,
        )
    except ValueError as error:
        return {"rows": [{"kl": kl, "samples": len(mean), "caveat": str(error)} for kl in KLS]}
    row: dict[str, Any] = {
        "entropy_bits": limit.entropy_bits,
        "se_bits": limit.entropy_se_bits,
        "bias_bits": limit.bias_bits,
        "samples": limit.samples,
        "dimension": limit.dimension,
        "caveat": limit.caveat,
    }
    bits = limit.bits(KLS).tolist()
    return {"rows": [row | {"kl": kl, "bits": b} for kl, b in zip(KLS, bits, strict=True)]}


#: Gaussians of the two parts of a chunk that are timed, and those for the limit.
SMALL, LARGER, FOR_LIMIT = 200, 1200, 2000


def cpu_seconds(study: Study) -> float:
    """Return about how much CPU time all tasks of a study take on this machine [s].

    A chunk costs something for itself and something for each Gaussian: two small parts of the first
    chunk of each set are timed, a scene of each number of lines, and the limit of some Gaussians.
    It takes some seconds. Of two studies it said 11 and 99 s, and 18 and 82 s were seen.
    """
    total = sum(_of_set(study, line_set) for line_set in study.sets)
    for lines, sizes in study.scene_sizes.items():
        one = partial(scenes_chunk, lines, 0, 1, study.codes, study.seed)
        total += sum(sizes) * _seconds(one)
    return total


def _of_set(study: Study, line_set: LineSet) -> float:
    """Return the time for the chunks and the limit of a set [s]."""
    sizes = line_set.sizes(study.n, study.chunk_size)
    n = min(sum(sizes), LARGER)
    (first,) = islice(line_set.chunks(min(study.n, LARGER), LARGER, study.seed), 1)
    given = first()
    n = min(n, len(given.mean))
    small = min(SMALL, n)
    total = 0.0
    for plans, gaussians in ((study.plans, sum(sizes)), (study.field_plans, study.fields_n)):
        gaussians = min(gaussians, sum(sizes))
        if not plans or not gaussians:
            continue
        chunks = -(-gaussians // study.chunk_size)
        each = [
            _seconds(partial(chunk_result, _head(given, size), plans, []))
            for size in (small, small, n)  # the first one makes the codecs
        ][1:]
        slope = max(each[1] - each[0], 0.0) / max(n - small, 1)
        total += chunks * max(each[0] - slope * small, 0.0) + gaussians * slope
    making = _seconds(first) / max(len(given.mean), 1)
    if study.limit_n:
        most = min(study.limit_n, sum(sizes), FOR_LIMIT, len(given.mean))
        for part in LIMIT_PARTS:
            limit = partial(limit_result, [_head(given, most)], most, part, study.seed)
            total += _seconds(limit) * min(study.limit_n, sum(sizes)) / max(most, 1)
    return total + making * sum(sizes)


def _head(given: Gaussians, n: int) -> Chunk:
    return partial(Gaussians, given.mean[:n], given.cov[:n])


def _seconds(work: Callable[[], Any]) -> float:
    """Return the CPU time of a piece of work [s]."""
    began = time.process_time()
    work()
    return time.process_time() - began
