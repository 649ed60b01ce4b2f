"""Lines of a received scene as Gaussian mixtures: the receiver splits the pose error itself."""

from __future__ import annotations

import numpy as np

from ..values.gaussian import Gaussian
from ..values.linalg import nearest_covariance
from ..values.line import PARAMETERS, Slot
from ..values.mixture import GaussianMixture
from ..values.scene import Scene
from ..values.seen_lines import SeenLines
from .splitting import Mixture
from .transform import Transform

#: Parameters of a line.
N = len(PARAMETERS)


def scene_mixture(
    scene: Scene, slot: Slot, components: int = 3, transform: Transform | None = None
) -> GaussianMixture:
    """Return the distribution of a line of a scene as a Gaussian mixture.

    Where the heading is uncertain and the line bends, one Gaussian describes the line badly. The
    pose error is split, and each part is propagated through the line, as ``Mixture`` does at a
    sender. So no component has to be sent. The line-specific covariance is added to each.

    Args:
        scene: a scene, such as that of ``Receiver.latest_scene``.
        slot: which line.
        components: 1 to 8.
        transform: moment transform within each part; None for the default of ``Mixture``.

    Raises:
        ValueError: the scene has no line of the slot, or the number of components is out of range.

    >>> from maplines_can import Polyline, map_scene
    >>> angle = np.linspace(-1.2, 1.2, 60)
    >>> bend = Polyline(30 * np.column_stack([np.sin(angle), 1 - np.cos(angle)]))
    >>> ego = Gaussian([0, 0, 0], np.diag([0.5, 0.5, 0.09]) ** 2)
    >>> scene = map_scene({Slot.CENTRE: bend}, ego)
    >>> mixture = scene_mixture(scene, Slot.CENTRE)
    >>> len(mixture.components), bool(np.ptp(mixture.means[:, 1]) > 0.1)
    (3, True)
    """
    i = scene.index[scene.line(slot).slot]
    line = slice(i, i + 1)
    seen = SeenLines(scene.means[line], scene.fit_ranges[line], scene.quartics[line])
    block = slice(N * i, N * i + N)
    P = scene.pose_error.cov
    own = scene.cov[block, block] - seen.spread(P)
    own = (own + own.T) / 2
    own[np.diag_indices(N)] = own.diagonal().clip(0)  # rounding may have made one negative
    own = nearest_covariance(own)
    weights, means, covs = Mixture(components, transform).moments(
        seen.centred(P), Gaussian(np.zeros(3), P)
    )
    # The line is the mean over the pose error; the mixture must have the same.
    shift = scene.means[i] - weights @ means[:, 0]
    gaussians = (
        Gaussian(mean + shift, cov + own) for mean, cov in zip(means[:, 0], covs[:, 0], strict=True)
    )
    return GaussianMixture(weights, tuple(gaussians))
