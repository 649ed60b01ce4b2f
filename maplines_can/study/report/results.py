"""The tables of a sweep as rows, checked, and numbers as text."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from ...values.errors import StudyError
from ..codes import CODES
from ..sweep.summary import TABLES, Row, read_table

#: Columns of the summary with a KL divergence, and their names in the report. The median comes
#: first, because the mean is dominated by a few outliers of up to 1e10 times the median.
SUMMARY = {
    "kl_p50": "KL of the covered target, median",
    "kl_p99": "KL of the covered target, 99 %",
    "kl_max": "KL of the covered target, largest",
    "kl_mean": "KL of the covered target, mean",
    "kl_before_inflation_mean": "KL before the inflation, mean",
    "kl_theory": "KL predicted by theory",
    "kl_untouched_mean": "KL of the true Gaussian, mean",
}
#: The rate-distortion limit is an approximation for high rates, and does not hold for a larger KL.
MAX_KL = 0.1


@dataclass(frozen=True, eq=False)
class Tables:
    """The tables of a sweep, as rows."""

    summary: list[Row]
    fields: list[Row]
    worst: list[Row]
    limit: list[Row]
    scenes: list[Row]

    @property
    def sets(self) -> list[str]:
        """Names of the sets, in the order of the summary."""
        return list(dict.fromkeys(row["set"] for row in self.summary))

    @property
    def codes(self) -> list[str]:
        """Names of the codes: the project's in their order, then others."""
        seen = dict.fromkeys(row["code"] for row in self.summary)
        return [code for code in CODES if code in seen] + [c for c in seen if c not in CODES]

    def of(self, set_: str, code: str) -> list[Row]:
        """Return the rows of the summary for one code, by its bits."""
        rows = [row for row in self.summary if (row["set"], row["code"]) == (set_, code)]
        return sorted(rows, key=lambda row: row["covariance_bits"])

    def shipped(self, set_: str, code: str) -> Row | None:
        """Return the row of the code with the widths of its DBC, or with the nearest ones."""
        return min(self.of(set_, code), key=lambda row: abs(row["finer_bits"]), default=None)

    def shipped_of(self, set_: str) -> list[Row]:
        """Return the rows of all codes on a set, with the widths of their DBCs."""
        return [row for code in self.codes if (row := self.shipped(set_, code))]

    def limit_of(self, set_: str) -> list[Row]:
        """Return the rate-distortion limit of a set, by KL; empty if it is not known."""
        rows = [
            row
            for row in self.limit
            if (row["set"], row["part"]) == (set_, "covariance")
            and math.isfinite(row["bits"])
            and row["kl"] > 0
        ]
        return sorted(rows, key=lambda row: row["kl"])

    def limit_bits(self, set_: str, kl: float) -> float | None:
        """Return the bits of the covariance at the limit.

        The table is interpolated and extrapolated linearly in log KL, up to ``MAX_KL``.
        Return None above it, and if the limit or the KL is not known.
        """
        rows = self.limit_of(set_)
        if len(rows) < 2 or not 0 < kl <= MAX_KL:
            return None
        before = [i for i, row in enumerate(rows) if row["kl"] <= kl]
        i = min(before[-1] if before else 0, len(rows) - 2)
        low, high = rows[i], rows[i + 1]
        way = math.log(kl / low["kl"]) / math.log(high["kl"] / low["kl"])
        return float(max(0.0, low["bits"] + way * (high["bits"] - low["bits"])))

    def over_limit(self, row: Row) -> float | None:
        """Return the bits of the covariance above the limit at the KL of a row.

        Return None if the limit is not known, and if the KL leaves out matrices that are not
        positive definite.
        """
        least = self.limit_bits(row["set"], row["kl_mean"])
        if least is None or row["not_positive_definite"] > 0:
            return None
        return float(row["covariance_bits"]) - least

    def over_text(self, row: Row) -> str:
        """Return ``over_limit`` as a range: without and with the estimated bias of the limit."""
        over = self.over_limit(row)
        if over is None:
            return "-"
        bias = max(0.0, *(point["bias_bits"] for point in self.limit_of(row["set"])))
        return f"{over:.0f}" if round(bias) == 0 else f"{over:.0f} to {over + bias:.0f}"


def read_tables(folder: str | Path) -> Tables:
    """Read the tables of a sweep from a folder.

    Raises:
        MissingExtraError: pyarrow is not installed.
        StudyError: the folder or a table does not exist, is not readable, lacks columns, or the
            summary has no rows.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise StudyError(f"{folder}: there is no such folder; a sweep creates one for its tables")
    tables = {name: read_table(folder, name) for name in TABLES if name != "terms"}
    if not tables["summary"]:
        raise StudyError(f"{folder / 'summary.parquet'}: has no rows; run the sweep to its end")
    for row in chain.from_iterable(tables.values()):
        row |= {key: math.nan for key, value in row.items() if value is None}
    return Tables(**tables)


def number(value: float, digits: int = 3) -> str:
    """Return a number for a reader.

    >>> number(0.0023456), number(1234567.0), number(float("inf")), number(float("nan"))
    ('0.00235', '1,230,000', '∞', 'none')
    """
    if math.isnan(value):
        return "none"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if 1000 <= abs(value) < 1e9:
        return f"{float(f'{value:.{digits}g}'):,.0f}"
    return f"{value:.{digits}g}"


def percent(value: float) -> str:
    """Return a share in percent."""
    return f"{number(100 * value)} %" if value else "0"


def with_error(value: float, error: float) -> str:
    """Return a number and twice its standard error.

    >>> with_error(0.0023456, 0.00001), with_error(float("inf"), float("nan"))
    ('0.00235 ± 2e-05', '∞')
    """
    if not (math.isfinite(value) and math.isfinite(error) and error > 0):
        return number(value)
    return f"{number(value)} ± {number(2 * error, 1)}"


def share(value: float, error: float, n: int) -> str:
    """Return a share of n cases in percent; of none, the 95 % upper bound of the true share, 3 / n.

    >>> share(0.0, 0.0, 3000), share(0.25, 0.01, 3000)
    ('0 (true share below 0.1 %)', '25 ± 2 %')
    """
    if value == 0:
        return f"0 (true share below {number(300 / n, 1)} %)"
    return f"{with_error(100 * value, 100 * error)} %"
