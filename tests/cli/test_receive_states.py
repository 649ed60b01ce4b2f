"""The E2E states that the command receive prints."""

import json
import re
import threading
import time
from typing import Any

import can
import pytest
from e2e_streams import frames

from maplines_can.cli import main


def test_receive_prints_the_states_and_two_senders(
    links: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """A note of each change, a summary of each slot, and in JSON the checks with each line."""

    def send() -> None:
        for cycle in range(30):
            for ahead in (0, 77):
                for frame in frames(cycle + ahead, which=cycle + ahead):
                    links[0].send(
                        can.Message(
                            arbitration_id=frame.can_id, data=frame.data, is_extended_id=False
                        )
                    )
                time.sleep(0.03)

    bus = ["--interface", "virtual", "--channel", links[0].name.split()[1]]
    sender = threading.Timer(0.2, send)
    sender.start()
    assert main(["receive", *bus, "--timeout", "1", "--json"]) == 0
    sender.join()
    out, err = capsys.readouterr()
    last = json.loads(out.splitlines()[-1])["e2e"]
    assert last["two_senders"]
    assert last["state"] != "VALID"
    assert last["wrong_sequence"] > 8
    notes = [note for note in err.splitlines() if "ego left" in note]
    assert "ego left: INIT; 1 ok" in notes[0]
    assert "TWO SENDERS" in notes[-1]
    assert re.search(r"\d+ ok, \d+ lost, 0 repeated, \d+ wrong sequence, 0 errors", notes[-1])
