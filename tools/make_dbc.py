#!/usr/bin/env python3
"""Write the DBCs of the package, their tables, and those in dbc/README.md.

python tools/make_dbc.py                write them
python tools/make_dbc.py --check        report whether they are up to date
python tools/make_dbc.py --codes DIR    write the DBC of each covariance code to a folder
"""

import sys
from pathlib import Path
from typing import Any

from reporting import fill_tables, parser_of

from maplines_can.dbc_files.dbc_cache import PACKAGED, key_of, parsed_tables
from maplines_can.dbc_files.dbc_tables import to_json
from maplines_can.generation.dbc.record_spec import (
    CONDITIONAL,
    DEFAULT,
    POSE_WITH_LEVELS,
    SECURED,
    WHOLE_SCENES,
)
from maplines_can.study.code_dbcs import covariance_signals, dbc_name, dbc_writer_for
from maplines_can.study.codes import CODES
from maplines_can.wire.layout.record_layout import RELATIONS
from maplines_can.wire.layout.record_signals import (
    COMPLETE_RECORD,
    CONDITIONAL_RECORD,
    FARTHEST,
    OCTAVES,
    OF_SLOT,
    POSE_RECORD,
    RATIO,
    SCENE_LINE,
    SCENE_RECORD,
    SLOT,
    SLOT_BOUNDS,
    SLOT_COUNTER,
    TRAILER,
    Bounds,
)

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "dbc"


def wanted() -> Any:
    """Return the text of each file."""
    tables = {
        "fields": DEFAULT.table(),
        "pose": POSE_WITH_LEVELS.record.table(),
        "conditional": without(CONDITIONAL.table(), DEFAULT.table()),
        "scene": WHOLE_SCENES.table(),
        "requirements": requirements_table(),
        "codes": codes_table(),
    }
    page = fill_tables((FOLDER / "README.md").read_text(), "make_dbc.py", tables)
    dbcs = {
        "maplines.dbc": DEFAULT.dbc(),
        "maplines-secoc.dbc": SECURED.dbc(),
        "maplines-pose.dbc": CONDITIONAL.dbc(),
        "maplines-scene.dbc": WHOLE_SCENES.dbc(),
    }
    texts = {FOLDER / name: dbc for name, dbc in dbcs.items()} | {FOLDER / "README.md": page}
    kept = {
        (PACKAGED / name).with_suffix(".json"): to_json(
            key_of(dbc.encode()), parsed_tables(dbc, name)
        )
        for name, dbc in dbcs.items()
    }
    return texts | kept


def without(table: str, other: str) -> str:
    """Return a table without the rows that another one has, too."""
    head, known = table.splitlines()[:2], set(other.splitlines())
    return "\n".join([*head, *(row for row in table.splitlines() if row not in known)])


def requirements_table() -> Any:
    """Return the table of what a DBC may change of each signal."""
    rows = [
        "| signal | unit | bits | type | factor, offset | values of any bits | together |",
        "|---|---|---|---|---|---|---|",
    ]
    bounds = dict(COMPLETE_RECORD)
    for name, own in CONDITIONAL_RECORD.items():
        bounds[name if bounds.get(name, own) == own else f"{name}` of `PoseConditional"] = own
    bounds |= {name: own for name, own in POSE_RECORD.items() if name not in bounds}
    bounds |= {"*Counter": SLOT_COUNTER} | {f"*{name}": own for name, own in OF_SLOT.items()}
    of_scene = {**SCENE_RECORD, **SCENE_LINE, SLOT: SLOT_BOUNDS}
    for name, own in of_scene.items():
        if own not in (bounds.get(name), bounds.get(f"{name}` of `PoseConditional")):
            bounds[name if name not in bounds else f"{name}` of `Scene"] = own
    bounds |= {**TRAILER, "Pivot*`, `Inflation": OCTAVES, "Ratio*": RATIO}
    for name, own in bounds.items():
        related = name.removeprefix("*") if name.removeprefix("*") in OF_SLOT else name
        is_shared = name in OF_SLOT  # the relations of these names are those of slots
        together = [r.needs for r in RELATIONS if r.name == related and not is_shared]
        rows.append(f"| `{name}` | {' | '.join(cells(own))} | {'; '.join(together)} |")
    return "\n".join(rows)


def cells(bounds: Bounds) -> list[str]:
    """Return unit, bits, type, conversion and values of bounds, as cells of a table."""
    units = [f'"{unit}"' if unit else "none" for unit in bounds.units]
    least, most = bounds.bits
    factor, offset = (
        free if fixed is None else f"{fixed:g}"
        for fixed, free in ((bounds.factor, "positive"), (bounds.offset, "any"))
    )
    low, high = bounds.values
    return [
        " or ".join(units) or "any",
        f"{least}" if least == most else f"{least} to {most}",
        "unsigned" if bounds.unsigned else "any",
        f"{factor}, {'whole' if bounds.whole_offset else offset}",
        "any" if high == FARTHEST and low == -FARTHEST else f"{low:g} to {high:g}",
    ]


def codes_table() -> Any:
    """Return the table of codes with their files, sizes and guarantees."""
    rows = [
        "| `CovarianceCode` | DBC | what is sent | bits of the covariance | classic frames | "
        "definite for all bits | covers the true covariance |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, code in CODES.items():
        bits = sum(spec.bits for spec in covariance_signals(name))
        rows.append(
            f"| {name} | `{dbc_name(name)}` | {code.about} | {bits} | "
            f"{len(dbc_writer_for(name).pages)} | {'yes' if code.positive_definite else 'no'} | "
            f"{'yes' if code.covering else 'no'} |"
        )
    return "\n".join(rows)


def main() -> Any:
    parser = parser_of(__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    parser.add_argument("--codes", type=Path, metavar="DIR", help="write those of all codes")
    options = parser.parse_args()
    if options.codes:
        options.codes.mkdir(parents=True, exist_ok=True)
        for code in CODES:
            (options.codes / dbc_name(code)).write_text(dbc_writer_for(code).dbc())
        return 0
    check, texts = options.check, wanted()
    stale = [path for path, text in texts.items() if not path.exists() or path.read_text() != text]
    for path in stale:
        if not check:
            path.write_text(texts[path])
        print(f"{path.relative_to(FOLDER.parent)}: {'is not up to date' if check else 'written'}")
    if not stale:
        print("up to date")
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
