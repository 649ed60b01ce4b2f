"""From the Gaussian of a pose to the Gaussian of a line."""

from .linear import Linear
from .monte_carlo import MonteCarlo, Samples
from .quadrature import Quadrature
from .refit import MapError, Refit
from .sigma_points import SigmaPoints
from .transform import Moments, Transform

__all__ = [
    "Linear",
    "MapError",
    "Moments",
    "MonteCarlo",
    "Quadrature",
    "Refit",
    "Samples",
    "SigmaPoints",
    "Transform",
]
