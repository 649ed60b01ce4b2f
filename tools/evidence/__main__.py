"""Measure what docs/promises.md states, and compare the figures with its bounds.

    python tools/evidence                          list all evidence, with its options
    python tools/evidence fusion.ways              measure this at its full size
    python tools/evidence lines n=150 by=scene     with options
    python tools/evidence scenes slots --quick     all of these modules, with few samples
    python tools/evidence --write                  write docs/promises.md and the residual error
                                                   rates of docs/assurance.md

Run it in the environment of the project: python3 tools/run.py python tools/evidence ...

A share or an rms of fewer than 400 independent cases has four standard errors of room beyond its
bound; other figures have none. The exit status is 1 if a bound is missed.
"""

from __future__ import annotations

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[1])  # the folder of the package
    from evidence.harness import main

    sys.exit(main(__doc__))
