"""Studies of the wire: sets of Gaussians, figures of merit, sweeps, designs and reports.

It may import the product and ``testing``.
"""

from ..values.coding_loss import LATERAL_X, Evaluation, evaluate
from .sets import Gaussians, adversarial, paper, road

__all__ = ["LATERAL_X", "Evaluation", "Gaussians", "adversarial", "evaluate", "paper", "road"]
