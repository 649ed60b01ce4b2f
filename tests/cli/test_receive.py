"""The command ``maplines receive``."""

import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from answers import one
from support.dbcs import default_codec
from support.e2e_streams import frames
from support.fixtures import Capture, Patch
from support.lines import scenario_lines

from maplines_can import Codec, Link, MapLine, Transmitter
from maplines_can.cli import command_line, main
from maplines_can.cli.output import check_text, line_dict, line_text
from maplines_can.simulation import scenario
from maplines_can.values.line import Status
from maplines_can.wire import E2EState, ProfileStatus, SlotStats, SlotView


@contextmanager
def sending(channel: str) -> Iterator[None]:
    """Send a line of the default DBC again and again."""
    with (
        Link(interface="virtual", channel=channel) as link,
        Transmitter(link, Codec.from_dbc(), period=0.01) as transmitter,
    ):
        transmitter.publish(scenario_lines(scenario("highway"), 1))
        yield


def test_lines_are_printed_until_the_count(capsys: Capture, channel: str) -> None:
    """JSON lines on standard output, the counters on standard error."""
    with (
        Link(interface="virtual", channel=channel) as link,
        Transmitter(link, Codec.from_dbc(), period=0.02, fd=True) as transmitter,  # no time-out
    ):
        for line in scenario_lines(scenario("highway")):
            transmitter.publish(line)
        bus = ["--interface", "virtual", "--channel", channel]
        assert main(["receive", *bus, "--count", "8", "--json"]) == 0
        assert main(["receive", *bus, "--count", "2"]) == 0
    out, err = capsys.readouterr()
    rows = [json.loads(row) for row in out.splitlines()[:8]]
    assert {row["slot"] for row in rows} == {"EGO_LEFT", "EGO_RIGHT", "NEXT_LEFT", "NEXT_RIGHT"}
    assert rows[0]["status"] == "FULL"
    assert not any(row["usable"] for row in rows)  # INIT
    assert re.match(r"\d+\.\d{3}  (ego|next) (left|right) ", out.splitlines()[8])
    assert "0 lines lost" in err


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_a_receiver_without_a_line_says_why_once(
    capsys: Capture, channel: str, monkeypatch: Patch, options: list[str]
) -> None:
    """Before it ends: it has no --timeout in daily use. A receiver of lines says nothing."""
    monkeypatch.setattr("maplines_can.cli.receive.SILENCE", 0.05)
    bus = ["--interface", "virtual", "--channel", channel, *options]
    assert main(["receive", *bus, "--timeout", "0.3"]) == 1
    assert main(["receive", *bus, "--timeout", "0.3", "--fd"]) == 1
    rows = capsys.readouterr().err.splitlines()
    notes = [row for row in rows if "no line for 0.05 s: no frame has arrived" in row]
    assert ["--fd" in note for note in notes] == [True, False]
    assert rows.index(notes[0]) < rows.index("maplines: no line for 0.3 s")
    assert rows[-1].startswith("maplines: error: nothing received: no frame has arrived; check")


@pytest.mark.usefixtures("patient_timeout")
def test_a_receiver_of_frames_that_it_cannot_read_says_why(
    capsys: Capture, channel: str, monkeypatch: Patch
) -> None:
    """Frames of its CAN IDs that complete no line, with the reasons for which they are dropped."""
    monkeypatch.setattr("maplines_can.cli.receive.SILENCE", 0.05)
    with sending(channel):
        bus = ["--interface", "virtual", "--channel", channel, "--faults", "corrupt=1,seed=1"]
        assert main(["receive", *bus, "--timeout", "1"]) == 1
    rows = capsys.readouterr().err.splitlines()
    (note,) = [row for row in rows if "no line for 0.05 s" in row]
    (error,) = [row for row in rows if "error:" in row]
    assert re.search(r"frames have arrived, but none completed a line \(dropped: \d", note)
    assert "frames have arrived, but none completed a line" in error


@pytest.mark.usefixtures("patient_timeout")
def test_the_dbc_of_the_frames_on_a_bus_is_named(capsys: Capture, channel: str) -> None:
    """Frames of all CAN IDs are tried until the first line."""
    with sending(channel):
        bus = ["--interface", "virtual", "--channel", channel, "--dbc", "maplines-pose.dbc"]
        assert main(["receive", *bus, "--timeout", "0.2"]) == 1
    assert "records of maplines.dbc are whole; take --dbc maplines.dbc" in capsys.readouterr().err


