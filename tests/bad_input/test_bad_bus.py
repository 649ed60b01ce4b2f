"""The bus, its logs and fault injection refuse bad input with an error that names it."""

import pytest
from support.expressions import WRONG_CLASS, cases, evaluate

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
        ("Transmitter(link, codec).publish(None)", WRONG_CLASS, "."),
        ("Transmitter(link, codec).publish(line, t_pose_ns=0)", ValueError, "t_pose_ns.*0"),
        ("Transmitter(link, codec).publish(line, t_pose_ns=nan)", ValueError, "t_pose_ns.*nan"),
        ("Receiver(link, codec.decoder(), queue_size=0)", ValueError, "queue_size.*0"),
        ("Receiver(link, codec.decoder(), queue_size=nan)", WRONG_CLASS, "."),
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
        ("Faults(loss=2)", ValueError, "loss.*2"),
        ("Faults(loss=nan)", ValueError, "loss.*nan"),
        ('Faults(loss="often")', TypeError, "'often'"),
        ("Faults(loss=None)", TypeError, "loss"),
        ("Faults(loss=10**400)", ValueError, "loss"),
        ("Faults(seed=0.5)", ValueError, "seed.*0.5"),
        ('Faults(seed="1")', TypeError, "'1'"),
        ("Faults(flip=0.6, garbage=0.6)", ValueError, "flip.*garbage"),
        ('Faults(direction="up")', ValueError, "direction.*'up'"),
        ("Faults(flood_ids=())", ValueError, "flood_ids"),
        ("Faults(flood_ids=None)", TypeError, "flood_ids.*None"),
        ('Faults(flood_ids=("a",))', TypeError, "flood_ids.*'a'"),
        ("Faults(flood_ids=(range(2**40),))", ValueError, "flood_ids"),
        ('Faults(script=["loss 3"])', TypeError, "'loss 3'"),
        ("Faults(script=3)", TypeError, "script.*3"),
        ('Faults.parse("")', ValueError, "KEY=VALUE"),
        ('Faults.parse("loss")', ValueError, "'loss'"),
        ('Faults.parse("loss=x")', ValueError, "loss.*'x'"),
        ('Faults.parse("los=0.1")', ValueError, "'los'"),
        ('Faults.parse("loss=0.1,loss=0.2")', ValueError, "loss"),
        ('Faults.parse("seed=0x" + "f" * 400)', ValueError, "seed"),
        ('Faults.parse("loss=0x" + "f" * 400)', ValueError, "loss"),
        ('Faults.parse("flood=1,flood_ids=0-0x20000000")', ValueError, "flood_ids.*0x0-0x20000000"),
        ('Faults.parse("script=/nowhere/plan")', ValueError, "/nowhere/plan"),
        ('Faults.parse("script=/dev/zero")', ValueError, "/dev/zero"),
        ('FaultyBus(None, "loss=0.1")', TypeError, "bus.*None"),
        ('FaultyBus("vcan0", "loss=0.1")', TypeError, "bus.*vcan0"),
        ('ScriptedFault.parse("loss 0")', ValueError, "0"),
        ('ScriptedFault.parse("loss 1-")', ValueError, "'1-'"),
        ('ScriptedFault.parse("loss " + "9" * 5000)', ValueError, "999"),
        ('ScriptedFault.parse("wrong_id 1 0x" + "f" * 400)', ValueError, "wrong_id"),
        ('ScriptedFault.parse("loss 3 1")', ValueError, "loss.*1"),
        ('ScriptedFault.parse("flip 3 0.5")', ValueError, "flip.*0.5"),
        ("FaultInjector(None)", WRONG_CLASS, "."),
        ('read_log("nowhere.log")', LogError, "nowhere.log"),
        ('read_log("/etc/passwd")', LogError, "/etc/passwd"),
        ('read_log("drive.mf4")', LogError, "drive.mf4"),
        ("read_log(None)", WRONG_CLASS, "."),
    ),
)
def test_bad_input_is_refused(expression: str, error: type[Exception], words: str) -> None:
    """The error has the right type and names what is wrong."""
    with pytest.raises(error, match=words):
        evaluate(expression)


@pytest.mark.parametrize(
    ("expression", "answer"),
    cases(
        ("FaultInjector(Faults(loss=1)).apply(frame)", "[]"),
    ),
)
def test_a_fault_injector_may_lose_all(expression: str, answer: str) -> None:
    """A frame that is lost gives no frame."""
    assert answer == str(evaluate(expression))
