"""The command ``maplines scenarios``."""

from __future__ import annotations

import argparse
import json
from typing import Any

from ..scenarios import SCENARIOS
from .options import add_job, add_json

__all__ = ["add_scenarios"]


def add_scenarios(jobs: Any) -> None:
    """Add the job ``scenarios`` to those of ``maplines``."""
    parser = add_job(jobs, "scenarios", _scenarios, "List the scenes.", "maplines scenarios --json")
    add_json(parser)


def _scenarios(arguments: argparse.Namespace) -> int:
    if arguments.json:
        rows = [
            {
                "name": scene.name,
                "about": scene.about,
                "ego_sigma": scene.ego.sigma.tolist(),
                "window": scene.window,
                "lines": [line.slot.name for line in scene.lines],
            }
            for scene in SCENARIOS.values()
        ]
        print(json.dumps(rows, indent=2))
    else:
        for scene in SCENARIOS.values():
            print(f"{scene.name:<20}{scene.about}")
    return 0
