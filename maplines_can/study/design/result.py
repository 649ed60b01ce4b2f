"""A design and its figures, as text, as a page in Markdown and for JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from ...values.output_files import whole_file
from ...wire.layout.signals import PARAMETER_SIGNALS
from ..dbc.dbc_writer import DbcWriter
from ..text_table import aligned, markdown
from .plan import Prediction, Targets


@dataclass(frozen=True)
class LayoutFigures:
    """Figures of a message layout on a set."""

    cases: int
    kl_mean: float  #: of the covered target, with the inflation [nat]
    kl_p99: float
    kl_max: float
    kl_untouched_mean: float  #: of the true covariance, which the mean's grid blurs [nat]
    kl_untouched_median: float
    saturated: float  #: share of lines
    out_of_range: float  #: share of lines
    not_definite: int
    overconfident: int
    lateral_error: float  #: largest at 80 m [m]


@dataclass(frozen=True, eq=False)
class Design:
    """A message layout and its figures."""

    writer: DbcWriter
    targets: Targets
    order: tuple[str, ...]  #: rows of the covariance, as signals of the mean
    mean_bits: int
    covariance_bits: int
    spare_bits: int  #: of no signal
    predicted: Prediction
    measured: Mapping[str, LayoutFigures]  #: by set, of lines that the search has not seen

    @property
    def frames(self) -> int:
        """Number of classic frames of a line."""
        return len(self.writer.pages)

    @property
    def _bits(self) -> str:
        return (
            f"{self.mean_bits} bits of mean, {self.covariance_bits} of covariance, "
            f"{self.spare_bits} spare"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return all figures and all fields, for JSON."""
        fields = [
            {"name": spec.name, "page": page, "bits": spec.bits, "factor": spec.factor}
            | {"offset": spec.offset, "signed": spec.signed}
            for page, specs in enumerate(self.writer.pages)
            for spec in specs
        ]
        return {
            "targets": asdict(self.targets),
            "frames": self.frames,
            "order": list(self.order),
            "mean_bits": self.mean_bits,
            "covariance_bits": self.covariance_bits,
            "spare_bits": self.spare_bits,
            "predicted": asdict(self.predicted),
            "measured": {name: asdict(figures) for name, figures in self.measured.items()},
            "fields": fields,
        }

    def text(self) -> str:
        """Return bits, figures and fields for a terminal."""
        lines = [
            f"{self.frames} classic frames: {self._bits}",
            f"rows of the covariance: {', '.join(self.order)}",
            "",
            aligned(self._figures(), left=1),
            "",
        ]
        for spec in chain(*self.writer.pages):
            if spec.name.startswith(("Pivot", "Ratio", "Inflation", *PARAMETER_SIGNALS)):
                low, high = spec.range
                lines.append(
                    f"{spec.name:<14}{spec.bits:>3} bits{spec.factor:>13.6g}  "
                    f"{low:.6g} .. {high:.6g} {spec.unit}".rstrip()
                )
        return "\n".join(lines)

    def page(self, name: str, command: str = "") -> str:
        """Return the page for the DBC, in Markdown.

        Args:
            name: of the DBC's file.
            command: that made it.
        """
        made_by = f"Made by\n\n    {command}\n\n" if command else ""
        targets = "\n".join(f"- {text}" for text in self._targets_text())
        return (
            f"# {name}\n\n"
            f"A map line in {self.frames} classic CAN frames: {self._bits}. Rows of the "
            f"covariance: {', '.join(self.order)}. The README of dbc/ explains how the fields "
            f"represent a Gaussian, and the other signals.\n\n{made_by}"
            f"## Targets\n\n{targets}\n\n"
            f"## Figures\n\n{markdown(self._figures())}\n"
            f"## Fields\n\n{self.writer.table()}\n"
        )

    def _targets_text(self) -> list[str]:
        t = self.targets
        texts = [
            (t.frames, f"{t.frames} classic frames"),
            (t.max_kl, f"KL of the covered target, mean over each set: {t.max_kl} nat at most"),
            (t.ranges, "ranges: " + ", ".join(f"{k} +-{v:g}" for k, v in t.ranges.items())),
            (t.sigmas, "sigmas up to " + ", ".join(f"{k} {v:g}" for k, v in t.sigmas.items())),
            (t.keep_mean, "the mean as in the project's own DBC"),
            (True, f"rounding of the mean at 80 m: {1000 * t.max_lateral:g} mm at most"),
            (True, f"saturated lines: {100 * t.max_saturated:g} % at most"),
        ]
        return [text for given, text in texts if given]

    def _figures(self) -> list[list[str]]:
        p = self.predicted
        blurred = "KL with the blur by the mean's grid, median"
        number, share, mm = "{:.3g}".format, _percent, _millimetres
        #: Heading, predicted text, name of the measured figure, and its format.
        rows: list[tuple[str, str, str, Callable[[float], str]]] = [
            ("lines", "-", "cases", str),
            ("KL, mean", number(p.kl_mean), "kl_mean", number),
            ("KL, 99 %", number(p.kl_p99), "kl_p99", number),
            ("KL, worst", "-", "kl_max", number),
            (blurred, number(p.kl_mean + p.blur), "kl_untouched_median", number),
            ("saturated lines", share(p.saturated), "saturated", share),
            ("lines out of range", "-", "out_of_range", share),
            ("worst lateral error at 80 m [mm]", mm(p.lateral_error), "lateral_error", mm),
            ("not definite", "0", "not_definite", str),
            ("overconfident", "0", "overconfident", str),
        ]
        return [["", "predicted", *(f"measured: {name}" for name in self.measured)]] + [
            [heading, predicted, *(text(getattr(f, name)) for f in self.measured.values())]
            for heading, predicted, name, text in rows
        ]

    def write(self, path: str | Path, command: str = "") -> tuple[Path, Path]:
        """Write the DBC, and its page with the same name and the suffix ``.md``."""
        dbc = Path(path).with_suffix(".dbc")
        page = dbc.with_suffix(".md")
        with whole_file(dbc) as part, whole_file(page) as part_of_page:
            part.write_text(self.writer.dbc())
            part_of_page.write_text(self.page(dbc.name, command))
        return dbc, page


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def _millimetres(length: float) -> str:
    return f"{1000 * length:.3g}"
