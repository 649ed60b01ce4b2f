"""Keys on the command line."""

import json
import logging
import re
import time
import uuid
from pathlib import Path
from typing import Any

import can
import pytest
from support.fake_bus import message_of
from support.fixtures import Capture, Patch
from support.lines import scenario_lines
from support.secoc_streams import (
    NOW,
    OTHER,
    SECRET,
    Clock,
    S,
    check_no_secret,
    codec_of,
    key_file,
    sent,
)

from maplines_can import Codec, Link, Transmitter
from maplines_can.bus import key_from_file
from maplines_can.cli import main
from maplines_can.simulation import scenario
from maplines_can.wire import Authenticator


@pytest.fixture
def clock() -> Any:
    return Clock()


@pytest.fixture
def lines() -> Any:
    return scenario_lines(scenario("highway"), 2)


COLONS = ":".join(f"{byte:02x}" for byte in SECRET)
HEX = SECRET.hex()


@pytest.mark.parametrize("option", ["--key-file", "--key-env"])
@pytest.mark.parametrize(
    "text",
    [
        *(HEX, HEX.upper(), f"0x{HEX}", f"./{HEX}", f"{HEX}.key", f"2:{HEX}", f"{HEX}:a"),
        *(HEX[:-1], HEX * 9, COLONS, f"12:{COLONS}"),
        *(COLONS.replace(":", "-"), COLONS.replace(":", " ")),
    ],
)
def test_a_key_on_the_command_line_is_not_printed(capsys: Capture, option: str, text: Any) -> None:
    """The error says that this looks like a key, without printing it."""
    assert main(["demo", option, text]) == 1
    out, err = capsys.readouterr()
    assert "looks like a key itself" in err
    check_no_typed_secret(out + err)


@pytest.mark.parametrize(
    "words",
    [
        ["demo", f"--key={HEX}"],
        ["demo", f"--key=0x{HEX.upper()}"],
        ["demo", "--key", HEX],
        ["demo", "--keyfile", HEX],
        ["demo", "--key-files", COLONS],
        ["demo", f"-k{HEX}"],
        ["demo", "--key-env", "A", HEX],
        ["demo", "--key-env", "A", *COLONS.split(":")],
        ["demo", "--rate", HEX],
        ["receive", f"--key={HEX[:-1]}"],
        ["study", "report", "--out", "a", "b", f"--key={HEX}"],
        [HEX],
    ],
)
def test_a_wrong_command_line_is_not_printed_if_it_may_contain_a_key(
    capsys: Capture, words: Any
) -> None:
    """Options cannot be abbreviated, and errors leave out what may be a key."""
    with pytest.raises(SystemExit, match="2"):
        main(words)
    out, err = capsys.readouterr()
    assert "(hidden)" in err
    check_no_typed_secret(out + err)


def check_no_typed_secret(text: Any) -> None:
    """As check_no_secret, whatever separates the digits."""
    check_no_secret(text)
    check_no_secret(re.sub("[^0-9A-Za-z]", "", text))


def test_a_wrong_command_line_without_a_key_is_printed(capsys: Capture) -> None:
    """What cannot be a key is printed."""
    with pytest.raises(SystemExit, match="2"):
        main(["demo", "--keyfile", "car.key", "--key", "2024-10-11"])
    assert (
        "arguments: --keyfile car.key --key 2024-10-11; did you mean --key-file?"
        in capsys.readouterr().err
    )


def test_the_demo_with_a_key(
    capsys: Capture, caplog: pytest.LogCaptureFixture, tmp_path: Path, monkeypatch: Patch
) -> None:
    """With a key from a file or the environment, as text or JSON, and no key in any output."""
    caplog.set_level(logging.DEBUG)
    path = key_file(tmp_path, SECRET.hex().encode())
    assert main(["demo", "--key-file", str(path), "--seconds", "0.2"]) == 0
    text = capsys.readouterr()
    assert "over CAN FD, authenticated, 20 Hz" in text.out
    monkeypatch.setenv("CAR_KEY", SECRET.hex())
    assert main(["demo", "--key-env", "3:CAR_KEY", "--seconds", "0.2", "--json"]) == 0
    machine = capsys.readouterr()
    result = json.loads(machine.out)
    assert (result["lines_lost"], result["frame_format"]) == (0, "CAN FD, authenticated")
    check_no_secret("".join([*text, *machine, caplog.text]))


@pytest.mark.usefixtures("patient_timeout")
def test_send_and_receive_with_keys(capsys: Capture, tmp_path: Path, monkeypatch: Patch) -> None:
    """With the right key there are lines; with the wrong one there are none, and the reason."""
    path = key_file(tmp_path, SECRET.hex().encode())
    monkeypatch.setenv("WRONG", OTHER.hex())
    channel = f"test-{uuid.uuid4()}"
    bus = ["--interface", "virtual", "--channel", channel]
    authenticator = Authenticator(key_from_file(path, 2), clock=time.time_ns)
    with (
        Link(interface="virtual", channel=channel, fd=True) as link,
        Transmitter(link, Codec.from_dbc(None, authenticator), period=0.02, fd=True) as transmitter,
    ):
        transmitter.publish(scenario_lines(scenario("highway"), 2))
        keys = ["--key-env", "1:WRONG", "--key-file", f"2:{path}"]
        assert main(["receive", *bus, *keys, "--count", "4", "--json"]) == 0
        rows = [json.loads(row) for row in capsys.readouterr().out.splitlines()]
        assert {row["slot"] for row in rows} == {"EGO_LEFT", "EGO_RIGHT"}
        assert main(["receive", *bus, "--key-env", "2:WRONG", "--timeout", "0.2"]) == 1
    out, err = capsys.readouterr()
    assert not out
    assert re.search(r"0 lines from \d+ frames.*dropped frames: \d+ mac", err)
    check_no_secret(out + err)


def test_a_recorded_log_is_decoded_with_its_key(
    capsys: Capture, tmp_path: Path, clock: Any, lines: Any
) -> None:
    """However old it is: only the order matters."""
    path, codec = tmp_path / "drive.log", codec_of(clock=clock)
    frames = sent(codec.encoder(), clock, lines[0], 4)
    with can.Logger(path) as writer:
        for i, frame in enumerate([*frames, frames[1]]):
            writer(message_of(frame, timestamp=NOW / S + 0.05 * i, channel="can0"))
    key = str(key_file(tmp_path, SECRET.hex().encode()))
    assert main(["decode", str(path), "--key-file", key]) == 0
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 4
    assert "dropped frames: 1 replay" in err
