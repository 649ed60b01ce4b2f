"""Random Gaussians of lines, without the study."""

from typing import Any

import numpy as np


def random_lines(n: Any, seed: Any) -> Any:
    """Return (n, 4) means and (n, 4, 4) covariances, as on a motorway."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(-1, 1, (n, 4)) * [4.0, 0.1, 2e-3, 1e-5]
    root = rng.standard_normal((n, 4, 4)) * np.array([[0.1], [0.01], [3e-4], [1e-5]])
    return means, root @ root.transpose(0, 2, 1)
