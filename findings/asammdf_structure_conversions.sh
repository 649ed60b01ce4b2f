#!/bin/sh
# asammdf 8.8.28 leaves out the conversions of the fields of a structure, such as CAN_DataFrame.
#
# MDF.get of a field of its own gives the physical value; MDF.get of the structure gives the raw
# value of the same field, also with raw=False. It does so if no field has a variable length and
# the structure has no gaps; otherwise the conversions hold. A logger may store the DLC and have the
# length by a conversion: the MF4Reader of python-can 4.6.1, which gets the structure, then has
# frames of another length.
#
# Seen:
#   field alone:      [8 3 3]
#   in the structure: [7 2 2]
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q asammdf==8.8.28
cd "$tmp"
"$tmp/venv/bin/python" - <<'P'
import sys

import numpy as np
from asammdf import MDF, Signal
from asammdf.blocks.conversion_utils import from_dict

NAME = "CAN_DataFrame.DataLength"
samples = np.zeros(3, [("CAN_DataFrame.ID", "<u4"), (NAME, "u1"), ("CAN_DataFrame.DataBytes", "u1", (8,))])
samples[NAME] = [7, 2, 2]
with MDF(version="4.10") as mdf:
    mdf.append(Signal(samples, np.arange(3.0), name="CAN_DataFrame"))
    for channel in mdf.groups[0].channels:
        if channel.name == NAME:
            channel.conversion = from_dict({"a": 1.0, "b": 1.0})
    mdf.save("a.mf4")
with MDF("a.mf4") as mdf:
    alone = mdf.get(NAME, 0, raw=False).samples.astype(int)
    together = mdf.get("CAN_DataFrame", 0, raw=False)[NAME].astype(int)
print("field alone:     ", alone)
print("in the structure:", together)
sys.exit(alone.tolist() != [8, 3, 3] or together.tolist() != [7, 2, 2])
P
