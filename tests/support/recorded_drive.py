"""Logs of a simulated drive on the map of the package, for tests of recordings."""

from __future__ import annotations

from pathlib import Path

from maplines_can.cli import main


def record(path: Path, *options: str, seconds: float = 12.0) -> Path:
    """Record a drive with these options of ``maplines drive``."""
    drive = ["drive", "--as-fast-as-possible", "--seconds", str(seconds), "--record", str(path)]
    assert main([*drive, "--seed", "1", *options]) == 0
    return path
