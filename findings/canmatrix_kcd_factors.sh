#!/bin/sh
# canmatrix 1.3.3: a factor in KCD has six digits.
#
# A DBC with the factor 0.0009765625 (2^-10) and one with 4.76837158203125e-07 (2^-21) are written as
# KCD and read again by canmatrix. KCD is XML whose slopes are doubles, and cantools 45.1.0 writes all
# digits. canmatrix formats them with %g. Seen:
#
#     canmatrix: Ten 0.000976562, Last 4.76837e-07: the raw value 32000 is 31.249984, not 31.25
#     cantools: Ten 0.0009765625, Last 4.76837158203125e-07
#
# So a DBC that is converted gives other values, without a warning.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q canmatrix==1.3.3 cantools==45.1.0 lxml
cd "$folder"
cat > a.dbc <<'DBC'
VERSION ""
NS_ :
BS_:
BU_: Car
BO_ 256 Place: 8 Car
 SG_ Ten : 0|16@1- (0.0009765625,0) [0|0] "m" Car
 SG_ Last : 16|20@1- (0.000000476837158203125,0) [0|0] "1/m" Car
DBC
env/bin/python - <<'PY'
import cantools
from canmatrix import formats

formats.dumpp({"": formats.loadp_flat("a.dbc")}, "a.kcd")
frame = formats.loadp_flat("a.kcd").frame_by_name("Place")
ten, last = (float(frame.signal_by_name(name).factor) for name in ("Ten", "Last"))
print(f"canmatrix: Ten {ten}, Last {last}: the raw value 32000 is {32000 * ten}, not 31.25")
own = cantools.database.load_string(cantools.database.load_file("a.dbc").as_kcd_string(), "kcd")
scales = [own.get_message_by_name("Place").get_signal_by_name(n).scale for n in ("Ten", "Last")]
print("cantools: Ten {}, Last {}".format(*scales))
assert (ten, last) == (0.000976562, 4.76837e-07)
assert scales == [0.0009765625, 4.76837158203125e-07]
PY
