"""The command: it serves a log or a bus until Ctrl-C, and says what is wrong with its input."""

import json
import re
import signal
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from maplines_can.cli import main

#: Ctrl-C is ignored in the background of a shell.
START = """
import signal, sys
from maplines_can.cli import main
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.exit(main())
"""


@contextmanager
def viewing(
    *arguments: str, command: tuple[str, ...] = ("view", "--port", "0")
) -> Iterator[tuple[Any, str]]:
    """Run the command on a free port; yield its process and the address that it prints."""
    words = (sys.executable, "-c", START, *command, *arguments)
    pipes: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    with subprocess.Popen(words, text=True, **pipes) as process:
        try:
            found: list[str] = []
            while not found:
                found = re.findall(r"http://\S+/", process.stderr.readline())  # type: ignore[union-attr]
            yield process, found[0]
        finally:
            process.kill()


def info(url: str, key: str, value: Any) -> Any:
    """Return the info of the page once a member has a value."""
    end = time.monotonic() + 20
    while (found := json.load(urlopen(f"{url}info")))[key] != value:  # noqa: S310
        assert time.monotonic() < end, found
        time.sleep(0.1)
    return found


@pytest.fixture
def log(tmp_path: Path) -> str:
    path = tmp_path / "drive.log"
    assert main(["drive", "--as-fast-as-possible", "--seconds", "4", "--record", str(path)]) == 0
    return str(path)


@pytest.mark.parametrize(
    ("arguments", "count", "why"),
    [
        (["--time", "1..2"], 20, None),
        (["--time", "3.."], 20, None),
        (["--time", "8..9"], 0, "there is nothing in --time"),
        (["--channel", "can7"], 0, "has no frame of channel 'can7'; there are '"),
    ],
)
def test_a_part_of_a_log(log: str, arguments: list[str], count: int, why: str | None) -> None:
    with viewing(log, *arguments) as (_, url):
        found = info(url, "is_over", True)
    assert abs(found["count"] - count) <= 1
    assert (found["error"] is None) if why is None else (why in found["error"])


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C reaches the tests, too")
def test_a_log_until_ctrl_c(log: str) -> None:
    with viewing(log, "--dbc", "auto") as (process, url):
        found = info(url, "is_over", True)
        assert (found["name"], found["error"], found["count"]) == ("drive.log", None, 80)
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 0
        assert "Traceback" not in process.stderr.read()


def test_a_bus_with_faults() -> None:
    """Facts come, also of a bus on which nothing is."""
    with viewing("--interface", "virtual", "--channel", "a", "--faults", "loss=0.5") as (_, url):
        assert url.startswith("http://127.0.0.1:")
        with urlopen(f"{url}events") as events:  # noqa: S310
            assert events.readline().startswith(b"id: ")
            assert json.loads(events.readline()[6:])["link"] == {"name": "virtual a", "up": True}
        assert info(url, "is_live", True)["slots"][0] == "EGO_LEFT"


def test_other_machines_are_let_in_by_host_only() -> None:
    """What that means is said."""
    arguments = ("--interface", "virtual", "--channel", "a", "--host", "0.0.0.0")  # noqa: S104
    with viewing(*arguments) as (process, url):
        assert url.startswith("http://0.0.0.0:")
        said = process.stderr.readline()
        assert "whoever reaches this machine on port" in said
        assert "can read all" in said


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("(1.0) can0 123#11", "the log has no frame of a message of this DBC; take another --dbc"),
        ("  can0  123   [1]  11", "has no time stamps; record it with candump -L"),
    ],
)
def test_a_log_that_shows_nothing(tmp_path: Path, text: str, why: str) -> None:
    """The reason is in the page, and printed."""
    path = tmp_path / "nothing.log"
    path.write_text(f"{text}\n")
    with viewing(str(path)) as (process, url):
        error = info(url, "is_over", True)["error"]
        assert why in error
        assert error in process.stderr.readline()


def test_what_a_consumer_has(tmp_path: Path) -> None:
    """The facts of each cycle have the lane that it fused; the page of a log stays."""
    log, dbc = str(tmp_path / "pose.log"), ("--dbc", "maplines-pose.dbc")
    words = ["drive", "--as-fast-as-possible", "--seconds", "4", *dbc, "--record", log]
    assert main(words) == 0
    with viewing(log, *dbc, command=("consume", "fusion", "--view", "--port", "0")) as (_, url):
        count = info(url, "is_over", True)["count"]
        with urlopen(f"{url}parts/0") as answer:  # noqa: S310
            facts = json.loads(zlib.decompress(answer.read()))
    assert len(facts) == count >= 80
    fused = facts[-1]["consumer"]["fused"]
    assert set(fused["lines"]) == set(fused["slots"]) == {"EGO_LEFT", "EGO_RIGHT"}
    assert facts[-1]["consumer"]["camera"] == {}
    line, own = facts[-1]["slots"]["EGO_LEFT"]["line"], fused["lines"]["EGO_LEFT"]
    assert own["mean"] == pytest.approx(line["mean"], abs=1.0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        pytest.param(["no.log"], "no.log: there is no such file", id="no-file"),
        pytest.param(["{log}", "--interface", "virtual"], "--interface is of a bus", id="both"),
        pytest.param(["{log}", "--host", "no such host"], "cannot be listened on", id="host"),
        pytest.param(["{log}", "--dbc", "no.dbc"], "no.dbc", id="dbc"),
        pytest.param(["--interface", "nonsense"], "nonsense", id="interface"),
        pytest.param(["--time", "1..2"], "--time is a part of LOG", id="time-of-a-bus"),
    ],
)
def test_mistakes_are_named(arguments: list[str], said: str, log: str, capsys: Any) -> None:
    """In one line, with status 1."""
    words = [word.replace("{log}", log) for word in arguments]
    capsys.readouterr()
    assert main(["view", "--port", "0", *words]) == 1
    error = capsys.readouterr().err
    assert error.startswith("maplines: error: ")
    assert said in error
    assert error.count("\n") == 1
