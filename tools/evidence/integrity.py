"""Protection levels of the lateral position: how often an error exceeds them."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from maplines_can.consumers.integrity import (
    ALERT_LIMITS,
    HOUR,
    PERIOD,
    RISKS,
    Tolerance,
    multiplier,
    risk_bound,
    samples_of,
)
from maplines_can.simulation.camera import PLACES, Errors

from .fleet import Simulation
from .fusion import TIMES, town_views
from .fusion_ways import RIGHT
from .harness import evidence, progress
from .sampling import excursion_probability, nominal, tail_probability

Array = NDArray[np.float64]

RISK = 0.05  #: in an hour, of the levels that are counted in simulated hours
STATED = 5.0  #: correlation time [s]
#: Hours that are drawn at once.
CHUNK = 50
#: Correlation time of the errors of received scenes [s], and the risk of their levels.
SCENES_TIME, SCENES_RISK = 5.0, 1e-5

#: Return (n,) ratios of true standard deviations to the stated one, each for an hour.
Ratios = Callable[[int, np.random.Generator], Array]


class Row(NamedTuple):
    """A true error, and the range for which the level is."""

    parts: tuple[tuple[float, float], ...]  #: shares of the variance and their times [s]; 0: white
    shortest: float = STATED  #: correlation time [s]
    tolerance: Tolerance = Tolerance()
    ratios: Ratios = lambda n, _: np.ones(n)


WHITE = Tolerance(white_share=0.3)
SIGMA = Tolerance(sigma_ratio=1.3)
SPREAD = Tolerance(sigma_spread=0.3)
ROWS = {
    "as stated": Row(((1.0, 5.0),)),
    "30 % white": Row(((0.7, 5.0), (0.3, 0.0)), 5.0, WHITE),
    "10 % white": Row(((0.9, 5.0), (0.1, 0.0)), 5.0, WHITE),
    "30 % white, any time": Row(((0.7, 5.0), (0.3, 0.0)), 0.0),
    "a tenth of the time": Row(((1.0, 0.5),), 0.5),
    "a third of the time": Row(((1.0, 1.7),), 0.5),
    "a tenth of the time, any time": Row(((1.0, 0.5),), 0.0),
    "half 0.5 s, half 30 s": Row(((0.5, 0.5), (0.5, 30.0)), 0.5),
    "30 s": Row(((1.0, 30.0),), 0.5),
    "sigma 30 % greater": Row(((1.0, 5.0),), 5.0, SIGMA, lambda n, _: np.full(n, 1.3)),
    "sigma within 30 %": Row(((1.0, 5.0),), 5.0, SIGMA, lambda n, rng: rng.uniform(0.7, 1.3, n)),
    "sigma of normal spread 30 %": Row(
        ((1.0, 5.0),), 5.0, SPREAD, lambda n, rng: np.abs(1 + 0.3 * rng.standard_normal(n))
    ),
    "sigma of log-normal spread 30 %": Row(
        ((1.0, 5.0),), 5.0, SPREAD, lambda n, rng: np.exp(0.3 * rng.standard_normal(n))
    ),
    "30 % white, a tenth of the time, sigma 30 % greater": Row(
        ((0.7, 0.5), (0.3, 0.0)), 0.5, Tolerance(0.3, 1.3), lambda n, _: np.full(n, 1.3)
    ),
}


def largest(row: Row, hours: int, rng: np.random.Generator) -> Array:
    """Return the largest absolute error of each hour, in stated standard deviations."""
    samples, found = round(HOUR / PERIOD), []
    for first in range(0, hours, CHUNK):
        count = min(CHUNK, hours - first)
        error = np.zeros((count, samples))
        for share, time in row.parts:
            noise = rng.standard_normal((count, samples))
            if time > 0:
                rho = math.exp(-PERIOD / time)
                noise[:, 1:] *= math.sqrt(1 - rho**2)
                noise = lfilter([1.0], [1.0, -rho], noise, axis=1)
            error += math.sqrt(share) * noise
        found.append(row.ratios(count, rng) * np.abs(error).max(axis=1))
    return np.concatenate(found)


@evidence(hours=60)
def hours(hours: int = 2000, seed: int = 0) -> dict[str, Any]:
    """Count the hours in which an error exceeds the levels for a range of what is stated.

    Errors are sums of Gauss-Markov processes and white noise, at 20 Hz. Stated is a correlation
    time of 5 s; the true errors have another time, a share of white noise, or another standard
    deviation. Each row has the share of the hours in which the error exceeds the level for what is
    stated (exact) and the level for the range (range). z is the share of the range less 0.05, in
    standard errors.
    """
    result: dict[str, Any] = {}
    exact = multiplier(RISK, STATED)
    for i, (name, row) in enumerate(progress(ROWS.items(), "rows", len(ROWS))):
        errors = largest(row, hours, np.random.default_rng([seed, i]))
        K = multiplier(RISK, row.shortest, tolerance=row.tolerance)
        share = float((errors > K).mean())
        deviation = math.sqrt(max(share * (1 - share), 1 / hours) / hours)
        result[name] = {
            "K, exact": exact,
            "share, exact": float((errors > exact).mean()),
            "K, range": K,
            "share, range": share,
            "standard error": deviation,
            "z": (share - RISK) / deviation,
        }
    return result


@evidence(draws=300, times=(1.0,))
def rare(draws: int = 4000, times: tuple[float, ...] = TIMES, seed: int = 1) -> dict[str, Any]:
    """Compare the stated risk of an hour with importance sampling of a Gauss-Markov error.

    "over risk" is the upper end of the 95 % confidence interval over the stated risk.
    """
    rng = np.random.default_rng(seed)
    result: dict[str, Any] = {}
    for T in progress(times, "correlation times"):
        for risk in RISKS:
            K = multiplier(risk, T)
            rho, n = math.exp(-PERIOD / T), samples_of(PERIOD)
            sampled = excursion_probability(K, rho, n, draws, rng)
            result[f"{risk:g} an hour, {T:g} s"] = {
                "K": K,
                "bound": risk_bound(K, T),
                "sampled": sampled.value,
                "low": sampled.low,
                "high": sampled.high,
                "over risk": sampled.high / risk,
            }
    return result


@evidence(draws=500, scenes=3, cars=10, seconds=3.0, stretches=("motorway",))
def received(
    draws: int = 4000,
    scenes: int = 60,
    cars: int = 50,
    seconds: float = 60.0,
    stretches: tuple[str, ...] = ("streets", "motorway"),
    plot: Path | None = None,
    seed: int = 1,
) -> dict[str, Any]:
    """Compare levels of received scenes and of fused lanes with errors, in the town.

    In a scene: probability that the error of the lane centre exceeds the level at one time, by
    importance sampling of pose errors (mean shift), over that of a normal variable with the decoded
    variance. The decoded covariance covers the true one, so the ratio is at most 1; scenes in which
    the misfit of the cubic is most of the error may exceed it, so the mean over scenes counts.

    Of fused lanes: shares of a Stanford diagram, of levels of a risk of 1e-5. Misleading: the error
    exceeds the level; hazardous: the alert limit, too, which the level does not.

    Args:
        draws: samples of a scene.
        scenes: of the motorway.
        cars: of the diagram.
        seconds: of each stretch [s].
        stretches: of the tour.
        plot: file of the diagram of the motorway.
        seed: of the simulation.
    """
    views, errors, result = town_views(seconds, 10.0, stretches), Errors(), {}
    for place, x in enumerate(progress(PLACES, "scenes")):
        view = views["motorway"]
        known = np.flatnonzero(
            view.valid[:, place] & np.isfinite(view.true[..., place]).all(axis=1)
        )
        for risk in RISKS:
            K, chosen = multiplier(risk, SCENES_TIME), known[:: max(1, len(known) // scenes)]
            tails = [
                tail_probability(view, int(k), place, K, errors, draws, seed + int(k)).value
                for k in chosen
            ]
            ratio = np.array(tails) / nominal(K)
            result[f"scenes, {risk:g} at {x:g} m"] = {
                "mean ratio": float(ratio.mean()),
                "largest ratio": float(ratio.max()),
            }
    return {"in a scene": result, "fused": diagram(views, cars, seed, plot)}


def diagram(views: Any, cars: int, seed: int, plot: Path | None) -> dict[str, Any]:
    """Return the shares of the Stanford diagram, and draw it."""
    result: dict[str, Any] = {}
    for name, view in progress(views.items(), "diagram"):
        way = RIGHT["pose error as state"](cars)
        track = Simulation(view, SCENES_TIME, cars, seed, Errors()).run(way)
        limit = ALERT_LIMITS["street" if name == "streets" else name]
        pairs = []
        for place, x in enumerate(PLACES):
            known = np.isfinite(track.error[..., place])
            error = np.abs(track.error[..., place][known])
            level = multiplier(SCENES_RISK, SCENES_TIME) * track.sigma[..., place][known]
            pairs.append((error, level))
            result[f"{name}, {x:g} m"] = stanford_shares(error, level, limit)
        if plot and name == "motorway":
            from .pictures import draw_stanford

            draw_stanford(pairs, limit, plot)
    return result


def stanford_shares(error: Array, level: Array, alert_limit: float) -> dict[str, float]:
    """Return the shares of (n,) absolute errors in the regions of a Stanford diagram.

    >>> error, level = np.array([0.1, 0.3, 0.6]), np.array([0.2, 0.2, 0.4])
    >>> stanford_shares(error, level, 0.5)["misleading"]
    0.6666666666666666
    """
    available, wrong = level <= alert_limit, error > level
    hazardous = wrong & available & (error > alert_limit)
    shares = {"available": available, "misleading": wrong, "hazardous": hazardous}
    return {"alert limit": alert_limit} | {k: float(of.mean()) for k, of in shares.items()}
