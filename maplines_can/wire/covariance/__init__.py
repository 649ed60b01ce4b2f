"""Codes of the covariance: covariances as signals, and back."""

from .cholesky import CholeskyCode

__all__ = ["CholeskyCode"]
