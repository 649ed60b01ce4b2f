"""The door to the terminal: its size and keys, its other screen, and all back as it was.

POSIX terminals by ``termios``, the console of Windows by its virtual terminal mode.
"""

from __future__ import annotations

import codecs
import io
import logging
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, suppress
from typing import Any

#: Other screen, without cursor and without wrapping; and back.
ENTER = "\x1b[?1049h\x1b[?25l\x1b[?7l"
LEAVE = "\x1b[0m\x1b[?7h\x1b[?25h\x1b[999;1H\x1b[?1049l"
#: Keys that are no characters, such as arrows.
SEQUENCE = re.compile(r"\x1b(\[[0-?]*[ -/]*[@-~]|O.)")
#: Time within which the rest of such a key comes [s].
REST = 0.02

NO_TERMINAL = (
    "standard output is no terminal on which rows can be drawn; for a pipe or a file there is "
    "'maplines receive', with --json for programs"
)


def check_terminal() -> None:
    """Raise if standard output is no terminal.

    Raises:
        ValueError: it is not.
    """
    if not sys.stdout.isatty() or os.environ.get("TERM") == "dumb":
        raise ValueError(NO_TERMINAL)


def has_colours() -> bool:
    """Return whether the terminal has colours, and the person wants them (no-color.org)."""
    if os.environ.get("NO_COLOR"):
        return False
    with suppress(ImportError):  # there is none on Windows, whose console has colours
        import curses

        with suppress(curses.error):
            curses.setupterm(fd=sys.stdout.fileno())
            return curses.tigetnum("colors") >= 8
    return True


def has_unicode() -> bool:
    """Return whether the terminal shows UTF-8, as far as the locale says.

    Python takes UTF-8 in a locale "C", whose terminal may know ASCII only.
    """
    if "utf" not in sys.stdout.encoding.lower():
        return False
    if sys.platform == "win32":
        return True
    names = (os.environ.get(name) for name in ("LC_ALL", "LC_CTYPE", "LANG"))
    return "utf" in next((name for name in names if name), "").lower()


if sys.platform == "win32":
    import ctypes
    import msvcrt
    from ctypes import wintypes

    class _Door:
        """Console of Windows."""

        _VIRTUAL = 0x0004  # ENABLE_VIRTUAL_TERMINAL_PROCESSING

        def __init__(self) -> None:
            self._handle = wintypes.HANDLE(msvcrt.get_osfhandle(sys.stdout.fileno()))
            self._mode: wintypes.DWORD | None = None
            self._has_keys = sys.stdin.isatty()

        def open(self, resumed: Callable[[], None]) -> None:
            del resumed
            mode = wintypes.DWORD()
            set_mode = ctypes.windll.kernel32.SetConsoleMode
            if not (
                ctypes.windll.kernel32.GetConsoleMode(self._handle, ctypes.byref(mode))
                and set_mode(self._handle, mode.value | self._VIRTUAL)
            ):
                raise ValueError(NO_TERMINAL)
            self._mode = mode
            self.write(ENTER)

        def close(self) -> None:
            if self._mode is not None:
                self.write(LEAVE)
                ctypes.windll.kernel32.SetConsoleMode(self._handle, self._mode)

        def write(self, text: str) -> None:
            sys.stdout.write(text)
            sys.stdout.flush()

        def wait(self, seconds: float) -> str:
            end = time.monotonic() + seconds
            while True:
                keys = ""
                while self._has_keys and msvcrt.kbhit():
                    key = msvcrt.getwch()
                    if key in "\0\xe0":
                        msvcrt.getwch()  # an arrow or a function key
                    else:
                        keys += key
                left = end - time.monotonic()
                if keys or left <= 0:
                    return keys
                time.sleep(min(left, 0.05))

