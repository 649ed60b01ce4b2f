"""Reader of DBC files: their places, their text, and the database that cantools makes of it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from ..values.errors import LayoutError
from ..values.input_files import checked_path
from .encoding import text_of

if TYPE_CHECKING:
    from cantools.database.can import Database as Database
    from cantools.database.can import Message as Message

#: DBCs of this package; their names stand for them where there is no such file.
SHIPPED = ("maplines.dbc", "maplines-secoc.dbc", "maplines-pose.dbc", "maplines-scene.dbc")


def default_dbc_path(name: str = "maplines.dbc") -> Path:
    """Return the path of one of the project's DBCs: in the installed package, or the checkout.

    Raises:
        LayoutError: it is in neither place.
    """
    package, root = Path(__file__).parents[1:3]
    packaged, checkout = package / "dbc" / name, root / "dbc" / name
    for path in (packaged, checkout):
        if path.is_file():
            return path
    raise LayoutError(f"{name} is neither at {packaged} nor at {checkout}; reinstall")


def read_bytes(path: Path) -> bytes:
    """Return the content of a DBC file; raises LayoutError as ``Layout.from_dbc``."""
    try:
        with checked_path(path, LayoutError).open("rb") as file:  # a pipe or device may never end
            data = file.read(MAX_DBC + 1)
    except OSError as error:
        raise LayoutError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(data) > MAX_DBC:
        raise LayoutError(f"{path}: is too large: a DBC must have {MAX_DBC:,} bytes at most")
    return data


def read_text(path: Path, encoding: str | None = None) -> str:
    """Return the text of a DBC file; see `text_of`; raises LayoutError as ``Layout.from_dbc``."""
    return text_of(read_bytes(path), str(path), encoding)


def parse_database(text: str, source: str, *, strict: bool = True) -> Database:
    """Return the database of the text of a DBC.

    Args:
        text: of the DBC.
        source: its name, for messages.
        strict: whether signals that overlap, or do not fit into their message, are an error.

    Raises:
        LayoutError: the text is not a DBC.
    """
    import cantools
    from cantools.database.can import Database

    check_numbers(text, source)
    try:
        database = cantools.database.load_string(text, database_format="dbc", strict=strict)
    except Exception as error:  # the parser raises many types, all for a text that is not a DBC
        reason = " ".join(str(error).split()) or type(error).__name__
        raise LayoutError(f"{source}: is not a valid DBC: {reason}") from error
    if not isinstance(database, Database):
        raise LayoutError(f"{source}: is not a DBC of CAN messages")
    return database


# Some DBC files would take cantools gigabytes of memory or hours of time. It allocates lists as
# long as some numbers in the file say, before it checks anything:
#
# - one element a bit of a message, so `BO_ 0 M: 65536 E` is refused (5 digits and more; a message
#   has 64 bytes at most);
# - one element a bit up to the start and length of a signal, so `SG_ a : 2147483648|4` is refused
#   (6 digits and more);
# - one element a number in a range of multiplexer values, so `SG_MUL_VAL_ 0 a b 0-2147483648;` is
#   refused (6 digits and more).
#
# It also expands a number such as `1e30865535` to an integer of as many digits where it expects an
# integer, in an attribute also from within quotes, so exponents of 4 digits and more are refused.
# For each word it makes an object, so the number of words has a limit, and the length of a text.
# Large numbers elsewhere are valid, such as a CAN ID of 29 bits or a range of values of 32 bits.

#: Largest size of a DBC file [byte]; the DBC of a whole car has a few million.
MAX_DBC = 16_000_000
#: Most words and signs outside of texts, for each of which cantools needs some 160 bytes.
MAX_TOKENS = 1_250_000
#: Most characters without a quotation mark, such as a text, for each of which it needs 200 bytes.
MAX_TEXT = 1 << 18
_TOKEN = re.compile(r"\w+|[^\w\s]")

#: A number with an exponent of 4 digits or more.
_LONG_EXPONENT = re.compile(r"(?<![\w.])\d[\d.]*[eE]\+?\d{4}")
#: Quoted texts and remarks, as cantools' tokenizer finds them: their numbers are harmless.
_TEXT = re.compile(r'"(?:\\"|[^"])*?"|//.*?\n', re.DOTALL)
#: Message lengths; starts and lengths of signals; ranges of multiplexer values.
_LONG_LIST = re.compile(
    r"""
      : \s* [+-]? \d{5,} \s* \w
    | : [\s\d|+-]* \d{6}
    | SG_MUL_VAL_\b \s* [+-]? \d++ \s*+ \w++ \s++ \w++ [\s\d,+-]* \d{6}
    """,
    re.VERBOSE,
)


def check_numbers(text: str, source: str) -> None:
    """Raise LayoutError if a text of a DBC is too long, or a number in it has too many digits."""
    if max(map(len, text.replace('\\"', "..").split('"'))) > MAX_TEXT:
        raise LayoutError(
            f"{source}: is too large: {MAX_TEXT} characters without a quotation mark; shorten them"
        )
    bare = _TEXT.sub(" ", text)
    if len(bare) > MAX_TOKENS and sum(1 for _ in _TOKEN.finditer(bare)) > MAX_TOKENS:
        raise LayoutError(
            f"{source}: is too large: it has more than {MAX_TOKENS} words and signs; keep the "
            "messages that are needed"
        )
    if found := _LONG_EXPONENT.search(text) or _LONG_LIST.search(bare):
        raise LayoutError(
            f"{source}: is not a valid DBC: a start, length or range has too many digits: "
            f"{' '.join(found[0].split())}"
        )
