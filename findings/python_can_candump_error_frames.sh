#!/bin/sh
# python-can 4.6.1: CanutilsLogReader returns most error frames of candump -L as data frames.
#
# candump prints the ID of an error frame with the flag 0x20000000 and the error classes below it.
# The reader takes a frame for an error frame only if the class "bus error" (0x80) is set too, which
# its own writer always sets. All other classes, such as a controller problem (0x04) or bus off
# (0x40), become data frames with an extended ID that is the class: 0x4 and 0x40, which are IDs that
# a bus may have.
#
# Seen: what the reader makes of three error frames of candump.
#   20000004#...  controller problem   data frame, ID 0x4
#   20000040#...  bus off              data frame, ID 0x40
#   20000088#...  bus error            error frame, ID 0x0
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

path = Path(sys.argv[1], "a.log")
rows = "20000004#0004000000000000", "20000040#0000000000000000", "20000088#0000801900000000"
path.write_text("".join(f"(1700000000.5) can0 {row}\n" for row in rows))
found = [(m.is_error_frame, m.arbitration_id) for m in can.CanutilsLogReader(path)]
for row, (is_error, can_id) in zip(rows, found):
    print(row, "error frame" if is_error else "data frame", hex(can_id))
sys.exit(found != [(False, 0x4), (False, 0x40), (True, 0)])
PY
