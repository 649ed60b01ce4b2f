"""The command ``maplines scenarios``."""

from __future__ import annotations

import argparse
import json
from typing import Any

from ..simulation.scenarios import SCENARIOS, STREETS
from .parsing import add_command, add_json


def add_scenarios(commands: Any) -> None:
    """Add the command ``scenarios``."""
    description = "List the scenarios that 'send' and 'demo' can send."
    parser = add_command(
        commands, "scenarios", _scenarios, description, "maplines scenarios --json"
    )
    add_json(parser, "the scenarios")


def _scenarios(arguments: argparse.Namespace) -> int:
    if arguments.json:
        rows = [
            {
                "name": scenario.name,
                "about": scenario.about,
                "ego_sigma": scenario.ego.sigma.tolist(),
                "window": scenario.window,
                "lines": [slot.name for slot in scenario.lines],
            }
            for scenario in (SCENARIOS | STREETS).values()
        ]
        print(json.dumps(rows, indent=2))
    else:
        for scenario in (SCENARIOS | STREETS).values():
            print(f"{scenario.name:<20}{scenario.about}")
    return 0
