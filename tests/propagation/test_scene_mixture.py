"""Mixtures of the lines of a scene, split by the receiver."""

import numpy as np
import pytest

from maplines_can import Gaussian, MapError, Polyline, Slot, map_scene, scene_mixture
from maplines_can.propagation import Refit
from maplines_can.values.line import lateral, lateral_jacobian
from maplines_can.values.scene import Scene

ANGLE = np.linspace(-1.3, 1.3, 200)
BEND = Polyline(30 * np.column_stack([np.sin(ANGLE), 1 - np.cos(ANGLE)]))
EGO = Gaussian([0, 0, 0], np.diag([0.3, 0.3, np.radians(5)]) ** 2)


def scene_of(map_error: MapError | None = None, heading_sigma_deg: float = 5.0) -> Scene:
    ego = Gaussian([0, 0, 0], np.diag([0.3, 0.3, np.radians(heading_sigma_deg)]) ** 2)
    return map_scene({Slot.CENTRE: BEND, Slot.ROUTE: BEND}, ego, map_error=map_error)


@pytest.mark.parametrize("components", [1, 2, 5])
@pytest.mark.parametrize("map_error", [None, MapError(0.05, 0.1)])
def test_the_whole_has_mean_and_covariance_of_the_line(
    components: int, map_error: MapError | None
) -> None:
    """In units of the line's standard deviations: sigma points and quadrature differ little."""
    scene = scene_of(map_error, heading_sigma_deg=1.0)
    mixture = scene_mixture(scene, Slot.ROUTE, components)
    joint = scene.joint([Slot.ROUTE])
    np.testing.assert_allclose(mixture.overall.mean, joint.mean, atol=1e-12)
    ratio = np.sqrt(mixture.overall.cov.diagonal()) / joint.sigma
    np.testing.assert_allclose(ratio, 1.0, atol=0.07)


def test_the_mixture_has_the_skewness_of_the_true_distribution() -> None:
    """Of the lateral position at 15 m: the third moment of 2 x 10^5 draws through the refit.

    The line-specific part is symmetric and adds nothing to it; a Gaussian has none.
    """
    scene, x = scene_of(), 15.0
    refit = Refit(BEND, EGO.mean, (-20.0, 80.0))
    drawn = refit(EGO.sample(200_000, seed=1))
    y = lateral(drawn[~np.isnan(drawn[:, 0])], x)
    true = np.mean((y - y.mean()) ** 3)
    mixture = scene_mixture(scene, Slot.CENTRE, 8)
    centres = np.array([lateral(one.mean, x) for one in mixture.components])
    J = [lateral_jacobian(one.mean, x) for one in mixture.components]
    variances = np.array([a @ c.cov @ a for a, c in zip(J, mixture.components, strict=True)])
    d = centres - mixture.weights @ centres
    assert mixture.weights @ (d**3 + 3 * d * variances) == pytest.approx(true, rel=0.4)
