"""What a study asks: which codes, at which widths, of which sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np

from ...errors import StudyError
from ...wire import Codec
from ...wire.message.layout import STATE_SIGNALS, Layout
from ..codes import CODES
from ..dbc.covariance_spec import covariance_signals
from ..dbc.record_spec import dbc_writer_for
from ..sets import LineSet

__all__ = [
    "DEFAULT_CODE",
    "LIMIT_PARTS",
    "Plan",
    "Study",
    "chunk_key",
    "codec_of",
    "limit_key",
    "theory",
]

#: The code of the project's own DBC.
DEFAULT_CODE = next(iter(CODES))
#: Of a Gaussian: the limit is told for both.
LIMIT_PARTS = ("all", "covariance")
#: Of the files of a study; another number is another study.
FORMAT = 1


class Plan(NamedTuple):
    """A code with the widths of its fields."""

    code: str
    finer_bits: int = 0
    field: str = ""  #: a single field that is wider, or empty
    delta_bits: int = 0  #: by so many bits


@dataclass(frozen=True)
class Study:
    """What is to be found out.

    Args:
        sets: of Gaussians, of different names.
        codes: of the covariance.
        finer_bits: widths of the fields, as ``dbc_writer_for`` has them; a code without widths of
            choice takes part with 0 alone.
        n: Gaussians of each drawn set; files are taken whole.
        seed: of the draws.
        chunk_size: Gaussians at a time.
        fields_n: so many Gaussians of each set tell what each single field is worth.
        limit_n: so many tell how few bits could do; 0 for none.

    Raises:
        StudyError: a value is out of its range.
    """

    sets: Sequence[LineSet]
    codes: Sequence[str] = tuple(CODES)
    finer_bits: Sequence[int] = (-2, -1, 0, 1, 2)
    n: int = 1_000_000
    seed: int = 0
    chunk_size: int = 10_000
    fields_n: int = 100_000
    limit_n: int = 20_000

    def __post_init__(self) -> None:
        for name, least in (
            ("n", 1),
            ("seed", 0),
            ("chunk_size", 1),
            ("fields_n", 0),
            ("limit_n", 0),
        ):
            if getattr(self, name) < least:
                raise StudyError(f"{name} must be {least} or more, got {getattr(self, name)}")
        names = [line_set.name for line_set in self.sets]
        if not names or len(set(names)) < len(names):
            raise StudyError(f"sets must be one or more, of different names, got {names}")
        if unknown := [code for code in self.codes if code not in CODES]:
            raise StudyError(f"there is no code {unknown[0]!r}; codes are {', '.join(CODES)}")
        for what in (self.codes, self.finer_bits):
            if not what or len(set(what)) < len(what):
                raise StudyError(f"codes and finer_bits must be different ones, got {list(what)}")
        if len(self.plans) == 0:
            raise StudyError("no code has such widths; add 0 to finer_bits")

    @property
    def plans(self) -> list[Plan]:
        """All codes at all widths that they have."""
        plans = []
        for code in self.codes:
            for finer_bits in self.finer_bits:
                if finer_bits and not _has_widths(code):
                    continue
                try:
                    dbc_writer_for(code, finer_bits)
                except ValueError as error:
                    raise StudyError(f"{code} with {finer_bits:+d} bits: {error}") from error
                plans.append(Plan(code, finer_bits))
        return plans

    @property
    def field_plans(self) -> list[Plan]:
        """The default code with a bit more and less in each field of mean and covariance."""
        if DEFAULT_CODE not in self.codes:
            return []
        names = [spec.name for spec in covariance_signals(DEFAULT_CODE)]
        return [
            Plan(DEFAULT_CODE, 0, name, delta)
            for name in (*STATE_SIGNALS, *names)
            for delta in (-1, 1)
        ]

    def describe(self) -> dict[str, Any]:
        """All that the result depends on, as the manifest has it."""
        return {
            "format": FORMAT,
            "maplines_can": version("maplines_can"),
            "sets": [line_set.describe() for line_set in self.sets],
            "codes": list(self.codes),
            "finer_bits": list(self.finer_bits),
            "n": self.n,
            "seed": self.seed,
            "chunk_size": self.chunk_size,
            "fields_n": self.fields_n,
            "limit_n": self.limit_n,
        }

    def weights(self) -> dict[str, int]:
        """How much of the progress each task is, by name; the chunks of a set in their order."""
        weights = {}
        for place, line_set in enumerate(self.sets):
            sizes = line_set.sizes(self.n, self.chunk_size)
            for part in LIMIT_PARTS if self.limit_n else ():
                weights[limit_key(place, part)] = min(self.limit_n, sum(sizes))
            weights |= {chunk_key(place, index): size for index, size in enumerate(sizes)}
        return weights


def _has_widths(code: str) -> bool:
    try:
        covariance_signals(code, 1)
    except ValueError:
        return False
    return True


def chunk_key(place: int, index: int) -> str:
    """The name of the task of a chunk, by the places of its set and of itself."""
    return f"{place}-{index:06d}"


def limit_key(place: int, part: str) -> str:
    """The name of the task that tells the limit of a set."""
    return f"{place}-limit-{part}"


@lru_cache(maxsize=256)
def codec_of(plan: Plan) -> Codec:
    """The codec of a plan's own DBC."""
    writer = dbc_writer_for(
        plan.code, plan.finer_bits, {plan.field: plan.delta_bits} if plan.field else None
    )
    return Codec(Layout.from_text(writer.dbc(), "the study's DBC"), codes=CODES)


def theory(codec: Codec) -> dict[str, float]:
    """Expected KL [nat] of the rounding of each field before any inflation, nothing saturated.

    A ratio of step D costs D^2 / 24, a pivot of D octaves (D ln 2)^2 / 12 (see
    ``wire/covariance/cholesky.py``), where its values spread over several steps; less where most
    of them lie within one. Empty for a code that has no such theory. It leaves
    out that without feedback an error in one entry goes into those that lean on it.
    """
    if codec.covariance.name not in ("Cholesky", "LogCholesky"):
        return {}
    ratios = {f.name: f.factor**2 / 24 for f in codec.covariance.signals if "Ratio" in f.name}
    pivots = {
        f.name: (f.factor * np.log(2)) ** 2 / 12
        for f in codec.covariance.signals
        if "Pivot" in f.name
    }
    return pivots | ratios
