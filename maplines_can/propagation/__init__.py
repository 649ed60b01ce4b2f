"""From the Gaussian of a pose to the Gaussian of a line."""

from .fits import Robust, TotalLeastSquares, robust, total_least_squares
from .linear import Linear
from .mixture import Mixture
from .monte_carlo import MonteCarlo, Samples
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
    "Quadrature",
    "Refit",
    "Robust",
    "Samples",
    "SigmaPoints",
    "TotalLeastSquares",
    "Transform",
    "robust",
    "total_least_squares",
]
