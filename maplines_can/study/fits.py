"""Other ways to fit a line to map points: total least squares, and a fit that outliers leave cold.

Both stand where ``Refit`` stands: a transform takes them as it takes the ordinary
least-squares fit, and the points are those that a ``Refit`` has chosen. Through points of
a cubic all three give this cubic. On a highway whose points scatter by a decimetre, total
least squares differs by less than a millimetre; the robust fit differs where points are
wrong. On a road that no cubic follows each misses it in its own way, by decimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from math import comb
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import IllPosedError
from ..line import STATES, line_of_cubic
from ..polyline import Polyline, to_ego
from ..propagation.refit import Refit

__all__ = ["Robust", "TotalLeastSquares", "robust", "total_least_squares"]

Array = NDArray[np.float64]

#: Points worked on at a time, over all poses: what they need stays in the processor's cache.
BLOCK = 8192
#: A fit has settled when no coefficient moves by more, as a share of half the line's extent.
SETTLED = 1e-10
#: Steps after which a fit that has not settled is given up; four are usual, fifteen the most seen.
STEPS = 50
#: Halvings of a step that does not shorten the distances.
HALVINGS = 30

#: Hampel's function: linear to a, flat to b, back to zero at c, in units of the scale.
#: The values of Venables and Ripley, Modern Applied Statistics with S (2002), section 6.5.
HAMPEL = (2.0, 4.0, 8.0)
#: The median of |r| of a normal distribution, in units of its standard deviation.
MAD_OF_NORMAL = 0.6744897501960817
#: A centimetre is no outlier [m]: maps are not made better than that.
LEAST_SCALE = 0.01
#: Reweightings, and after how many of them the scale stays.
REWEIGHTINGS, SCALE_STAYS = 200, 50
#: Cubics through 4 points among which the start is sought: with 40 % of wrong points, 65
#: of so many go through good points only.
TRIALS = 500
#: The 4 points of a trial are this far apart at least, as a share of half the line's extent.
LEAST_GAP = 0.02


def total_least_squares(points: ArrayLike) -> Array:
    """The cubic with the least sum of squared orthogonal distances from points.

    See ``TotalLeastSquares``; this is its value for one pose.

    Args:
        points: (n, 2) points of a line as seen from the car [m], in their order along it.

    Returns:
        (4,) line (y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]).

    Raises:
        IllPosedError: fewer than 4 points, points that double back, or no convergence.

    >>> total_least_squares([[x, 2 + 0.005 * x**2] for x in range(0, 80, 5)]).round(9) + 0.0
    array([2.  , 0.  , 0.01, 0.  ])
    """
    refit = _refit_of(points)
    return TotalLeastSquares(refit)(refit.pose)


def robust(points: ArrayLike, scale: float | None = None) -> Array:
    """The cubic through most of the points, whatever the others do.

    See ``Robust``; this is its value for one pose.

    Args:
        points: (n, 2) points of a line as seen from the car [m], in their order along it.
        scale: standard deviation of a good point [m]; None to estimate it.

    Returns:
        (4,) line (y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]).

    Raises:
        IllPosedError: fewer than 4 points, or points that double back.

    >>> road = np.array([[x, 2.0] for x in range(0, 80, 5)])
    >>> road[3:6, 1] += 3.0  # three points that belong to another line
    >>> robust(road).round(9) + 0.0
    array([2., 0., 0., 0.])
    """
    refit = _refit_of(points)
    return Robust(refit, scale)(refit.pose)


@final
class TotalLeastSquares:
    """The map from a pose to the line with the least squared orthogonal distances.

    Minimises ``sum_i (u_i - t_i)^2 + (v_i - l(t_i))^2`` over the line l and the
    foot points t_i (Map Line Interface, section III-A-1), by Newton's method on
    both at once, from the least-squares cubic; where Newton's step does not
    lead down, Gauss-Newton's does.

    The *objective* is the same in every frame. The line need not be: a cubic
    y(x) of one frame is none in a turned one, so that the best of them is another
    curve, unless the best is straight. After a turn of 10 deg it is another by
    0.05 mm on a highway and by decimetres on a street turn, as with least
    squares; what it is free of is the least squares' pull towards the car's axis
    where points scatter along the line too (1.6 mm for 0.2 m of scatter, 4 cm
    for 1 m).

    It is no better guess at the road than least squares when the heading is
    known, and outliers draw it as much. Costs 12 us for a pose and 51 points on a
    highway and 60 us on a street turn, where ``Refit`` costs 0.2 us; a single
    pose 0.3 to 1 ms.

    Args:
        refit: chooses the points; its map error is taken over (that of the
            ordinary fit, to first order the same where the line is nearly
            straight).

    >>> road = Polyline([[x, 2.0] for x in range(0, 100, 5)])
    >>> fit = TotalLeastSquares(Refit(road, [0.0, 0.0, 0.0], window=(-20.0, 80.0)))
    >>> fit([10.0, 0.5, 0.0]).round(9) + 0.0
    array([1.5, 0. , 0. , 0. ])
    >>> fit([[0.0, 0.0, 0.1], [0.0, 0.0, 1.57]]).round(3) + 0.0  # the second looks across
    array([[ 2.01, -0.1 ,  0.  ,  0.  ],
           [  nan,   nan,   nan,   nan]])
    """

    def __init__(self, refit: Refit) -> None:
        self.refit = refit
        self.noise_cov = refit.noise_cov

    def __call__(self, poses: ArrayLike) -> Array:
        """Lines (y_off, beta, c0, c1) as seen from poses.

        Args:
            poses: (N, 3), or (3,) for a single one [m, m, rad].

        Returns:
            (N, 4), or (N, L, 4) for several lines; a row of NaN where the
            points double back or the fit does not converge.

        Raises:
            IllPosedError: a single pose without a line.
        """
        return _lines(self.refit, poses, [_orthogonal] * len(self.refit.points))


@final
class Robust:
    """The map from a pose to the line through most of its points.

    An M-estimator of the lateral residuals with Hampel's three-part function
    (Andrews et al., Robust Estimates of Location, 1972; here 2, 4, 8), by
    iteratively reweighted least squares. Points within two scales count in
    full, those beyond eight not at all, so that no point has more influence
    than two scales. Where no residual is beyond two scales, the result *is* that of
    least squares. The scale is ``median |r| / 0.6745``, at least 1 cm.

    Such a function has several minima, so the start decides: it is the cubic
    through 4 of the points with the least median of |r| (Rousseeuw, Least Median
    of Squares Regression, 1984), which less than half of the points cannot turn,
    unless noise helps them: 20 % and 30 % of wrong points never did, 40 % in one
    run at the end of the window sometimes. It is sought once, at the mean pose,
    since which points are wrong is a property of the map; from other poses the
    weights found there are refined.

    Not for a road that no cubic follows, such as a street turn: what the cubic
    misses looks like outliers, and the line follows the greater part of the
    road exactly and forgets the rest. Give a ``scale`` as wide as that misfit, or
    use ``Refit``.

    Nor for points farther aside than the line is long: ``Refit`` takes such a
    line for one that doubles back, before any fit.

    Costs 4 us for a pose and 51 points where the weights soon settle, and up
    to 150 us on a street turn; a single pose 0.3 to 2 ms. Where it is enough
    that outliers are found once, a ``Refit`` of the points that have ``weights``
    is cheaper.

    Args:
        refit: chooses the points; its map error is taken over.
        scale: standard deviation of a good point [m]; None to estimate it.

    Raises:
        ValueError: the scale is not positive.
    """

    def __init__(self, refit: Refit, scale: float | None = None) -> None:
        if scale is not None and not 0 < scale < np.inf:
            raise ValueError(f"scale must be more than 0 m, got {scale!r}")
        self.refit = refit
        self.scale = scale
        self.noise_cov = refit.noise_cov
        #: (n,) weight of each point of each line at the mean pose, from 0 to 1.
        self.weights = [_first_weights(points, scale) for points in refit.points]

    def __call__(self, poses: ArrayLike) -> Array:
        """Lines (y_off, beta, c0, c1) as seen from poses.

        Args:
            poses: (N, 3), or (3,) for a single one [m, m, rad].

        Returns:
            (N, 4), or (N, L, 4) for several lines; a row of NaN where the
            points double back.

        Raises:
            IllPosedError: a single pose without a line.
        """

        def fit_with(weights: Array) -> Fit:
            return lambda a, b, half: _reweighted(a, b, half, weights, self.scale)[0]

        return _lines(self.refit, poses, [fit_with(weights) for weights in self.weights])


# A fit of N poses: from points (N, n), a and b, in units of half the line's extent, and that
# half (N,) [m], to cubics (N, 4) in the same units; NaN where there is none.
Fit = Callable[[Array, Array, Array], Array]


def _refit_of(points: ArrayLike) -> Refit:
    """The ordinary fit through points as seen from the car."""
    line = Polyline(np.asarray(points, dtype=float))
    x = line.points[:, 0]
    return Refit(line, np.zeros(3), (x.min() - 1, x.max() + 1))


def _lines(refit: Refit, poses: ArrayLike, fits: Sequence[Fit]) -> Array:
    """Lines as seen from poses, one fit for each line; NaN where ``refit`` or the fit has none."""
    poses = np.asarray(poses, dtype=float)
    if poses.ndim == 1:
        refit(poses)  # raises where the points double back
        line = _lines(refit, poses[None], fits)[0]
        if np.isnan(line).any():
            raise IllPosedError(
                f"the fit does not converge at the pose ({poses[0]:g} m, {poses[1]:g} m, "
                f"{np.degrees(poses[2]):g} deg): the points are too far from any cubic; "
                "use Refit or shorten the window"
            )
        return line
    lines = refit(poses)
    rows = lines.reshape(len(poses), len(fits), len(STATES))
    d = np.column_stack([to_ego(poses[:, :2], refit.pose), poses[:, 2] - refit.pose[2]])
    for i, (points, fit) in enumerate(zip(refit.points, fits, strict=True)):
        posed = np.flatnonzero(~np.isnan(rows[:, i, 0]))
        for some in np.array_split(posed, posed.size * len(points) // BLOCK + 1):
            rows[some, i] = _seen(points, d[some], fit)
    return lines


def _seen(points: Array, d: Array, fit: Fit) -> Array:
    """(N, 4) lines through points (n, 2) as seen from poses d (N, 3) in the points' frame."""
    s, t = points[:, 0] - d[:, :1], points[:, 1] - d[:, 1:2]
    cosine, sine = np.cos(d[:, 2:]), np.sin(d[:, 2:])
    u, v = cosine * s + sine * t, cosine * t - sine * s  # (N, n)
    low, high = u.min(axis=1), u.max(axis=1)
    centre, half, level = (low + high) / 2, (high - low) / 2, v.mean(axis=1)
    a, b = (u - centre[:, None]) / half[:, None], (v - level[:, None]) / half[:, None]
    q = half * fit(a, b, half).T
    q[0] += level
    return line_of_cubic(q, centre, half)


