"""Coordinate systems of map files: metres whatever the system, or a refusal that names it."""

import io
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.fixtures import Patch
from support.lanelet_files import Osm
from support.xodr_files import geometry, read_map, road, section
from support.xodr_files import lane as xodr_lane

from maplines_can.maps import Map, MapFileError
from maplines_can.maps.formats.commonroad import read as read_commonroad
from maplines_can.maps.formats.points import read as read_points
from maplines_can.maps.formats.projection import local_cartesian, shifted, utm_of
from maplines_can.simulation.map_frame import project
from maplines_can.values.errors import MissingExtraError

Array = NDArray[np.float64]
WIDTH, LENGTH = 3.5, 300.0
MUNICH, PARIS, NEW_YORK = (11.6, 48.1), (2.3, 48.8), (-73.9, 40.7)
#: Gauss-Kruger by a PROJ string whose grid is not installed.
NO_GRID = (
    "+proj=tmerc +lon_0=9 +x_0=3500000 +ellps=bessel +nadgrids=@no_such_grid.gsb,null +units=m"
)


def on_ground(name: str, at: tuple[float, float]) -> list[Array]:
    """Return both sides of a lane, of geodesics on WGS84, in the x and y of a system."""
    pyproj = pytest.importorskip("pyproj")
    globe = pyproj.Geod(ellps="WGS84")
    to_system = pyproj.Transformer.from_crs("EPSG:4326", name, always_xy=True)
    s, sides = np.linspace(0, LENGTH, 31), []
    for across in (WIDTH / 2, -WIDTH / 2):
        along = globe.fwd(np.full(31, at[0]), np.full(31, at[1]), np.full(31, 60.0), s)
        lon, lat, _ = globe.fwd(*along[:2], along[2] + 90, np.full(31, across))
        sides.append(np.column_stack(to_system.transform(lon, lat)))
    return sides


def geojson_text(name: Any, sides: list[Array]) -> str:
    features = [
        {
            "type": "Feature",
            "properties": {"lane": "1", "side": side},
            "geometry": {"type": "LineString", "coordinates": points.tolist()},
        }
        for side, points in zip(("left", "right"), sides, strict=True)
    ]
    crs = name if isinstance(name, dict) else {"type": "name", "properties": {"name": name}}
    return json.dumps({"type": "FeatureCollection", "crs": crs, "features": features})


def geojson(name: Any, sides: list[Array]) -> Map:
    return read_points(io.BytesIO(geojson_text(name, sides).encode()), "map.geojson")


def commonroad(name: str, sides: list[Array], more: str = "") -> Map:
    bounds = ""
    for tag, points in zip(("leftBound", "rightBound"), sides, strict=True):
        each = (f"<point><x>{x!r}</x><y>{y!r}</y></point>" for x, y in points.tolist())
        bounds += f"<{tag}>{''.join(each)}</{tag}>"
    text = (
        '<commonRoad commonRoadVersion="2020a"><location><geoTransformation>'
        f"<geoReference>{name}</geoReference>{more}</geoTransformation></location>"
        f'<lanelet id="1">{bounds}</lanelet></commonRoad>'
    )
    return read_commonroad(io.BytesIO(text.encode()), "map.xml")


def opendrive(name: str, x: float, y: float, offset: str = "") -> Map:
    header = f"<geoReference><![CDATA[{name}]]></geoReference>{offset}"
    plan = geometry(x=x, y=y, length=300.0)
    return read_map(road(section(xodr_lane(-1)), plan=plan, length=300.0), header=header)


