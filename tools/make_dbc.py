#!/usr/bin/env python3
"""Write the DBCs of the package and the tables in dbc/README.md.

python tools/make_dbc.py                write them
python tools/make_dbc.py --check        report whether they are up to date
python tools/make_dbc.py --codes DIR    write the DBC of each covariance code to a folder
"""

import sys
from pathlib import Path
from typing import Any

from reporting import fill_tables, parser_of

from maplines_can.study.codes import CODES
from maplines_can.study.dbc.covariance_spec import covariance_signals
from maplines_can.study.dbc.pose_spec import CONDITIONAL, POSE_WITH_LEVELS
from maplines_can.study.dbc.record_spec import DEFAULT, SECURED, dbc_name, dbc_writer_for
from maplines_can.wire.covariance.code import OCTAVES
from maplines_can.wire.covariance.factor import RATIO
from maplines_can.wire.layout.requirements import (
    CONDITIONAL_REQUIREMENTS,
    EXACT,
    QUANTITY,
    RELATIONS,
    REQUIREMENTS,
)

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "dbc"


def wanted() -> Any:
    """Return the text of each file."""
    tables = {
        "fields": DEFAULT.table(),
        "pose": POSE_WITH_LEVELS.record.table(),
        "conditional": without(CONDITIONAL.table(), DEFAULT.table()),
        "requirements": requirements_table(),
        "codes": codes_table(),
    }
    page = fill_tables((FOLDER / "README.md").read_text(), "make_dbc.py", tables)
    return {
        FOLDER / "maplines.dbc": DEFAULT.dbc(),
        FOLDER / "maplines-secoc.dbc": SECURED.dbc(),
        FOLDER / "maplines-pose.dbc": CONDITIONAL.dbc(),
        FOLDER / "README.md": page,
    }


def without(table: str, other: str) -> str:
    """Return a table without the rows that another one has, too."""
    head, known = table.splitlines()[:2], set(other.splitlines())
    return "\n".join([*head, *(row for row in table.splitlines() if row not in known)])


def requirements_table() -> Any:
    """Return the table of what each signal needs, but for what all of them need."""
    rows = ["| signal | needs |", "|---|---|"]
    relations = {
        name: [relation for relation in RELATIONS if relation.name == name] for name in REQUIREMENTS
    }
    needs: dict[str, Any] = {
        **{name: [*own, *relations[name]] for name, own in REQUIREMENTS.items()},
        "Pivot*`, `Inflation": OCTAVES,
        "Ratio*": RATIO,
        **{f"{name}` of `PoseConditional": own for name, own in CONDITIONAL_REQUIREMENTS.items()},
    }
    for name, of_signal in needs.items():
        common = QUANTITY if EXACT in of_signal else ()
        own = [requirement.needs for requirement in of_signal if requirement not in common]
        rows.append(f"| `{name}` | {'; '.join(own).replace('|', chr(92) + '|')} |")
    needed = "; ".join(requirement.needs for requirement in QUANTITY).replace("|", "\\|")
    return "\n".join([*rows, f"| each signal of a record | {needed} |"])


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
