"""Small OpenDRIVE files for tests."""

import io
from collections.abc import Iterable

from maplines_can.maps import Map, Skipped
from maplines_can.maps.formats.opendrive import read
from maplines_can.maps.formats.opendrive.boundaries import Boundaries
from maplines_can.maps.formats.opendrive.road import RoadRecord, read_road
from maplines_can.maps.formats.xml_tree import Document

#: The usual cross-section: one driving lane in each direction.
TWO_LANES = {1: "driving", -1: "driving"}


def geometry(
    shape: str = "<line/>",
    *,
    s: float = 0.0,
    x: float = 0.0,
    y: float = 0.0,
    heading: float = 0.0,
    length: float = 100.0,
) -> str:
    """Return a ``<geometry>`` with the element of its shape."""
    attributes = f'x="{x:.17g}" y="{y:.17g}" hdg="{heading:.17g}" length="{length:.17g}"'
    return f'<geometry s="{s:.17g}" {attributes}>{shape}</geometry>'


def cubic(
    tag: str, a: float, b: float = 0.0, c: float = 0.0, d: float = 0.0, **start: float
) -> str:
    """Return an element with the coefficients of a cubic, and its ``s`` or ``sOffset``."""
    starts = " ".join(f'{name}="{value!r}"' for name, value in start.items())
    return f'<{tag} {starts} a="{a!r}" b="{b!r}" c="{c!r}" d="{d!r}"/>'


WIDTH = cubic("width", 3.5, sOffset=0.0)


def lane(
    lane_id: int,
    content: str = WIDTH,
    kind: str = "driving",
    *,
    successor: int | None = None,
    predecessor: int | None = None,
    attributes: str = "",
) -> str:
    """Return a ``<lane>``."""
    link = "".join(
        f'<{tag} id="{other}"/>'
        for tag, other in (("predecessor", predecessor), ("successor", successor))
        if other is not None
    )
    return f'<lane id="{lane_id}" type="{kind}" {attributes}><link>{link}</link>{content}</lane>'


def section(*lanes: str, s: float = 0.0, centre: str = "", attributes: str = "") -> str:
    """Return a ``<laneSection>``; the side of a lane follows from the sign of its id."""
    left = "".join(text for text in lanes if 'id="-' not in text.split(">")[0])
    right = "".join(text for text in lanes if 'id="-' in text.split(">")[0])
    return (
        f'<laneSection s="{s!r}" {attributes}><left>{left}</left>'
        f'<center><lane id="0" type="none">{centre}</lane></center>'
        f"<right>{right}</right></laneSection>"
    )


def road(
    *sections: str,
    road_id: str = "1",
    plan: str = geometry(),
    length: float = 100.0,
    link: str = "",
    offsets: str = "",
    lateral: str = "",
    attributes: str = "",
    before: str = "",
) -> str:
    """Return a ``<road>``."""
    lanes = "".join(sections) or section(*(lane(i, kind=k) for i, k in TWO_LANES.items()))
    junction = "" if "junction=" in attributes else 'junction="-1"'
    return (
        f'<road name="Main Street" id="{road_id}" length="{length!r}" {junction} {attributes}>\n'
        f"<link>{link}</link>{before}\n<planView>{plan}</planView>\n"
        f"<lateralProfile>{lateral}</lateralProfile>\n<lanes>{offsets}{lanes}</lanes>\n</road>\n"
    )


def linked(tag: str, road_id: str, contact: str = "start", kind: str = "road") -> str:
    """Return the link of a road to another one, or to a junction."""
    point = f'contactPoint="{contact}"' if contact else ""
    return f'<{tag} elementType="{kind}" elementId="{road_id}" {point}/>'


def document(*elements: str, header: str = "") -> str:
    """Return the whole file."""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<OpenDRIVE>\n'
        f'<header revMajor="1" revMinor="7">{header}</header>\n{"".join(elements)}</OpenDRIVE>\n'
    )


def read_map(*elements: str, header: str = "") -> Map:
    """Return the map of a file with these elements."""
    return read(io.BytesIO(document(*elements, header=header).encode()), "map.xodr")


def record(text: str) -> RoadRecord:
    """Return the road of a ``<road>``, of which everything is used."""
    elements = Document(io.BytesIO(document(text).encode()), "map.xodr").elements()
    skipped: list[Skipped] = []
    (found,) = (read_road(element, skipped) for element in elements if element.tag == "road")
    assert not skipped
    return found


def boundaries(text: str, index: int = 0) -> Boundaries:
    """Return the boundaries of a lane section of a ``<road>``."""
    return Boundaries(record(text), index)


def reasons(road_map: Map) -> list[str]:
    """Return why what is skipped in a map is."""
    return [skipped.why for skipped in road_map.skipped]


def ids(lanes: Iterable[str]) -> str:
    """Return ids of lanes in one string, sorted."""
    return " ".join(sorted(lanes))
