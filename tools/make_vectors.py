#!/usr/bin/env python3
"""Write the test vectors of the DBCs of the package to c/tests/vectors.

python tools/make_vectors.py            write them
python tools/make_vectors.py --check    report whether they are up to date
"""

import sys
from pathlib import Path

from reporting import parser_of

from maplines_can.generation.c_tables import identifier_of
from maplines_can.generation.vector_files import vectors_from
from maplines_can.wire import Layout

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "c" / "tests" / "vectors"


def wanted() -> dict[Path, str]:
    """Return the text of each file."""
    files: dict[Path, str] = {}
    for dbc in sorted((ROOT / "dbc").glob("*.dbc")):
        vectors, name = vectors_from(Layout.from_dbc(dbc)), identifier_of(dbc.name)
        files |= {FOLDER / f"{name}.json": vectors.json, FOLDER / f"{name}.txt": vectors.text}
    return files


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    check, texts = parser.parse_args().check, wanted()
    stale = [path for path, text in texts.items() if not path.exists() or path.read_text() != text]
    for path in stale:
        if not check:
            path.write_text(texts[path])
        print(f"{path.relative_to(ROOT)}: {'is not up to date' if check else 'written'}")
    if not stale:
        print("up to date")
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
