"""Random residuals of map lines and camera lines, and faults in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from maplines_can import Gaussian, MapError, Polyline, Slot, map_scene
from maplines_can.consumers.plausibility import CameraBias, residuals
from maplines_can.consumers.residual_filter import FAST, SLOW, ResidualModel

Array = NDArray[np.float64]

DT = 0.05  #: of the images [s]
POSE_SIGMA = (0.3, 0.1, math.radians(0.2))
CAMERA_SIGMA = (0.05, 0.003, 2e-4, 2e-6)
SPEED = 15.0
#: Degrees of freedom of the heavy tails.
TAILS = 4.0


def model_of_lane(bend: float = 0.0) -> tuple[ResidualModel, Array]:
    """Return the model of the residuals of a lane, and their distances ahead [m].

    Args:
        bend: curvature of the lane [1/m].
    """
    s = np.linspace(-50.0, 120.0, 341) if bend else np.array([-50.0, 150.0])
    # sin(bend s) / bend and (1 - cos(bend s)) / bend
    x, y = s * np.sinc(bend * s / np.pi), bend * s**2 / 2 * np.sinc(bend * s / 2 / np.pi) ** 2
    lane = {
        slot: Polyline(np.column_stack([x - left * np.sin(bend * s), y + left * np.cos(bend * s)]))
        for slot, left in ((Slot.EGO_LEFT, 1.75), (Slot.EGO_RIGHT, -1.75))
    }
    scene = map_scene(
        lane,
        Gaussian(np.zeros(3), np.diag(np.square(POSE_SIGMA))),
        map_error=MapError(point_sigma=0.05, offset_sigma=0.03, heading_sigma=0.0005),
    )
    noise = np.diag(np.square(CAMERA_SIGMA))
    seen = {line.slot: Gaussian(line.gaussian.mean, noise) for line in scene.lines}
    model = cast(Any, residuals(scene, seen))[2]
    bias = model.H @ CameraBias().cov @ model.H.T
    return model._replace(slow_cov=model.slow_cov + bias), -model.H[:, 2]


class Noise(NamedTuple):
    """True noise of a camera."""

    time: float = 0.0  #: correlation time of what lasts [s]
    share: float = 0.0  #: of the variance that lasts
    heavy: bool = False  #: what is new in each image has Student's t-distribution

    def drawn(self, cars: int, roots: Array, rng: np.random.Generator) -> Iterator[Array]:
        """Yield the (cars, n) noise of one image after another, for an (n, n) root."""
        rho, n = math.exp(-DT / self.time) if self.time else 0.0, len(roots)
        lasting = rng.standard_normal((cars, n))
        while True:
            white = rng.standard_normal((cars, n))
            if self.heavy:  # the near and the far residual of a line have their outliers together
                scale = np.sqrt((TAILS - 2) / rng.chisquare(TAILS, (cars, n // 2)))
                white *= np.repeat(scale, 2, axis=1)
            if self.share == 1:  # an outlier lasts, too
                lasting = rho * lasting + math.sqrt(1 - rho**2) * white
                yield lasting @ roots.T
                continue
            if self.share:
                new = rng.standard_normal((cars, n))
                lasting = rho * lasting + math.sqrt(1 - rho**2) * new
            mixed = math.sqrt(self.share) * lasting + math.sqrt(1 - self.share) * white
            yield mixed @ roots.T


WHITE = Noise()


class Errors:
    """Random residuals of many cars without a fault, image by image.

    Args:
        covs: (n, n) covariances of the errors that last, in the residuals.
        times: their correlation times [s].
        noise_cov: (n, n) of the noise.
        cars: number of cars.
        rng: source of the random numbers.
        noise: of the camera.
    """

    def __init__(
        self,
        covs: Sequence[Array],
        times: Sequence[float],
        noise_cov: Array,
        cars: int,
        rng: np.random.Generator,
        noise: Noise = WHITE,
    ) -> None:
        self._rng = rng
        self._maps = [np.linalg.cholesky(cov + 1e-12 * np.eye(len(cov))) for cov in covs]
        self._noise = noise.drawn(cars, np.asarray(np.linalg.cholesky(noise_cov)), rng)
        self._rho = [math.exp(-DT / time) for time in times]
        self._states = [rng.standard_normal((cars, len(m))) for m in self._maps]

    @classmethod
    def of_model(
        cls,
        model: ResidualModel,
        time: float,
        cars: int,
        rng: np.random.Generator,
        noise: Noise = WHITE,
    ) -> Errors:
        """Return the errors of a model, for a correlation time of the pose error [s]."""
        pose = model.H @ model.pose_cov @ model.H.T
        covs = [pose, model.fast_cov, model.slow_cov]
        return cls(covs, [time, FAST, SLOW], model.noise_cov, cars, rng, noise)

    def next(self) -> Array:
        """Return the (cars, n) residuals of the next image [m]."""
        z = next(self._noise).copy()
        for i, (rho, m) in enumerate(zip(self._rho, self._maps, strict=True)):
            state = self._states[i]
            state *= rho
            state += math.sqrt(1 - rho**2) * self._rng.standard_normal(state.shape)
            z += state @ m.T
        return z


def own_errors(
    model: ResidualModel, time: float, own: float, cars: int, rng: np.random.Generator
) -> Errors:
    """Return errors that last for a time [s]: of the pose, and those of a map line's own."""
    pose = model.H @ model.pose_cov @ model.H.T
    camera = model.slow_cov - model.fast_cov
    times = [time, own, max(own, SLOW)]
    return Errors([pose, model.fast_cov, camera], times, model.noise_cov, cars, rng)


def faults(x: Array) -> dict[str, Callable[[Array], Array]]:
    """Return the (..., n) shifts of the residuals at (...,) times after a fault begins [s]."""
    left = (np.arange(len(x)) < 2).astype(float)
    bias, degree = math.radians(0.1), math.radians(1.0)

    def begun(t: Array) -> Array:
        return np.asarray(t >= 0, float)[..., None]

    def since(t: Array) -> Array:
        return np.maximum(t, 0.0)[..., None]

    return {
        "shift": lambda t: 0.5 * begun(t) * np.ones(len(x)),
        "camera": lambda t: degree * begun(t) * x,
        "drift": lambda t: degree * (since(t) / 60).clip(max=1.0) * x,
        "lost": lambda t: -bias * (SPEED * since(t) ** 2 / 2 + since(t) * x),
        "lane": lambda t: 3.5 * begun(t) * left,
        "start": lambda t: 0.5 * begun(t) * np.ones(len(x)),
    }