else:
    import select
    import termios

    class _Door:
        """POSIX terminal."""

        def __init__(self) -> None:
            self._out = sys.stdout.fileno()
            self._keys = sys.stdin.fileno() if sys.stdin.isatty() else None
            self._has_keys = self._keys is not None
            self._decode = codecs.getincrementaldecoder("utf-8")("ignore").decode
            self._before: list[Any] | None = None  # attributes of the terminal
            self._handlers: dict[signal.Signals, Any] = {}
            self._is_open = False

        def open(self, resumed: Callable[[], None]) -> None:
            self._resumed = resumed
            self._woken, self._wake = os.pipe()
            os.set_blocking(self._wake, False)
            if self._keys is not None:
                self._before = termios.tcgetattr(self._keys)
            if threading.current_thread() is threading.main_thread():
                handlers = (
                    (signal.SIGTSTP, self._stop),
                    (signal.SIGCONT, self._go_on),
                    (signal.SIGWINCH, self._rouse),
                )
                for number, handler in handlers:
                    self._handlers[number] = signal.signal(number, handler)
            self._is_open = True
            self._enter()

        def close(self) -> None:
            if not self._is_open:
                return
            self._is_open = False
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
            try:
                self._leave()
            finally:
                os.close(self._woken)
                os.close(self._wake)

        def _enter(self) -> None:
            if self._keys is not None and self._before is not None:
                mode = [*self._before[:6], [*self._before[6]]]
                mode[3] &= ~(termios.ECHO | termios.ICANON)  # Ctrl-C and Ctrl-Z stay signals
                mode[6][termios.VMIN], mode[6][termios.VTIME] = 1, 0
                mode[6][termios.VQUIT] = b"\0"  # Ctrl-\ would end it as it is
                with suppress(termios.error):  # of a background job; it is asked again with fg
                    termios.tcsetattr(self._keys, termios.TCSANOW, mode)
            self.write(ENTER)

        def _leave(self) -> None:
            try:
                self.write(LEAVE)
            finally:
                if self._keys is not None and self._before is not None:
                    termios.tcsetattr(self._keys, termios.TCSANOW, self._before)

        def _stop(self, *_: Any) -> None:
            """Give the terminal back before Ctrl-Z stops the process, which goes on here."""
            self._leave()
            signal.signal(signal.SIGTSTP, signal.SIG_DFL)
            signal.raise_signal(signal.SIGTSTP)
            self._go_on()

        def _go_on(self, *_: Any) -> None:
            if self._is_open:
                signal.signal(signal.SIGTSTP, self._stop)
                self._enter()
                self._resumed()
                self._rouse()

        def _rouse(self, *_: Any) -> None:
            """End a wait."""
            with suppress(BlockingIOError):
                os.write(self._wake, b"x")

        def write(self, text: str) -> None:
            left = text.encode(sys.stdout.encoding, "replace")
            while left:
                left = left[os.write(self._out, left) :]

        def wait(self, seconds: float) -> str:
            sources = [self._woken]
            if self._keys is not None and self._has_keys:
                sources.append(self._keys)
            ready = select.select(sources, [], [], seconds)[0]
            if self._woken in ready:
                os.read(self._woken, 4096)
            if self._keys is None or self._keys not in ready:
                return ""
            found = os.read(self._keys, 4096)
            if found.endswith(b"\x1b") and select.select([self._keys], [], [], REST)[0]:
                found += os.read(self._keys, 4096)
            self._has_keys = bool(found)  # it was closed
            return SEQUENCE.sub("", self._decode(found))


class Console:
    """The terminal of this process, as `open_console` gives it."""

    def __init__(self, door: _Door) -> None:
        self._door = door
        self._is_blank = True

    def size(self) -> tuple[int, int]:
        """Return columns and rows."""
        try:
            columns, rows = os.get_terminal_size(sys.stdout.fileno())
        except OSError:
            columns, rows = 0, 0
        return columns or 80, rows or 24

    def write(self, text: str) -> None:
        """Write a text at once."""
        self._door.write(text)

    def wait(self, seconds: float) -> str:
        """Wait for keys, at most a time [s]; return them, or "" also if the screen has changed."""
        return self._door.wait(seconds)

    def is_blank(self) -> bool:
        """Return whether the screen was left since the last call, so that nothing is on it."""
        blank, self._is_blank = self._is_blank, False
        return blank

    def _resumed(self) -> None:
        self._is_blank = True


@contextmanager
def open_console(say: Callable[[str], None]) -> Iterator[Console]:
    """Show the other screen, and take keys as they come; at the end, all is as it was.

    What the process prints to standard error meanwhile is passed on, a row at a time.

    Args:
        say: takes a row for standard error.

    Raises:
        ValueError: as ``check_terminal``.
    """
    check_terminal()
    door = _Door()
    console = Console(door)
    try:
        with _no_errors_on_screen(say):
            door.open(console._resumed)  # noqa: SLF001 - of the same module
            yield console
    finally:
        is_main = threading.current_thread() is threading.main_thread()
        ctrl_c = signal.signal(signal.SIGINT, signal.SIG_IGN) if is_main else None
        try:
            door.close()
        finally:
            if is_main:
                signal.signal(signal.SIGINT, ctrl_c)


class _Rows(io.TextIOBase):
    """File that passes its rows on."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._rest = say, ""

    def write(self, text: str) -> int:
        *rows, self._rest = (self._rest + text).split("\n")
        for row in rows:
            self._say(row)
        return len(text)


@contextmanager
def _no_errors_on_screen(say: Callable[[str], None]) -> Iterator[None]:
    rows: Any = _Rows(say)
    handlers: list[Any] = [
        one for one in logging.getLogger().handlers if type(one) is logging.StreamHandler
    ]
    streams = [one.setStream(rows) for one in handlers]
    try:
        with redirect_stderr(rows):
            yield
    finally:
        for one, stream in zip(handlers, streams, strict=True):
            one.setStream(stream)
