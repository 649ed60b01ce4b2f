"""Small OSM files with lanelets for tests."""

import io
from collections.abc import Mapping, Sequence

from maplines_can.maps import Map
from maplines_can.maps.formats.osm import read

#: Latitude and longitude of the origin of ``Osm`` [deg], and of one metre.
ORIGIN = (49.0, 8.4)
METRE = (1 / 111_210.0, 1 / 73_170.0)
ROAD = {"type": "lanelet", "subtype": "road", "location": "urban"}


class Osm:
    """An OSM file in the making; positions are metres from its origin, to 1 %.

    Args:
        frame: whether nodes get "globe" (latitude and longitude), "local" (``local_x`` and
            ``local_y``), or "both".
        origin: latitude and longitude [deg].
    """

    def __init__(self, frame: str = "globe", origin: tuple[float, float] = ORIGIN) -> None:
        self.frame, self._origin = frame, origin
        self._nodes: dict[tuple[float, float], str] = {}
        self.elements: list[str] = []
        self._count = 0

    def node(self, x: float, y: float) -> str:
        """Return the id of the node at a position; the same one for the same position."""
        if (x, y) not in self._nodes:
            self._nodes[x, y] = key = self._next()
            at, tags = "", {}
            if self.frame != "local":
                lat, lon = (self._origin[0] + y * METRE[0], self._origin[1] + x * METRE[1])
                at = f'lat="{lat!r}" lon="{lon!r}"'
            if self.frame != "globe":
                tags = {"local_x": repr(x), "local_y": repr(y)}
            self.elements.append(f'<node id="{key}" {at}>{_tags(tags)}</node>')
        return self._nodes[x, y]

    def way(self, *points: tuple[float, float], **tags: str) -> str:
        """Add a way, and return its id."""
        key = self._next()
        refs = "".join(f'<nd ref="{self.node(*point)}"/>' for point in points)
        self.elements.append(f'<way id="{key}">{refs}{_tags(tags)}</way>')
        return key

    def lanelet(self, left: str, right: str, tags: Mapping[str, str] | None = None) -> str:
        """Add a lanelet between two ways, and return its id."""
        key = self._next()
        members = "".join(
            f'<member type="way" ref="{way}" role="{role}"/>'
            for way, role in ((left, "left"), (right, "right"))
        )
        self.elements.append(f'<relation id="{key}">{members}{_tags(tags or ROAD)}</relation>')
        return key

    def strip(self, *x: float, y: Sequence[float] = (3.5, 0.0)) -> str:
        """Add a straight lanelet with new ways, and return its id."""
        left, right = (self.way(*((one, side) for one in x)) for side in y)
        return self.lanelet(left, right)

    def text(self) -> str:
        """Return the file."""
        body = "\n".join(self.elements)
        return f'<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6">\n{body}\n</osm>\n'

    def map(self, projection: str | None = None) -> Map:
        """Return the map of the file."""
        return read(io.BytesIO(self.text().encode()), "map.osm", projection)

    def _next(self) -> str:
        self._count += 1
        return str(self._count)


def _tags(tags: Mapping[str, str]) -> str:
    return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
