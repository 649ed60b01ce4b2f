"""The command ``maplines fmu check``."""

from __future__ import annotations

import argparse
import json
from typing import Any

from ..cosimulation.checks import check
from ..cosimulation.fmu_description import read_description
from .command_line import add_command, add_json

DESCRIPTION = """\
Check FMUs against FMI-LS-BUS 1.0.0, low cut, CAN: manifest, bus terminals and their configuration,
clocks, MIME types, sizes and causality. This is what 'fmpy validate' does not check; use both.
An error breaks a rule of the standard. The exit status is 1 if there is one."""


def add_check(commands: Any) -> None:
    """Add the command ``fmu check``."""
    parser = add_command(commands, "check", _check, DESCRIPTION, "maplines fmu check sender.fmu")
    parser.add_argument("fmus", nargs="+", metavar="FMU", help="FMU to check")
    add_json(parser, "the findings")


def _check(arguments: argparse.Namespace) -> int:
    findings = {path: check(read_description(path)) for path in arguments.fmus}
    if arguments.json:
        table = {path: [one._asdict() for one in found] for path, found in findings.items()}
        print(json.dumps(table, indent=2))
    else:
        for path, found in findings.items():
            print("\n".join(f"{path}: {one}" for one in found) or f"{path}: no findings")
    return int(any(one.is_error for found in findings.values() for one in found))
