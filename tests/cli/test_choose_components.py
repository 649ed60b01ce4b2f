"""Numbers of components for the lines of a scene, within a bus load."""

from itertools import chain

import pytest
from dbcs import default_codec
from hypothesis import given
from hypothesis import strategies as st

from maplines_can import MonteCarlo, Refit, Slot, scenario
from maplines_can.bus import bus_load
from maplines_can.cli.sending import MAX_LOAD, choose_components, scene_lines
from maplines_can.propagation import Mixture, component_counts, nonlinearity
from maplines_can.study.accuracy.approximations import Approximation
from maplines_can.study.accuracy.evaluation import judged, truth_of


@given(
    st.sampled_from(["production", "street-turn-10deg"]),
    st.integers(1, 8),
    st.floats(1, 100),
    st.booleans(),
    st.floats(0.01, 1),
)
def test_the_bus_load_is_within_its_bound(name, lines, rate, fd, max_load):
    """The bound holds for the frames that are sent, or an error is raised."""
    codec, scene = default_codec(), scenario(name)
    one_each = codec.encode_lines(scene_lines(scene, lines), fd=fd)
    if bus_load(chain(*one_each), 1 / rate, 5e5, 2e6) > max_load:
        with pytest.raises(ValueError, match=f"{100 * max_load:g} % are allowed"):
            choose_components(scene, codec, lines, rate=rate, fd=fd, max_load=max_load)
        return
    chosen = choose_components(scene, codec, lines, rate=rate, fd=fd, max_load=max_load)
    sent = scene_lines(scene, lines, components=[line.parts for line in chosen])
    assert bus_load(chain(*codec.encode_lines(sent, fd=fd)), 1 / rate, 5e5, 2e6) <= max_load * (
        1 + 1e-9
    )


def test_a_bus_too_slow_for_one_component_each_raises():
    """Four transfers of 4 x 135 bits at 20 Hz and 500 kbit/s take 8.64 %."""
    with pytest.raises(
        ValueError, match=r"4 lines in 4 parts take 8.64 % .* 8 % are allowed; send"
    ):
        choose_components(scenario("highway"), default_codec(), max_load=0.08)
    assert [
        p.parts for p in choose_components(scenario("highway"), default_codec(), max_load=0.0864)
    ] == [1] * 4


def test_a_fixed_number_is_bounded_only_on_demand():
    """A fixed number of components has no default bound of the load."""
    scene, codec = scenario("highway"), default_codec()
    chosen = choose_components(scene, codec, components=8)
    assert [line.parts for line in chosen] == [8] * 4
    with pytest.raises(ValueError, match=r"4 lines in 32 parts take 69.1 %"):
        choose_components(scene, codec, components=8, max_load=MAX_LOAD)


@pytest.mark.filterwarnings("ignore:.* draws are ill-posed")
@pytest.mark.parametrize(
    ("name", "count", "before", "after"),
    [
        pytest.param("production", 1, 0.02, 0.02, id="production"),
        pytest.param("street-turn", 1, 0.04, 0.04, id="street-turn"),
        pytest.param("street-turn-10deg", 5, 0.14, 0.05, id="street-turn-10deg"),
        pytest.param("highway", 5, 0.43, 0.10, id="highway"),
        pytest.param("highway-10deg", 5, 0.43, 0.11, id="highway-10deg"),
    ],
)
def test_false_positives_of_the_chosen_components(name, count, before, after):
    """One component stays where it is good enough; in the other scenes most false positives go."""
    scene = scenario(name)
    refit = Refit(scene.polylines[1], scene.ego.mean, scene.window)
    truth = truth_of(MonteCarlo(200_000, 0).samples(refit, scene.ego).values)

    def false_positives(k):
        mixture = Approximation(*Mixture(k).moments(refit, scene.ego))
        return judged(truth, mixture, (name, str(k), "before")).false_positives

    (k,) = component_counts([nonlinearity(refit, scene.ego).amount])
    assert k == count
    assert false_positives(k) < after
    if k > 1:
        assert false_positives(1) > before


def test_a_faster_bus_gives_more_components():
    """On CAN FD each line of a turn gets the components it needs; classic CAN is shared."""
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
