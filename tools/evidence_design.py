#!/usr/bin/env python3
"""Evaluate designs of the wire.

    evidence_design.py frames    3, 4 and 5 classic frames for the set road: bits and figures
    evidence_design.py default   dbc/maplines.dbc follows from its targets, field by field

Run it in the project's environment: python3 tools/run.py python tools/evidence_design.py ...

The exit status is nonzero if a bound is missed.
"""

import sys
import time
from typing import Any

from reporting import bar, parser_of

from maplines_can.study.dbc.record_spec import DEFAULT
from maplines_can.study.design.plan import Targets
from maplines_can.study.design.search import design, sets_of
from maplines_can.wire.layout.message_layout import PARAMETER_SIGNALS

#: The targets in dbc/README.md.
OF_THE_DEFAULT = Targets(
    frames=4,
    keep_mean=True,
    max_saturated=0.002,
    sigmas={"y_off": 41.0, "beta": 0.65, "c0": 0.17, "c1": 0.047},
)
HELD_OUT_SEED = 1_000_003


def frames(n: Any) -> Any:
    """Return whether designs are definite and cover, and three frames keep KL below 0.02."""
    sets, held_out = (sets_of("road", n, seed) for seed in (0, HELD_OUT_SEED))
    held_out |= sets_of("paper", n, HELD_OUT_SEED)
    met = True
    for count in (3, 4, 5):
        made = designed(sets, Targets(frames=count), held_out)
        figures = made.measured["road"]
        met &= count > 3 or figures.kl_mean <= 0.02
        met &= not any(f.not_definite or f.overconfident for f in made.measured.values())
    return met


def default(n: Any) -> bool:
    """Return whether the search gives the default DBC again."""
    sets, held_out = (sets_of("both", n, seed) for seed in (1, 1 + HELD_OUT_SEED))
    made = designed(sets, OF_THE_DEFAULT, held_out)
    found, own = of_covariance(made.writer), of_covariance(DEFAULT)
    for name in sorted({*found, *own}):
        if found.get(name) != own.get(name):
            print(f"{name}: {found.get(name)} instead of {own.get(name)} (bits, factor, range)")
    return found == own


def designed(sets: Any, targets: Any, held_out: Any) -> Any:
    started = time.perf_counter()
    with bar(100, unit=" %", leave=False) as percents:
        made = design(
            sets,
            targets,
            held_out=held_out,
            progress=lambda done, _: percents.update(round(100 * done) - percents.n),
        )
    print(f"{made.text()}\n{time.perf_counter() - started:.1f} s\n")
    return made


def of_covariance(writer: Any) -> Any:
    kept = (*PARAMETER_SIGNALS, "Inflation")
    return {
        spec.name: (spec.bits, spec.factor, spec.range)
        for page in writer.pages
        for spec in page
        if spec.name in kept or spec.name.startswith(("Pivot", "Ratio"))
    }


def main() -> Any:
    parser = parser_of(__doc__)
    jobs = {"frames": (frames, 5000), "default": (default, 15_000)}
    parser.add_argument("what", choices=jobs)
    parser.add_argument("-n", type=int, help="lines of each set; by default 5000 and 15000")
    arguments = parser.parse_args()
    job, n = jobs[arguments.what]
    met = job(arguments.n or n)
    print("met" if met else "missed")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
