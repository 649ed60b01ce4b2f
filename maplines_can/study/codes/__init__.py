"""Covariance codes for comparison, and the table of all codes."""

from ...wire.covariance.cholesky import CholeskyCode
from ...wire.covariance.code import CovarianceCode
from .integer_cholesky import IntegerCholesky
from .log_cholesky import LogCholesky
from .sigmas import LogCorrelation, MeanOnly, Sigmas
from .triangle import Float16Triangle, Float32Triangle, LinearCovering, LinearNearest

__all__ = ["CODES"]

#: All codes by name, as in the DBC's attribute CovarianceCode; the first is the default.
#: ``Codec.from_dbc(path, codes=CODES)`` reads the DBC of any of them.
CODES: dict[str, type[CovarianceCode]] = {
    code.name: code
    for code in (
        CholeskyCode,
        LogCholesky,
        IntegerCholesky,
        LinearCovering,
        LinearNearest,
        LogCorrelation,
        Float16Triangle,
        Float32Triangle,
        Sigmas,
        MeanOnly,
    )
}
