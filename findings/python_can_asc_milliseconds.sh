#!/bin/sh
# The date of an ASC log by python-can 4.6.1 is wrong by up to 0.9 s, and python-can reads it so.
#
# ASCWriter writes the milliseconds of a date without leading zeros: 7 ms is ".7", which is 700 ms.
# ASCReader takes it as such, and shifts the times of all messages. It happens in one of ten logs:
# those that begin in the first 100 ms of a second.
#
# Seen:
#   Begin Triggerblock ... 12:00:00.7 2026
#   first message: written at 0.007 s of the second, read at 0.700 s
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q python-can==4.6.1
cd "$tmp"
TZ=UTC "$tmp/venv/bin/python" - <<'P'
import sys

import can

START = 1_772_625_600.007
with can.ASCWriter("a.asc") as log:
    log.on_message_received(can.Message(arbitration_id=0x123, timestamp=START, data=b"a"))
with open("a.asc") as file:
    rows = file.read().splitlines()
print(next(row for row in rows if row.startswith("Begin")))
# The reader takes the row "date", which has the time of writing: that of the block is put there.
rows[0] = "date" + next(row for row in rows if row.startswith("Begin"))[len("Begin Triggerblock") :]
with open("a.asc", "w") as file:
    file.write("\n".join(rows) + "\n")
(message,) = can.ASCReader("a.asc", relative_timestamp=False)
found = message.timestamp % 1
print(f"first message: written at {START % 1:.3f} s of the second, read at {found:.3f} s")
sys.exit(abs(found - 0.7) > 1e-3)
P
