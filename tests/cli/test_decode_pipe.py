"""``maplines decode -``: a pipe from candump."""

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.fixtures import Capture, Patch
from support.lines import scenario_lines

from maplines_can import Codec
from maplines_can.cli import main
from maplines_can.cli.command_line import with_progress
from maplines_can.simulation import scenario


def rows(n: int) -> list[str]:
    """Return n lines as candump prints their frames without -L, one text for each line."""
    codec, (line,) = Codec.from_dbc(), scenario_lines(scenario("highway"), 1)
    encoder = codec.encoder()
    return [
        "".join(
            f"  vcan0  {f.can_id:03X}   [{len(f.data)}]  {f.data.hex(' ').upper()}\n"
            for f in encoder.encode(line)
        )
        for _ in range(n)
    ]


@contextmanager
def piped(**pipes: Any) -> Iterator[Any]:
    """Start the command with a pipe as its input; end it if it hangs."""
    script = (  # SIGINT is ignored in the background
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from maplines_can.cli import main\n"
        "sys.exit(main(['decode', '-']))"
    )
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", script], text=True, **streams | pipes) as process:
        guard = threading.Timer(120, process.kill)
        guard.start()
        try:
            yield process
        finally:
            guard.cancel()


def test_item_11_a_line_is_printed_as_soon_as_it_is_complete() -> None:
    """The pipe is still open: neither input nor output is buffered. Ctrl-C then ends it cleanly."""
    first, second = rows(2)
    with piped() as process:
        for text in (first, second):
            process.stdin.write(text)
            process.stdin.flush()
            row = json.loads(process.stdout.readline())
            assert (row["slot"], row["t"]) == ("EGO_LEFT", None)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate()
    assert process.returncode == 130
    assert out == ""
    assert "Traceback" not in err
    assert "2 lines from 8 frames" in err


def test_item_11_the_end_of_a_pipe_ends_it() -> None:
    """Status 0, and a note that time was not checked."""
    with piped() as process:
        out, err = process.communicate("".join(rows(3)))
    assert process.returncode == 0, err
    assert len(out.splitlines()) == 3
    assert "no time stamps" in err
    assert "3 lines from 12 frames; 0 lines lost" in err


def test_item_11_a_log_of_candump_alone_is_decoded(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "drive.log"
    path.write_text("".join(rows(3)))
    assert main(["decode", str(path), "--csv"]) == 0
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 4
    assert out.splitlines()[1].startswith(",vcan0,EGO_LEFT,")
    assert "no time stamps" in err


class Terminal:
    """Stream that is a terminal, or is not."""

    def __init__(self, *, isatty: bool) -> None:
        self.text, self._isatty = "", isatty

    def isatty(self) -> bool:
        return self._isatty

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None:
        pass


@pytest.mark.parametrize("rows_on_terminal", [True, False])
def test_item_11_no_progress_bar_runs_into_the_rows(
    monkeypatch: Patch, rows_on_terminal: bool
) -> None:
    """The bar is drawn only if the rows go elsewhere."""
    stderr = Terminal(isatty=True)
    monkeypatch.setattr(sys, "stderr", stderr)
    monkeypatch.setattr(sys, "stdout", Terminal(isatty=rows_on_terminal))
    assert list(with_progress([1, 2], " frames")) == [1, 2]
    assert ("frames" in stderr.text) is not rows_on_terminal