FORMATS = [pytest.param(geojson, id="geojson"), pytest.param(commonroad, id="commonroad")]
Reader = Callable[[str, list[Array]], Map]
MOVED = [
    pytest.param("EPSG:3857", MUNICH, "metre, 0.66", id="mercator"),
    pytest.param("EPSG:4258", MUNICH, "longitude and latitude", id="degrees"),
    pytest.param("urn:ogc:def:crs:EPSG::4258", MUNICH, "longitude and latitude", id="urn"),
    pytest.param("EPSG:6318", NEW_YORK, "longitude and latitude", id="nad83-2011"),
    pytest.param("EPSG:4807", PARIS, "[grad]", id="grad-from-paris"),
    pytest.param("EPSG:2263", NEW_YORK, "[US survey foot, 0.3048", id="feet"),
    pytest.param("EPSG:5513", (14.4, 50.0), "x and y of EPSG:5513", id="south-and-west"),
    pytest.param("+proj=tmerc +lat_0=48 +lon_0=11 +k=1.0012", MUNICH, "metre, 0.9987", id="k"),
    pytest.param("+proj=utm +zone=32 +units=us-ft", MUNICH, "US survey foot", id="proj-feet"),
    pytest.param("+proj=tmerc +lat_0=48 +lon_0=11 +to_meter=0.3048", MUNICH, "foot", id="to-meter"),
]
KEPT = [
    pytest.param("EPSG:25832", (8.9, 49.3), id="utm"),
    pytest.param("EPSG:2154", PARIS, id="lambert-93"),
    pytest.param("+proj=tmerc +lat_0=48 +lon_0=11 +k=1.0008", MUNICH, id="k"),
    pytest.param("EPSG:27700", (-1.5, 52.0), id="british-grid"),
    pytest.param("EPSG:2193", (172.0, -43.0), id="north-before-east"),
    pytest.param("EPSG:31467", (8.9, 49.3), id="gauss-kruger"),
    pytest.param("EPSG:3035", MUNICH, id="laea"),
    pytest.param("EPSG:5514", (14.4, 50.0), id="krovak"),
    pytest.param("EPSG:2048", (19.0, -33.0), id="west-and-south"),
    pytest.param("EPSG:25832+7837", (8.9, 49.3), id="compound"),
    pytest.param("+proj=utm +zone=32 +datum=WGS84 +vunits=us-ft", (8.9, 49.3), id="vertical-feet"),
]


@pytest.mark.parametrize("read", FORMATS)
@pytest.mark.parametrize(("name", "at", "notice"), MOVED)
def test_other_units_and_scales_become_metres(
    read: Reader, name: str, at: tuple[float, float], notice: str
) -> None:
    """A lane is as wide and long as on the ground, the map says so, and a drive agrees with it."""
    found = read(name, on_ground(name, at))
    lane = found.lanes["1"]
    assert lane.width == pytest.approx(WIDTH, abs=1e-4)
    assert lane.length == pytest.approx(LENGTH, abs=1e-3)
    assert notice in found.skipped[0].why
    start = project([at[1]], [at[0]], found.projection)[0]
    assert lane.centre.points[0] == pytest.approx(start, abs=5e-3)  # Krovak's inverse: 1 mm


@pytest.mark.parametrize("read", FORMATS)
@pytest.mark.parametrize(("name", "at"), KEPT)
def test_metric_systems_are_kept(read: Reader, name: str, at: tuple[float, float]) -> None:
    """Their positions are those of the file, with the scale of the system, up to 0.1 %."""
    sides = on_ground(name, at)
    found = read(name, sides)
    lane = found.lanes["1"]
    assert lane.left.points.tolist() == sides[0].tolist()
    assert lane.width == pytest.approx(WIDTH, rel=1e-3)
    assert found.projection == name
    start = project([at[1]], [at[0]], found.projection)[0]
    assert lane.centre.points[0] == pytest.approx(start, abs=1e-3)


@pytest.mark.parametrize("name", ["OGC:CRS84", "EPSG:4326", "EPSG:4979", "WGS 84"])
def test_wgs84_needs_no_pyproj(name: str, monkeypatch: Patch) -> None:
    """Longitude stands first, as GeoJSON says, whatever the order of the system's axes."""
    sides = on_ground("EPSG:4326", MUNICH)
    monkeypatch.setitem(sys.modules, "pyproj", None)
    found = geojson(name, sides)
    assert found.lanes["1"].width == pytest.approx(WIDTH, abs=1e-4)
    assert not found.skipped


@pytest.mark.parametrize("name", ["EPSG:32632", "EPSG:25832", "+proj=utm +zone=32 +ellps=GRS80"])
def test_utm_needs_no_pyproj(name: str, monkeypatch: Patch) -> None:
    """The scale of UTM is known."""
    sides = on_ground(name, (8.9, 49.3))
    monkeypatch.setitem(sys.modules, "pyproj", None)
    assert geojson(name, sides).skipped == ()


