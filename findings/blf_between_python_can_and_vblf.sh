#!/bin/sh
# BLF between two public libraries fails in both directions.
#
# python-can 4.6.1 writes a CAN FD frame (object type 100, CAN_FD_MESSAGE) as an object of 116 bytes.
# The structure has 120: it ends with four reserved bytes. vblf 0.3.1 raises struct.error.
#
# vblf 0.3.1 writes no compression by default. Each of its containers then has 2 (zlib) in the field
# of the compression method, since it writes the flags of an ordinary object header there. Only the
# header of the file says that nothing is compressed. python-can raises zlib.error.
#
# Seen:
#   python-can: bytes of an object of CAN FD: 116
#   vblf reads it: error: unpack_from requires a buffer of at least 120 bytes ...
#   vblf: compression method of a container that is not compressed: 2
#   python-can reads it: error: Error -3 while decompressing data: incorrect header check
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q python-can==4.6.1 vblf==0.3.1
cd "$tmp"
"$tmp/venv/bin/python" - <<'P'
import struct
import sys
import zlib

import can
from vblf.can import CanMessage
from vblf.constants import ObjFlags
from vblf.reader import BlfReader
from vblf.writer import BlfWriter


def outcome(read):
    try:
        return f"{len(list(read()))} objects"
    except (struct.error, zlib.error) as error:
        return f"error: {error}"


with can.BLFWriter("fd.blf") as log:
    log.on_message_received(
        can.Message(arbitration_id=0x123, is_fd=True, data=bytes(12), timestamp=1.7e9)
    )
with open("fd.blf", "rb") as file:
    objects = zlib.decompress(file.read()[144 + 32 :])
size = struct.unpack_from("<L", objects, 8)[0]
print("python-can: bytes of an object of CAN FD:", size)
by_vblf = outcome(lambda: BlfReader("fd.blf"))
print("vblf reads it:", by_vblf)

with BlfWriter("plain.blf") as log:
    log.write(CanMessage.new(ObjFlags.TIME_ONE_NANS, 0, 1, 0, 8, 0x123, bytes(8)))
with open("plain.blf", "rb") as file:
    content = file.read()
method = struct.unpack_from("<H", content, 144 + 16)[0]
print("vblf: compression method of a container that is not compressed:", method)
by_can = outcome(lambda: can.BLFReader("plain.blf"))
print("python-can reads it:", by_can)
sys.exit((size, method) != (116, 2) or "error" not in by_vblf or "error" not in by_can)
P
