#!/usr/bin/env python3
"""Load altered DBCs, and print how many of each field are right, refused and wrong.

    altered_dbc.py                     all fields and alterations
    altered_dbc.py Line.Age --json     some fields, as JSON with the text of each refusal
    altered_dbc.py Pose Scene          all fields of kinds of records
    altered_dbc.py messages            alterations of messages and their attributes

An altered DBC is refused if loading it raises a LayoutError that names the signal or a message. It
is right if cantools decodes the same values from all frames as the codec, and all lines arrive as
promised. Anything else is wrong.

Run it in the environment of the project: python3 tools/run.py python tools/altered_dbc.py

The exit status is 1 if a result is wrong.
"""

from __future__ import annotations

import json
import re
import sys
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from cantools.database.can import Database
from dbc_alterations import ALTERATIONS, EDITS, ORIGINALS, SLOTS, altered, edited
from dbc_witness import check_codec
from reporting import parser_of, progress

from maplines_can.dbc_files.parser import parse_database
from maplines_can.values.errors import LayoutError
from maplines_can.wire import Codec, Layout

MESSAGES = "messages"


class Outcome(NamedTuple):
    """Result of an altered DBC."""

    name: str  #: what is altered
    result: str  #: "right", "refused" or "wrong"
    text: str = ""  #: of the refusal, or what is wrong


def outcome(database: Database, name: str, named: str, records: int, lines: int = 24) -> Outcome:
    """Load an altered DBC and check it.

    Args:
        database: the altered DBC.
        name: what is altered.
        named: what a refusal names, as a regular expression.
        records: number of lines in a row in each frame format.
        lines: number of lines of all kinds in each frame format.
    """
    try:
        codec = Codec(Layout.from_dbc(database))
    except LayoutError as error:
        if re.search(named, str(error)):
            return Outcome(name, "refused", str(error))
        return Outcome(name, "wrong", f"the refusal names no signal or message: {error}")
    except Exception as error:  # noqa: BLE001 - any other error is a wrong result
        return Outcome(name, "wrong", f"loading raises {error!r}")
    try:
        check_codec(codec, database, records, lines)
    except Exception as error:  # noqa: BLE001
        return Outcome(name, "wrong", f"{type(error).__name__}: {error}")
    return Outcome(name, "right")


def outcomes(field: str, records: int = 300, lines: int = 24) -> Iterator[Outcome]:
    """Yield the results of all alterations of a field, such as ``Pose.Age``, or of messages.

    A record needs its signals in all messages, so they are renamed and removed in one form of the
    messages, too.
    """
    if field == MESSAGES:
        for name in EDITS:
            try:
                database = parse_database(edited(name), "DBC")
            except LayoutError as error:  # cantools refuses it
                yield Outcome(name, "refused", str(error))
                continue
            yield outcome(database, name, "", records, lines)
        return
    kind, _, signal = field.partition(".")
    original = ORIGINALS[kind]
    named = f"{signal}|{SLOTS[0].name}|EgoLeft|Pose|Scene"
    for name in ALTERATIONS:
        with altered(original, signal, name):
            yield outcome(original.database, name, named, records, lines)
    for name in ("renamed", "removed"):
        for form, end in original.forms.items():
            with altered(original, signal, name, end):
                found = outcome(original.database, f"{name} in {form}", named, records, lines)
                yield found


def fields() -> list[str]:
    """Return the fields of all records, and ``messages``."""
    return [f"{kind}.{name}" for kind, own in ORIGINALS.items() for name in own.fields] + [MESSAGES]


def table(found: dict[str, list[Outcome]]) -> str:
    """Return the counts of each field and their sum as text."""
    counts = {field: Counter(o.result for o in group) for field, group in found.items()}
    counts["all"] = sum(counts.values(), Counter())
    lines = [f"{'field':<28}{'tried':>8}{'right':>8}{'refused':>9}{'wrong':>8}"]
    for field, n in counts.items():
        lines.append(f"{field:<28}{n.total():>8}{n['right']:>8}{n['refused']:>9}{n['wrong']:>8}")
    return "\n".join(lines)


def main() -> int:
    """Print the counts, and what is wrong, and return the exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("field", nargs="*", help=f"fields, kinds, or {MESSAGES} (default: all)")
    parser.add_argument("--records", type=int, default=300, help="records in a row (default: 300)")
    parser.add_argument("--json", action="store_true", help="print each alteration as JSON")
    options = parser.parse_args()
    known = fields()
    chosen = [f for f in known if not options.field or {f, f.split(".")[0]} & {*options.field}]
    if unknown := {*options.field} - {*known} - {*ORIGINALS}:
        parser.error(f"there is no field {', '.join(unknown)}; choose from {', '.join(known)}")
    found = {
        field: list(outcomes(field, options.records)) for field in progress(chosen, "altered DBCs")
    }
    wrong = [(field, o) for field, group in found.items() for o in group if o.result == "wrong"]
    if options.json:
        result = {
            field: {o.name: {"result": o.result, "text": o.text} for o in group}
            for field, group in found.items()
        }
        print(json.dumps(result, indent=2))
    else:
        print(table(found))
        for field, o in wrong:
            print(f"wrong: {field}, {o.name}: {o.text}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
