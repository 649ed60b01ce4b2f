"""The command ``maplines send``."""

import json

import pytest

from maplines_can.cli import main


def test_it_ends_after_the_count(capsys: pytest.CaptureFixture[str], channel: str) -> None:
    """Each line is sent --count times, then the counters are printed."""
    bus = ["--interface", "virtual", "--channel", channel, "--rate", "200"]
    assert main(["send", *bus, "--count", "5", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["lines"] + result["overruns"] == 20  # a busy machine may skip periods
    assert result["frames"] == 4 * result["lines"] > 0
    assert result["down"] == result["full"] == 0
