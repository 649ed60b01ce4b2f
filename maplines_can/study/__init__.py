"""What the wire costs: sets of Gaussians, and figures of merit."""

from .metrics import LATERAL_X, Judgement, judge
from .sets import Gaussians, hostile, paper, road

__all__ = ["LATERAL_X", "Gaussians", "Judgement", "hostile", "judge", "paper", "road"]
