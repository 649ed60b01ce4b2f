"""Numbers of mixture components within a bus load."""

from itertools import chain
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.dbcs import default_codec
from support.lines import scenario_lines

from maplines_can.bus import bus_load
from maplines_can.simulation import scenario
from maplines_can.simulation.bus_share import MAX_LOAD, BusShare, choose_components


@given(
    st.sampled_from(["production", "street-turn-10deg"]),
    st.integers(1, 8),
    st.floats(1, 100),
    st.booleans(),
    st.floats(0.01, 1),
)
def test_the_bus_load_stays_within_its_limit(
    name: Any, lines: int, rate: float, fd: bool, max_load: float
) -> None:
    """If one component for each line exceeds the limit, an error says so."""
    codec, scene = default_codec(), scenario(name)
    encoder = codec.encoder()
    share = BusShare(rate, fd, max_load=max_load)
    one_each = encoder.encode_lines(scenario_lines(scene, lines), fd=fd)
    if bus_load(chain(*one_each), 1 / rate, 5e5, 2e6) > max_load:
        with pytest.raises(ValueError, match=f"{100 * max_load:g} % are allowed"):
            choose_components(scene, codec, lines, bus=share)
        return
    chosen = choose_components(scene, codec, lines, bus=share)
    sent = scenario_lines(
        scene, lines, components={slot: line.components for slot, line in chosen.items()}
    )
    assert bus_load(chain(*encoder.encode_lines(sent, fd=fd)), 1 / rate, 5e5, 2e6) <= max_load * (
        1 + 1e-9
    )


def test_a_fixed_number_has_no_limit_by_default() -> None:
    """A number of components is used as it is unless ``max_load`` is given."""
    scene, codec = scenario("highway"), default_codec()
    chosen = choose_components(scene, codec, components=8)
    assert [line.components for line in chosen.values()] == [8] * 4
    with pytest.raises(ValueError, match=r"4 lines with 32 components take 69.1 %"):
        choose_components(scene, codec, components=8, bus=BusShare(max_load=MAX_LOAD))


def test_can_fd_allows_more_components() -> None:
    """On CAN FD each line of a turn gets what it needs; classic CAN has no room for that."""
    scene, codec = scenario("street-turn-10deg"), default_codec()
    classic, fd = (
        {slot: line.components for slot, line in chosen.items()}
        for chosen in (
            choose_components(scene, codec, bus=BusShare(fd=fd, max_load=0.2))
            for fd in (False, True)
        )
    )
    assert sum(classic.values()) == 9  # 9 transfers of 4 x 135 bits take 19.4 %
    assert set(fd.values()) == {3}  # nonlinearity of 0.4 to 0.52, of which each may keep 0.225
    assert len(fd) == 4
    assert all(classic[slot] <= fd[slot] for slot in fd)
    production = choose_components(scenario("production"), codec)
    assert all(line.components == 1 for line in production.values())
