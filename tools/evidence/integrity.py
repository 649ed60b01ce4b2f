"""Protection levels of the lateral position of received scenes and of fused lanes.

How often an error exceeds them at the stated risks, tests/consumers/test_integrity.py shows.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from maplines_can.consumers.integrity import ALERT_LIMITS, RISKS, multiplier
from maplines_can.simulation.camera import PLACES, Errors
from maplines_can.values.line import lateral, transform_line_or_nan

from .drive_view import DriveView
from .fusion import RIGHT, STRETCHES, Fused, Simulation, town_views
from .harness import evidence, progress

Array = NDArray[np.float64]

#: Correlation time of the errors of received scenes [s], and the risk of their levels.
TIME, RISK = 5.0, 1e-5


@evidence
def integrity(
    draws: int = 4000,
    scenes: int = 60,
    cars: int = 50,
    seconds: float = 60.0,
    stretches: tuple[str, ...] = tuple(STRETCHES),
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
        seed: of the simulation.
    """
    views, result = town_views(seconds, 10.0, stretches), dict[str, Any]()
    view = views["motorway"]
    for place, x in enumerate(progress(PLACES, "scenes")):
        known = view.valid[:, place] & np.isfinite(view.true[..., place]).all(axis=1)
        every = np.flatnonzero(known)
        for risk in RISKS:
            K, chosen = multiplier(risk, TIME), every[:: max(1, len(every) // scenes)]
            tails = [tail(view, int(k), place, K, Errors(), draws, seed + int(k)) for k in chosen]
            ratio = np.array(tails) / nominal(K)
            result[f"scenes, {risk:g} at {x:g} m"] = {
                "mean ratio": float(ratio.mean()),
                "largest ratio": float(ratio.max()),
            }
    fused: dict[str, Any] = {}
    for name, one in progress(views.items(), "fused"):
        errors, sigmas = Simulation(one, TIME, cars, seed).run(Fused(cars, RIGHT[0]))
        limit = ALERT_LIMITS["street" if name == "streets" else name]
        for place, x in enumerate(PLACES):
            known = np.isfinite(errors[..., place])
            error = np.abs(errors[..., place][known])
            level = multiplier(RISK, TIME) * sigmas[..., place][known]
            fused[f"{name}, {x:g} m"] = stanford_shares(error, level, limit)
    return {"in a scene": result, "fused": fused}


def nominal(K: float) -> float:
    """Return P(|u| > K) of a normal variable."""
    return float(2 * ndtr(-K))


def tail(
    view: DriveView, k: int, place: int, K: float, errors: Errors, draws: int, seed: int
) -> float:
    """Estimate P(|error| > K sigma) of the lane centre of a received scene.

    Errors of pose and map are drawn about the most likely ones that make the error K sigma to
    either side (mean shift), and weighted by the ratio of the densities. The error is that of the
    cubics seen from the erroneous pose, so it need not be linear or Gaussian; sigma is that of the
    decoded covariance.

    Args:
        view: of a drive.
        k: index of its time.
        place: index in ``PLACES``.
        K: the level in decoded standard deviations.
        errors: true ones of pose and map.
        draws: number of samples.
        seed: of the samples.
    """
    rng, x = np.random.default_rng(seed), PLACES[place]
    window = view.fit_ranges[k][:, 0], view.fit_ranges[k][:, 1]
    L = np.diag(errors.pose_sigma)

    def centre(u: Array) -> Array:
        lines = transform_line_or_nan(view.lines[k], (u @ L)[:, None], window)
        return np.asarray(lateral(lines, x).mean(axis=1))

    step = 1e-3
    steps = np.vstack([np.zeros(3), step * np.eye(3)])
    gradient = (centre(steps)[1:] - centre(steps)[0]) / step
    J = np.tile([1.0, x, x**2 / 2, x**3 / 6], 2) / 2
    sigma = math.sqrt(gradient @ gradient + J @ view.own[k] @ J)
    own = np.array([errors.map_offset, errors.map_heading * x]) / math.sqrt(2)
    direction = np.append(gradient, own)
    shift = K * sigma * direction / (direction @ direction)
    side = rng.choice([-1.0, 1.0], draws)[:, None]
    u = side * shift + rng.standard_normal((draws, 5))
    error = centre(u[:, :3]) + u[:, 3:] @ own - view.true[k, :, place].mean()
    error = np.where(np.isnan(error), np.inf, error)  # no line: counts as exceeded
    log_ratio = u @ shift - shift @ shift / 2, -(u @ shift) - shift @ shift / 2
    weights = 1 / (0.5 * np.exp(log_ratio[0]) + 0.5 * np.exp(log_ratio[1]))
    return float((weights * (np.abs(error) > K * sigma)).mean())


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
