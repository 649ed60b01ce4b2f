"""The results of a study as tidy tables.

``summary``: codes at their widths. ``fields``: the default code with a bit more or less in one
field. ``terms``: the part of each field in its divergence. ``worst``: the worst cases. ``limit``:
the rate-distortion limit of each set. ``scenes``: codes on scenes, with the joint limit.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from math import isnan
from pathlib import Path
from textwrap import indent
from typing import Any

from ...simulation.parquet_files import arrow
from ...values.coding_loss import LATERAL_X
from ...values.errors import StudyError
from ...values.line import Status
from ...values.text_table import aligned
from ..codes import CODES
from ..metrics import Figure, Score
from ..scenes.carriers import scenes_rows, scenes_text
from ..sets import LineSet
from .plan import (
    DEFAULT_CODE,
    LIMIT_PARTS,
    Plan,
    Study,
    StudyDirectory,
    chunk_key,
    codec_of,
    limit_key,
    scenes_key,
    theory,
)
from .tasks import WORST

#: Outcomes whose shares are in the tables; "clipped" are means that were clipped to their range.
SHARES = ("not_positive_definite", "overconfident", "saturated", "out_of_range", "clipped")
#: Relative deviation from theory that ``summary_text`` reports.
TOLERANCE = 0.03

Row = dict[str, Any]


def write_tables(study: Study, directory: StudyDirectory) -> None:
    """Add up the results of all tasks, and write a Parquet file for each table.

    Raises:
        StudyError: the file of a result is damaged.
        MissingExtraError: pyarrow is not installed.
    """
    rows: dict[str, list[Row]] = {name: [] for name in TABLES}
    for place, line_set in enumerate(study.sets):
        sums = _Sums(study, directory, place, line_set)
        rows["summary"] += sums.summary()
        rows["fields"] += sums.fields()
        rows["terms"] += sums.terms()
        rows["worst"] += sums.worst()
        for part in LIMIT_PARTS if study.limit_n else ():
            result = directory.result(limit_key(place, part))
            rows["limit"] += [{"set": line_set.name, "part": part} | row for row in result["rows"]]
    for lines, sizes in study.scene_sizes.items():
        keys = (scenes_key(lines, index) for index in range(len(sizes)))
        rows["scenes"] += scenes_rows(lines, map(directory.result, keys))
    for name, of_table in rows.items():
        directory.write(f"{name}.parquet", _as_parquet(of_table, SCHEMAS[name]))


def read_table(folder: Path, name: str) -> list[Row]:
    """Return the rows of one of ``TABLES``.

    Raises:
        MissingExtraError: pyarrow is not installed.
        StudyError: the table does not exist, is not readable, or lacks columns.
    """
    pa, path = arrow(), folder / f"{name}.parquet"
    if not path.is_file():
        raise StudyError(f"{path}: is missing; a sweep writes it when it is complete")
    try:
        table = pa.parquet.ParquetFile(path).read()
    except (pa.ArrowException, OSError) as error:
        raise StudyError(f"{path}: cannot be read as Parquet: {error}") from error
    if missing := [column for column in SCHEMAS[name] if column not in table.column_names]:
        raise StudyError(f"{path}: lacks the columns {', '.join(missing)}")
    rows: list[Row] = table.to_pylist()
    return rows


class _Sums:
    """The scores of one set, added up over its chunks in their order."""

    def __init__(
        self, study: Study, directory: StudyDirectory, place: int, line_set: LineSet
    ) -> None:
        self.name, self.seed = line_set.name, study.seed
        self.scores: dict[Plan, Score] = {}
        self.field_scores: dict[Plan, Score] = {}
        self.term_scores: dict[Plan, Score] = {}
        self.seconds: dict[Plan, float] = {}
        self.worst_cases: dict[Plan, list[Row]] = {}
        for index in range(len(line_set.sizes(study.n, study.chunk_size))):
            result = directory.result(chunk_key(place, index))
            for entry in result["scores"]:
                plan = Plan(*entry["plan"])
                _add(self.scores, plan, entry["score"])
                self.seconds[plan] = self.seconds.get(plan, 0.0) + entry["seconds"]
                if "terms" in entry:
                    _add(self.term_scores, plan, entry["terms"])
                # The sort is stable: among equals, the first of the set come first.
                cases = self.worst_cases.get(plan, []) + entry.get("worst", [])
                self.worst_cases[plan] = sorted(cases, key=lambda case: -case["kl"])[:WORST]
            for entry in result["fields"]:
                _add(self.field_scores, Plan(*entry["plan"]), entry["score"])

    def summary(self) -> Iterator[Row]:
        """Yield a row for each code and width."""
        for plan, score in self.scores.items():
            n, seconds, figures = score.counts["n"], self.seconds[plan], score.figures
            row = self._row(plan) | {"n": n, "seed": self.seed}
            row["definite_guarantee"] = CODES[plan.code].positive_definite
            row["covering_guarantee"] = CODES[plan.code].covering
            for name in SHARES:
                row[name], row[f"{name}_se"] = score.share(name)
            kl = figures["kl"]
            row |= _mean("kl", kl) | {"kl_max": kl.greatest if kl.count else None}
            for percent in (50, 99):
                row[f"kl_p{percent}"] = kl.quantile(percent / 100)
                row[f"kl_p{percent}_se"] = kl.quantile_se(percent / 100)
            row |= _mean("kl_untouched", figures["kl_untouched"])
            terms = self.term_scores.get(plan)
            row |= _mean("kl_before_inflation", terms.figures["kl"] if terms else Figure())
            row["kl_theory"] = sum(theory(codec_of(plan)).values()) or None
            for x in LATERAL_X:
                error, ratio = figures[f"mean_error_{x:g}"], figures[f"sigma_ratio_{x:g}"]
                row[f"mean_error_rms_{x:g}"] = error.rms
                row[f"mean_error_max_{x:g}"] = error.greatest if error.count else None
                row[f"sigma_ratio_min_{x:g}"] = ratio.least if ratio.count else None
                row[f"sigma_ratio_p50_{x:g}"] = ratio.quantile(0.5)
                row[f"sigma_ratio_p99_{x:g}"] = ratio.quantile(0.99)
            clipped = figures["clipped_error_80"]
            row["clipped_error_max_80"] = clipped.greatest if clipped.count else None
            row |= {"seconds": seconds, "gaussians_per_second": n / seconds if seconds else None}
            yield row

    def fields(self) -> Iterator[Row]:
        """Yield a row for each field of the default code with a bit more or less."""
        for plan, score in self.field_scores.items():
            row = self._row(plan) | {"n": score.counts["n"]}
            row |= _mean("kl", score.figures["kl"])
            row |= _mean("kl_change", score.figures["kl_change"])
            row["saturated"], row["saturated_se"] = score.share("saturated")
            row["lateral_rms_80"] = score.figures["mean_error_80"].rms
            yield row

    def terms(self) -> Iterator[Row]:
        """Yield a row for each field of the default code at each width."""
        for plan, score in self.term_scores.items():
            for name, expected in theory(codec_of(plan)).items():
                row = self._row(plan) | {"field": name, "n": score.counts["n"]}
                row |= _mean("kl", score.figures[name]) | {"kl_theory": expected}
                row["rounded_to_zero"] = score.share(name)[0] if name in score.counts else None
                yield row

    def worst(self) -> Iterator[Row]:
        """Yield a row for each of the worst cases of each code at its own widths."""
        for plan, cases in self.worst_cases.items():
            for rank, case in enumerate(cases, 1):
                row = self._row(plan) | {"rank": rank, "kl": case["kl"], "status": case["status"]}
                for prefix in ("", "decoded_"):
                    values = (*case[f"{prefix}mean"], *case[f"{prefix}cov"])
                    row |= dict(zip(_gaussian_names(prefix), values, strict=True))
                yield row

    def _row(self, plan: Plan) -> Row:
        """Return the columns that say what a row is about."""
        codec = codec_of(plan)
        return {
            "set": self.name,
            **plan._asdict(),
            "covariance_bits": sum(signal.length for signal in codec.covariance.signals),
            "record_bits": 8 * codec.layout.record_bytes,
            "classic_frames": codec.layout.pages,
        }


def _add(scores: dict[Plan, Score], plan: Plan, data: Row) -> None:
    score = Score.from_json(data)
    scores[plan] = scores[plan] + score if plan in scores else score


def _mean(name: str, figure: Figure) -> Row:
    return {f"{name}_mean": figure.mean, f"{name}_mean_se": figure.mean_se}


# ---- Parquet --------------------------------------------------------------------------


def _gaussian_names(prefix: str) -> list[str]:
    cov = [f"{prefix}cov_{i}{j}" for i in range(4) for j in range(4)]
    return [*(f"{prefix}mean_{i}" for i in range(4)), *cov]


def _with_errors(*names: str) -> list[str]:
    return [column for name in names for column in (name, f"{name}_se")]


def _schema(*columns: str) -> dict[str, str]:
    return {column: _TYPES.get(column, "float64") for column in columns}


#: Types of the columns that do not hold float64.
_TYPES = {
    **dict.fromkeys(("set", "code", "field", "status", "part", "caveat"), "string"),
    **dict.fromkeys(("finer_bits", "delta_bits", "n", "seed", "rank"), "int64"),
    **dict.fromkeys(("covariance_bits", "record_bits", "classic_frames"), "int64"),
    **dict.fromkeys(("samples", "dimension", "lines", "scenes", "limit_dimension"), "int64"),
    **dict.fromkeys(("definite_guarantee", "covering_guarantee", "has_joint"), "bool"),
}
_WIDTHS = ("covariance_bits", "record_bits", "classic_frames")
_OF_LATERAL = ("mean_error_rms", "mean_error_max", "sigma_ratio_min", "sigma_ratio_p50")
#: The columns of each table and their types, in their order.
SCHEMAS = {
    "summary": _schema(
        *("set", "code", "finer_bits", "n", "seed", *_WIDTHS),
        *("definite_guarantee", "covering_guarantee"),
        *_with_errors("not_positive_definite", "overconfident", "saturated", "out_of_range"),
        *(*_with_errors("kl_mean", "kl_p50", "kl_p99"), "kl_max"),
        *(*_with_errors("kl_untouched_mean", "kl_before_inflation_mean"), "kl_theory"),
        *(f"{name}_{x:g}" for name in (*_OF_LATERAL, "sigma_ratio_p99") for x in LATERAL_X),
        *("clipped", "clipped_se", "clipped_error_max_80", "seconds", "gaussians_per_second"),
    ),
    "fields": _schema(
        *("set", "code", "field", "delta_bits", *_WIDTHS, "n"),
        *(*_with_errors("kl_mean", "kl_change_mean", "saturated"), "lateral_rms_80"),
    ),
    "terms": _schema(
        *("set", "code", "finer_bits", "field", "n"),
        *(*_with_errors("kl_mean"), "kl_theory", "rounded_to_zero"),
    ),
    "worst": _schema(
        *("set", "code", "rank", "kl", "status"),
        *(*_gaussian_names(""), *_gaussian_names("decoded_")),
    ),
    "limit": _schema(
        *("set", "part", "entropy_bits", "se_bits", "bias_bits", "kl", "bits"),
        *("samples", "dimension", "caveat"),
    ),
    "scenes": _schema(
        *("lines", "code", "scenes", "has_joint", "frames", "mean_bits", "joint_bits"),
        *("limit_kl", "limit_bits", "limit_se_bits", "limit_dimension", "over_bits"),
        *("not_positive_definite", "overconfident", "left_out", "all_entries"),
        *("kl_line_mean", "kl_line_p99", "kl_joint_mean"),
        *("far_p50", "far_p99", "width_p50", "width_p99", "centre_p50", "centre_p99"),
    ),
}
TABLES = tuple(SCHEMAS)


def _as_parquet(rows: Iterable[Row], schema: dict[str, str]) -> bytes:
    pa = arrow()
    types = pa.schema([(name, pa.type_for_alias(kind)) for name, kind in schema.items()])
    known = [{name: _known(row.get(name)) for name in schema} for row in rows]
    buffer = io.BytesIO()
    pa.parquet.write_table(pa.Table.from_pylist(known, schema=types), buffer)
    return buffer.getvalue()


def _known(value: Any) -> Any:
    """Return None for NaN: unknown values are null in the tables."""
    return None if isinstance(value, float) and isnan(value) else value


# ---- text -----------------------------------------------------------------------------

_HEAD = (
    *("code", "finer", "bits", "frames", "indefinite", "overconfident", "saturated", "lost"),
    *("KL mean", "+-", "50 %", "99 %", "sigma 50 %", "99 %", "mean"),
)


def summary_text(summary: Sequence[Row], terms: Sequence[Row], scenes: Sequence[Row] = ()) -> str:
    """Format cost and quality of each code as plain text, of the default code at all widths.

    Args:
        summary: rows of that table.
        terms: rows of that table.
        scenes: rows of that table.
    """
    lines: list[str] = []
    for name in dict.fromkeys(row["set"] for row in summary):
        of_set = [row for row in summary if row["set"] == name]
        cells = [
            _cells(row) for row in of_set if not row["finer_bits"] or row["code"] == DEFAULT_CODE
        ]
        lines.append(f"{name}: {of_set[0]['n']} Gaussians")
        lines.append(indent(aligned([_HEAD, *cells], left=1), "  "))
        lines += ["", *_theory_lines(of_set, [row for row in terms if row["set"] == name])]
    lines += [
        "KL [nat] is of the covered target, over lines that are definite and in range. At "
        f"{LATERAL_X[-1]:g} m: sigma of the",
        "lateral position, decoded over true, and the error of the mean line (rms), without means",
        f"that were clipped to their range, which the covariance covers. lost: "
        f"{Status.OUT_OF_RANGE.name}.",
    ]
    if scenes:
        lines += ["", scenes_text(scenes)]
    return "\n".join(lines)


def _cells(row: Row) -> list[str]:
    return [
        row["code"],
        f"{row['finer_bits']:+d}" if row["finer_bits"] else "0",
        str(row["covariance_bits"]),
        str(row["classic_frames"]),
        *(f"{100 * row[name]:.3g} %" if row[name] else "0" for name in SHARES[:4]),
        _number(row["kl_mean"]),
        _number(row["kl_mean_se"], 2),
        *(_number(row[f"kl_p{percent}"]) for percent in (50, 99)),
        *(_number(row[f"sigma_ratio_p{percent}_80"], 4) for percent in (50, 99)),
        "-" if row["mean_error_rms_80"] is None else f"{1e3 * row['mean_error_rms_80']:.2f} mm",
    ]


def _theory_lines(summary: Sequence[Row], terms: Sequence[Row]) -> Iterator[str]:
    """Yield how near the default code is to its theory, and which fields are not."""
    of_code = [row for row in summary if row["kl_before_inflation_mean"] is not None]
    if not of_code:
        return
    yield f"{DEFAULT_CODE}, KL before inflation where nothing saturates, over its theory:"
    for row in of_code:
        measured, expected = row["kl_before_inflation_mean"], row["kl_theory"]
        error = (row["kl_before_inflation_mean_se"] or 0.0) / expected
        off = [
            f"{term['field']} {term['kl_mean'] / term['kl_theory']:.2f}"
            + (f" ({100 * zero:.0f} % are 0)" if (zero := term["rounded_to_zero"]) else "")
            for term in terms
            if term["finer_bits"] == row["finer_bits"]
            and abs(term["kl_mean"] / term["kl_theory"] - 1) > TOLERANCE
        ]
        yield (
            f"  {row['finer_bits']:>+2d} bits: {measured:.3e} / {expected:.3e} = "
            f"{measured / expected:.3f} +- {error:.1g}"
            + (f"; by field: {', '.join(off)}" if off else "")
        )
    yield ""


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}g}"