@pytest.mark.parametrize("read", FORMATS)
def test_a_system_that_needs_pyproj_is_refused_without(read: Reader, monkeypatch: Patch) -> None:
    """The message names the system and the extra."""
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(MissingExtraError, match=r"'EPSG:2154'.*install the extra \"maps\""):
        read("EPSG:2154", [np.array([[0, WIDTH], [9, WIDTH]]), np.array([[0.0, 0], [9, 0]])])


@pytest.mark.parametrize("read", FORMATS)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("EPSG:9999999", id="no-such-code"),
        pytest.param("local", id="word"),
        pytest.param("EPSG:4978", id="geocentric"),
        pytest.param("EPSG:7837", id="heights"),
        pytest.param("+proj=nonsense", id="proj"),
    ],
)
def test_systems_without_a_plane_are_refused(read: Reader, name: str) -> None:
    pytest.importorskip("pyproj")
    sides = [np.array([[0, WIDTH], [9, WIDTH]]), np.array([[0.0, 0], [9, 0]])]
    with pytest.raises(MapFileError, match=f"'{name.replace('+', '.')}' is not valid"):
        read(name, sides)


@pytest.mark.parametrize(
    ("crs", "text"),
    [
        pytest.param({"type": "name", "properties": {"name": ""}}, "projection ''", id="empty"),
        pytest.param({"type": "link", "properties": {"href": "x"}}, "href", id="link"),
        pytest.param("EPSG:2154", "EPSG:2154", id="text"),
    ],
)
def test_a_member_crs_that_names_no_system_is_refused(crs: Any, text: str) -> None:
    pytest.importorskip("pyproj")
    body = {"type": "FeatureCollection", "crs": crs, "features": []}
    with pytest.raises(MapFileError, match="member crs: .*" + text):
        read_points(io.BytesIO(json.dumps(body).encode()), "map.geojson")


@pytest.mark.parametrize("read", FORMATS)
@pytest.mark.parametrize(
    ("name", "at", "text"),
    [
        pytest.param("EPSG:4326", MUNICH, "left boundary of each lane is on its right", id="4326"),
        pytest.param("EPSG:4258", MUNICH, "write longitude before latitude", id="4258"),
        pytest.param("EPSG:31467", (8.9, 49.3), "'EPSG:31467'; write x .east. before", id="31467"),
        pytest.param("EPSG:2263", NEW_YORK, "left boundary", id="2263"),
        pytest.param("EPSG:32632", (8.9, 49.3), "left boundary", id="utm"),
    ],
)
def test_exchanged_axes_are_refused(
    read: Reader, name: str, at: tuple[float, float], text: str
) -> None:
    """They are seen by the area of the system, or else by lanes that are mirrored."""
    sides = [points[:, ::-1] for points in on_ground(name, at)]
    with pytest.raises(MapFileError, match=text):
        read(name, sides)


@pytest.mark.parametrize("name", ["EPSG:25832", "EPSG:2154"])
def test_local_metres_of_a_national_grid_are_metres(name: str, monkeypatch: Patch) -> None:
    """Positions around 0 are not in the area that the file names; it is said."""
    if name == "EPSG:25832":
        monkeypatch.setitem(sys.modules, "pyproj", None)
    else:
        pytest.importorskip("pyproj")
    sides = [np.array([[0, WIDTH], [90, WIDTH]]), np.array([[0.0, 0], [90, 0]])]
    found = commonroad(name, sides)
    assert found.lanes["1"].width == WIDTH
    assert f"not in the area of {name}; they are taken as metres" in found.skipped[0].why


