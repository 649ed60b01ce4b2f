#!/bin/sh
# python-can 4.6.1: ASCReader reads a decimal log as hexadecimal if the row before "base dec" is not
# one that it knows, and drops the first frame after a header without "internal events logged".
#
# Its header ends at the first row that is none of date, base, a comment or "internal events
# logged"; that row is consumed. A date is known only if its day is of word characters: "lun." is
# the French one, and an ISO date has none. The rows after it are then skipped as events, "base dec"
# too, without an error or a warning. Decimal IDs and bytes that have the form of hexadecimal ones
# become other IDs and values.
#
# Seen: the IDs of two frames that were recorded as 257 and 256 (0x101 and 0x100), in decimal.
#   date Mon Jun 10 ...     [257, 256]
#   date lun. juin 10 ...   [599, 598]     as hexadecimal
#   date 2024-06-10 ...     [599, 598]     as hexadecimal
#   without a third row     [256]          the first frame is lost
#
# Exits with 0 if that is still so.
set -eu
T=$(mktemp -d)
trap 'rm -rf "$T"' EXIT
python3 -m venv "$T/venv"
"$T/venv/bin/pip" install -q python-can==4.6.1
"$T/venv/bin/python" - "$T" <<'PY'
import sys
from pathlib import Path

import can

path = Path(sys.argv[1], "a.asc")
frames = "   0.100000 1  257  Rx   d 1  10\n   0.200000 1  256  Rx   d 1  10\n"
events = "internal events logged\n"
dates = {
    "date Mon Jun 10 10:00:00 2024\n": (events, [257, 256]),
    "date lun. juin 10 10:00:00 2024\n": (events, [599, 598]),
    "date 2024-06-10T10:00:00\n": (events, [599, 598]),
    "date Tue Jun 11 10:00:00 2024\n": ("", [256]),
}
found = {}
for date, (end, _) in dates.items():
    path.write_text(date + "base dec  timestamps absolute\n" + end + frames)
    found[date] = [message.arbitration_id for message in can.ASCReader(path)]
    print(date.strip(), "/", end.strip() or "-", "/", found[date])
sys.exit(found != {date: ids for date, (_, ids) in dates.items()})
PY
