"""tools/evidence_levels.py: a level that is too low is found."""

import json

import evidence_levels as tool
import numpy as np
import pytest

from maplines_can.consumers.integrity import Tolerance


def test_hours_of_white_noise_are_those_of_independent_samples() -> None:
    """The largest of 72000: its median is where each sample is within with 0.5^(1 / 72000)."""
    row = tool.Row(((1.0, 0.0),))
    found = tool.largest(row, 60, np.random.default_rng(0))
    assert np.median(found) == pytest.approx(4.42, abs=0.1)


def test_a_level_that_is_too_low_is_found(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    good = tool.ROWS["sigma 30 % greater"]
    monkeypatch.setattr(tool, "ROWS", {"good": good})
    assert tool.main(["--hours", "60", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["good"]
    assert found["exact"]["share of the hours"] > 0.5
    assert found["range"]["share of the hours"] < 0.2
    monkeypatch.setattr(tool, "ROWS", {"bad": good._replace(tolerance=Tolerance())})
    assert tool.main(["--hours", "60"]) == 1
