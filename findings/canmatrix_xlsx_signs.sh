#!/bin/sh
# canmatrix 1.3.3: a signed signal is unsigned after XLSX and back, with its minimum as its offset.
#
# A DBC with one signed signal of 16 bits is written as XLSX and read again by canmatrix. Seen, with
# what the bits ffff then mean:
#
#     before: signed True, offset 0: ffff is -0.5
#     after: signed False, offset -16384: ffff is 16383.5
#
# No exception tells it.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q canmatrix==1.3.3 xlsxwriter==3.3.1 openpyxl==3.1.5 xlrd==2.0.2
cd "$folder"
cat > a.dbc <<'DBC'
VERSION ""
NS_ :
BS_:
BU_: Car
BO_ 256 Place: 8 Car
 SG_ Y : 0|16@1- (0.5,0) [-16384|16383.5] "m" Car
DBC
env/bin/python - <<'PY'
from canmatrix import formats

formats.dumpp({"": formats.loadp_flat("a.dbc")}, "a.xlsx")
values = []
for name, path in (("before", "a.dbc"), ("after", "a.xlsx")):
    frame = formats.loadp_flat(path).frame_by_name("Place")
    signal = frame.signal_by_name("Y")
    raw = int.from_bytes(b"\xff\xff", "little", signed=signal.is_signed)
    values.append(raw * float(signal.factor) + float(signal.offset))
    print(f"{name}: signed {signal.is_signed}, offset {signal.offset}: ffff is {values[-1]}")
assert values == [-0.5, 16383.5]
PY
