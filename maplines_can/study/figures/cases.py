"""A scenario's line for the figures: its true distribution, its approximations and its view."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...propagation import MonteCarlo, Refit, SigmaPoints
from ...simulation.scenarios import Scenario
from ...values.gaussian import Gaussian
from ...values.line import Slot, lateral
from ...values.polyline import to_ego
from ..paper_refit import paper_refit
from .panels import PanelView

Array = NDArray[np.float64]

#: The line of all figures: the right boundary of the car's lane, as in the paper's figure 2.
SLOT = Slot.EGO_RIGHT
#: Samples drawn as arrows and lines; more would hide each other.
LINES = 200


@dataclass(frozen=True, eq=False)
class Case:
    """A scenario's line: its true distribution and two Gaussian approximations."""

    scenario: Scenario
    refit: Refit
    poses: Array  #: (n, 3) Monte Carlo draws, in the frame of the mean pose
    lines: Array  #: (n, 4) their lines: the true distribution
    ill_posed: int  #: draws left out, from which no cubic y(x) follows the points
    monte_carlo: Gaussian
    sigma_poses: Array  #: (7, 3) in the frame of the mean pose
    sigma_lines: Array  #: (7, 4)
    sigma_points: Gaussian

    @property
    def shown(self) -> tuple[tuple[Array, Array, str], ...]:
        """Drawn poses, their lines and their name: sigma points, then samples."""
        return (
            (self.sigma_poses, self.sigma_lines, "sigma points"),
            (self.poses[:LINES], self.lines[:LINES], "Monte Carlo samples"),
        )


def case_of(scenario: Scenario, samples: int, seed: int) -> Case:
    """Return the distribution of a scenario's line ``SLOT``, by sampling and by sigma points."""
    ego, refit = scenario.ego, paper_refit(scenario, SLOT)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the figure prints the number of draws left out
        draws = MonteCarlo(samples, seed).samples(refit, ego)
    transform = SigmaPoints()
    sigma_poses = transform.rule(ego).points(ego)

    def in_ego_frame(poses: Array) -> Array:
        return np.column_stack([to_ego(poses[:, :2], ego.mean), poses[:, 2] - ego.mean[2]])

    return Case(
        scenario=scenario,
        refit=refit,
        poses=in_ego_frame(draws.inputs),
        lines=draws.values,
        ill_posed=draws.ill_posed,
        monte_carlo=Gaussian(draws.values.mean(axis=0), np.cov(draws.values.T, bias=True)),
        sigma_poses=in_ego_frame(sigma_poses),
        sigma_lines=refit(sigma_poses),
        sigma_points=transform(refit, ego),
    )


def view_of(case: Case) -> PanelView:
    """Return the view of a case's map panels."""
    low, high = (float(x) for x in case.refit.x_range)
    points = case.refit.points[0]
    bottom, top = points[:, 1].min(), points[:, 1].max()
    # Space for the lines around the points, in a shape that suits a page and any heading.
    tall = max(0.64 * (high - low), 1.5 * (top - bottom))
    wide = max(1.06 * (high - low), tall / 0.78)
    x, y = (low + high) / 2, 0.57 * bottom + 0.43 * top  # false lines run below a left turn
    true = lateral(case.lines[:20_000, None], np.linspace(low, high, 60))
    return PanelView(
        ego=Gaussian(np.zeros(3), case.scenario.ego.cov),
        line=case.refit(case.scenario.ego.mean),
        points=points,
        x_range=(low, high),
        band=np.quantile(true, [0.005, 0.995], axis=0),
        limits=(x - wide / 2, x + wide / 2, y - tall / 2, y + tall / 2),
        arrow=0.04 * (high - low),
        fan=0.16 * (high - low),
    )


def close_up(view: PanelView) -> PanelView:
    """Return the view of the vicinity of the car."""
    return replace(view, band=np.empty((0, 60)), limits=(-2.6, 2.6, -2.6, 2.6), arrow=0.6, fan=2.3)
