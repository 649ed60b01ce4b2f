"""The picture of a map: any map can be drawn."""

import sys
from pathlib import Path

import pytest
from support.lane_maps import crossing, lane, network

from maplines_can import Kind, Polyline
from maplines_can.maps import LaneType, Map
from maplines_can.pictures.map_picture import SURFACES, WINDOW, draw_map
from maplines_can.values.errors import MissingExtraError

LINE = Polyline([[5e5, 5e6], [5e5 + 900, 5e6 + 40]], Kind.BARRIER)


def far(length: float) -> Map:
    """Return a map of one straight lane."""
    return network(lane("a", (0.0, 0.0, 0.0), length))


@pytest.mark.parametrize(
    "road_map",
    [
        pytest.param(crossing(), id="crossing"),
        pytest.param(far(0.5), id="half-a-metre"),
        pytest.param(far(WINDOW * 40), id="with-detail"),
        pytest.param(Map({}, {}, polylines={"line": LINE}), id="no-lanes"),
    ],
)
def test_a_map_is_drawn(road_map: Map, tmp_path: Path) -> None:
    """Whatever its size, and with or without lanes."""
    path = tmp_path / "map.png"
    draw_map(road_map, path)

    assert path.read_bytes().startswith(b"\x89PNG")


def test_the_picture_names_what_it_contains(tmp_path: Path) -> None:
    """The legend has the surfaces and boundaries of the map, and only those."""
    path = tmp_path / "map.svg"
    draw_map(Map({}, {}, polylines={"line": LINE}), path)
    text = path.read_text()

    assert "<!-- barrier -->" in text
    assert "<!-- driving -->" not in text


def test_each_type_of_lane_has_one_surface() -> None:
    named = [kind for _, types in SURFACES.values() for kind in types]

    assert len(named) == len(set(named))
    assert set(LaneType) - set(named) <= {
        LaneType.OTHER, LaneType.RESTRICTED, LaneType.ROAD_WORKS,
    }  # fmt: skip


def test_without_matplotlib(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The error names the extra."""
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtraError, match="plot"):
        draw_map(crossing(), tmp_path / "map.png")


def test_each_part_of_a_line_is_drawn_as_its_kind(tmp_path: Path) -> None:
    path = tmp_path / "map.svg"
    line = Polyline(LINE.points, [(0.0, Kind.KERB), (100.0, Kind.BARRIER)])
    draw_map(Map({}, {}, polylines={"line": line}), path)
    text = path.read_text()
    assert "<!-- barrier -->" in text
    assert "<!-- kerb -->" in text
