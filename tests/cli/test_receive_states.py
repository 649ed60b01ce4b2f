"""The E2E states that the command receive prints."""

import json
import re
import threading
from typing import Any

import pytest
from answers import one
from support.dbcs import default_codec
from support.e2e_streams import frames

from maplines_can import MapLine
from maplines_can.cli import command_line, main


def test_receive_prints_the_states_and_two_senders(
    replay: Any, channel: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
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
    last = json.loads(out.splitlines()[-1])["e2e"]
    assert last["two_senders"]
    assert last["state"] != "VALID"
    assert last["wrong_sequence"] > 8
    notes = [note for note in err.splitlines() if "ego left" in note]
    assert "ego left: INIT; 1 ok" in notes[0]
    assert "TWO SENDERS" in notes[-1]
    assert re.search(r"\d+ ok, \d+ lost, 0 repeated, \d+ wrong sequence, 0 errors", notes[-1])
