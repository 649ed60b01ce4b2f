"""From the Gaussian of a pose to the Gaussian of a line, and from one time to another."""

from .component_counts import component_counts
from .linear import Linear
from .map_lines import map_lines
from .mixture import Mixture, nonlinearity
from .monte_carlo import MonteCarlo, Samples
from .motion import Motion, pose_time_ns, predict, predict_to
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
    "Samples",
    "SigmaPoints",
    "Transform",
    "component_counts",
    "map_lines",
    "nonlinearity",
    "pose_time_ns",
    "predict",
    "predict_to",
]
