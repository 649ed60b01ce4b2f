"""Codes of the covariance: how a 4 x 4 matrix becomes signals, and what each code guarantees."""

from ...errors import LayoutError
from ..layout import Layout
from .cholesky import CholeskyCode
from .code import Coded, CovarianceCode
from .floats import Float16Triangle, Float32Triangle
from .integer_cholesky import IntegerCholesky
from .linear import Linear, LinearNearest
from .log_cholesky import LogCholesky
from .log_correlation import LogCorrelation
from .sigmas import MeanOnly, Sigmas

__all__ = ["CODES", "Coded", "CovarianceCode", "covariance_code"]

#: All codes, by the name that a DBC's attribute CovarianceCode gives; the default is the first.
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


def covariance_code(layout: Layout) -> CovarianceCode:
    """The code that a layout names.

    Raises:
        LayoutError: there is none of that name, or its signals are missing.
    """
    code = CODES.get(layout.covariance_code)
    if code is None:
        raise LayoutError(
            f"{layout.source}: the covariance code {layout.covariance_code!r} is not known; "
            f"there are {', '.join(CODES)}"
        )
    return code(layout)
