"""Codes of the covariance: how a 4 x 4 matrix becomes signals, and what each code guarantees."""

from ...wire.covariance.cholesky import CholeskyCode
from ...wire.covariance.code import CovarianceCode
from .floats import Float16Triangle, Float32Triangle
from .integer_cholesky import IntegerCholesky
from .linear import Linear, LinearNearest
from .log_cholesky import LogCholesky
from .log_correlation import LogCorrelation
from .sigmas import MeanOnly, Sigmas

__all__ = ["CODES"]

#: All codes, by the name that a DBC's attribute CovarianceCode gives; the default is the first.
#: ``Codec.from_dbc(path, codes=CODES)`` reads the DBC of any of them.
CODES: dict[str, type[CovarianceCode]] = {
    code.name: code
    for code in (
        CholeskyCode,
        LogCholesky,
        IntegerCholesky,
        Linear,
        LinearNearest,
        LogCorrelation,
        Float16Triangle,
        Float32Triangle,
        Sigmas,
        MeanOnly,
    )
}
