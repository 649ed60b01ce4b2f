"""How many parts a line needs, and how a bus that is too small for all is shared."""

from itertools import chain, product

import numpy as np
import pytest
from dbcs import default_codec
from hypothesis import given
from hypothesis import strategies as st

from maplines_can import Gaussian, MonteCarlo, Quadrature, Refit, Slot, scenario
from maplines_can.bus import bus_load, transfers_within
from maplines_can.cli.sending import MAX_LOAD, choose_components, scene_lines
from maplines_can.propagation import component_counts as component_counts
from maplines_can.propagation import nonlinearity
from maplines_can.propagation.component_counts import remaining_nonlinearity
from maplines_can.propagation.mixture import SPLITS, Mixture
from maplines_can.study.accuracy.approximations import Approximation
from maplines_can.study.accuracy.evaluation import evaluate_approximation, true_distribution
from maplines_can.wire import Frame

amounts = st.lists(st.floats(0, 1), min_size=1, max_size=8)
tolerances = st.floats(0.01, 1)


def most_left(values, counts):
    return max(remaining_nonlinearity(a, k) for a, k in zip(values, counts, strict=True))


def pooled(function, gaussian, k):
    """What ``remaining_nonlinearity`` predicts, measured on each part, of the worst output."""
    parts = Mixture(k).split(gaussian, function)
    found = []
    for i in range(np.asarray(function(gaussian.mean[None])).shape[1]):

        def output(x, i=i):
            return function(x)[:, [i]]

        bends = np.array([nonlinearity(output, part).amount for part in parts.components])
        spread = np.array([Quadrature(5)(output, part).cov[0, 0] for part in parts.components])
        found.append(np.sqrt(parts.weights @ (bends**2 * spread) / (parts.weights @ spread)))
    return max(found)


# ---- how many a line needs ----------------------------------------------------------------


@pytest.mark.parametrize("k", SPLITS)
@pytest.mark.parametrize("slope", [0.0, 0.3, 1.0, 10.0])
def test_what_is_left_of_a_parabola(slope, k):
    """Of one variable and quadratic: exact, from the vertex to nearly straight."""

    def parabola(x):
        return slope * x + x**2

    gaussian = Gaussian([0.0], [[1.0]])
    left = remaining_nonlinearity(nonlinearity(parabola, gaussian).amount, k)
    assert left == pytest.approx(pooled(parabola, gaussian, k), rel=1e-6)


@pytest.mark.parametrize("k", SPLITS)
def test_small_bends_shrink_with_the_parts(k):
    """In proportion to their spread, whose square is what the means leave of the variance."""
    part = Mixture(k).split(Gaussian([0.0], [[1.0]]), direction=[1.0]).components[0]
    assert remaining_nonlinearity(1e-3, k) / 1e-3 == pytest.approx(part.sigma[0], rel=1e-5)


def test_spread_across_the_split_leaves_less():
    """A straight variable beside the bent one is not narrowed by the split."""

    def saddle(x):
        return x[:, :1] ** 2 + x[:, 1:]

    gaussian = Gaussian([0.0, 0.0], np.eye(2))
    for k in range(2, 9):
        predicted = remaining_nonlinearity(nonlinearity(saddle, gaussian).amount, k)
        assert pooled(saddle, gaussian, k) < predicted


@pytest.mark.parametrize(
    ("name", "least", "most"),
    [
        pytest.param("highway", 0.97, 1.01, id="a-parabola"),
        pytest.param("highway-10deg", 0.97, 1.05, id="wide"),
        pytest.param("production", 0.25, 0.76, id="spread-across"),
        pytest.param("street-turn-10deg", 1.2, 2.0, id="higher-orders"),
    ],
)
def test_measured_over_predicted_of_a_refit(name, least, most):
    """Where the heading is nearly all it holds; higher orders in the outer parts of a turn."""
    scene = scenario(name)
    refit = Refit(scene.polylines[1], scene.ego.mean, scene.window)
    amount = nonlinearity(refit, scene.ego).amount
    for k in range(2, 9):
        ratio = pooled(refit, scene.ego, k) / remaining_nonlinearity(amount, k)
        assert least < ratio < most


