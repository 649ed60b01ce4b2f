"""The command in a terminal: its keys, its sizes, and the terminal as it was in every case."""

import os
import re
import select
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from maplines_can.cli import main

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="there are no ptys")
ENTER, LEAVE = "\x1b[?1049h", "\x1b[?1049l"
#: Sends lines on a virtual bus, and monitors it.
BUS = """
import itertools, threading, time, can
from support.lines import scenario_lines
from maplines_can import Codec
from maplines_can.cli import main
from maplines_can.simulation import scenario

def send():
    encoder, lines = Codec.from_dbc().encoder(), scenario_lines(scenario("highway"))
    with can.Bus(interface="virtual", channel="a") as bus:
        while True:
            for line in lines:
                for frame in encoder.encode(line):
                    bus.send(can.Message(arbitration_id=frame.can_id, data=frame.data,
                                         is_extended_id=False))
            time.sleep(0.05)

threading.Thread(target=send, daemon=True).start()
"""
MONITOR = "raise SystemExit(main(['monitor', '--interface', 'virtual', '--channel', 'a'{}]))"
BROKEN = """
from maplines_can.desk.watch import Watch
def add(*_): raise OSError("no more facts")
Watch.add = add
"""


class Pty:
    """A terminal in which a program runs."""

    def __init__(self, code: str, **environment: str) -> None:
        import pty

        self.pid, self.fd = pty.fork()
        if self.pid == 0:
            environment = {"TERM": "xterm", "LANG": "C.UTF-8"} | environment
            os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)
            os.environ.update(environment)
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # ignored in the background of a shell
            os.execv(sys.executable, [sys.executable, "-c", code])  # noqa: S606
        self.output = ""
        self.before = self.attributes()
        self.resize(80, 24)

    def attributes(self) -> list[Any]:
        import termios

        return termios.tcgetattr(self.fd)

    def resize(self, columns: int, rows: int) -> None:
        import termios

        termios.tcsetwinsize(self.fd, (rows, columns))

    def type(self, keys: str) -> None:
        os.write(self.fd, keys.encode())

    def until(self, pattern: str) -> str:
        """Read until a pattern is there, and return what came up to its end."""
        end = time.monotonic() + 60
        while (found := re.search(pattern, self.output, re.DOTALL)) is None:
            assert time.monotonic() < end, self.output[-4000:]
            assert self._read(1.0), self.output[-4000:]
        before, self.output = self.output[: found.end()], self.output[found.end() :]
        return before

    def _read(self, timeout: float) -> bool:
        if not select.select([self.fd], [], [], timeout)[0]:
            return True
        try:
            found = os.read(self.fd, 65536)
        except OSError:  # of Linux, at the end
            found = b""
        self.output += found.decode(errors="replace")
        return bool(found)

    def ended(self) -> int:
        """Read to the end, and return the exit status."""
        while self._read(60.0):
            pass
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


@contextmanager
def monitor(*options: str, code: str = BUS, **environment: str) -> Iterator[Pty]:
    """Run the command."""
    words = "".join(f", {word!r}" for word in ("--rate", "20", *options))
    terminal = Pty(code + MONITOR.format(words), **environment)
    try:
        yield terminal
    finally:
        try:
            os.kill(terminal.pid, signal.SIGKILL)
            os.waitpid(terminal.pid, 0)
        except OSError:
            pass  # it has ended
        os.close(terminal.fd)


def test_keys() -> None:
    """Each shows what it does; the lines are there, the terminal is as it was."""
    with monitor() as terminal:
        terminal.until(r"\x1b\[\?1049h.*virtual a   maplines.dbc.*ego left.*VALID")
        assert terminal.attributes() != terminal.before
        terminal.type("p")
        terminal.until(r"PAUSED.*p play")
        terminal.type("f\x1b[Anext l")
        terminal.until(r"filter next l .*filter: next l_")
        terminal.type("\r")
        terminal.until("q quit")
        terminal.type("r")
        terminal.until(r"\x1b\[2;1Hload")
        terminal.type("q")
        terminal.until(re.escape(LEAVE))
        assert terminal.ended() == 0
        assert terminal.output == ""


@pytest.mark.parametrize(
    ("options", "keys", "code", "status", "last"),
    [
        pytest.param([], "\x03", BUS, 0, "", id="ctrl-c"),
        pytest.param(["--count", "2"], "", BUS, 0, "", id="count"),
        pytest.param(["--seconds", "0.2"], "", BUS, 0, "", id="seconds"),
        pytest.param([], "", BUS + BROKEN, 1, "maplines: error: no more facts\r\n", id="error"),
    ],
)
def test_the_terminal_is_as_it_was(
    options: list[str], keys: str, code: str, status: int, last: str
) -> None:
    """However it ends."""
    with monitor(*options, code=code) as terminal:
        terminal.until(re.escape(ENTER))
        terminal.type(keys)
        terminal.until(re.escape(LEAVE))
        assert terminal.ended() == status
        assert terminal.output == last


def test_ctrl_z_and_sizes() -> None:
    """The terminal is given back before a stop, and taken again; a new size is drawn at once."""
    with monitor() as terminal:
        terminal.until("ego left")
        terminal.resize(60, 20)
        terminal.until(r"\x1b\[2J.*\x1b\[20;1H")
        inside = terminal.attributes()
        os.kill(terminal.pid, signal.SIGTSTP)  # the leader of a session goes on at once
        terminal.until(re.escape(LEAVE) + ".*" + re.escape(ENTER) + r".*\x1b\[2J.*ego left")
        assert terminal.attributes() == inside != terminal.before


@pytest.mark.parametrize(
    ("environment", "colours", "marks"),
    [
        pytest.param({}, True, "±", id="xterm"),
        pytest.param({"NO_COLOR": "1"}, False, "±", id="no-color"),
        pytest.param({"TERM": "vt100"}, False, "±", id="mono"),
        pytest.param({"LC_ALL": "C"}, True, "+-", id="ascii"),
    ],
)
def test_terminals(environment: dict[str, str], colours: bool, marks: str) -> None:
    """Colours only where they are wanted; words tell the states in any case."""
    with monitor(**environment) as terminal:
        output = terminal.until(r"ego left.*VALID.*lane width.*\x1b\[\?2026l")
        assert ("\x1b[32m" in output) is colours
        assert marks in output
        assert output.isascii() is (marks == "+-")


def test_a_pipe_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    """By one line that names the command for it."""
    assert main(["monitor", "--interface", "virtual", "--channel", "a"]) == 1
    error = capsys.readouterr().err
    assert "maplines: error: standard output is no terminal" in error
    assert "'maplines receive'" in error
    assert error.count("\n") == 1


def test_keys_are_off_without_a_terminal() -> None:
    """Standard input may be anything."""
    code = "import os\nos.dup2(os.open(os.devnull, os.O_RDONLY), 0)\n"
    with monitor("--count", "3", code=code + BUS) as terminal:
        terminal.until(re.escape(ENTER))
        terminal.until(re.escape(LEAVE))
        assert terminal.ended() == 0
