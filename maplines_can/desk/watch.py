"""What a person has chosen to see of the facts of a bus, by keys, while they come."""

from __future__ import annotations

from collections import deque

from .facts import Facts, changes
from .history import NOTHING
from .screen import Row
from .terminal import Look, Shown, screen

#: Changes that are kept, and the time over which rates are told [s].
KEPT, SECOND = 200, 1.0
ENTER, ESCAPE, BACKSPACE, CTRL_C, CTRL_U = "\r\n", "\x1b", "\b\x7f", "\x03", "\x15"


class Watch:
    r"""Facts as they come, and what of them is shown.

    The keys are those of ``cantools monitor``: q ends, p pauses and plays, r resets counters,
    changes and the filter, f or / asks for a text that names contain.

    Args:
        look: of the screen.

    >>> watch = Watch(Look("virtual a", "maplines.dbc"))
    >>> watch.press("fleft")
    True
    >>> watch.shown.filter, watch.shown.is_typing, watch.press("\nq")
    ('left', True, False)
    """

    def __init__(self, look: Look) -> None:
        self._look = look
        self._facts: Facts = NOTHING | {"t": None, "scene": None, "lines": 0}
        self._since = self._last = NOTHING
        self._changes = deque[tuple[float, str]](maxlen=KEPT)
        self._past = deque[Facts]()  # facts of the last second
        self._frozen: Shown | None = None
        self._filter = ""
        self._before: str | None = None  # the filter before the one that is being typed

    def add(self, facts: Facts) -> None:
        """Take the newest facts."""
        t = facts["t"]
        self._changes.extend((t, text) for text in changes(self._last, facts))
        self._past.append(facts)
        while len(self._past) > 2 and not 0 <= t - self._past[1]["t"] < SECOND:
            self._past.popleft()
        self._facts = self._last = facts

    def say(self, text: str) -> None:
        """Show a text among the changes."""
        self._changes.append((self._facts["t"] or 0.0, text))

    def press(self, keys: str) -> bool:
        """Take keys; return whether to go on."""
        for key in keys:
            if key == CTRL_C or (key == "q" and self._before is None):
                return False
            if self._before is not None:
                self._type(key)
            elif key in "f/":
                self._before = self._filter
            elif key == "p":
                self._frozen = self._now() if self._frozen is None else None
            elif key == "r":
                self._reset()
        return True

    def _type(self, key: str) -> None:
        """Take a key of the filter, which counts at once."""
        if key in ENTER:
            self._before = None
        elif key == ESCAPE:
            self._filter, self._before = self._before or "", None
        elif key in BACKSPACE:
            self._filter = self._filter[:-1]
        elif key == CTRL_U:
            self._filter = ""
        elif key.isprintable():
            self._filter += key

    def _reset(self) -> None:
        self._since, self._filter, self._frozen = self._facts, "", None
        self._changes.clear()

    def _now(self) -> Shown:
        before = self._past[0] if len(self._past) > 1 else None
        return Shown(self._facts, self._since, before, tuple(self._changes))

    @property
    def shown(self) -> Shown:
        """What is shown now."""
        shown = self._now() if self._frozen is None else self._frozen
        return shown._replace(
            filter=self._filter,
            is_typing=self._before is not None,
            is_paused=self._frozen is not None,
        )

    def rows(self, width: int, height: int) -> list[Row]:
        """Return the rows of the screen, as ``terminal.screen``."""
        return screen(self.shown, self._look, width, height)
