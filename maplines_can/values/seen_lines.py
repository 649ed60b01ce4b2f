"""Lines as functions of the pose from which they are seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import lib
from ..core.memory import pointer, shaped
from .arrays import floats
from .errors import IllPosedError
from .line import check_window


def bases(means: NDArray[np.float64], fit_ranges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (L, 4, 4) derivatives of lines with respect to their coefficients of T_0 .. T_3.

    These are Chebyshev polynomials in the normalised variable w, -1 to 1 in the range. An error of
    1 m of any coefficient moves the line by up to 1 m.

    Args:
        means: (L, 4) lines.
        fit_ranges: (L, 2) ranges [m].
    """
    n = len(means)
    J = np.empty((n, 4, 4))
    lib.maplines_bases_of(n, shaped(means, (n, 4)), shaped(fit_ranges, (n, 2)), pointer(J))
    return J


class SeenLines:
    """Function from a displacement of the car to the cubics that lines are, seen from there.

    The lines are given as cubics, and most of what these leave of the lines of the map: a multiple
    of the Chebyshev polynomial T_4. It matters to a line in a bend that is seen from a turned car.
    For each displacement, points of the lines are transformed to the new frame, and cubics are
    fitted (see ``transform_line``). Where a line is not a function of x, its value is extrapolated.

    Args:
        means: (L, 4) lines [m, rad, 1/m, 1/m^2].
        fit_ranges: (L, 2) ranges in which cubics are fitted to them [m].
        quartics: (L,) coefficients of T_4 in these ranges [m]; None for 0.

    Raises:
        ValueError: a shape is wrong, or a range is empty.
        IllPosedError: a line is nearly perpendicular to the x axis within its range; also of a
            call, if no pose nearby sees it otherwise, of ``centred``, and of ``spread`` if it
            overflows.

    >>> seen = SeenLines([[1.75, 0, 0, 0], [-1.75, 0, 0, 0]], [[-20, 80], [-20, 60]])
    >>> seen([[0, 0.5, 0]]).round(9)[0, :, 0]
    array([ 1.25, -2.25])
    """

    def __init__(
        self, means: ArrayLike, fit_ranges: ArrayLike, quartics: ArrayLike | None = None
    ) -> None:
        self.means, self.fit_ranges = floats(means, "means"), floats(fit_ranges, "fit_ranges")
        lines = len(self.means)
        if self.means.shape != (lines, 4) or self.fit_ranges.shape != (lines, 2):
            raise ValueError(
                "means must be (L, 4) and fit_ranges (L, 2), got "
                f"{self.means.shape} and {self.fit_ranges.shape}"
            )
        quartics = floats(np.zeros(lines) if quartics is None else quartics, "quartics")
        if quartics.shape != (lines,):
            raise ValueError(f"quartics must be (L,), got {quartics.shape}")
        check_window(self.fit_ranges[:, 0], self.fit_ranges[:, 1])
        self._curves = np.column_stack([self.means, self.fit_ranges, quartics])  # (L, 7)
        self._lines = lines, pointer(self._curves)
        if not lib.maplines_are_functions(*self._lines):
            raise IllPosedError("a line is nearly perpendicular to the x axis in its range")

    def __call__(self, displacements: ArrayLike) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines seen after (N, 3) displacements [m, m, rad]."""
        poses = floats(displacements, "displacements")
        found = np.empty((len(poses), len(self.means), 4))
        asked = len(poses), shaped(poses, (len(poses), 3)), pointer(found)
        if not lib.maplines_see_curves(*self._lines, *asked):
            raise IllPosedError("a line is not a function of x, seen from the mean pose")
        return found

    def jacobian(self) -> NDArray[np.float64]:
        """Return the (L, 4, 3) derivatives of the lines with respect to the displacement."""
        J = np.empty((len(self.means), 4, 3))
        lib.maplines_curve_jacobians(*self._lines, pointer(J))
        return J

    def centred(self, P: NDArray[np.float64]) -> SeenLines:
        """Return the lines as seen from the mean pose, if these are their means over pose errors.

        The means over a pose error with the (3, 3) covariance P differ from the lines that are
        seen from the mean pose, by half the trace of P times their second derivatives.
        """
        curves = self._curves.copy()
        lib.maplines_centre_curves(len(curves), pointer(curves), shaped(P, (3, 3)))
        return SeenLines(curves[:, :4], self.fit_ranges, curves[:, 6])

    def spread(self, P: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (4 L, 4 L) joint covariance of the lines for a pose error with covariance P.

        It is positive semidefinite, and that of sigma points to second order in the pose.
        """
        n = 4 * len(self.means)
        A, cov = np.empty((n, 7)), np.empty((n, n))
        given = shaped(floats(P, "P"), (3, 3))
        if not lib.maplines_spread_curves(*self._lines, given, pointer(A), pointer(cov)):
            raise IllPosedError("the covariance of the lines overflows for this pose error")
        return cov
