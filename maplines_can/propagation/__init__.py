"""Propagation of a pose Gaussian to the Gaussian of a line, and of a line over time.

It may import ``core`` and ``values``.
"""

from ..values.scene import MapError
from .component_counts import component_counts, remaining_nonlinearity
from .from_map import map_lines, map_scene
from .monte_carlo import MonteCarlo, Samples
from .motion import Motion
from .nonlinearity import Nonlinearity, nonlinearity
from .paths import point_errors, points_in_window
from .prediction import pose_time_ns, predict, predict_to
from .quadrature import Quadrature
from .refit import Refit
from .scene_mixture import scene_mixture
from .sigma_points import SigmaPoints
from .splitting import Mixture
from .transform import Linear, Moments, Transform

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
    "map_scene",
    "nonlinearity",
    "point_errors",
    "points_in_window",
    "pose_time_ns",
    "predict",
    "predict_to",
    "remaining_nonlinearity",
    "scene_mixture",
]
