"""The command ``maplines scenarios``."""

from __future__ import annotations

import argparse
import json
from typing import Any

from ..scenarios import SCENARIOS, STREETS
from .options import add_json
from .parsing import add_command


def add_scenarios(commands: Any) -> None:
    """Add the command ``scenarios``."""
    description = "List the scenes that 'send' and 'demo' can send."
    parser = add_command(
        commands, "scenarios", _scenarios, description, "maplines scenarios --json"
    )
    add_json(parser, "the scenes")


def _scenarios(arguments: argparse.Namespace) -> int:
    if arguments.json:
        rows = [
            {
                "name": scene.name,
                "about": scene.about,
                "ego_sigma": scene.ego.sigma.tolist(),
                "window": scene.window,
                "lines": [slot.name for slot in scene.lines],
            }
            for scene in (SCENARIOS | STREETS).values()
        ]
        print(json.dumps(rows, indent=2))
    else:
        for scene in (SCENARIOS | STREETS).values():
            print(f"{scene.name:<20}{scene.about}")
    return 0
