"""tools/evidence_plausibility.py: its errors are those of the model, and it finds wrong rates."""

import json
import math

import evidence_plausibility as tool
import numpy as np
import pytest


def test_the_errors_have_the_covariance_of_the_model() -> None:
    model, x = tool.model_of_lane()
    errors = tool.Errors.of_model(model, 5.0, 40_000, np.random.default_rng(0))
    z = errors.next()
    scale = np.sqrt(model.marginal.diagonal())
    found = np.cov(z.T) / scale / scale[:, None]
    assert found == pytest.approx(model.marginal / scale / scale[:, None], abs=0.03)
    assert x == pytest.approx([2.0, 20.0] * 2)


def test_the_faults_are_those_of_the_docstring() -> None:
    _, x = tool.model_of_lane()
    t = np.array([-1.0, 0.0, 10.0])
    faults = {name: fault(t) for name, fault in tool.faults(x).items()}
    assert all(not shift[0].any() for shift in faults.values())
    assert faults["shift"][1:] == pytest.approx(0.5 * np.ones((2, 4)))
    assert faults["camera"][1] == pytest.approx(math.radians(1) * x)
    assert faults["drift"][2] == pytest.approx(math.radians(1) / 6 * x)
    assert faults["lost"][2] == pytest.approx(-math.radians(0.1) * (15 * 50 + 10 * x))
    assert faults["lane"][1] == pytest.approx([3.5, 3.5, 0, 0])


@pytest.mark.parametrize(
    ("number", "met"), [(100, True), (132, True), (134, False), (68, True), (66, False)]
)
def test_a_wrong_number_of_false_alarms_is_found(number: int, met: bool) -> None:
    assert tool.FalseAlarms(100.0, number, 10.0).result(1.0)["met"] is met


def test_run_of_few_images(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A jump is found at once; what the docstring names is in the result."""
    monkeypatch.setattr(tool, "TIMES", (1.0,))
    monkeypatch.setattr(tool, "RATES", (5.0,))
    monkeypatch.setattr(tool, "OWN_TIMES", ())
    monkeypatch.setattr(tool, "LONGEST", 1.0)
    monkeypatch.setattr(tool, "HOUR", 30.0)
    tool.main(["--hours", "50", "--cars", "10", "--json"])
    result = json.loads(capsys.readouterr().out)
    row = result["correlation time 1 s"]
    assert row["5 per hour"]["hours without an alarm"] == pytest.approx(50 * 30 / 3600, rel=0.3)
    assert set(row["detection"]) == {"shift", "camera", "drift", "lost", "lane", "start"}
    assert row["detection"]["shift"]["windows"]["95 % [s]"] < 0.3
    assert row["detection"]["lane"]["windows"]["95 % [s]"] < 0.3
    assert row["detection"]["drift"]["windows"]["median [s]"] == math.inf
