#!/bin/sh
# pyproj 3.7.2 (PROJ 9.5.1): a datum shift that is left out, as its optional grid is not installed,
# counts as the best available.
#
# For EPSG:31467 without its grid, TransformerGroup warns, best_available is False, and the accuracy
# of the shift that is taken instead is stated (3 m). Map files often state the same system as a PROJ
# string with "+nadgrids=@BETA2007.gsb,null": if the grid is not there, nothing is shifted. Then there
# is no warning, best_available is True, unavailable_operations is empty, and the accuracy is -1 (not
# known), as if the grid were there. Positions differ by 140 m. Only the attribute "available" of the
# grids of transformers[0].operations shows it.
#
# Seen, at 49.3 N 8.9 E:
#   EPSG:31467   best_available False  warnings 1  accuracy 3.0   x 3492802.0 y 5462556.2
#   PROJ string  best_available True   warnings 0  accuracy -1.0  x 3492727.8 y 5462437.6
#   grids of the PROJ string: @BETA2007.gsb False, null True
#
# Exits with 0 if that is still so.
set -eu
T=$(mktemp -d)
trap 'rm -rf "$T"' EXIT
python3 -m venv "$T/venv"
"$T/venv/bin/pip" install -q pyproj==3.7.2
PROJ_NETWORK=OFF "$T/venv/bin/python" - <<'PY'
import sys
import warnings

from pyproj.transformer import AreaOfInterest, TransformerGroup

STRING = (
    "+proj=tmerc +lat_0=0 +lon_0=9 +k=1 +x_0=3500000 +ellps=bessel "
    "+nadgrids=@BETA2007.gsb,null +units=m"
)
area = AreaOfInterest(8.89, 49.29, 8.91, 49.31)
seen = []
for label, system in (("EPSG:31467", "EPSG:31467"), ("PROJ string", STRING)):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        group = TransformerGroup(system, "EPSG:4326", always_xy=True, area_of_interest=area)
    best = group.transformers[0]
    x, y = best.transform(8.9, 49.3, direction="INVERSE")
    seen.append((group.best_available, len(said), best.accuracy, round(x), round(y)))
    print(f"{label:12} best_available {group.best_available!s:5}  warnings {len(said)}  "
          f"accuracy {best.accuracy:<4}  x {x:.1f} y {y:.1f}")
grids = [(g.short_name, g.available) for one in best.operations for g in one.grids]
print("grids of the PROJ string:", ", ".join(f"{name} {there}" for name, there in grids))
expected = [(False, 1, 3.0, 3492802, 5462556), (True, 0, -1.0, 3492728, 5462438)]
sys.exit(seen != expected or ("@BETA2007.gsb", False) not in grids)
PY
