"""The work of a study: a chunk through all codes and widths, and the limit of a set."""

from __future__ import annotations

import gzip
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...line import Status
from ...wire.covariance.cholesky import CholeskyCode
from ...wire.message.packing import Packing
from ...wire.message.reader import Batch
from ..metrics import Figure, Score, evaluate, kl_terms
from ..sets import Chunk, Gaussians, LineSet
from .engines import Task
from .plan import DEFAULT_CODE, LIMIT_PARTS, Plan, Study, chunk_key, codec_of, limit_key

__all__ = ["KLS", "WORST", "LimitTask", "SweepTask", "packed", "tasks_of", "unpacked"]

#: So many of the worst cases are kept.
WORST = 5
#: Divergences for which the limit is told [nat].
KLS = (1e-2, 1e-3, 1e-4)
#: The rows of the covariance as the default code orders them, whose ratios are small.
ORDER = [3, 1, 0, 2]


def tasks_of(study: Study, done: set[str]) -> Iterator[Task]:
    """What is left to do of a study, the long tasks first; none is made before it is asked for.

    Args:
        study: which.
        done: names of the tasks whose results are there.
    """
    sets, plans, field_plans = list(enumerate(study.sets)), study.plans, study.field_plans
    for place, line_set in sets if study.limit_n else []:
        keys = {part: limit_key(place, part) for part in LIMIT_PARTS}
        if not done.issuperset(keys.values()):
            chunks, size = _first_chunks(study, line_set)
            for part, key in keys.items():
                if key not in done:
                    yield LimitTask(key, part, chunks, size, study.seed)
    for place, line_set in sets:
        start = 0
        sizes = line_set.sizes(study.n, study.chunk_size)
        made = line_set.chunks(study.n, study.chunk_size, study.seed)
        for index, (size, chunk) in enumerate(zip(sizes, made, strict=True)):
            fields = field_plans if start < study.fields_n else []
            start += size
            key = chunk_key(place, index)
            if key not in done:
                yield SweepTask(key, chunk, plans, fields, size)


def _first_chunks(study: Study, line_set: LineSet) -> tuple[list[Chunk], int]:
    """Those that tell the limit, and how many Gaussians of them do."""
    chunks: list[Chunk] = []
    total = 0
    sizes = line_set.sizes(study.n, study.chunk_size)
    for size, chunk in zip(
        sizes, line_set.chunks(study.n, study.chunk_size, study.seed), strict=True
    ):
        chunks.append(chunk)
        total += size
        if total >= study.limit_n:
            break
    return chunks, min(total, study.limit_n)


@dataclass(frozen=True, eq=False)
class SweepTask(Task):
    """One chunk through all codes and widths."""

    key: str
    chunk: Chunk
    plans: Sequence[Plan]
    field_plans: Sequence[Plan]
    weight: int

    def content(self) -> bytes:
        """Sums and worst cases, as ``packed`` has them."""
        given = self.chunk.gaussians()
        base = None
        scores, fields = [], []
        for plan in self.plans:
            trial = _Trial(plan, given)
            entry = {"plan": plan, "seconds": trial.seconds, "score": trial.score().as_json()}
            if plan.code == DEFAULT_CODE:
                entry["terms"] = trial.terms_before_inflation().as_json()
            if plan == Plan(DEFAULT_CODE):
                base = trial
            if plan.finer_bits == 0:
                entry["worst"] = trial.worst()
            scores.append(entry)
        if self.field_plans:
            base = base or _Trial(Plan(DEFAULT_CODE), given)
            for plan in self.field_plans:
                trial = _Trial(plan, given)
                entry = {"plan": plan, "score": trial.score_of_field(base).as_json()}
                fields.append(entry)
        return packed({"n": len(given.mean), "scores": scores, "fields": fields})


