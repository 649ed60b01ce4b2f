"""Total least squares and the robust fit, and what a turn of the frame does to a fit."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import least_squares
from strategies import mild_lines, motions

from maplines_can.errors import IllPosedError
from maplines_can.line import lateral, line_of_cubic, transform_line
from maplines_can.polyline import Polyline, to_ego
from maplines_can.propagation import Linear, MapError, MonteCarlo, Quadrature, Refit, SigmaPoints
from maplines_can.scenarios import random_scenarios, scenario
from maplines_can.study.fits import Robust, TotalLeastSquares, robust, total_least_squares

X = np.linspace(-20.0, 80.0, 51)
HIGHWAY = np.array([1.75, -0.02, 1 / 2000, 1e-6])
TURN = np.array([3.0, -2.0, np.radians(10.0)])


def line_points(line, x=X):
    return np.column_stack([x, lateral(line, x)])


def ordinary(points):
    """The ordinary fit, with the signature of the others."""
    x = points[:, 0]
    return Refit(Polyline(points), np.zeros(3), (x.min() - 1, x.max() + 1))(np.zeros(3))


FITS = pytest.mark.parametrize("fit", [ordinary, total_least_squares, robust])
OTHERS = pytest.mark.parametrize("make", [TotalLeastSquares, Robust, lambda r: Robust(r, 0.1)])


def refit_of(name, i=0, noise=0.0, map_error=None):
    """A line of a scenario, its map points noisy, and the scenario."""
    scene = scenario(name)
    points = scene.polylines[i].points
    points = points + noise * np.random.default_rng(i).normal(size=points.shape)
    x_min, x_max = scene.window
    return Refit(Polyline(points), scene.ego.mean, (x_min - 1, x_max + 1), map_error), scene


def apart(one, other, points):
    """The greatest lateral difference of two lines over the extent of points [m]."""
    x = np.linspace(points[:, 0].min(), points[:, 0].max(), 101)
    return np.abs(lateral(one, x) - lateral(other, x)).max()


def change_by_turn(fit, points, pose=TURN):
    """How far a line fitted in a turned frame lies from one fitted in the first [m]."""
    turned = to_ego(points, pose)
    x = np.linspace(turned[:, 0].min(), turned[:, 0].max(), 101)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    back = line_points(fit(turned), x) @ np.array([[c, s], [-s, c]]) + pose[:2]
    return np.abs(back[:, 1] - lateral(fit(points), back[:, 0])).max()


def squared_distances(line, points):
    """Sum of the squared orthogonal distances, foot points found by trying all of a fine grid."""
    u, v = points.T[:, :, None]
    near = np.linspace(-1.0, 1.0, 401) * (np.abs(v[:, 0] - lateral(line, u[:, 0])).max() + 0.01)
    t = u + near
    d2 = (u - t) ** 2 + (v - lateral(line, t)) ** 2
    k = d2.argmin(axis=1).clip(1, len(near) - 2)
    low, mid, high = (d2[np.arange(len(k)), k + i] for i in (-1, 0, 1))
    return (mid - (high - low) ** 2 / (8 * (high - 2 * mid + low))).sum()  # the parabola's depth


# Both, and the ordinary fit


@FITS
@given(line=mild_lines())
def test_points_of_a_cubic_give_this_cubic(fit, line):
    """Where all distances can be 0, they are, whichever distance is meant."""
    assert apart(fit(line_points(line)), line, line_points(line)) < 1e-9


@given(line=mild_lines(), motion=motions(5.0, 10.0))
def test_four_points_of_a_line_give_the_moved_line_whatever_the_distance(line, motion):
    """The paper's experiment (section III-A-1): seen from elsewhere, and all fits agree."""
    nodes = 30 + 50 * np.cos(np.pi * (np.arange(4) + 0.5) / 4)
    seen = to_ego(line_points(line, nodes), motion)
    expected = transform_line(line, motion, window=(-20.0, 80.0), points=4)

    for fit in (ordinary, total_least_squares, robust):
        np.testing.assert_allclose(fit(seen), expected, rtol=0, atol=1e-9)


