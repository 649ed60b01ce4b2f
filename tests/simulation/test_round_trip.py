"""Lines over a bus and back."""

from dataclasses import replace

import numpy as np
import pytest
from answers import one
from support.lines import lines_timed_out, scenario_lines

from maplines_can import Codec
from maplines_can.simulation import scenario
from maplines_can.simulation.round_trip import BusSettings, round_trip
from maplines_can.testing import Faults

LINES = scenario_lines(scenario("production"), 2)


def test_every_line_is_received_as_the_codec_decodes_it() -> None:
    """The figures are those of the received Gaussians, and no line is lost."""
    codec = Codec.from_dbc()
    encoder = codec.encoder()
    trip = round_trip(LINES, codec, seconds=0.2)
    decoder = Codec.from_dbc().decoder()
    for line, result in zip(LINES, trip.lines, strict=True):
        *_, expected = [one(decoder.feed(f.can_id, f.data, 0)) for f in encoder.encode(line)]
        received = trip.received_lines[line.slot.name]
        assert result.slot == line.slot.name
        assert result.mean == received.gaussian.mean.tolist() == expected.gaussian.mean.tolist()  # type: ignore[union-attr]
        assert result.true_mean == line.gaussian.mean.tolist()
        assert np.array_equal(received.gaussian.cov, expected.gaussian.cov)  # type: ignore[union-attr]
    assert trip.sent.lines + trip.sent.overruns == 2 * 4
    counts = {reason.name: n for reason, n in trip.received.counts.items()}
    lost = lines_timed_out(counts, trip.received.pending, trip.sent.frames // trip.sent.lines)
    assert (trip.lines_lost, trip.frames_lost) == (lost, 0)
    assert trip.received.lines == trip.sent.lines - lost
    assert trip.faults is None


@pytest.mark.parametrize("direction", ["send", "receive"])
def test_faults_are_counted_at_either_end(direction: str) -> None:
    """If every frame is lost, no line is received, and its result has no mean."""
    faults = replace(Faults.parse("loss=1"), direction=direction)
    trip = round_trip(LINES, Codec.from_dbc(), seconds=0.1, faults=faults)
    assert trip.faults["lost"] == trip.sent.frames == trip.frames_lost  # type: ignore[index]
    assert [line.mean for line in trip.lines] == [None, None]
    assert trip.lines_lost == trip.sent.lines > 0


def test_can_fd_and_its_bus_load() -> None:
    """A data bit rate means CAN FD; a faster data phase takes less of the bus."""
    loads = []
    for data_bitrate in (500_000, 2_000_000):
        bus = BusSettings(rate=50.0, data_bitrate=data_bitrate)
        trip = round_trip(LINES, Codec.from_dbc(), bus=bus, seconds=0.1)
        assert trip.frame_format == "CAN FD"
        assert trip.sent.frames == trip.sent.lines
        loads.append(trip.bus_load)
    assert loads[0] > loads[1] > 0
