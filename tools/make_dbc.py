#!/usr/bin/env python3
"""Write dbc/maplines.dbc and the table in dbc/README.md from the description of the wire.

python tools/make_dbc.py            write them
python tools/make_dbc.py --check    say whether they are up to date
"""

import argparse
import sys
from pathlib import Path

from maplines_can.wire.signals import DEFAULT

FOLDER = Path(__file__).resolve().parents[1] / "dbc"
BEGIN, END = "<!-- fields: written by tools/make_dbc.py -->\n", "\n<!-- end of fields -->"


def wanted():
    """The texts of the two files."""
    page = (FOLDER / "README.md").read_text()
    before, after = page.split(BEGIN)[0], page.split(END)[1]
    return {
        FOLDER / "maplines.dbc": DEFAULT.dbc(),
        FOLDER / "README.md": f"{before}{BEGIN}{DEFAULT.table()}{END}{after}",
    }


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    stale = [path for path, text in wanted().items() if path.read_text() != text]
    for path in stale:
        if not check:
            path.write_text(wanted()[path])
        print(f"{path.relative_to(FOLDER.parent)}: {'is not up to date' if check else 'written'}")
    if not stale:
        print("up to date")
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
