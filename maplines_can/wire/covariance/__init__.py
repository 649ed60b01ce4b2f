"""Codes of the covariance: covariances as signals, and back."""

from .cholesky import CholeskyCode
from .scene_code import SceneCode

__all__ = ["CholeskyCode", "SceneCode"]