def _powers(t: Array) -> Array:
    """(..., n, 4): 1, t, t^2, t^3."""
    return np.stack([np.ones_like(t), t, t * t, t * t * t], axis=-1)


def _least_squares(a: Array, b: Array, weights: Array) -> Array:
    """(N, 4) cubics with the least weighted sum of squared lateral residuals."""
    A = _powers(a)
    AtW = (A * weights[..., None]).swapaxes(-1, -2)
    try:
        q = np.linalg.solve(AtW @ A, AtW @ b[..., None])
    except np.linalg.LinAlgError:  # too few points have a weight: the least of the cubics that fit
        q = np.linalg.pinv(AtW @ A, hermitian=True) @ (AtW @ b[..., None])
    return np.asarray(q[..., 0], dtype=float)


def _orthogonal(a: Array, b: Array, half: Array) -> Array:  # noqa: ARG001 - needs no metres
    """(N, 4) cubics of ``TotalLeastSquares``."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # of steps too long
        return _settled(a, b)


def _settled(a: Array, b: Array) -> Array:
    """(N, 4) cubics at which the steps end, NaN where they do not."""
    out = np.full((len(a), 4), np.nan)
    q, t, busy = _least_squares(a, b, np.ones_like(a)), a, np.arange(len(a))
    for _ in range(STEPS):
        dq, dt = _descent(a, b, q, t)
        q, t, share = _stepped(a, b, q, t, dq, dt)
        settled = np.abs(dq).max(axis=1) <= SETTLED
        out[busy[settled]] = q[settled]
        go = ~settled & (share > 0)
        a, b, q, t, busy = a[go], b[go], q[go], t[go], busy[go]
        if not busy.size:
            break
    return out


def _misses(a: Array, b: Array, q: Array, t: Array) -> tuple[Array, Array]:
    """(N, n) what foot points at t miss the points by, along the car's two axes."""
    q0, q1, q2, q3 = q.T[:, :, None]
    return a - t, b - (q0 + t * (q1 + t * (q2 + t * q3)))


