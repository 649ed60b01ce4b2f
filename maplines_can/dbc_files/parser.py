"""Reader of DBC files: their places, their text, and the database that cantools makes of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..values.errors import LayoutError
from ..values.input_files import checked_path
from .encoding import text_of
from .limits import MAX_DBC, check_numbers

if TYPE_CHECKING:  # cantools is loaded if it parses a DBC; these are for the modules above, too
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
