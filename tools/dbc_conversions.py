#!/usr/bin/env python3
"""Measure what conversions to other formats keep of the DBCs of the package.

python tools/dbc_conversions.py            print the table
python tools/dbc_conversions.py --write    write it into dbc/README.md

Each DBC is converted, read again by the tool that wrote it, and compared: random payloads of each
message are decoded by both. It needs canmatrix of the version below, in an environment of its own:
that of the package may have another one, which asammdf asks for.
"""

from __future__ import annotations

import logging
import random
import tempfile
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import cantools

ROOT = Path(__file__).resolve().parents[1]
DBCS = ("maplines.dbc", "maplines-secoc.dbc", "maplines-pose.dbc", "maplines-scene.dbc")
CANMATRIX = "1.3.3"
#: Random payloads of each message.
PAYLOADS = 40
#: Formats that each tool writes and reads; canmatrix fails on those of `REFUSED`.
BY_CANTOOLS = ("dbc", "kcd", "sym")
BY_CANMATRIX = ("dbc", "kcd", "sym", "json", "xls", "xlsx", "arxml", "dbf", "xml")
NAMES = {"xml": "FIBEX", "xls": "XLS", "xlsx": "XLSX", "dbf": "DBF (Busmaster)"}


class Row(NamedTuple):
    """What a conversion keeps."""

    tool: str
    format: str
    kept: str  #: messages all of whose payloads decode to the same values, and all messages
    lost: str

    def __str__(self) -> str:
        return "| " + " | ".join(self) + " |"


def by_cantools(path: Path, suffix: str) -> Any:
    """Return the database that cantools reads of what it writes."""
    text = getattr(cantools.database.load_file(path), f"as_{suffix}_string")()
    return cantools.database.load_string(text, suffix)


def by_canmatrix(path: Path, suffix: str) -> Any:
    """Return the database that canmatrix reads of what it writes; its DBCs are exact."""
    formats: Any = import_module("canmatrix.formats")  # it has no types
    with tempfile.TemporaryDirectory() as folder:
        converted, back = Path(folder) / f"a.{suffix}", Path(folder) / "b.dbc"
        formats.dumpp({"": formats.loadp_flat(str(path))}, str(converted))
        formats.dumpp({"": formats.loadp_flat(str(converted))}, str(back))
        return cantools.database.load_file(back, strict=False)


def rows(tool: str) -> Iterator[Row]:
    """Yield the rows of cantools or of canmatrix."""
    own = tool == "cantools"
    convert: Callable[[Path, str], Any] = by_cantools if own else by_canmatrix
    for suffix in BY_CANTOOLS if own else BY_CANMATRIX:
        kept = total = 0
        lost: dict[str, None] = {}
        for name in DBCS:
            reference: Any = cantools.database.load_file(ROOT / "dbc" / name)
            total += len(reference.messages)
            try:
                other = convert(ROOT / "dbc" / name, suffix)
            except Exception as error:  # noqa: BLE001 - each format has errors of its own
                lost[f"cannot be converted ({type(error).__name__})"] = None
                continue
            same, losses = compared(reference, other)
            kept += same
            lost |= dict.fromkeys(losses)
        title = NAMES.get(suffix, suffix.upper())
        yield Row(
            f"{tool} {version(tool)}", title, f"{kept} of {total}", ", ".join(lost) or "nothing"
        )


def compared(reference: Any, other: Any) -> tuple[int, list[str]]:
    """Return how many messages decode as before, and what is lost of any."""
    found = {(m.frame_id, m.is_extended_frame): m for m in other.messages}
    rng, same, lost = random.Random(0), 0, set()  # noqa: S311
    for message in reference.messages:
        own = found.get((message.frame_id, message.is_extended_frame))
        if own is None:
            lost.add("messages")
            continue
        lost |= set(properties_lost(message, own))
        same += all(decodes_as_before(message, own, rng) for _ in range(PAYLOADS))
    return same, sorted(lost)


def properties_lost(message: Any, other: Any) -> Iterator[str]:
    """Yield what another message does not have of one, but for comments and attributes."""
    for what, name in (("length", "length"), ("is_fd", "CAN FD flag")):
        if getattr(message, what) != getattr(other, what):
            yield name
    signals = {signal.name: signal for signal in other.signals}
    for signal in message.signals:
        own = signals.get(signal.name)
        if own is None:
            yield "multiplexer" if signal.is_multiplexer else "names of signals"
            continue
        if signal.scale != own.scale:
            is_rounded = abs(own.scale / signal.scale - 1) < 1e-5
            yield "factors after six digits" if is_rounded else "factors"
        for name, of in (
            ("offsets", "offset"),
            ("signs", "is_signed"),
            ("units", "unit"),
            ("names of values", "choices"),
            ("pages", "multiplexer_ids"),
            ("places", "start"),
        ):
            if (getattr(signal, of) or 0) != (getattr(own, of) or 0):
                yield name


def decodes_as_before(message: Any, other: Any, rng: random.Random) -> bool:
    """Return whether random data of a message are decoded to the same values."""
    data = rng.randbytes(message.length)
    try:
        values = message.decode(data, decode_choices=False)
    except cantools.database.DecodeError:  # there is no such page
        return True
    try:
        return bool(values == other.decode(data, decode_choices=False))
    except Exception:  # noqa: BLE001 - of a database that does not fit
        return False


def table(found: list[Row]) -> str:
    """Return the rows as a table of Markdown."""
    return "\n".join(
        ["| tool | format | messages kept | what is lost |", "|---|---|---|---|", *map(str, found)]
    )


def main() -> int:
    from reporting import fill_tables, parser_of

    parser = parser_of(__doc__)
    parser.add_argument("--write", action="store_true", help="write the table into dbc/README.md")
    options = parser.parse_args()
    if version("canmatrix") != CANMATRIX:
        parser.error(f"canmatrix must be {CANMATRIX}, got {version('canmatrix')}")
    logging.disable()
    text = table([*rows("cantools"), *rows("canmatrix")])
    page = ROOT / "dbc" / "README.md"
    if options.write:
        tables = {"conversions": text}
        page.write_text(fill_tables(page.read_text("utf-8"), "dbc_conversions.py", tables), "utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
