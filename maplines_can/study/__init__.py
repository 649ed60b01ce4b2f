"""What the wire costs: sets of Gaussians, and figures of merit."""

from .metrics import LATERAL_X, Evaluation, evaluate
from .sets import Gaussians, adversarial, paper, road

__all__ = ["LATERAL_X", "Evaluation", "Gaussians", "adversarial", "evaluate", "paper", "road"]
