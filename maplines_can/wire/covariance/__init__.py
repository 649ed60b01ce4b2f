"""The covariance of a line as signals, and back: the code that a DBC names."""

from .cholesky import CholeskyCode
from .code import Coded, CovarianceCode

__all__ = ["CholeskyCode", "Coded", "CovarianceCode"]
