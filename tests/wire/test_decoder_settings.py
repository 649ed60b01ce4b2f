"""Settings of a decoder."""

from pathlib import Path
from typing import Any

import pytest
from dbcs import default_codec, edited

from maplines_can.line import Slot
from maplines_can.wire import Codec, E2EConfig


def test_a_time_of_an_hour_is_allowed() -> None:
    """The upper bound is part of the range."""
    assert default_codec().decoder(timeout_ms=3_600_000, cycle_ms=3_600_000).lines == 0


def test_max_delta_counter_must_be_less_than_half_of_the_counters(tmp_path: Path) -> None:
    """A short counter reduces the default; with a given value it is an error."""
    narrow = [(rf"({name} m0 : 16\|)8@1\+ \(1,0\) \[0\|255\]", r"\g<1>4@1+ (1,0) [0|15]")
              for name in ("Counter",)]  # fmt: skip
    codec = Codec.from_dbc(edited(tmp_path, *narrow, (r"Counter : 16\|8@1\+", "Counter : 16|4@1+")))
    assert codec.decoder().checks[Slot.EGO_LEFT].received(3, 3, 0) is None
    with pytest.raises(ValueError, match=r"max_delta_counter must be less than 8.*got 16"):
        codec.decoder(e2e=E2EConfig())


@pytest.mark.parametrize("cycle_ms", [0, -5, float("nan"), float("inf")])
def test_a_cycle_time_must_be_positive(cycle_ms: Any) -> None:
    """The message has the name, the value and the unit."""
    with pytest.raises(ValueError, match="cycle_ms must be more than 0 ms"):
        default_codec().decoder(cycle_ms=cycle_ms)
