"""From the Gaussian of a pose to the Gaussian of a line, and from one time to another."""

from .fits import Robust, TotalLeastSquares, robust, total_least_squares
from .linear import Linear
from .mixture import Mixture, bend
from .monte_carlo import MonteCarlo, Samples
from .motion import Motion, carried, line_at, pose_time_ns
from .part_counts import part_counts
from .quadrature import Quadrature
from .refit import MapError, Refit
from .sigma_points import SigmaPoints
from .transform import Moments, Transform

__all__ = [
    "Linear",
    "MapError",
    "Mixture",
    "Moments",
    "MonteCarlo",
    "Motion",
    "Quadrature",
    "Refit",
    "Robust",
    "Samples",
    "SigmaPoints",
    "TotalLeastSquares",
    "Transform",
    "bend",
    "carried",
    "line_at",
    "part_counts",
    "pose_time_ns",
    "robust",
    "total_least_squares",
]