def _descent(a: Array, b: Array, q: Array, t: Array) -> tuple[Array, Array]:
    """(N, 4), (N, n) steps of cubics and foot points towards the least squared distances.

    With f = a - t, e = b - p(t) and p the cubic, half the sum of f^2 + e^2 has in t the
    gradient -(f + e p') and the second derivative 1 + p'^2 - e p''; mixed with the k-th
    coefficient it is p' t^k - e k t^(k-1). Gauss-Newton leaves the terms with e out.
    The foot points are eliminated: what remains is 4 x 4.
    """
    f, e = _misses(a, b, q, t)
    _, q1, q2, q3 = q.T[:, :, None]
    p1, p2 = q1 + t * (2 * q2 + t * 3 * q3), 2 * q2 + 6 * q3 * t
    T = _powers(t)
    T1 = np.stack([np.zeros_like(t), np.ones_like(t), 2 * t, 3 * t * t], axis=-1)
    grad_t = -(f + e * p1)
    grad_q = -(e[:, None] @ T)[:, 0]

    def step(e: Array | float) -> tuple[Array, Array, NDArray[np.bool_]]:
        D = 1 + p1 * p1 - e * p2  # (N, n)
        C = p1[..., None] * T - np.asarray(e)[..., None] * T1  # (N, n, 4)
        CtD = (C / D[..., None]).swapaxes(1, 2)
        H = T.swapaxes(1, 2) @ T - CtD @ C
        dq = np.linalg.solve(H, CtD @ grad_t[..., None] - grad_q[..., None])
        dt = -(grad_t + (C @ dq)[..., 0]) / D
        dq = dq[..., 0]
        slope = (grad_q * dq).sum(axis=1) + (grad_t * dt).sum(axis=1)
        return dq, dt, (D > 0).all(axis=1) & (slope <= 0)

    dq, dt, down = step(e)
    if not down.all():
        gauss_q, gauss_t, _ = step(0.0)
        dq[~down], dt[~down] = gauss_q[~down], gauss_t[~down]
    return dq, dt


