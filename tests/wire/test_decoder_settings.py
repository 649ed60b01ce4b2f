"""Settings of a decoder."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dbcs import default_codec, edited

from maplines_can.values.line import MapLine, Slot
from maplines_can.wire import POSE, Codec, E2EConfig, Layout, ProfileStatus, default_dbc_path
from maplines_can.wire.reception.settings import decoder_settings, timeout_cycles


def test_a_time_of_an_hour_is_allowed() -> None:
    """The upper bound is part of the range."""
    assert default_codec().decoder(timeout_ms=3_600_000, cycle_ms=3_600_000).lines == 0


def test_max_delta_counter_must_be_less_than_half_of_the_counters(tmp_path: Path) -> None:
    """A short counter reduces the default; with a given value it is an error."""
    narrow = [(rf"({name} m0 : 16\|)8@1\+ \(1,0\) \[0\|255\]", r"\g<1>4@1+ (1,0) [0|15]")
              for name in ("Counter",)]  # fmt: skip
    codec = Codec.from_dbc(edited(tmp_path, *narrow, (r"Counter : 16\|8@1\+", "Counter : 16|4@1+")))
    for counter, status in ((7, ProfileStatus.OKSOMELOST), (8, ProfileStatus.WRONGSEQUENCE)):
        decoder, line = codec.decoder(), MapLine.mean_only(Slot.EGO_LEFT, np.zeros(4))
        for i, own in enumerate((3, counter)):  # 4 is a quarter of the counter modulus
            (frames,) = codec.encoder().encode_lines([line], counters={Slot.EGO_LEFT: own})
            for frame in frames:
                decoder.feed(frame.can_id, frame.data, 5 * i * 50_000_000)
        assert decoder.lines == 2
        assert decoder.checks[Slot.EGO_LEFT].status is status
    with pytest.raises(ValueError, match=r"max_delta_counter must be less than 8.*got 16"):
        codec.decoder(e2e=E2EConfig())
    with pytest.raises(ValueError, match=r"max_delta_counter must be less than 8.*got 8"):
        codec.decoder(e2e=E2EConfig(max_delta_counter=8))
    assert codec.decoder(e2e=E2EConfig(max_delta_counter=7)).lines == 0


@pytest.mark.parametrize("cycle_ms", [0, -5, float("nan"), float("inf"), 3_600_001])
def test_a_cycle_time_must_be_positive(cycle_ms: Any) -> None:
    """The message has the name, the value and the unit."""
    with pytest.raises(ValueError, match="cycle_ms must be more than 0 ms"):
        default_codec().decoder(cycle_ms=cycle_ms)


@pytest.mark.parametrize("cycle_attribute", [True, False])
@pytest.mark.parametrize("dbc", ["maplines.dbc", "maplines-pose.dbc"])
def test_the_times_of_lines_and_of_the_pose_error(
    dbc: str, cycle_attribute: bool, tmp_path: Path
) -> None:
    """By the cycle time of the DBC, 100 ms if it has none, or as they are given.

    The time-out is 1.5 cycles, and half a cycle of the DBC at least.
    """
    text, path = default_dbc_path(dbc).read_text(), tmp_path / dbc
    lines = [line for line in text.splitlines() if not line.startswith('BA_ "GenMsgCycleTime"')]
    path.write_text(text if cycle_attribute else "\n".join(lines) + "\n")
    layout = Layout.from_dbc(path)
    assert layout.pose is not None
    factor = 1 if cycle_attribute else 2
    for given, timeout_ms, cycle_ms in (
        ((None, None), 75 * factor, 50 * factor),
        ((None, 200), 300, 200),
        ((None, 10), 25 * factor, 10),
        ((7, None), 7, 50 * factor),
    ):
        times = timeout_ms * 1_000_000, cycle_ms * 1_000_000
        settings = decoder_settings(layout, *given)
        assert settings.keys() == {POSE, *Slot}
        assert {one[:2] for one in settings.values()} == {times}


def test_a_record_without_components_is_one_for_each_transfer_id() -> None:
    """The transfer IDs of the pose error come again after as many cycles."""
    layout = Layout.from_dbc(default_dbc_path("maplines-pose.dbc"))
    assert "ComponentCount" not in layout.signals
    assert timeout_cycles(layout) == 1.5


def test_a_time_is_a_nanosecond_or_more() -> None:
    """A cycle time of less would be 0, by which nothing can be divided."""
    decoder = default_codec().decoder(cycle_ms=1e-9, timeout_ms=1e-9)
    assert decoder.checks[Slot.EGO_LEFT].cycle_ns == 1
    assert decoder.latest(Slot.EGO_LEFT, 10**18).line is None
