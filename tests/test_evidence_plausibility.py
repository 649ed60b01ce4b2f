"""tools/evidence_plausibility.py: its errors are those of the model, and it finds wrong rates."""

import json
import math

import evidence_plausibility as tool
import numpy as np
import plausibility_errors as drawn
import pytest


def test_the_errors_have_the_covariance_of_the_model() -> None:
    model, x = drawn.model_of_lane()
    errors = drawn.Errors.of_model(model, 5.0, 40_000, np.random.default_rng(0))
    z = errors.next()
    scale = np.sqrt(model.marginal.diagonal())
    found = np.cov(z.T) / scale / scale[:, None]
    assert found == pytest.approx(model.marginal / scale / scale[:, None], abs=0.03)
    assert x == pytest.approx([2.0, 20.0] * 2)


def test_the_faults_are_those_of_the_docstring() -> None:
    _, x = drawn.model_of_lane()
    t = np.array([-1.0, 0.0, 10.0])
    faults = {name: fault(t) for name, fault in drawn.faults(x).items()}
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


@pytest.mark.parametrize(
    "noise",
    [
        pytest.param(drawn.WHITE, id="white"),
        pytest.param(drawn.Noise(0.3, 1.0), id="lasts"),
        pytest.param(drawn.Noise(0.3, 0.5, heavy=True), id="half-lasts-half-heavy"),
    ],
)
def test_the_noise_has_the_stated_covariance(noise: drawn.Noise) -> None:
    """And the stated correlation between two images."""
    rng, root = np.random.default_rng(1), np.linalg.cholesky(np.diag([1.0, 2.0, 3.0, 4.0]))
    images = noise.drawn(200_000, root, rng)
    first, second = next(images), next(images)
    variance = (second**2).mean(axis=0)
    assert variance == pytest.approx([1, 2, 3, 4], rel=0.05)
    rho = noise.share * math.exp(-drawn.DT / noise.time) if noise.time else 0.0
    assert (first * second).mean(axis=0) / variance == pytest.approx([rho] * 4, abs=0.03)


def test_errors_that_are_not_covered_need_not_meet_the_rate() -> None:
    many = tool.FalseAlarms(100.0, 900, 30.0)
    assert "met" not in many.result(1.0, covered=False)
    assert not many.result(1.0, exact=False)["met"]
    assert tool.FalseAlarms(100.0, 2, 10.0).result(1.0, exact=False)["met"]


def test_run_of_few_images(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A jump is found at once; what the docstring names is in the result."""
    monkeypatch.setattr(tool, "TIMES", (1.0,))
    monkeypatch.setattr(tool, "RATES", (5.0,))
    monkeypatch.setattr(tool, "OWN_TIMES", ())
    monkeypatch.setattr(tool, "ROWS", {"t": tool.ROWS["noise of Student's t"]})
    monkeypatch.setattr(tool, "LONGEST", 1.0)
    monkeypatch.setattr(tool, "CARS", 50)
    tool.main(["--hours", "0.4", "--cars", "10", "--json"])
    result = json.loads(capsys.readouterr().out)
    row = result["model"]["correlation time 1 s"]["5 per hour"]
    assert row["hours without an alarm"] == pytest.approx(0.4, rel=0.3)
    heavy = result["camera"]["t"]
    assert heavy["as modelled, 5 per hour"]["hours without an alarm"] < 0.2
    assert heavy["default, 5 per hour"]["met"]
    detection = result["detection"]["correlation time 1 s"]
    assert set(detection) == {"shift", "camera", "drift", "lost", "lane", "start"}
    assert detection["shift"]["windows"]["95 % [s]"] < 0.3
    assert detection["lane"]["windows"]["95 % [s]"] < 0.3
    assert detection["lane"]["default"]["95 % [s]"] < 0.4
    assert detection["drift"]["windows"]["median [s]"] == math.inf