@pytest.mark.parametrize("read", FORMATS)
@pytest.mark.parametrize(
    ("name", "text"),
    [
        pytest.param("EPSG:31467", "right to 3 m, instead of 1 m, as the grid de_adv", id="worse"),
        pytest.param(NO_GRID, "grid no_such_grid.gsb is not installed: .* some 100 m", id="none"),
        pytest.param("+proj=utm +zone=32 +ellps=intl", "its datum is unknown", id="no-datum"),
    ],
)
def test_a_shift_without_its_grid_is_said(read: Reader, name: str, text: str) -> None:
    """With the accuracy that remains; the positions in the plane are right."""
    pyproj = pytest.importorskip("pyproj")
    if (Path(pyproj.datadir.get_data_dir()) / "de_adv_BETA2007.tif").exists():
        pytest.skip("the grid is installed")
    (notice,) = read(name, on_ground(name, (8.9, 49.3))).skipped
    assert re.search(text, notice.why)


def test_a_translation_of_commonroad_is_part_of_the_frame() -> None:
    """Positions are those of the system less the translation, as the tools of CommonRoad write."""
    sides = on_ground("EPSG:3857", MUNICH)
    corner = sides[0][0].tolist()
    more = (
        f"<additionalTransformation><xTranslation>{corner[0]!r}</xTranslation>"
        f"<yTranslation>{corner[1]!r}</yTranslation></additionalTransformation>"
    )
    local = [points - corner for points in sides]
    found = commonroad("EPSG:3857", local, more)
    assert found.lanes["1"].width == pytest.approx(WIDTH, abs=1e-4)
    start = project([MUNICH[1]], [MUNICH[0]], found.projection)[0]
    assert found.lanes["1"].centre.points[0] == pytest.approx(start, abs=1e-3)

    sides = on_ground("EPSG:25832", (8.9, 49.3))
    more = more.replace(repr(corner[0]), "490000").replace(repr(corner[1]), "5460000.0")
    local = [points - [490000, 5460000] for points in sides]
    found = commonroad("EPSG:25832", local, more)
    assert found.lanes["1"].left.points.tolist() == local[0].tolist()
    start = project([49.3], [8.9], found.projection)[0]
    assert found.lanes["1"].centre.points[0] == pytest.approx(start, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "at", "texts"),
    [
        pytest.param("EPSG:3857", MUNICH, ["a metre of EPSG:3857 is 0.66"], id="mercator"),
        pytest.param("EPSG:2263", NEW_YORK, ["US survey foot", "right to 4 m"], id="feet"),
        pytest.param("EPSG:25832+7837", (8.9, 49.3), [], id="compound"),
        pytest.param("EPSG:4979", None, ["is in degrees, not a plane"], id="three-dimensional"),
        pytest.param("nonsense", None, ["'nonsense' is not valid"], id="unknown"),
        pytest.param("EPSG:5513", (14.4, 50.0), ["are mirrored"], id="mirrored"),
        pytest.param("+lat_0=49 +lon_0=8", None, ["is not valid: it has no +proj"], id="carla"),
    ],
)
def test_opendrive_remains_in_metres(
    name: str, at: tuple[float, float] | None, texts: list[str]
) -> None:
    """The map says what differs, and a drive in degrees lies on the road."""
    pytest.importorskip("pyproj")
    x, y = (0.0, 0.0) if at is None else project([at[1]], [at[0]], name)[0].tolist()
    if name == "EPSG:2263":  # 1 011 978 US survey feet of the plane
        assert x == pytest.approx(1011978.077 * 1200 / 3937, abs=0.01)
    found = opendrive(name, x, y)
    assert found.lanes["1:0:-1"].width == pytest.approx(WIDTH, abs=1e-9)
    assert len(found.skipped) == len(texts)
    assert all(text in one.why for text, one in zip(texts, found.skipped, strict=True))


@pytest.mark.parametrize(
    "name",
    ["+proj=utm +zone=32 +datum=WGS84", "EPSG:32632", "+proj=lcc +lat_1=48 +lat_2=50 +lon_0=9"],
)
def test_the_offset_of_a_header_is_part_of_the_frame(name: str) -> None:
    """A drive in degrees lies on the road."""
    pytest.importorskip("pyproj")
    x, y = project([49.3], [8.9], name)[0].tolist()
    found = opendrive(name, x - 490e3, y + 1e6, '<offset x="490000" y="-1e6" z="0" hdg="0"/>')
    if name.startswith("EPSG:32632"):
        assert found.projection == (
            "+proj=tmerc +lat_0=0 +lon_0=9 +k=0.9996 +datum=WGS84 +x_0=10000.0 +y_0=1000000.0"
        )
    start = project([49.3], [8.9], found.projection)[0]
    assert found.lanes["1:0:-1"].left.points[0] == pytest.approx(start, abs=1e-3)
    assert not found.skipped


