"""Encoding of the text of a DBC: stated by the user, or found.

A DBC does not state its encoding: tools write UTF-8, or the code page of the machine. They are
told apart by the units, whose signs are few: the same byte is the degree sign in cp1252 and cp1250,
and two bytes are "℃" in cp936 and nonsense in others. Detectors of encodings are made for prose: of
23 short DBCs in eight encodings, charset-normalizer 3.5.2 gave the wrong unit of 9, and chardet
7.7.0 of 7.
"""

# ruff: noqa: RUF001 - Cyrillic and East Asian units
from __future__ import annotations

import codecs
import re
import warnings

from ..values.errors import LayoutError

__all__ = ["decoded", "say", "text_of"]

#: Code pages, in the order in which they are tried; the first one is what most DBC tools write.
FALLBACK = "cp1252"
CODE_PAGES = ("utf-8", FALLBACK, "cp1250", "cp1251", "cp949", "cp936", "cp932")
#: Byte order marks, with the encoding that reads each; of UTF-32 none, as no DBC tool writes it.
MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}

#: Signs of units that are beyond ASCII; East Asian code pages have some units as one character.
_SIGNS = "±·×ÅΩ′″‰℃℉ℓΩÅ√∆㍱-㏟％／"
#: Words that are units: in Russian, and in Chinese, Japanese and Korean.
_WORDS = (
    "об|мин|км|ч|мм|см|м|кг|г|сек|с|мс|В|мВ|А|мА|Вт|кВт|Н|Па|кПа|МПа|л|С|град|рад|Гц|кГц|Ом|бар"
    "|度|毫秒|微秒|秒|分钟|分|小时|时|時間|時|天|日|年|月|毫米|厘米|公里|千米|米|转|回転|回|圈|次|个|個|升|伏"
    "|安|牛|도|초|분|시간|시|일|년|월|회전|회|개"
)
#: Not units: "°²" and "µµ", which are one character in an East Asian code page.
_UNIT = re.compile(
    rf"""(?: [ -~{_SIGNS}]
      | ° | [µμ] (?=[A-Za-zΩ]) | (?<![^\x00-\x7e℃㍱-㏟]) [¹²³]
      | (?<=[A-Za-z]) [À-öø-ž] (?![À-ž])
      | (?<![А-я‰]) (?:{_WORDS}) (?![А-я]) )*""",
    re.VERBOSE,
)
_UNITS = re.compile(r'^[ \t]*SG_\s[^"\n]*"([^"\n]*)"', re.MULTILINE)
_MESSAGE = re.compile(r"^[ \t]*BO_\s", re.MULTILINE)
#: Comments, whose words have no effect.
_COMMENT = re.compile(r'^[ \t]*CM_\s[^"\n]*"(?:\\"|[^"])*"', re.MULTILINE)
_QUOTED = re.compile(r'"((?:\\"|[^"])*)"')


def text_of(data: bytes, source: str, encoding: str | None = None) -> str:
    """Return the text of a DBC.

    Args:
        data: content of the file.
        source: its name, for messages.
        encoding: stated by the user, of any name that Python knows; None to find it: by a byte
            order mark, otherwise as the first one of `CODE_PAGES` that has each byte and in which
            the most units exist.

    Warns:
        UserWarning: a unit or a name is uncertain: it is not in UTF-8, and no unit that is known.

    Raises:
        LayoutError: there is no such encoding, or the text does not have it.
    """
    text, doubt = decoded(data, source, encoding)
    say(doubt, source)
    return text


def say(doubt: str, source: str) -> None:
    """Warn of what is uncertain in a DBC; see `decoded`."""
    if doubt:
        warnings.warn(f"{source}: {doubt}", stacklevel=3)


def decoded(data: bytes, source: str, encoding: str | None = None) -> tuple[str, str]:
    """Return the text of a DBC as `text_of`, and what is uncertain, which is empty if nothing is.

    Raises:
        LayoutError: there is no such encoding, or the text does not have it.
    """
    if encoding is not None:
        return _stated(data, source, encoding), ""
    for mark, name in MARKS.items():
        if data.startswith(mark):
            return _stated(data, source, name), ""
    found = {name: text for name in CODE_PAGES if (text := _strict(data, name)) is not None}
    # A DBC of several encodings is read, too, although it has bytes that none of them has.
    found = found or {FALLBACK: data.decode(FALLBACK, "replace")}
    page = min(found, key=lambda name: len(_strange(_UNITS.findall(found[name]))))
    if page == "utf-8" or not _MESSAGE.search(found[page]):  # the parser says what it is not
        return found[page], ""
    uncertain = _strange(_QUOTED.findall(_COMMENT.sub("", found[page])))
    if not uncertain:
        return found[page], ""
    more = f" and {len(uncertain) - 3} more" if len(uncertain) > 3 else ""
    return found[page], (
        f"is not in UTF-8, and taken to be in {page}, so it is uncertain whether "
        f"{', '.join(map(repr, uncertain[:3]))}{more} is right; state the encoding "
        "(encoding=, --encoding), such as cp1252 or cp936"
    )


def _stated(data: bytes, source: str, encoding: str) -> str:
    """Return the text in an encoding; a byte order mark is not part of it."""
    try:
        return data.decode(encoding).removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        raise LayoutError(
            f"{source}: is not in encoding={encoding}: {error}; state another one, or none"
        ) from error
    except (LookupError, ValueError) as error:
        raise LayoutError(f"encoding={encoding!r} is none that Python knows: {error}") from error


def _strict(data: bytes, page: str) -> str | None:
    try:
        return data.decode(page)
    except UnicodeDecodeError:
        return None


def _strange(texts: list[str]) -> list[str]:
    """Return the texts beyond ASCII that are no units, each once."""
    return [text for text in dict.fromkeys(texts) if not _UNIT.fullmatch(text)]
