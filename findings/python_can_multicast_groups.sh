#!/bin/sh
# python-can 4.6.1, udp_multicast on Linux: a bus also receives the frames of other groups.
#
# The channel of this interface is a multicast group. A bus binds its socket to the port and not to
# the group, and does not clear the option IP_MULTICAST_ALL, which is on by default: it then gets
# what comes to the port for any group that a socket of this machine has joined. Two benches on one
# machine with a channel each are one bus. Another port separates them.
#
# Seen:
#   on the group of the sender:       0x123
#   on another group:                 0x123
#   on another group, another port:   nothing
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q python-can==4.6.1 msgpack==1.1.2
cd "$tmp"
"$tmp/venv/bin/python" - <<'P'
import sys

import can


def opened(channel, port):
    return can.Bus(interface="udp_multicast", channel=channel, port=port, hop_limit=0)


GROUP, OTHER, PORT = "239.74.163.61", "239.74.163.62", 43861
with (
    opened(GROUP, PORT) as same,
    opened(OTHER, PORT) as other,
    opened(OTHER, PORT + 1) as apart,
    opened(GROUP, PORT) as sender,
):
    sender.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=[1]))
    found = [bus.recv(1.0) for bus in (same, other, apart)]
ids = [None if one is None else hex(one.arbitration_id) for one in found]
print("on the group of the sender:      ", ids[0])
print("on another group:                ", ids[1])
print("on another group, another port:  ", ids[2] or "nothing")
sys.exit(ids != ["0x123", "0x123", None])
P