@pytest.mark.usefixtures("patient_timeout")
def test_item_11_a_receiver_that_outlives_its_sender_succeeds(
    capsys: Capture, channel: str, monkeypatch: Patch
) -> None:
    """Lines came, so the status is 0 and there is no error. The sender stops at the first row."""
    with (
        Link(interface="virtual", channel=channel) as link,
        Transmitter(link, Codec.from_dbc(), period=0.02) as transmitter,
    ):

        def stop(_: Any) -> str:
            transmitter.stop()
            return "a row"

        monkeypatch.setattr("maplines_can.cli.receive.line_text", stop)
        transmitter.publish(scenario_lines(scenario("highway"), 1))
        bus = ["--interface", "virtual", "--channel", channel]
        assert main(["receive", *bus, "--timeout", "0.3"]) == 0
    out, err = capsys.readouterr()
    assert "a row" in out
    assert "no line for 0.3 s" in err
    assert "error:" not in err


@pytest.mark.parametrize(
    ("state", "status", "words"),
    [
        (E2EState.INVALID, ProfileStatus.NONEWDATA, "no data any more, INVALID; 60 ok, 0 lost"),
        (E2EState.INVALID, ProfileStatus.ERROR, "INVALID; 60 ok"),
        (E2EState.VALID, ProfileStatus.NONEWDATA, "VALID; 60 ok"),
        (E2EState.INIT, ProfileStatus.NONEWDATA, "INIT; 60 ok"),
    ],
)
def test_item_11_the_end_of_a_sender_is_named(
    state: E2EState, status: ProfileStatus, words: str
) -> None:
    """INVALID without data is not said like a failure."""
    stats = SlotStats(state, status, 60, 0, 0, 0, 0, 100, two_senders=False)
    assert check_text(stats).startswith(words)


def test_the_cycle_time_decides_whether_a_slot_is_valid(
    replay: Any, slot_notes: Any, channel: str
) -> None:
    """The slot of a slow sender is VALID with --cycle-ms and not VALID without it."""
    bus = ["--interface", "virtual", "--channel", channel]
    (line,) = scenario_lines(scenario("highway"), 1)
    codec = Codec.from_dbc()
    encoder = codec.encoder()
    transfers = [(1e9 + 0.2 * k, encoder.encode(line)) for k in range(8)]
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
    (line,) = scenario_lines(scenario("highway"), 1)
    assert "y_off" in line_text(line)
    text = line_text(replace(line, **change))
    assert words in text
    assert "y_off" not in text
    view = SlotView(
        line.slot,
        line,
        0.0,
        stale=True,
        state=E2EState.VALID,
        status=ProfileStatus.OK,
        two_senders=False,
    )
    assert line_dict(line, view)["usable"]  # as it arrived
    row = json.loads(json.dumps(line_dict(replace(line, **change), view), allow_nan=False))
    assert row["age"] == (None if "age" in change else 0.0)
    assert not row["usable"]


def test_receive_prints_the_states_and_two_senders(
    replay: Any, channel: str, capsys: Capture, monkeypatch: Patch
) -> None:
    """A note of each change, a summary of each slot, and in JSON the checks with each line."""
    transfers = [
        (1e9 + 0.06 * cycle + 0.03 * sender, frames(counter, which=counter))
        for cycle in range(30)
        for sender, counter in enumerate((cycle, cycle + 77))
    ]
    decoder = default_codec().decoder()
    answers = [
        one(decoder.feed(frame.can_id, frame.data, round(stamp * 1e9)))
        for stamp, transfer in transfers
        for frame in transfer
    ]
    delivered = sum(isinstance(answer, MapLine) for answer in answers)
    noted = threading.Event()

    def note(text: str) -> None:
        command_line.note(text)
        if "INIT" in text:
            noted.set()

    monkeypatch.setattr("maplines_can.cli.receive.note", note)
    replay(transfers, after_first=noted)
    bus = ["--interface", "virtual", "--channel", channel]
    assert main(["receive", *bus, "--count", str(delivered), "--json"]) == 0
    out, err = capsys.readouterr()
    row = json.loads(out.splitlines()[-1])
    assert (row["usable"], row["two_senders"]) == (False, True)
    last = row["e2e"]
    assert last["two_senders"]
    assert last["state"] != "VALID"
    assert last["wrong_sequence"] > 8
    notes = [note for note in err.splitlines() if "ego left" in note]
    assert "ego left: INIT; 1 ok" in notes[0]
    assert "TWO SENDERS" in notes[-1]
    assert re.search(r"\d+ ok, \d+ lost, 0 repeated, \d+ wrong sequence, 0 errors", notes[-1])