class _Trial:
    """One chunk through one code and back, timed."""

    def __init__(self, plan: Plan, given: Gaussians) -> None:
        self.codec, self.given = codec_of(plan), given
        started = time.perf_counter()
        self.payloads = self.codec.encode_batch(*given)
        self.batch: Batch = self.codec.decode_batch(self.payloads)
        resolution = self.codec.resolution
        self.verdict = evaluate(*given, self.batch.mean, self.batch.cov, resolution)
        self.seconds = time.perf_counter() - started

    @property
    def good(self) -> NDArray[np.bool_]:
        """(N,) rows whose covariance may be used."""
        stated = self.batch.accepted & (self.batch.status != Status.OUT_OF_RANGE)
        return stated & self.verdict.positive_definite

    def score(self) -> Score:
        """All that is counted and added up of it."""
        d = np.abs(self.given.mean - self.batch.mean)
        beyond_rounding = d > 0.51 * np.sqrt(12 * self.codec.resolution)
        clipped = np.asarray(beyond_rounding.any(axis=1))
        return Score.of(self.verdict, self.batch.status, self.batch.accepted, clipped)

    def score_of_field(self, base: _Trial) -> Score:
        """Less than a whole score, and the difference to what it is without the bit."""
        whole = self.score()
        both = self.good & base.good
        change = self.verdict.kl_covered[both] - base.verdict.kl_covered[both]
        figures = {
            "kl": Figure.of(self.verdict.kl_covered[self.good]),
            "kl_change": Figure.of(change),
            "mean_error_80": whole.figures["mean_error_80"],
        }
        return Score(whole.counts, figures)

    def terms_before_inflation(self) -> Score:
        """KL of the covered target with the covariance before it was inflated, field by field.

        Of the default code, over the rows where nothing saturates. The figure "kl" is the sum of
        all; the count of a ratio's name is of those that are rounded to zero.
        """
        layout, code = self.codec.layout, self.codec.covariance
        if not isinstance(code, CholeskyCode):
            raise TypeError(f"only {CholeskyCode.name} is inflated, not {code.name}")
        rows = self.batch.status == Status.FULL
        inflation = Packing([layout["Inflation"]], layout.record_bytes).unpack(self.payloads)
        factor = np.exp2(layout["Inflation"].physical(inflation["Inflation"]))
        mean, cov = self.given
        d = mean - self.batch.mean
        target = cov + d[:, :, None] * d[:, None, :] + np.diag(self.codec.resolution)
        decoded = self.batch.cov / factor[:, None, None]
        target, decoded = (
            S[rows][:, code.factor.order][:, :, code.factor.order] for S in (target, decoded)
        )
        terms = kl_terms(target, decoded)
        figures = {"kl": Figure.of(terms.sum(axis=(1, 2)))}
        counts = {"n": int(rows.sum())}
        L = np.linalg.cholesky(decoded)
        for i, pivot in enumerate(code.factor.pivots):
            figures[pivot.name] = Figure.of(terms[:, i, i])
            for j, ratio in enumerate(code.factor.ratios[i]):
                figures[ratio.name] = Figure.of(terms[:, i, j])
                zero = np.abs(L[:, i, j]) < ratio.factor / 2 * L[:, i, i]
                counts[ratio.name] = int(zero.sum())
        return Score(counts, figures)

    def worst(self) -> list[dict[str, Any]]:
        """The rows of the greatest KL, with all that is known of them."""
        kl = np.where(self.good, self.verdict.kl_covered, -np.inf)
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


@dataclass(frozen=True, eq=False)
class LimitTask(Task):
    """How few bits could do for a set."""

    key: str
    part: str
    chunks: Sequence[Chunk]
    weight: int
    seed: int

    def content(self) -> bytes:
        """The limit, or why there is none."""
        from .limit import limit_of

        parts = [chunk.gaussians() for chunk in self.chunks]
        mean = np.concatenate([part.mean for part in parts])[: self.weight, ORDER]
        cov = np.concatenate([part.cov for part in parts])[: self.weight, ORDER][:, :, ORDER]
        resolution = codec_of(Plan(DEFAULT_CODE)).resolution[ORDER]
        try:
            limit = limit_of(
                mean,
                cov,
                part=self.part,  # type: ignore[arg-type]
                resolution=resolution,
                seed=self.seed,
            )
        except ValueError as error:
            return packed({"refused": str(error), "samples": len(mean)})
        known = not np.isnan(limit.entropy_bits)
        return packed(
            {
                "entropy_bits": limit.entropy_bits if known else None,
                "se_bits": limit.entropy_se_bits if known else None,
                "bias_bits": limit.bias_bits if known else None,
                "bits": limit.bits(KLS).tolist() if known else [None] * len(KLS),
                "samples": limit.samples,
                "dimension": limit.dimension,
                "caveat": limit.caveat,
            }
        )


def packed(data: dict[str, Any]) -> bytes:
    """A result as the bytes of its file."""
    return gzip.compress(json.dumps(data, separators=(",", ":")).encode(), 6, mtime=0)


def unpacked(content: bytes) -> Any:
    """What ``packed`` made bytes of.

    Raises:
        OSError, EOFError, ValueError: something else did.
    """
    return json.loads(gzip.decompress(content))
