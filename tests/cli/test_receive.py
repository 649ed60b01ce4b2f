"""The command ``maplines receive``."""

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scenes import scene_lines

from maplines_can import Codec, Link, Transmitter, scenario
from maplines_can.cli import main
from maplines_can.cli.output import line_dict, line_text
from maplines_can.line import Status


def test_lines_are_printed_until_the_count(
    capsys: pytest.CaptureFixture[str], channel: str
) -> None:
    """JSON lines on standard output, the counters on standard error."""
    with (
        Link(interface="virtual", channel=channel) as link,
        Transmitter(link, Codec.from_dbc(), period=0.02, fd=True) as transmitter,  # no time-out
    ):
        for line in scene_lines(scenario("highway")):
            transmitter.publish(line)
        bus = ["--interface", "virtual", "--channel", channel]
        assert main(["receive", *bus, "--count", "8", "--json"]) == 0
        assert main(["receive", *bus, "--count", "2"]) == 0
    out, err = capsys.readouterr()
    rows = [json.loads(row) for row in out.splitlines()[:8]]
    assert {row["slot"] for row in rows} == {"EGO_LEFT", "EGO_RIGHT", "NEXT_LEFT", "NEXT_RIGHT"}
    assert rows[0]["status"] == "FULL"
    assert re.match(r"\d+\.\d{3}  (ego|next) (left|right) ", out.splitlines()[8])
    assert "0 lines lost" in err


def test_a_silent_bus_ends_it_after_the_timeout(
    capsys: pytest.CaptureFixture[str], channel: str
) -> None:
    """The status is 1 if fewer lines arrived than --count."""
    bus = ["--interface", "virtual", "--channel", channel]
    assert main(["receive", *bus, "--count", "1", "--timeout", "0.05"]) == 1
    assert "nothing received for 0.05 s" in capsys.readouterr().err


def test_the_cycle_time_decides_whether_a_slot_is_valid(
    replay: Any, slot_notes: Any, channel: str
) -> None:
    """The slot of a slow sender is VALID with --cycle-ms and not VALID without it."""
    bus = ["--interface", "virtual", "--channel", channel]
    (line,) = scene_lines(scenario("highway"), 1)
    codec = Codec.from_dbc()
    transfers = [(1e9 + 0.2 * k, codec.encode(line)) for k in range(8)]
    replay(transfers)
    assert main(["receive", *bus, "--count", "8", "--cycle-ms", "200"]) == 0
    (with_cycle,) = slot_notes()
    replay(transfers)
    assert main(["receive", *bus, "--count", "8"]) == 0
    (without,) = slot_notes()
    assert with_cycle.startswith("maplines: ego left: VALID; 8 ok, 0 lost")
    assert not without.startswith("maplines: ego left: VALID")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"status": Status.OUT_OF_RANGE}, "out of range  not usable: the line does not fit"),
        ({"age": np.inf}, "full       not usable: too old"),
    ],
)
def test_item_1_a_line_that_is_not_usable_is_printed_without_its_values(
    change: Any, words: str
) -> None:
    """With the reason; JSON has no infinite age."""
    (line,) = scene_lines(scenario("highway"), 1)
    assert "y_off" in line_text(line)
    text = line_text(replace(line, **change))
    assert words in text
    assert "y_off" not in text
    row = json.loads(json.dumps(line_dict(replace(line, **change)), allow_nan=False))
    assert row["age"] == (None if "age" in change else 0.0)