def test_four_points_agree_on_a_street_turn_too():
    """However sharp the line: all distances are 0."""
    refit, scene = refit_of("street-turn")
    line = refit(scene.ego.mean)
    motion = [5.0, -5.0, np.radians(10)]
    a, b = refit.x_range
    nodes = (a + b) / 2 + (b - a) / 2 * np.cos(np.pi * (np.arange(4) + 0.5) / 4)
    seen = to_ego(line_points(line, nodes), motion)
    expected = transform_line(line, motion, window=(a, b), points=4)

    for fit in (ordinary, total_least_squares, robust):
        np.testing.assert_allclose(fit(seen), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("fit", [total_least_squares, robust])
@pytest.mark.parametrize(
    ("points", "words"),
    [
        pytest.param([[0, 0], [1, 0], [2, 0]], "needs 4 points", id="three"),
        pytest.param([[0, 0], [0, 5], [0, 9], [0, 20]], "stand across", id="across"),
        pytest.param([[0, 0], [9, 0], [0, 1], [9, 1], [0, 2]], "double back", id="back-and-forth"),
        pytest.param([[0, 0], [0, 0], [9, 0], [9, 0], [5, 0]], "double back", id="three-distinct"),
    ],
)
def test_points_without_a_cubic_are_refused(fit, points, words):
    with pytest.raises(IllPosedError, match=words):
        fit(points)


@pytest.mark.parametrize("fit", [total_least_squares, robust])
@given(arrays(int, st.tuples(st.integers(4, 9), st.just(2)), elements=st.integers(-9999, 9999)))
@example(np.array([[-190, 0], [1, 0], [-1, 0], [0, 17], [-1, 0], [0, 0]]))
@settings(max_examples=300)
def test_any_points_give_a_line_or_are_refused(fit, points):
    """Points at random are mostly not a road; what comes out is finite or an IllPosedError."""
    try:
        line = fit(points / 100)  # maps are digitised to the centimetre
    except IllPosedError:
        return
    assert np.isfinite(line).all()


# As a function of the pose, for the transforms


@OTHERS
def test_a_pose_gives_what_its_points_give(make):
    """The vectorised face is the fit for one pose, pose by pose."""
    refit, scene = refit_of("highway-10deg", noise=0.05)
    function = make(refit)
    poses = scene.ego.sample(20, np.random.default_rng(1))
    scale = getattr(function, "scale", None)
    lines = function(poses)

    for pose, line in zip(poses, lines, strict=True):
        seen = to_ego(refit.points[0], pose)
        one = robust(seen, scale) if isinstance(function, Robust) else total_least_squares(seen)
        assert apart(one, line, seen) < 1e-8
        assert apart(function(pose), line, seen) < 1e-8


@OTHERS
def test_several_lines_share_a_call(make):
    """(N, L, 4), and each line as if it were alone."""
    scene = scenario("highway")
    poses = scene.ego.sample(7, np.random.default_rng(0))
    together = make(Refit(scene.polylines, scene.ego.mean, scene.window))(poses)

    assert together.shape == (7, 8, 4)
    for i, polyline in enumerate(scene.polylines):
        alone = make(Refit(polyline, scene.ego.mean, scene.window))(poses)
        np.testing.assert_allclose(together[:, i], alone, rtol=0, atol=1e-9)


@OTHERS
def test_poses_that_look_across_are_rows_of_nan_and_alone_an_error(make):
    function = make(refit_of("highway")[0])
    lines = function([[0.0, 0.0, 1.57], [0.0, 0.0, 0.0]])

    assert np.isnan(lines[0]).all()
    assert np.isfinite(lines[1]).all()
    with pytest.raises(IllPosedError, match="90 deg"):
        function([0.0, 0.0, np.pi / 2])


@OTHERS
def test_no_poses_give_no_lines(make):
    assert make(refit_of("highway")[0])(np.empty((0, 3))).shape == (0, 4)


@OTHERS
@pytest.mark.parametrize("transform", [Linear(), SigmaPoints(), Quadrature(5), MonteCarlo(2000)])
def test_transforms_take_them_as_they_take_the_ordinary_fit(make, transform):
    """On a highway the three give the same Gaussian, the error of the map included."""
    refit, scene = refit_of("highway", map_error=MapError(point_sigma=0.1))
    expected, got = transform(refit, scene.ego), transform(make(refit), scene.ego)

    assert (np.abs(got.mean - expected.mean) < [1e-4, 1e-5, 1e-7, 1e-8]).all()
    np.testing.assert_allclose(got.sigma, expected.sigma, rtol=1e-3)


def test_a_scale_is_positive():
    with pytest.raises(ValueError, match="scale must be more than 0 m, got 0"):
        robust(line_points(HIGHWAY), scale=0)


# Total least squares


@pytest.mark.parametrize("name", ["highway", "street-turn", "street-turn-10deg"])
@pytest.mark.parametrize("noise", [0.0, 0.1, 0.5])
def test_no_line_nearby_has_less_distance(name, noise):
    """The objective, computed by brute force, grows in whatever direction the line is changed."""
    refit, scene = refit_of(name, noise=noise)
    points = to_ego(refit.points[0], scene.ego.sample(1, np.random.default_rng(2))[0])
    line = total_least_squares(points)
    least = squared_distances(line, points)

    assert least <= squared_distances(ordinary(points), points) * (1 + 1e-6)
    for direction in np.random.default_rng(3).normal(size=(40, 4)):
        shift = direction * [1e-2, 3e-4, 1e-5, 5e-7]
        assert squared_distances(line + shift, points) > least * (1 - 1e-6)


def scaled(points):
    u, v = points.T
    centre, half = (u.max() + u.min()) / 2, (u.max() - u.min()) / 2
    a, b = (u - centre) / half, v / half
    return a, b, np.polynomial.polynomial.polyfit(a, b, 3), centre, half


def by_scipy(points):
    """Total least squares by MINPACK, on the cubic and all foot points at once."""
    a, b, q, centre, half = scaled(points)

    def misses(z):
        return np.append(a - z[4:], b - np.polynomial.polynomial.polyval(z[4:], z[:4]))

    found = least_squares(misses, np.append(q, a), method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return line_of_cubic(half * found.x[:4], centre, half)


def by_odrpack(points):
    """Total least squares by ODRPACK95, the Fortran that scipy.odr wrapped too."""
    odrpack = pytest.importorskip("odrpack")
    a, b, q, centre, half = scaled(points)

    def cubic(x, beta):
        return np.polynomial.polynomial.polyval(x, beta)

    found = odrpack.odr_fit(cubic, a, b, q, partol=1e-14, sstol=1e-15, maxit=1000)
    return line_of_cubic(half * found.beta, centre, half)


@pytest.mark.parametrize(
    ("witness", "tolerance"),
    [pytest.param(by_scipy, 1e-6, id="scipy"), pytest.param(by_odrpack, 2e-5, id="odrpack")],
)
@pytest.mark.parametrize("name", ["highway", "street-turn", "street-turn-10deg"])
def test_total_least_squares_is_what_others_find(witness, tolerance, name):
    refit, scene = refit_of(name, noise=0.1)
    for pose in scene.ego.sample(8, np.random.default_rng(4)):
        points = to_ego(refit.points[0], pose)
        line = total_least_squares(points)

        assert apart(line, witness(points), points) < tolerance
        assert apart(line, ordinary(points), points) > 2 * tolerance  # it could tell


def test_it_converges_wherever_the_ordinary_fit_exists():
    """On random roads, from motorway to street turn, no pose is lost."""
    for scene in random_scenarios(60, seed=5):
        refit = Refit(scene.polylines[0], scene.ego.mean, scene.window)
        poses = scene.ego.sample(200, np.random.default_rng(0))

        there = ~np.isnan(refit(poses)[:, 0])
        assert np.array_equal(there, ~np.isnan(TotalLeastSquares(refit)(poses)[:, 0]))


def test_points_too_far_from_any_cubic_do_not_converge():
    """What does not settle is no line: it is refused alone, and NaN among others."""
    refit, _ = refit_of("highway")
    function = TotalLeastSquares(refit)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("maplines_can.study.fits.STEPS", 0)
        assert np.isnan(function(np.zeros((2, 3)))).all()
        with pytest.raises(IllPosedError, match="does not converge"):
            function(np.zeros(3))


# What a turn of the frame changes


def paired(scatter, length):
    """A straight line's points, each twice, on either side."""
    x = np.repeat(np.arange(0.0, length + 1, 2.0), 2)
    return np.column_stack([x, 2 + scatter * np.resize([1.0, -1.0], len(x))])


@pytest.mark.parametrize(
    ("scatter", "length", "pull"),
    [(0.2, 80.0, 1e-3), (1.0, 80.0, 2e-2), (0.5, 20.0, 2e-2)],
)
def test_where_the_best_curve_is_straight_only_total_least_squares_is_invariant(
    scatter, length, pull
):
    """Least squares is pulled towards the car's axis where points scatter along the line too."""
    points = paired(scatter, length)

    assert change_by_turn(total_least_squares, points) < 1e-9
    assert change_by_turn(ordinary, points) > pull


@FITS
def test_a_shift_of_the_frame_changes_no_fit(fit):
    """A shifted cubic is a cubic, and all distances stay."""
    points = refit_of("street-turn", noise=0.1)[0].points[0]

    assert change_by_turn(fit, points, np.array([3.0, 2.0, 0.0])) < 1e-8


def test_the_orthogonal_distance_is_invariant_and_the_lateral_is_not():
    """The objective at a curve and its points, both turned: a straight line stays a cubic."""
    points = paired(0.5, 80.0)
    line, turned = np.array([2.1, 0.01, 0.0, 0.0]), to_ego(points, TURN)
    seen = transform_line(line, TURN, window=(0.0, 80.0))

    before, after = squared_distances(line, points), squared_distances(seen, turned)
    assert after == pytest.approx(before, rel=1e-9)
    before = np.sum((points[:, 1] - lateral(line, points[:, 0])) ** 2)
    after = np.sum((turned[:, 1] - lateral(seen, turned[:, 0])) ** 2)
    assert after > 1.02 * before


@pytest.mark.parametrize(
    ("name", "noise", "least", "most"),
    [
        pytest.param("highway", 0.0, 1e-5, 1e-4, id="highway"),
        pytest.param("highway", 0.1, 1e-5, 1e-3, id="highway-with-scatter"),
        pytest.param("street-turn", 0.0, 0.1, 1.0, id="street-turn"),
    ],
)
@pytest.mark.parametrize("fit", [ordinary, total_least_squares])
def test_a_turned_cubic_is_no_cubic(fit, name, noise, least, most):
    """Why total least squares is not invariant either: the best of other curves is another."""
    points = refit_of(name, noise=noise)[0].points[0]

    assert least < change_by_turn(fit, points) < most


# Outliers


def with_outliers(points, share, kind, rng):
    """The same points, some of them 2 m away; and which."""
    points, n = points.copy(), len(points)
    count = round(share * n)
    wrong = rng.choice(n, count, replace=False)
    if kind == "run":
        wrong = rng.integers(0, n - count + 1) + np.arange(count)
    if kind == "end":
        wrong = np.arange(n - count, n)
    angle = np.full(count, np.pi / 2)
    if kind == "any direction":
        angle = rng.uniform(0, 2 * np.pi, count)
    points[wrong] += 2 * np.column_stack([np.cos(angle), np.sin(angle)])
    return points, np.isin(np.arange(n), wrong)


KINDS = pytest.mark.parametrize("kind", ["one side", "any direction", "run", "end"])


@KINDS
@pytest.mark.parametrize("share", [0.1, 0.2, 0.3])
def test_outliers_of_two_metres_do_not_move_the_robust_line(kind, share):
    """Within 1 cm of the truth, where least squares, total or not, is decimetres off."""
    rng = np.random.default_rng(7)
    for _ in range(10):
        points, _ = with_outliers(line_points(HIGHWAY), share, kind, rng)

        assert apart(robust(points), HIGHWAY, points) < 0.01
        assert apart(ordinary(points), HIGHWAY, points) > 0.1
        assert apart(total_least_squares(points), HIGHWAY, points) > 0.1


@KINDS
def test_with_noise_the_robust_line_is_that_of_the_good_points(kind):
    """2 cm of noise: as near to the truth as least squares that is told which points are good."""
    rng = np.random.default_rng(8)
    robust_off, told_off = [], []
    for _ in range(60):
        noisy = line_points(HIGHWAY) + 0.02 * rng.normal(size=(51, 2))
        points, wrong = with_outliers(noisy, 0.2, kind, rng)
        robust_off.append(apart(robust(points), HIGHWAY, points))
        told_off.append(apart(ordinary(points[~wrong]), HIGHWAY, points))

    assert np.mean(robust_off) < 1.15 * np.mean(told_off)
    assert kind == "end" or np.median(robust_off) < 0.02


def test_from_all_poses_the_outliers_stay_out():
    """They are found once, at the mean pose; elsewhere they are the same points."""
    _, scene = refit_of("highway")
    clean = scene.polylines[0].points
    points, wrong = with_outliers(clean, 0.2, "any direction", np.random.default_rng(9))
    window = (-25.0, 85.0)
    truth = Refit(Polyline(clean), scene.ego.mean, window)
    function = Robust(Refit(Polyline(points), scene.ego.mean, window))
    poses = scene.ego.sample(200, np.random.default_rng(0))

    for pose, line, true_line in zip(poses, function(poses), truth(poses), strict=True):
        assert apart(line, true_line, to_ego(clean, pose)) < 0.01
    assert np.array_equal(function.weights[0][~wrong], np.ones(np.sum(~wrong)))
    assert np.sum(function.weights[0][wrong] == 0) >= np.sum(wrong) - 2  # but those along the line


@pytest.mark.parametrize("shift", [1.0, 10.0, 100.0])
def test_the_influence_of_a_point_is_bounded(shift):
    """However far it is, beyond eight scales it does not count at all."""
    points = line_points(HIGHWAY)
    points[40, 1] += shift
    assert apart(robust(points, scale=0.1), HIGHWAY, line_points(HIGHWAY)) < 1e-8


def test_a_point_in_another_town_is_a_wrong_line():
    """Farther aside than the line is long: judged before anything is fitted."""
    points = line_points(HIGHWAY)
    points[40, 1] += 1000.0
    with pytest.raises(IllPosedError, match="stand across"):
        robust(points)


@given(
    line=mild_lines(),
    noise=arrays(float, 51, elements=st.floats(-0.19, 0.19)),
    heading=st.floats(-0.1, 0.1),
)
@settings(max_examples=50)
def test_without_outliers_the_robust_fit_is_least_squares(line, noise, heading):
    """Residuals of the least-squares line within two scales: the same line."""
    points = to_ego(line_points(line) + np.column_stack([0 * noise, noise]), [0, 0, heading])
    expected = ordinary(points)
    residuals = np.abs(points[:, 1] - lateral(expected, points[:, 0]))
    scale = max(0.1, residuals.max() / 1.99)

    assert apart(robust(points, scale=scale), expected, points) < 1e-8


def test_the_robust_fit_is_what_statsmodels_finds():
    """RLM(..., M=norms.Hampel()) of statsmodels 0.15.0 (a, b, c = 2, 4, 8; scale by MAD)."""
    i = np.arange(40)
    x = 2.0 * i
    y = 1.75 - 0.03 * x + x**2 / 1200 - x**3 / 240000 + 0.05 * np.sin(37 * i)
    y[i % 5 == 1] += 2.0
    statsmodels = [
        1.7360913035827596,
        -0.02963497498850081,
        0.0016923323592893402,
        -2.6461802544943597e-05,
    ]

    np.testing.assert_allclose(robust(np.column_stack([x, y])), statsmodels, rtol=1e-9)


def test_where_no_cubic_follows_the_road_the_robust_fit_forgets_a_part_of_it():
    """Its limit, and the cure: a scale as wide as what the cubic misses."""
    points = refit_of("street-turn")[0].points[0]
    residuals = np.abs(points[:, 1] - lateral(ordinary(points), points[:, 0]))
    line = robust(points)
    missed = np.abs(points[:, 1] - lateral(line, points[:, 0]))

    assert np.median(missed) < np.median(residuals)
    assert missed.max() > residuals.max()
    assert apart(robust(points, scale=residuals.max()), ordinary(points), points) < 1e-9
