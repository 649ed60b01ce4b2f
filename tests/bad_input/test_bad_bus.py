"""The bus, its logs and fault injection refuse bad input with an error that names it."""

import pytest
from support.expressions import cases, evaluate

from maplines_can.values.errors import BusError, LogError


@pytest.mark.parametrize(
    ("expression", "error", "words"),
    cases(
        # Bus
        ('Link(interface="warp")', BusError, "warp"),
        ('Link(interface="socketcan", channel="nocan9")', BusError, "nocan9"),
        ('Link(FaultyOpener("loss"), interface="virtual")', ValueError, "loss"),
        ("Link(None)", BusError, "no CAN interface"),
        ("Transmitter(link, codec, period=0)", ValueError, "period.*0"),
        ("Transmitter(link, codec, period=nan)", ValueError, "period.*nan"),
        ("Transmitter(link, codec, period=1e9)", ValueError, "period.*1000000000|period.*1e"),
        ("Transmitter(link, codec, period=0.0009)", ValueError, "period.*0.0009"),
        ("Transmitter(link, codec, period=3600.5)", ValueError, "period.*3600.5"),
        ("Transmitter(link, codec, count=0)", ValueError, "count.*0"),
        ("Transmitter(link, codec).publish(line, t_pose_ns=0)", ValueError, "t_pose_ns.*0"),
        ("Transmitter(link, codec).publish(line, t_pose_ns=nan)", ValueError, "t_pose_ns.*nan"),
        ("Receiver(link, codec.decoder(), queue_size=0)", ValueError, "queue_size.*0"),
        ("Transmitter(link, codec.decoder())", TypeError, "codec must be a Codec.*Decoder"),
        ("Receiver(link, codec)", TypeError, r"decoder must be a Decoder.*codec\.decoder\(\)"),
        ("Receiver(link, None)", TypeError, "decoder must be a Decoder.*None"),
        ("LineListener(codec)", TypeError, r"decoder must be a Decoder.*codec\.decoder\(\)"),
        ("Receiver(link, codec.decoder(), on_line=3)", TypeError, "on_line.*plain function.*3"),
        ("LineListener(codec.decoder(), on_line=Queue().put)", TypeError, "put_nowait"),
        ("Receiver(link, codec.decoder()).latest(9)", ValueError, "slot.*9"),
        ("Receiver(link, codec.decoder(), on_line=print).get()", TypeError, "on_line"),
        ("frame_bits(9)", ValueError, "length.*9"),
        ("frame_bits(-1)", ValueError, "length.*-1"),
        ("frame_bits(nan)", ValueError, "length.*nan"),
        ("frame_bits(65, is_fd=True)", ValueError, "length.*65"),
        ("frame_time(frame, 0)", ValueError, "bit/s.*0"),
        ("frame_time(frame, nan)", ValueError, "bit/s.*nan"),
        ("frame_time(frame, inf)", ValueError, "bit/s.*inf"),
        ("frame_time(frame, 500_000, 0)", ValueError, "bit/s.*0"),
        ("frame_time(frame, 500_000, inf)", ValueError, "bit/s.*inf"),
        ("bus_load([frame], 0, 500_000)", ValueError, "period.*0"),
        ("bus_load([frame], nan, 500_000)", ValueError, "period.*nan"),
        ("transfers_within(0, [frame], 1, 500_000)", ValueError, "share.*0"),
        ("transfers_within(nan, [frame], 1, 500_000)", ValueError, "share.*nan"),
        ("transfers_within(1.01, [frame], 1, 500_000)", ValueError, "share.*1.01"),
        ("transfers_within(0.5, [], 1, 500_000)", ValueError, "frame"),
        ('FaultyBus(None, "loss=0.1")', TypeError, "bus.*None"),
        ('FaultyBus("vcan0", "loss=0.1")', TypeError, "bus.*vcan0"),
        ('read_log("nowhere.log")', LogError, "nowhere.log"),
        ('read_log("/etc/passwd")', LogError, "/etc/passwd"),
        ('read_log("drive.mf4")', LogError, "drive.mf4"),
    ),
)
def test_bad_input_is_refused(expression: str, error: type[Exception], words: str) -> None:
    """The error has the right type and names what is wrong."""
    with pytest.raises(error, match=words):
        evaluate(expression)
