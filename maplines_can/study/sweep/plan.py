"""The plan of a study: which codes, at which widths, on which sets; and its directory."""

from __future__ import annotations

import gzip
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...values.errors import StudyError
from ...values.input_files import json_of
from ...values.output_files import whole_file
from ...wire.layout.record_signals import PARAMETER_SIGNALS
from ..code_dbcs import FIXED_WIDTHS, covariance_signals, dbc_writer_for
from ..codes import CODES
from ..comparison import AnyCodec, codec_for
from ..sets import LineSet

#: The code of the project's own DBC.
DEFAULT_CODE = next(iter(CODES))
#: What of a Gaussian the rate-distortion limit is computed for.
LIMIT_PARTS = ("all", "covariance")
#: Scenes in a chunk, and numbers of their lines.
SCENES_IN_A_CHUNK, SCENE_LINES = 20, (4, 8)
#: Version of the files of a study; a study of another version is another study.
FORMAT = 3


class Plan(NamedTuple):
    """A code with the widths of its fields."""

    code: str
    finer_bits: int = 0  #: more bits for all fields of the covariance
    field: str = ""  #: a single field with another width, or empty
    delta_bits: int = 0  #: more bits for that field


@dataclass(frozen=True)
class Study:
    """A study of covariance codes.

    Raises:
        StudyError: a value is out of its range.
    """

    sets: Sequence[LineSet]  #: of different names
    codes: Sequence[str] = tuple(CODES)  #: names of ``CODES``
    #: Widths as for ``dbc_writer_for``; a code with fixed widths takes part only with 0.
    finer_bits: Sequence[int] = (-2, -1, 0, 1, 2)
    n: int = 1_000_000  #: Gaussians of each drawn set; files are taken whole
    seed: int = 0  #: of the draws
    chunk_size: int = 10_000  #: Gaussians at a time
    fields_n: int = 100_000  #: Gaussians of each set for the table ``fields``
    limit_n: int = 20_000  #: Gaussians of each set for the table ``limit``; 0 for none
    scenes_n: int = 400  #: scenes of each number of lines for the table ``scenes``; 0 for none

    def __post_init__(self) -> None:
        minima = {"n": 1, "seed": 0, "chunk_size": 1, "fields_n": 0, "limit_n": 0}
        minima["scenes_n"] = 0
        for name, least in minima.items():
            if getattr(self, name) < least:
                raise StudyError(f"{name} must be {least} or more, got {getattr(self, name)}")
        names = [line_set.name for line_set in self.sets]
        if not names or len(set(names)) < len(names):
            raise StudyError(f"sets must be one or more, of different names, got {names}")
        if unknown := [code for code in self.codes if code not in CODES]:
            raise StudyError(f"there is no code {unknown[0]!r}; codes are {', '.join(CODES)}")
        for values in (self.codes, self.finer_bits):
            if not values or len(set(values)) < len(values):
                raise StudyError(f"codes and finer_bits must be different ones, got {list(values)}")
        if not self.plans:
            raise StudyError("no code has such widths; add 0 to finer_bits")

    @property
    def plans(self) -> list[Plan]:
        """All codes at all of ``finer_bits`` that they support."""
        plans = []
        for code in self.codes:
            for finer_bits in self.finer_bits:
                if finer_bits and code in FIXED_WIDTHS:
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
        names = (*PARAMETER_SIGNALS, *(spec.name for spec in covariance_signals(DEFAULT_CODE)))
        return [Plan(DEFAULT_CODE, 0, name, delta) for name in names for delta in (-1, 1)]

    def describe(self) -> dict[str, Any]:
        """Return everything that the result depends on, for the manifest."""
        versions = {"format": FORMAT, "maplines_can": version("maplines_can")}
        return versions | vars(self) | {"sets": [line_set.describe() for line_set in self.sets]}

    def weights(self) -> dict[str, int]:
        """Return the size of each task [Gaussians] by its key, for progress."""
        weights = {}
        for place, line_set in enumerate(self.sets):
            sizes = line_set.sizes(self.n, self.chunk_size)
            for part in LIMIT_PARTS if self.limit_n else ():
                weights[limit_key(place, part)] = min(self.limit_n, sum(sizes))
            weights |= {chunk_key(place, index): size for index, size in enumerate(sizes)}
        for lines, sizes in self.scene_sizes.items():
            weights |= {scenes_key(lines, i): lines * size for i, size in enumerate(sizes)}
        return weights

    @property
    def scene_sizes(self) -> dict[int, list[int]]:
        """Number of scenes in each chunk, by the number of their lines."""
        starts = range(0, self.scenes_n, SCENES_IN_A_CHUNK)
        sizes = [min(SCENES_IN_A_CHUNK, self.scenes_n - start) for start in starts]
        return dict.fromkeys(SCENE_LINES if sizes else (), sizes)