@pytest.mark.parametrize(
    ("values", "settings", "counts"),
    [
        pytest.param([], {}, [], id="no-line"),
        pytest.param([0.0], {}, [1], id="straight"),
        pytest.param([0.3], {}, [1], id="at-the-tolerance"),
        pytest.param([0.3001], {}, [2], id="above-it"),
        pytest.param([1.0], {}, [5], id="a-vertex"),
        pytest.param([1.0], {"tolerance": 0.01}, [8], id="no-more-than-eight"),
        pytest.param([1.0] * 3, {"budget": 3}, [1, 1, 1], id="one-each"),
        pytest.param([1.0] * 3, {"budget": 5}, [2, 2, 1], id="ties-in-order"),
        pytest.param([1.0, 0.1], {"budget": 100}, [5, 1], id="no-more-than-needed"),
        pytest.param([1.0, 0.5], {"budget": 100, "tolerance": 0.1}, [8, 8], id="the-full-goes-by"),
    ],
)
def test_counts(values, settings, counts):
    """Values one step from each bound."""
    assert component_counts(values, **settings) == counts


@given(amounts, tolerances, tolerances)
def test_a_wider_tolerance_takes_no_part_more(values, one, other):
    """And with no budget each line has the fewest that meet it."""
    wide, narrow = (
        component_counts(values, tolerance=t) for t in sorted([one, other], reverse=True)
    )
    assert all(w <= n for w, n in zip(wide, narrow, strict=True))
    tolerance = min(one, other)
    for value, k in zip(values, narrow, strict=True):
        assert k == 8 or remaining_nonlinearity(value, k) <= tolerance
        assert k == 1 or remaining_nonlinearity(value, k - 1) > tolerance


@given(amounts, tolerances, st.integers(0, 64), st.integers(0, 64))
def test_a_larger_budget_takes_no_part_away(values, tolerance, one, other):
    """No budget is overrun, and none leaves a line without a part."""
    few, many = (
        component_counts(values, tolerance=tolerance, budget=len(values) + extra)
        for extra in sorted([one, other])
    )
    assert all(1 <= a <= b <= 8 for a, b in zip(few, many, strict=True))
    assert sum(few) <= len(values) + min(one, other)
    assert sum(many) <= len(values) + max(one, other)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=3), st.integers(0, 21))
def test_no_division_leaves_less(values, extra):
    """Against all divisions of the budget."""
    budget = len(values) + extra
    counts = component_counts(values, tolerance=1e-9, budget=budget)
    others = product(range(1, 9), repeat=len(values))
    best = min(most_left(values, other) for other in others if sum(other) <= budget)
    assert max(most_left(values, counts), 1e-9) == max(best, 1e-9)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (([1.1],), "amounts must be .* from 0 to 1"),
        (([float("nan")],), "amounts must be"),
        (([[0.5]],), "amounts must be"),
        (([0.5], {"tolerance": 0.0}), "tolerance must be more than 0, got 0.0"),
        (([0.5, 0.5], {"budget": 1}), "budget must be 2 or more, a part for each line, got 1"),
    ],
)
def test_wrong_arguments_raise(arguments, words):
    """With name, range and value."""
    values, *settings = arguments
    with pytest.raises(ValueError, match=words):
        component_counts(values, **(settings[0] if settings else {}))


# ---- what a bus allows --------------------------------------------------------------------


@given(st.floats(1e-4, 1), st.floats(1e-3, 1), st.sampled_from([125e3, 500e3, 1e6]), st.booleans())
def test_bursts_within_a_share(share, period, bitrate, fd):
    """They fit, and one more does not."""
    transfer = [Frame(0x100, bytes(32), is_fd=True)] if fd else [Frame(0x100, bytes(8))] * 4
    n = transfers_within(share, transfer, period, bitrate)
    assert bus_load(transfer * n, period, bitrate) <= share * (1 + 1e-9)
    assert bus_load(transfer * (n + 1), period, bitrate) > share


@pytest.mark.parametrize("n", [1, 3, 13, 64])
def test_a_share_filled_to_the_last_bit(n):
    """Rounding takes no transfer away."""
    transfer = [Frame(0x100, bytes(8))] * 4
    assert transfers_within(bus_load(transfer * n, 0.1, 5e5), transfer, 0.1, 5e5) == n


