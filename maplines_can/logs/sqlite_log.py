"""Reader of SQLite logs that runs nothing of what their schema may contain."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

from .frame_block import LogFrame, stamp_ns
from .log_summary import LogSummary, Skipped
from .text_rows import check_frame

#: Most bytes of a row of an SQL table; that of a frame has some 100.
MAX_ROW = 1 << 16
#: Columns of the table as python-can writes it.
_COLUMNS = ("ts", "arbitration_id", "extended", "remote", "error", "dlc", "data")
#: First time that is a date and not counted from the start of the log, as for python-can [s].
_DATES = 631_152_000


class SqliteReader:
    """Reader of the table ``messages`` of an SQLite file, as python-can writes it.

    python-can's also runs a view or an expression in place of the table, which may never end. Its
    writer loses the channel of each frame; a table of others may have it as the column ``channel``.

    Args:
        path: of the file; it is not written to.
        summary: of the log.

    Raises:
        sqlite3.Error: the file is damaged, or a row has more than ``MAX_ROW`` bytes.
        ValueError: there is no such table, or a row of it is no frame.
    """

    def __init__(self, path: Path, summary: LogSummary) -> None:
        self._summary = summary
        self._connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
        self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_ROW)

    def __enter__(self) -> SqliteReader:
        return self

    def __exit__(self, *exception: object) -> None:
        self._connection.close()

    def __iter__(self) -> Iterator[LogFrame]:
        kinds = "SELECT type FROM sqlite_master WHERE name = 'messages'"
        if (kind := self._connection.execute(kinds).fetchone()) != ("table",):
            raise ValueError(f"it has {'a view' if kind else 'no table'} named messages")
        self._connection.set_authorizer(_reads_messages)
        rows = self._connection.execute("SELECT * FROM messages")
        names = [str(column[0]).lower() for column in rows.description]
        if not set(_COLUMNS) <= set(names):
            raise ValueError(
                f"the table messages must have the 7 columns {', '.join(_COLUMNS)}, "
                f"got {', '.join(names)}"
            )
        fields = itemgetter(*map(names.index, _COLUMNS))
        channel = names.index("channel") if "channel" in names else None
        if channel is None:
            self._summary.notices.append(
                "The table messages has no column channel: its frames are read as those of one bus."
            )
        for row in rows:
            self._summary.times = self._summary.times or (
                "absolute" if row[names.index("ts")] >= _DATES else "zero"
            )
            yield from self._frames(fields(row), None if channel is None else row[channel])

    def _frames(self, row: tuple[Any, ...], channel: object) -> Iterator[LogFrame]:
        timestamp, can_id, is_extended, is_remote, is_error, _, data = row
        if not isinstance(can_id, int) or not isinstance(data, bytes | None):
            raise ValueError("a row of messages has an integer as CAN ID and a blob as data")  # noqa: TRY004
        if is_error or is_remote:
            self._summary.skipped[Skipped.ERROR if is_error else Skipped.REMOTE] += 1
            return
        data, t_ns = data or b"", stamp_ns(timestamp)
        check_frame(can_id, data, t_ns)
        name = "" if channel is None else str(channel)
        yield LogFrame(can_id, data, t_ns, bool(is_extended), name, has_time=True)


def _reads_messages(action: int, table: str | None, *_: Any) -> int:
    """Allow to read the table, and nothing that an expression of the schema may do."""
    allowed = action == sqlite3.SQLITE_SELECT or (
        action == sqlite3.SQLITE_READ and table == "messages"
    )
    return sqlite3.SQLITE_OK if allowed else sqlite3.SQLITE_DENY
