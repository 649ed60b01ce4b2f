#!/bin/sh
# pyproj 3.7.2 (PROJ 9.5.1): always_xy=True returns mirrored coordinates for systems with axes to the
# south and to the west.
#
# always_xy asks for the order easting, northing whatever the axes of a system. Axes to the north and
# east are exchanged, and axes to the west and south leave x, y turned by 180 degrees, so that what is
# on the left remains there. Systems whose axes are south, then west (EPSG:5513 and 2065, Krovak) are
# left as they are: x is to the south and y to the west, a mirrored plane. Distances are right, but
# the left side of each line is on its right, and angles have the other sign.
#
# Seen: east and north are the change of (x, y) for 0.001 deg to the east and to the north.
#   EPSG:2193  north, east   (82, 1) and (-1, 111)       not mirrored
#   EPSG:2048  west, south   (-93, 0) and (0, -111)      not mirrored
#   EPSG:5513  south, west   (10, -71) and (-110, -15)   mirrored
#   EPSG:2065  south, west   (10, -71) and (-110, -15)   mirrored
#
# Exits with 0 if that is still so.
set -eu
T=$(mktemp -d)
trap 'rm -rf "$T"' EXIT
python3 -m venv "$T/venv"
"$T/venv/bin/pip" install -q pyproj==3.7.2
"$T/venv/bin/python" - <<'PY'
import sys

from pyproj import CRS, Transformer

expected = {"EPSG:2193": False, "EPSG:2048": False, "EPSG:5513": True, "EPSG:2065": True}
places = {"EPSG:2193": (172.0, -43.0), "EPSG:2048": (19.0, -33.0)}
found = {}
for name in expected:
    lon, lat = places.get(name, (14.4, 50.0))
    to_plane = Transformer.from_crs("EPSG:4326", name, always_xy=True).transform
    x, y = to_plane(lon, lat)
    (ex, ey), (nx, ny) = to_plane(lon + 0.001, lat), to_plane(lon, lat + 0.001)
    east, north = (round(ex - x), round(ey - y)), (round(nx - x), round(ny - y))
    found[name] = east[0] * north[1] - east[1] * north[0] < 0
    axes = ", ".join(axis.direction for axis in CRS(name).axis_info)
    print(f"{name}  {axes:13} {east} and {north}", "mirrored" if found[name] else "not mirrored")
sys.exit(found != expected)
PY
