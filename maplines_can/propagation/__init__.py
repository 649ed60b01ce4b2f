"""Propagation of a pose Gaussian to the Gaussian of a line, and of a line over time."""

from .component_counts import component_counts, remaining_nonlinearity
from .linear import Linear
from .map_lines import map_lines
from .monte_carlo import MonteCarlo, Samples
from .motion import Motion
from .nonlinearity import Nonlinearity, nonlinearity
from .prediction import pose_time_ns, predict, predict_to
from .quadrature import Quadrature
from .refit import MapError, Refit
from .sigma_points import SigmaPoints
from .splitting import Mixture
from .transform import Moments, Transform

__all__ = [
    "Linear",
    "MapError",
    "Mixture",
    "Moments",
    "MonteCarlo",
    "Motion",
    "Nonlinearity",
    "Quadrature",
    "Refit",
    "Samples",
    "SigmaPoints",
    "Transform",
    "component_counts",
    "map_lines",
    "nonlinearity",
    "pose_time_ns",
    "predict",
    "predict_to",
    "remaining_nonlinearity",
]
