"""Facts of a bus: what was sent on it is counted and decoded."""

import threading
import time
from typing import Any

import can
from support.lines import scenario_lines

from maplines_can import Codec
from maplines_can.desk.live import live_facts
from maplines_can.simulation import scenario


def send(bus: Any, codec: Any, lines: Any) -> int:
    """Send lines; return the number of their frames."""
    encoder = codec.encoder()
    frames = [frame for line in lines for frame in encoder.encode(line)]
    for frame in frames:
        bus.send(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False))
    return len(frames)


def test_facts_of_a_bus() -> None:
    """Lines, foreign frames and error frames are told apart; facts come a period apart."""
    codec, channel = Codec.from_dbc(), "desk live"
    lines = scenario_lines(scenario("highway"))
    over = threading.Event()
    with (
        can.Bus(interface="virtual", channel=channel) as bus,
        live_facts(codec, interface="virtual", channel=channel) as live,
    ):
        sent = send(bus, codec, lines)
        bus.send(can.Message(arbitration_id=0x123, data=b"12", is_extended_id=True))
        bus.send(can.Message(is_error_frame=True))
        bus.send(can.Message(arbitration_id=0x124, is_remote_frame=True))
        times, end = [], time.monotonic() + 10
        for facts in live.each(over.wait, period=0.01):
            times.append(facts["t"])
            traffic = facts["traffic"]
            is_all = traffic["frames"] == sent + 1 and traffic["error_frames"] == 1
            if (len(times) > 20 and is_all) or time.monotonic() > end:
                over.set()

    assert set(facts["slots"]) == {line.slot.name for line in lines}
    assert facts["lines"] == len(lines)
    assert (traffic["frames"], traffic["error_frames"]) == (sent + 1, 1)
    assert traffic["messages"]["0x123x"]["owner"] is None
    assert facts["link"] == {"name": f"virtual {channel}", "up": True}
    assert (times[-1] - times[0]) / (len(times) - 1) > 0.009
