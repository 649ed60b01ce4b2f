"""Covariance codes for comparison, and the table of all codes."""

from ...wire.covariance.cholesky import CholeskyCode
from .code import CovarianceCode
from .integer_cholesky import IntegerCholesky
from .log_cholesky import LogCholesky
from .sigmas import LogCorrelation, MeanOnly, Sigmas
from .triangle import Float16Triangle, Float32Triangle, LinearCovering, LinearNearest

__all__ = ["CODES"]


class Cholesky(CholeskyCode, CovarianceCode):
    """Code of the core, which its ``Codec`` sends."""

    about = "as LogCholesky, with feedback from row to row, and inflated until it covers"
    positive_definite = True
    covering = True


#: All codes by name, as in the DBC's attribute CovarianceCode; the first is the default.
CODES: dict[str, type[CovarianceCode]] = {
    code.name: code
    for code in (
        Cholesky,
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
