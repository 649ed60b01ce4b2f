"""A screen as rows of pieces of text, and what is written so that a terminal shows it.

Nothing here touches a terminal; that is ``console``'s.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from functools import lru_cache

#: A text and its style, a key of `COLOURS`.
Piece = tuple[str, str]
Row = Sequence[Piece]

#: Attributes of the styles, for terminals with colours and for others (SGR of ECMA-48). States
#: are told by words; colours repeat them.
COLOURS = {"": "", "good": "32", "warn": "33", "bad": "1;31", "dim": "2", "bold": "1", "bar": "7"}
MONO = {"": "", "good": "", "warn": "", "bad": "1", "dim": "", "bold": "1", "bar": "7"}
#: Begin and end of what is to be shown at once; terminals that do not know them ignore them.
BEGIN, END = "\x1b[?2026h", "\x1b[?2026l"


def clean(text: str) -> str:
    r"""Return a text without what would move the cursor or change the terminal.

    >>> clean("a\x1b[2Jb\n")
    'a?[2Jb?'
    """
    return text if text.isprintable() else "".join(c if c.isprintable() else "?" for c in text)


def cells(text: str) -> int:
    r"""Return how many cells of a terminal a clean text takes.

    >>> cells("lane"), cells("車線"), cells("e\u0301")
    (4, 4, 1)
    """
    return len(text) if text.isascii() else sum(map(_cells_of, text))


@lru_cache(1024)
def _cells_of(char: str) -> int:
    if unicodedata.category(char) in ("Mn", "Me"):
        return 0
    return 2 if unicodedata.east_asian_width(char) in "WF" else 1


def cut(text: str, width: int) -> str:
    """Return what of a text fits into a width; ``~`` stands for the rest.

    >>> cut("a long name", 7), cut("name", 7), cut("車線", 3)
    ('a long~', 'name', '車~')
    """
    text = clean(text)
    if cells(text) <= width:
        return text
    kept, left = [], width - 1
    for char in text:
        left -= _cells_of(char)
        if left < 0:
            break
        kept.append(char)
    return "".join(kept) + "~" * (width > 0)


def padded(text: str, width: int, *, right: bool = False) -> str:
    """Return a text that takes exactly a width."""
    text = cut(text, width)
    space = " " * (width - cells(text))
    return space + text if right else text + space


def fitted(row: Row, width: int) -> Row:
    """Return what of a row fits into a width."""
    kept: list[Piece] = []
    for text, style in row:
        text = cut(text, width)
        width -= cells(text)
        if text:
            kept.append((text, style))
    return kept


def plain(row: Row) -> str:
    """Return the text of a row."""
    return "".join(text for text, _ in row)


class Painter:
    r"""What is written for a new screen: the rows that are not on the terminal already.

    Args:
        colours: whether the terminal has colours, and a person wants them.

    >>> painter = Painter(colours=True)
    >>> first = painter.paint([[("a", "")], [("b", "good")]], 80, 24)
    >>> painter.paint([[("a", "")], [("c", "good")]], 80, 24)
    '\x1b[?2026h\x1b[2;1H\x1b[32mc\x1b[0m\x1b[K\x1b[?2026l'
    >>> painter.paint([[("a", "")], [("c", "good")]], 80, 24)
    ''
    """

    def __init__(self, *, colours: bool) -> None:
        self._styles = COLOURS if colours else MONO
        self.forget()

    def forget(self) -> None:
        """Take nothing as known of what the terminal shows."""
        self._size = (0, 0)
        self._shown: list[str] = []

    def paint(self, rows: Sequence[Row], width: int, height: int) -> str:
        """Return what to write for rows, each of which fits; "" if all is there."""
        found = []
        if (width, height) != self._size:
            self._size, self._shown = (width, height), ["\x1b[K"] * height
            found.append("\x1b[2J")
        texts = [self._text(row, width) for row in rows]
        texts += ["\x1b[K"] * (height - len(texts))
        for k, (text, shown) in enumerate(zip(texts, self._shown, strict=True), 1):
            if text != shown:
                found.append(f"\x1b[{k};1H{text}")
        self._shown = texts
        return f"{BEGIN}{''.join(found)}{END}" if found else ""

    def _text(self, row: Row, width: int) -> str:
        """Return a row with its attributes; the rest of it is erased.

        After the last cell of a row, erasing would take that cell.
        """
        each = [
            f"\x1b[{attribute}m{text}\x1b[0m" if (attribute := self._styles[style]) else text
            for text, style in row
            if text
        ]
        return "".join(each) + ("\x1b[K" if cells(plain(row)) < width else "")