@pytest.mark.parametrize("share", [0.0, -0.1, 1.01, float("nan")])
def test_a_share_is_a_share(share):
    with pytest.raises(ValueError, match="share must be more than 0 and at most 1"):
        transfers_within(share, [Frame(0x100, bytes(8))], 0.1, 5e5)


@given(
    st.sampled_from(["production", "street-turn-10deg"]),
    st.integers(1, 8),
    st.floats(1, 100),
    st.booleans(),
    st.floats(0.01, 1),
)
def test_the_load_keeps_within_its_bound(name, lines, rate, fd, max_load):
    """Of the frames that are sent; or an error that says so."""
    codec, scene = default_codec(), scenario(name)
    one_each = codec.encode_lines(scene_lines(scene, lines), fd=fd)
    if bus_load(chain(*one_each), 1 / rate, 5e5, 2e6) > max_load:
        with pytest.raises(ValueError, match=f"{100 * max_load:g} % are allowed"):
            choose_components(scene, codec, lines, rate=rate, fd=fd, max_load=max_load)
        return
    parts = choose_components(scene, codec, lines, rate=rate, fd=fd, max_load=max_load)
    sent = scene_lines(scene, lines, components=[line.parts for line in parts])
    assert bus_load(chain(*codec.encode_lines(sent, fd=fd)), 1 / rate, 5e5, 2e6) <= max_load * (
        1 + 1e-9
    )


def test_too_little_bus_for_one_part_each():
    """Four transfers of 4 x 135 bits at 20 Hz and 500 kbit/s take 8.64 %."""
    with pytest.raises(
        ValueError, match=r"4 lines in 4 parts take 8.64 % .* 8 % are allowed; send"
    ):
        choose_components(scenario("highway"), default_codec(), max_load=0.08)
    assert [
        p.parts for p in choose_components(scenario("highway"), default_codec(), max_load=0.0864)
    ] == [1] * 4


def test_a_fixed_number_is_bounded_only_on_demand():
    """Who says how many gets them, unless a bound is given as well."""
    scene, codec = scenario("highway"), default_codec()
    parts = choose_components(scene, codec, components=8)
    assert [line.parts for line in parts] == [8] * 4
    with pytest.raises(ValueError, match=r"4 lines in 32 parts take 69.1 %"):
        choose_components(scene, codec, components=8, max_load=MAX_LOAD)


# ---- whether the choice is a good one -----------------------------------------------------


@pytest.mark.filterwarnings("ignore:.* draws are ill-posed")
@pytest.mark.parametrize(
    ("name", "parts", "before", "after"),
    [
        pytest.param("production", 1, 0.02, 0.02, id="production"),
        pytest.param("street-turn", 1, 0.04, 0.04, id="street-turn"),
        pytest.param("street-turn-10deg", 5, 0.14, 0.05, id="street-turn-10deg"),
        pytest.param("highway", 5, 0.43, 0.10, id="highway"),
        pytest.param("highway-10deg", 5, 0.43, 0.11, id="highway-10deg"),
    ],
)
def test_false_positives_of_the_chosen_parts(name, parts, before, after):
    """A scene that one Gaussian serves keeps it; the others lose most of their false positives."""
    scene = scenario(name)
    refit = Refit(scene.polylines[1], scene.ego.mean, scene.window)
    truth = true_distribution(MonteCarlo(200_000, 0).samples(refit, scene.ego).values)

    def false_positives(k):
        mixture = Approximation(*Mixture(k).moments(refit, scene.ego))
        return evaluate_approximation(truth, mixture, (name, str(k), "before")).false_positives

    (k,) = component_counts([nonlinearity(refit, scene.ego).amount])
    assert k == parts
    assert false_positives(k) < after
    if k > 1:
        assert false_positives(1) > before


def test_a_bus_of_more_room_gives_more_parts():
    """On CAN FD each line of a turn has what it needs; on classic CAN the bus is shared."""
    scene, codec = scenario("street-turn-10deg"), default_codec()
    classic, fd = (
        {line.slot: line.parts for line in choose_components(scene, codec, fd=fd)}
        for fd in (False, True)
    )
    assert sum(classic.values()) == 13
    assert sum(fd.values()) > 13
    assert fd[Slot.EGO_RIGHT.name] == 5
    assert all(classic[slot] <= fd[slot] for slot in fd)
    assert all(line.parts == 1 for line in choose_components(scenario("production"), codec))
