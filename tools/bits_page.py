#!/usr/bin/env python3
"""Write the tables of docs/bits.md from the tables of a study and from custom designs.

    maplines study run --out sweep --n 200000
    python tools/bits_page.py sweep
    python tools/bits_page.py sweep --only scenes     one of the tables

Run it in the project's environment: python3 tools/run.py python tools/bits_page.py sweep
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from reporting import fill_tables, parser_of

from maplines_can.bus import frame_bits
from maplines_can.study.design.planner import Targets
from maplines_can.study.design.search import design, sets_of
from maplines_can.study.production_messages import as_markdown, production_table
from maplines_can.study.scenes.carriers import SCENE_HEAD, WITH_POSE, scene_cells

PAGE = Path(__file__).resolve().parents[1] / "docs" / "bits.md"
HELD_OUT_SEED = 1_000_003
TARGETS = (1e-2, 1e-3, 1e-4)
#: Of the load of a bus of classic CAN: bit rate [1/s], and rates of the scenes [Hz].
BITRATE, RATES = 500_000.0, (20, 50)
#: Codes that docs/bits.md compares on scenes.
SCENE_CODES = ("Cholesky", "Float32", *(code for code, one in WITH_POSE.items() if not one.fd))


#: Columns of the table of scenes, beside the bus loads.
SCENE_COLUMNS = (
    "frames",
    "cov",
    "limit",
    "over",
    "overconfident",
    "KL joint",
    "width 50 %",
    "centre 50 %",
    "all entries",
)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("folder", type=Path, help="directory that 'maplines study run --out' wrote")
    parser.add_argument("--only", metavar="NAME", help="write only the table of this name")
    options = parser.parse_args()
    folder, only = options.folder, options.only
    names = ("summary", "limit", "scenes")
    summary, limit, scenes = (
        pq.read_table(folder / f"{name}.parquet").to_pylist() for name in names
    )
    n, seed = summary[0]["n"], summary[0]["seed"]
    makers: dict[str, Callable[[], str]] = {
        "source": lambda: (
            f"    maplines study run --out sweep --n {n} --seed {seed}\n"
            "    python tools/bits_page.py sweep"
        ),
        "paper": lambda: codes([row for row in summary if row["set"] == "paper"]),
        "road": lambda: codes([row for row in summary if row["set"] == "road"]),
        "limit": lambda: over_the_limit(summary, limit),
        "scenes": lambda: of_scenes(scenes),
        "designs": designs,
        "messages": lambda: production()[0],
        "steps": lambda: production()[2],
    }
    if only is not None and only not in makers:
        parser.error(f"there is no table {only}; choose from {', '.join(makers)}")
    sections = {name: make() for name, make in makers.items() if only in (None, name)}
    PAGE.write_text(fill_tables(PAGE.read_text(), "bits_page.py", sections))
    print(f"docs/{PAGE.name}: written")
    return 0


def table(head: Any, rows: Any) -> Any:
    """Return a Markdown table whose first column is text."""
    lines = [[*head], ["---"] + ["---:"] * (len(head) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def codes(rows: Any) -> Any:
    """Return all codes at their own widths."""
    head = ["code", "bits", "frames", "not definite", "overconfident", "KL mean", "KL 99 %"]
    body = [
        [
            row["code"],
            str(row["covariance_bits"]),
            str(row["classic_frames"]),
            *(share(row[name]) for name in ("not_positive_definite", "overconfident")),
            *(number(row[name]) for name in ("kl_mean", "kl_p99")),
            *(number(row[f"sigma_ratio_p{p}_80"], 4) for p in (50, 99)),
        ]
        for row in rows
        if not row["finer_bits"]
    ]
    return table([*head, "sigma at 80 m: 50 %", "99 %"], body)


def over_the_limit(summary: Any, limit: Any) -> Any:
    """Return the bits of the default code at each KL, and how many fewer could do."""
    body = []
    for name in dict.fromkeys(row["set"] for row in limit):
        widths = [row for row in summary if (row["set"], row["code"]) == (name, "Cholesky")]
        # Bits are linear in log KL: a bit more in all fields divides KL by four.
        slope, offset = np.polyfit(
            [np.log2(row["kl_untouched_mean"]) for row in widths],
            [row["covariance_bits"] for row in widths],
            1,
        )
        for kl in TARGETS:
            (row,) = (
                row
                for row in limit
                if (row["set"], row["part"]) == (name, "covariance")
                and abs(row["kl"] / kl - 1) < 1e-9
            )
            spent = slope * np.log2(kl) + offset
            low, high = sorted((row["bits"], row["bits"] - row["bias_bits"]))
            body.append(
                [
                    f"{name}, {kl:g}",
                    f"{spent:.0f}",
                    f"{low:.0f} to {high:.0f}",
                    f"{spent - high:.0f} to {spent - low:.0f}",
                ]
            )
    return table(["set and KL", "bits of the default code", "limit [bit]", "over the limit"], body)


def of_scenes(scenes: Any) -> Any:
    """Return the codes whose joint covariances have a limit, and what it is."""
    body = []
    for row in scenes:
        if row["code"] in SCENE_CODES:
            cells = dict(zip(SCENE_HEAD, scene_cells(row), strict=True))
            bits = (row["frames"] or 0) * frame_bits(8).nominal
            loads = [f"{100 * bits * rate / BITRATE:.1f} %" for rate in RATES]
            kept = [cells[name] for name in SCENE_COLUMNS]
            body.append([f"{row['code']}, {row['lines']} lines", kept[0], *loads, *kept[1:]])
    loads = [f"load at {rate} Hz" for rate in RATES]
    return table(["code", SCENE_COLUMNS[0], *loads, *SCENE_COLUMNS[1:]], body)


def designs() -> Any:
    """Return the designs for 3, 4 and 5 classic frames."""
    sets = sets_of("road", 5000, 0)
    held_out = sets_of("both", 5000, HELD_OUT_SEED)
    body = []
    for frames in (3, 4, 5):
        made = design(sets, Targets(frames=frames), held_out=held_out)
        bits = {spec.name: spec.bits for page in made.writer.pages for spec in page}
        mean = sum(bits[name] for name in ("YOff", "Beta", "C0", "C1"))
        cov = sum(b for name, b in bits.items() if name.startswith(("Pivot", "Ratio", "Infl")))
        road, paper = made.measured["road"], made.measured["paper"]
        body.append(
            [
                f"{frames} frames",
                str(mean),
                str(cov),
                number(road.kl_mean),
                number(road.kl_p99),
                share(road.saturated),
                f"{1e3 * road.lateral_error:.3g} mm",
                number(paper.kl_mean),
                share(paper.saturated),
            ]
        )
    head = ["made for *road*", "bits of the mean", "of the covariance", "road: KL mean", "99 %"]
    return table([*head, "saturated", "error at 80 m", "paper: KL mean", "saturated"], body)


def production() -> list[str]:
    """Return the tables of production messages: signals, bits of quality, steps, and others."""
    return [part.strip() for part in as_markdown(production_table(100)).split("\n\n")]


def share(value: Any) -> Any:
    return f"{100 * value:.3g} %" if value else "0"


def number(value: Any, digits: int = 3) -> Any:
    return "-" if value is None else f"{value:.{digits}g}"


if __name__ == "__main__":
    sys.exit(main())
