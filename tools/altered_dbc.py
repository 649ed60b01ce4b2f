#!/usr/bin/env python3
"""Load altered DBCs, and print how many of each field are right, refused and wrong.

    altered_dbc.py                     all fields and alterations, in ten minutes
    altered_dbc.py Status Age --json   some fields, as JSON with the text of each refusal
    altered_dbc.py Pose.Age            a field of the pose error, or of Conditional records
    altered_dbc.py scenes              all signals of DBCs with scenes, misspelt and removed

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
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, NamedTuple

from cantools.database.can import Database, Message
from dbc_alterations import (
    SLOTS,
    Alteration,
    conditional_original,
    fields,
    fields_of,
    of_field,
    of_field_in,
    of_messages,
    part,
    pose_original,
)
from dbc_witness import check_codec
from pose_witness import check_conditional, check_pose
from reporting import parser_of, progress
from scene_alterations import FORMS, alterations_in, scenes_outcome
from scene_alterations import original as original_with_scenes

from maplines_can.values.errors import LayoutError
from maplines_can.wire import Codec, Layout
from maplines_can.wire.layout.dbc_reader import parse_database

MESSAGES, SCENES = "messages", "scenes"
#: Most records in a row of the pose error and of conditional records.
SCENE_RECORDS = 8


class SceneRecord(NamedTuple):
    """Kind of record of a scene, whose fields are altered.

    Its alterations have the altered messages only, since loading the DBC takes most of the time.
    """

    original: Callable[[], str]  #: the text of the DBC
    message: str  #: one of its messages
    messages: str  #: all of its messages, as a regular expression
    check: Callable[[Layout, Any, int], None]

    def loaded(self, text: str) -> Database:
        """Return the database of the altered messages, and of the others in CAN FD frames."""
        database = parse_database(text, "DBC")
        database.messages.extend(_others(self))
        return database


@cache
def _others(kind: SceneRecord) -> list[Message]:
    """Return the CAN FD messages of the original that no alteration changes."""
    whole = parse_database(kind.original(), "DBC").messages
    return [m for m in whole if m.is_fd and not re.fullmatch(kind.messages, m.name)]


KINDS = {
    "Pose": SceneRecord(pose_original, "Pose", "Pose(?:Fd)?", check_pose),
    "Conditional": SceneRecord(conditional_original, "EgoLeft", r"Ego\w+", check_conditional),
}


class Outcome(NamedTuple):
    """Result of an altered DBC."""

    alteration: Alteration
    result: str  #: "right", "refused" or "wrong"
    text: str = ""  #: of the refusal, or what is wrong


def outcome(alteration: Alteration, records: int = 300, lines: int = 24) -> Outcome:
    """Load an altered DBC and check it; ``records`` are sent in a row in each frame format."""
    kind, _, field = alteration.field.rpartition(".")
    try:
        text = alteration.text
        database = KINDS[kind].loaded(text) if kind else parse_database(text, "DBC")
        codec = Codec(Layout.from_dbc(database))
    except LayoutError as error:
        named = (field, SLOTS[0].name, KINDS[kind].message if kind else "EgoLeft")
        if alteration.field == MESSAGES or any(name in str(error) for name in named):
            return Outcome(alteration, "refused", str(error))
        return Outcome(alteration, "wrong", f"the refusal names no signal or message: {error}")
    except Exception as error:  # noqa: BLE001 - any other error is a wrong result
        return Outcome(alteration, "wrong", f"loading raises {error!r}")
    try:
        if kind:
            KINDS[kind].check(codec.layout, database, min(records, SCENE_RECORDS))
        else:
            check_codec(codec, database, records, lines)
    except Exception as error:  # noqa: BLE001
        return Outcome(alteration, "wrong", f"{type(error).__name__}: {error}")
    return Outcome(alteration, "right")


def scene_outcomes() -> Iterator[Outcome]:
    """Yield the result of each signal of the messages of scenes, misspelt and removed."""
    for form in FORMS:
        database = original_with_scenes(form, SLOTS)
        for altered in alterations_in(database):
            what = "misspelt" if altered.misspelt else "removed"
            where = f"{form}, {altered.field} {what} in {' and '.join(altered.messages)}"
            text = scenes_outcome(database, altered)
            result = text if text in {"right", "refused"} else "wrong"
            yield Outcome(Alteration(SCENES, where, ""), result, text)


def alterations_of(field: str) -> Iterator[Alteration]:
    """Yield the alterations of a signal, or of messages."""
    kind, _, signal = field.rpartition(".")
    if kind:
        record = KINDS[kind]
        altered = of_field_in(part(record.original(), record.messages), signal, record.messages)
        return (alteration._replace(field=field) for alteration in altered)
    return of_messages() if field == MESSAGES else of_field(field)


def scene_fields() -> list[str]:
    """Return the fields of the pose error and of conditional records, after their kind."""
    return [
        f"{name}.{field}"
        for name, kind in KINDS.items()
        for field in fields_of(kind.original(), kind.message)
    ]


def table(outcomes: dict[str, list[Outcome]]) -> str:
    """Return the counts of each field and their sum as text."""
    rows = {field: [o.result for o in group] for field, group in outcomes.items()}
    rows["all"] = [result for results in rows.values() for result in results]
    lines = [f"{'field':<28}{'tried':>8}{'right':>8}{'refused':>9}{'wrong':>8}"]
    for field, results in rows.items():
        right, refused, wrong = (results.count(name) for name in ("right", "refused", "wrong"))
        lines.append(f"{field:<28}{len(results):>8}{right:>8}{refused:>9}{wrong:>8}")
    return "\n".join(lines)


def main() -> int:
    """Print the counts, and what is wrong, and return the exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("field", nargs="*", help=f"signals, {MESSAGES} or {SCENES} (default: all)")
    parser.add_argument("--records", type=int, default=300, help="records in a row (default: 300)")
    parser.add_argument("--json", action="store_true", help="print each alteration as JSON")
    options = parser.parse_args()
    known = [MESSAGES, SCENES, *fields(), *scene_fields()]
    if unknown := [field for field in options.field if field not in known]:
        parser.error(f"there is no field {', '.join(unknown)}; choose from {', '.join(known)}")
    outcomes = {}
    for field in progress(options.field or known, "altered DBCs"):
        outcomes[field] = (
            [*scene_outcomes()]
            if field == SCENES
            else [outcome(a, options.records) for a in alterations_of(field)]
        )
    wrong = [o for group in outcomes.values() for o in group if o.result == "wrong"]
    if options.json:
        result: dict[str, Any] = {
            field: {o.alteration.name: {"result": o.result, "text": o.text} for o in group}
            for field, group in outcomes.items()
        }
        print(json.dumps(result, indent=2))
    else:
        print(table(outcomes))
        for o in wrong:
            print(f"wrong: {o.alteration.field}, {o.alteration.name}: {o.text}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