@pytest.mark.parametrize(
    ("name", "offset"),
    [
        pytest.param("EPSG:2154", '<offset x="5"/>', id="code"),
        pytest.param("+proj=utm +zone=32", '<offset hdg="0.1"/>', id="turned"),
        pytest.param("+proj=utm +zone=32", '<offset x="far"/>', id="no-number"),
    ],
)
def test_an_offset_that_cannot_be_is_said(name: str, offset: str) -> None:
    """Degrees have no place on such a map."""
    found = opendrive(name, 0.0, 0.0, offset)
    assert "the offset is not applied" in found.skipped[0].why
    assert found.projection is None


@pytest.mark.parametrize("name", ["EPSG:3857", "EPSG:3035", "EPSG:25832", "EPSG:4326"])
def test_a_requested_frame_of_a_file_with_a_system(name: str) -> None:
    """Positions are projected to it from another system, metric or not."""
    text = geojson_text(name, on_ground(name, MUNICH))
    wanted = "+proj=utm +zone=33"
    found = read_points(io.BytesIO(text.encode()), "map.geojson", wanted)
    assert found.projection == wanted
    start = project([MUNICH[1]], [MUNICH[0]], wanted)[0]
    assert found.lanes["1"].centre.points[0] == pytest.approx(start, abs=1e-3)


@pytest.mark.parametrize(
    ("projection", "text"),
    [
        pytest.param("+proj=utm +zone=32", None, id="its-zone"),
        pytest.param("+proj=utm +zone=50", "not in the area of +proj=utm +zone=50", id="far-zone"),
        pytest.param("+proj=tmerc +lon_0=11 +lat_0=48 +k=1.5", "is 0.6666", id="scale"),
        pytest.param(local_cartesian(48.1, 11.6), None, id="tangent-plane"),
    ],
)
def test_the_scale_of_a_requested_frame_is_said(projection: str, text: str | None) -> None:
    """Also of Lanelet2, whose positions are in WGS84; a drive in degrees is in the same frame."""
    pytest.importorskip("pyproj")
    osm = Osm(origin=MUNICH[::-1])
    osm.strip(0.0, 300.0, y=(WIDTH / 2, -WIDTH / 2))
    crs84 = geojson_text("OGC:CRS84", on_ground("EPSG:4326", MUNICH))
    for found in (
        read_points(io.BytesIO(crs84.encode()), "map.geojson", projection),
        osm.map(projection),
    ):
        assert len(found.skipped) == (text is not None)
        assert text is None or text in found.skipped[0].why
        start = project([MUNICH[1]], [MUNICH[0]], found.projection)[0]
        lane = next(iter(found.lanes.values()))
        assert lane.centre.points[0] == pytest.approx(start, abs=1e-3, rel=1e-9)


def test_a_code_of_an_early_draft() -> None:
    sides = on_ground("EPSG:3857", MUNICH)
    found = geojson({"type": "EPSG", "properties": {"code": 3857}}, sides)
    assert found.lanes["1"].width == pytest.approx(WIDTH, abs=1e-4)


def test_codes_and_origins_of_utm() -> None:
    """Also of the south, where y begins 10 000 km below the equator."""
    south = utm_of("http://www.opengis.net/def/crs/EPSG/0/32701")
    assert south == "+proj=utm +zone=1 +south +datum=WGS84"
    assert [utm_of(name) for name in ("EPSG:32661", "EPSG:3", "EPSG:32600", "25832")] == [None] * 4
    moved = shifted("+proj=utm +zone=33 +south", 0, 5)
    assert moved == "+proj=tmerc +lat_0=0 +lon_0=15 +k=0.9996 +x_0=500000.0 +y_0=9999995.0"
    assert shifted("+proj=longlat", 1, 2) is None
