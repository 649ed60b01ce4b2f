"""Loading of a map file of any format."""

from __future__ import annotations

import gzip
import io
import os
import re
import zlib
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from ...values.errors import MapFileError
from ...values.input_files import checked_path
from ..road_map import Map
from ..tour import town_path

#: Largest map file, after decompression [bytes].
MAX_BYTES = 1 << 30
#: Maps of this package, by name.
SHIPPED = {town_path().name: town_path()}
#: Bytes that show the format.
HEAD = 1 << 16

_GZIP_MAGIC = b"\x1f\x8b"
_ENCODINGS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"\xef\xbb\xbf": "utf-8-sig"}
#: Possessive, so that no file makes it search for long.
_ROOT = re.compile(
    r"(?>\s|<\?.*?\?>|<!--.*?-->|<!DOCTYPE[^>\[]*(?>\[.*?\]\s*)?>)*+<([^\s/>!?]+)", re.S
)


class Format(NamedTuple):
    """A format of map files.

    Args:
        name: for messages.
        module: of this package, with ``read(stream, name) -> Map``; loaded when it is used.
        root: tag of the root element, if the format is XML.
        suffixes: of file names, for formats that are not XML.
        is_projected: whether positions are in WGS84, and ``read`` takes a projection.
    """

    name: str
    module: str
    root: str = ""
    suffixes: tuple[str, ...] = ()
    is_projected: bool = False


FORMATS = (
    Format("OpenDRIVE", "opendrive", root="OpenDRIVE"),
    Format("Lanelet2", "osm", root="osm", is_projected=True),
    Format("CommonRoad", "commonroad", root="commonRoad"),
    Format("GeoJSON", "points", suffixes=(".geojson", ".json"), is_projected=True),
    Format("CSV", "points", suffixes=(".csv",)),
)


def load(path: str | os.PathLike[str], projection: str | None = None) -> Map:
    """Load a map file. Its root element or ending shows the format; gzip is read.

    Args:
        path: of a map in one of the formats ``FORMATS``, or the name of one of this package, see
            ``map_path``.
        projection: PROJ string of the frame for positions in WGS84, as ``maps.formats.projection``
            returns it. By default it is the UTM zone of a Lanelet2 map, or its ``local_x`` and
            ``local_y``, and a transverse Mercator projection around the middle of a GeoJSON map.

    Raises:
        ValueError: the projection is not one of ``maps.formats.projection``, or the positions of
            the format are in metres.
        FileNotFoundError: there is no such file.
        MapFileError: the file cannot be read, or contains nothing that can be used. What cannot be
            used of a map that can is listed in ``Map.skipped``.
    """
    path = map_path(checked_path(path, MapFileError))
    try:
        with path.open("rb") as file, _decompressed(file) as stream:
            bounded = _Bounded(stream, path.name)
            buffered = io.BufferedReader(bounded, HEAD)
            head = _head(buffered, path.name)
            form = _format(head, path)
            if projection is not None and not form.is_projected:
                raise ValueError(
                    f"{path.name} is {form.name}, whose positions are in metres; "
                    f"leave out the projection, got {projection[:80]!r}"
                )
            reader = import_module(f".{form.module}", __package__)
            options = {} if projection is None else {"projection": projection}
            road_map: Map = reader.read(buffered, path.name, **options)
    except FileNotFoundError:
        raise
    except OSError as error:
        why = error.strerror or str(error)
        raise MapFileError(f"{path.name} cannot be read: {why}") from None
    return road_map


def map_path(path: str | os.PathLike[str]) -> Path:
    """Return the path of a map; a name in ``SHIPPED`` is that map where there is no such file.

    >>> map_path("town.xodr") == town_path(), map_path("city.osm").name
    (True, 'city.osm')
    """
    path = Path(path)
    return SHIPPED.get(str(path), path) if not path.exists() else path


def _decompressed(file: BinaryIO) -> BinaryIO:
    is_gzip = file.read(2) == _GZIP_MAGIC
    file.seek(0)
    return gzip.GzipFile(fileobj=file) if is_gzip else file  # type: ignore[return-value]


class _Bounded(io.RawIOBase):
    """A stream that refuses to yield more than ``MAX_BYTES``."""

    def __init__(self, stream: BinaryIO, name: str) -> None:
        self._stream, self._name, self._count = stream, name, 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        data = self._stream.read(len(buffer))
        self._count += len(data)
        if self._count > MAX_BYTES:
            raise MapFileError(
                f"{self._name} has more than {MAX_BYTES >> 20} MB; divide the map into several"
            )
        buffer[: len(data)] = data
        return len(data)


def _head(stream: io.BufferedReader[Any], name: str) -> str:
    """Return the beginning of the file as text."""
    try:
        data = stream.peek(HEAD)
    except (EOFError, zlib.error) as error:
        raise MapFileError(f"{name} cannot be decompressed: {error}") from None
    encoding = next((e for mark, e in _ENCODINGS.items() if data.startswith(mark)), "utf-8")
    return data.decode(encoding, "replace")


def _format(head: str, path: Path) -> Format:
    """Return the format that the content shows, or else the suffix.

    Raises:
        MapFileError: neither does.
    """
    known = ", ".join(form.name for form in FORMATS)
    if not head.strip():
        raise MapFileError(f"{path.name} is empty; a map is one of: {known}")
    if root := _ROOT.match(head):
        tag = root[1].rpartition(":")[2]
        for form in FORMATS:
            if form.root == tag:
                return form
        raise MapFileError(
            f"{path.name} is XML with the root element <{tag[:40]}>; a map is one of: {known}"
        )
    suffixes = [suffix.lower() for suffix in path.suffixes]
    for form in FORMATS:
        if set(form.suffixes) & set(suffixes):
            return form
    raise MapFileError(f"{path.name} is of no known format; a map is one of: {known}")