def chunk_key(place: int, index: int) -> str:
    """Return the key of a chunk's task, from the index of the set and of the chunk."""
    return f"{place}-{index:06d}"


def limit_key(place: int, part: str) -> str:
    """Return the key of the task that computes the limit of a set."""
    return f"{place}-limit-{part}"


def scenes_key(lines: int, index: int) -> str:
    """Return the key of the task of a chunk of scenes, from the number of their lines."""
    return f"scenes-{lines}-{index:06d}"


@lru_cache(maxsize=256)
def codec_of(plan: Plan) -> AnyCodec:
    """Return the codec of a plan, with a DBC of its own for one slot, since all are alike."""
    writer = dbc_writer_for(
        plan.code, plan.finer_bits, {plan.field: plan.delta_bits} if plan.field else None
    )
    return codec_for(writer.layout(1))


def theory(codec: AnyCodec) -> dict[str, float]:
    """Return the expected KL [nat] of the rounding of each field, before inflation.

    A ratio of step D costs D^2 / 24, a pivot of D octaves (D ln 2)^2 / 12 (see
    ``wire/layout/cholesky.py``), if its values spread over several steps; less if most of them
    lie within one. Saturation is left out, and that without feedback an error in one entry
    propagates to those that depend on it. Empty for codes other than Cholesky and LogCholesky.
    """
    if codec.covariance.name not in ("Cholesky", "LogCholesky"):
        return {}
    signals = codec.covariance.signals
    ratios = {s.name: s.factor**2 / 24 for s in signals if "Ratio" in s.name}
    pivots = {s.name: (s.factor * np.log(2)) ** 2 / 12 for s in signals if "Pivot" in s.name}
    return pivots | ratios


# ---- files ---------------------------------------------------------------------------


class StudyDirectory:
    """The files of one study.

    Args:
        path: created if it does not exist.
        description: everything that the result of the study depends on, as JSON values.

    Raises:
        StudyError: the directory holds another study, or other files.
    """

    def __init__(self, path: Path, description: Mapping[str, Any]) -> None:
        self.path = path
        manifest = path / "study.json"
        text = json.dumps(description, indent=2)
        #: Identifies the study.
        self.fingerprint = hashlib.sha256(text.encode()).hexdigest()[:12]
        try:
            if manifest.exists():
                _compare(manifest, json.loads(text))
            elif path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise StudyError(f"{path}: holds other things than a study; name a new directory")
            else:
                path.mkdir(parents=True, exist_ok=True)
                self.write(manifest.name, text.encode() + b"\n")
            (path / "chunks").mkdir(exist_ok=True)
        except (OSError, ValueError) as error:
            if isinstance(error, StudyError):
                raise
            raise StudyError(f"{path}: cannot be used: {error}") from error

    def write(self, name: str, content: bytes) -> None:
        """Write a file as a whole or not at all."""
        with whole_file(self.path / name) as part:
            part.write_bytes(content)

    def store(self, key: str, result: Mapping[str, Any]) -> None:
        """Store the result of a task."""
        text = json.dumps(result, separators=(",", ":"))
        self.write(f"chunks/{key}.json.gz", gzip.compress(text.encode(), 6, mtime=0))

    def done(self) -> set[str]:
        """Return the keys of the tasks whose results are stored."""
        chunks = (self.path / "chunks").glob("*.json.gz")
        return {path.name.removesuffix(".json.gz") for path in chunks}

    def result(self, key: str) -> Any:
        """Return the result of a task.

        Raises:
            StudyError: its file is damaged.
        """
        path = self.path / "chunks" / f"{key}.json.gz"
        try:
            text = gzip.decompress(path.read_bytes()).decode()
            return json_of(text, path.name, ValueError)
        except (OSError, EOFError, ValueError) as error:
            raise StudyError(
                f"{path}: cannot be read ({error}); delete it and run the study again"
            ) from error


def _compare(manifest: Path, wanted: Mapping[str, Any]) -> None:
    """Raise ``StudyError`` if a manifest describes another study than the wanted one."""
    there = json_of(manifest.read_text(encoding="utf-8"), str(manifest), StudyError)
    if not isinstance(there, dict):
        raise StudyError(f"{manifest}: is not the manifest of a study")
    for key, value in wanted.items():
        if there.get(key) != value:
            raise StudyError(
                f"{manifest.parent}: holds another study: there {key} is "
                f"{json.dumps(there.get(key))}, and now {json.dumps(value)}; name another "
                "directory, or ask for the same"
            )