def _stepped(
    a: Array, b: Array, q: Array, t: Array, dq: Array, dt: Array
) -> tuple[Array, Array, Array]:
    """Cubics and foot points after a step, halved until no distance is gained; and its share."""

    def after(share: Array) -> tuple[Array, Array, Array]:
        q_new, t_new = q + share[:, None] * dq, t + share[:, None] * dt
        f, e = _misses(a, b, q_new, t_new)
        return q_new, t_new, (f * f + e * e).sum(axis=1)

    share = np.ones(len(q))
    most = after(np.zeros(len(q)))[2] * (1 + 1e-12) + 1e-24  # rounding is no gain
    for _ in range(HALVINGS):
        q_new, t_new, cost = after(share)
        worse = ~(cost <= most)
        if not worse.any():
            break
        share[worse] /= 2
    else:
        share[worse] = 0
    return q_new, t_new, share


def _reweighted(
    a: Array, b: Array, half: Array, weights: Array, scale: float | None
) -> tuple[Array, Array]:
    """(N, 4) cubics of ``Robust`` from weights (N, n) or (n,) to begin with, and their weights."""
    s = (LEAST_SCALE if scale is None else scale) / half
    least = s
    q = np.full((len(a), 4), np.inf)
    for i in range(REWEIGHTINGS):
        # No weight is quite 0, so that there always is a solution.
        last, q = q, _least_squares(a, b, np.maximum(weights, 1e-12))
        r = np.abs(_misses(a, b, q, a)[1])
        if scale is None and i < SCALE_STAYS:
            s = np.maximum(least, np.median(r, axis=1) / MAD_OF_NORMAL)
        weights = _hampel(r / s[:, None])
        if (np.abs(q - last) <= SETTLED).all():
            break
    return q, weights


def _hampel(r: Array) -> Array:
    """Weights of residuals in units of the scale: Hampel's function, divided by r."""
    one, flat, zero = HAMPEL
    weights: Array = one / np.maximum(r, one) * ((zero - r) / (zero - flat)).clip(0, 1)
    return weights


def _first_weights(points: Array, scale: float | None) -> Array:
    """(n,) weights of points (n, 2) from the best of many cubics through 4 of them."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = (high[:1] - low[:1]) / 2
    a, b = ((points - (low + high) / 2) / half).T
    n = len(points)
    if comb(n, 4) <= TRIALS:
        trials = np.array(list(combinations(range(n), 4)))
    else:
        trials = np.random.default_rng(0).random((TRIALS, n)).argsort(axis=1)[:, :4]
    trials = trials[np.diff(np.sort(a[trials], axis=1), axis=1).min(axis=1) >= LEAST_GAP]
    weights = np.ones(n)
    if len(trials):
        q = np.linalg.solve(_powers(a[trials]), b[trials][..., None])[..., 0]
        r = np.abs(_misses(a[None], b[None], q, a[None])[1])  # (trials, n)
        best = np.median(r, axis=1).argmin()
        s = np.median(r[best]) * half[0] / MAD_OF_NORMAL if scale is None else scale
        weights = _hampel(r[best] * half[0] / max(s, LEAST_SCALE if scale is None else 0.0))
    return _reweighted(a[None], b[None], half, weights, scale)[1][0]
