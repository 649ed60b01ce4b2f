"""tools/evidence_localisation.py: its figures on data whose answers are known."""

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can.localisation import BlockOutcome, Verdict

TOOLS = Path(__file__).parents[1] / "tools"
RNG_SEED = 6


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The tool as a module."""
    monkeypatch.syspath_prepend(str(TOOLS))
    import evidence_localisation

    return evidence_localisation


def run_of(tool: Any, scale: float) -> Any:
    """Return a run of 50 cars whose errors are ``scale`` times what is stated."""
    rng = np.random.default_rng(RNG_SEED)
    k, n, tau = 400, 50, 5.0
    root = np.diag([0.3, 0.1, 0.01])
    phi = math.exp(-tool.STEP / tau)
    unit = rng.standard_normal((k, n, 3))
    unit[1:] *= math.sqrt(1 - phi**2)
    for i in range(1, k):
        unit[i] += phi * unit[i - 1]
    covs = np.broadcast_to(root @ root, (k, n, 3, 3))
    times = np.full((k, n, 3), tau)
    used = np.full((n, 1), Verdict.USED)
    outcomes = [
        BlockOutcome(float(i), source, used, scale**2 * rng.chisquare(2, (n, 1)))
        for i in range(k)
        for source in ("gnss", "line", "landmark")
    ]
    errors = scale * unit @ root
    return tool.Run(np.arange(k) * tool.STEP, errors, covs, np.zeros(k), times, outcomes, {})


def test_a_consistent_run_is_found_consistent(tool: Any) -> None:
    """Means of 3 and 2, about 95 % inside, and the stated autocorrelation."""
    found = tool.figures(run_of(tool, 1.0))
    assert found["consistent"]
    assert found["NEES mean"] == pytest.approx(3, abs=0.1)
    assert found["NEES inside"] == pytest.approx(0.95, abs=0.04)
    assert found["NIS line"]["mean"] == pytest.approx(2, abs=0.05)
    for name in ("along", "across", "heading"):
        assert found["autocorrelation"][name]["found"] == pytest.approx(math.exp(-1), abs=0.05)


@pytest.mark.parametrize("scale", [0.7, 1.3])
def test_a_wrong_covariance_is_found(tool: Any, scale: float) -> None:
    """Whether it is too small or too large."""
    found = tool.figures(run_of(tool, scale))
    assert not found["consistent"]
    assert not found["NEES mean inside"]
    assert found["NEES inside"] < 0.5


def recording(path: Path, bias: tuple[float, float]) -> Path:
    """Write a recorded drive along x at 15 m/s, whose GNSS is off by a constant."""
    rng = np.random.default_rng(RNG_SEED)
    imu_t, gnss_t, truth_t = (np.arange(0.0, 60.0, dt) for dt in (0.01, 0.1, 0.05))
    still = np.zeros_like
    np.savez(
        path,
        imu_t=imu_t,
        gyro_frd=np.column_stack(
            [still(imu_t), still(imu_t), 0.002 + 0.002 * rng.standard_normal(len(imu_t))]
        ),
        speed_t=imu_t,
        speed=np.full(len(imu_t), 15.0),
        gnss_t=gnss_t,
        gnss_enu=np.column_stack([15 * gnss_t, still(gnss_t), still(gnss_t)])
        + [*bias, 0.0]
        + 0.1 * rng.standard_normal((len(gnss_t), 3)),
        gnss_bearing_deg=np.full(len(gnss_t), 90.0),
        truth_t=truth_t,
        truth_enu=np.column_stack([15 * truth_t, still(truth_t), still(truth_t)]),
        truth_vel_enu=np.broadcast_to([15.0, 0.0, 0.0], (len(truth_t), 3)),
    )
    return path


def test_a_recorded_drive_shows_the_bias(tool: Any, tmp_path: Path) -> None:
    """With the bias as a state, the covariance covers it; as white noise, it does not."""
    found = tool.recorded(recording(tmp_path / "drive.npz", (1.4, 0.4)))
    assert found["met"]
    assert found["GNSS noise from the first 15 s [m]"] == pytest.approx(0.1, rel=0.2)
    assert found["bias as a state"]["NEES mean"] < 3
    assert found["white, 0.5 m"]["NEES mean"] > 30
    assert found["bias as a state"]["RMS along, across [m]"].startswith("1.")
    far = tool.recorded(recording(tmp_path / "far.npz", (12.0, 0.4)))
    assert not far["met"]


def drives_of(scale: float) -> list[Any]:
    """50 drives whose errors are ``scale`` times what is stated; half the poses are known."""
    from localised_drives import Localised

    rng, sigma = np.random.default_rng(RNG_SEED), np.array([0.3, 0.1, 0.01])
    drives = []
    for _ in range(50):
        unit = scale * rng.standard_normal((100, 3))
        unit[::2] = np.nan
        other, counts = np.arange(100) % 4 == 1, Counter(USED=3, AMBIGUOUS=1)
        nees = (unit**2).sum(axis=1)
        drives.append(Localised(unit * sigma, sigma + 0 * unit, nees, other, counts))
    return drives


@pytest.mark.usefixtures("tool")
def test_the_figures_of_drives_are_those_of_their_errors() -> None:
    """Of known poses only; a covariance that is too small is found."""
    from localised_drives import figures

    right, wrong = figures(drives_of(1.0)), figures(drives_of(1.5))
    assert right["NEES"] == pytest.approx(3, abs=0.15)
    assert right["inside"] == pytest.approx(0.95, abs=0.015)
    assert right["stated along, across [m]"] == "0.30, 0.10"
    assert right["RMS along, across [m]"] in ("0.29, 0.10", "0.30, 0.10", "0.31, 0.10")
    assert (right["known"], right["lines used"], right["other lane"]) == (0.5, 0.75, 0.5)
    assert right["more than 1 m beside"] == 0
    assert wrong["NEES"] == pytest.approx(6.75, abs=0.3)
    assert wrong["inside"] < 0.8


@pytest.mark.usefixtures("tool")
def test_a_drive_on_a_random_road_uses_the_lines() -> None:
    from localised_drives import on_road

    drive = on_road("rural", RNG_SEED, 3.0)
    assert len(drive.nees) == 30
    assert drive.known.all()
    assert drive.lines["USED"] > 20
