"""Covariance codes for comparison, and the table of all codes.

It may import the product and ``study``.
"""

from .code import CovarianceCode
from .integer_cholesky import IntegerCholesky
from .log_cholesky import LogCholesky
from .sigmas import LogCorrelation, MeanOnly, Sigmas
from .triangle import Float16Triangle, Float32Triangle, LinearCovering, LinearNearest

__all__ = ["CODES", "COMPARED"]


class Cholesky:
    """Code of the core, which its ``Codec`` sends."""

    name = "Cholesky"
    about = "as LogCholesky, with feedback from row to row, and inflated until it covers"
    positive_definite = True
    covering = True


#: Codes for comparison by name, as in the DBC's attribute CovarianceCode.
COMPARED: dict[str, type[CovarianceCode]] = {
    code.name: code
    for code in (
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
#: All codes by name; the first is the default.
CODES: dict[str, type[Cholesky | CovarianceCode]] = {Cholesky.name: Cholesky, **COMPARED}
