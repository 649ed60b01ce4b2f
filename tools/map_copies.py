"""A large map: copies of the town of the package beside each other."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from copy import deepcopy
from pathlib import Path

from maplines_can.maps import town_path

#: Attributes with the id of a road or of a junction.
_REFERENCES = ("elementId", "incomingRoad", "connectingRoad", "linkedRoad")
#: Distance of the copies [m]; the town is 4 km wide.
_SPACING = 5000.0


def copies_of_town(roads: int, path: Path) -> int:
    """Write an OpenDRIVE file of at least so many roads, and return how many they are."""
    root = ET.parse(town_path()).getroot()  # noqa: S314 - a file of the package
    whole = [child for child in root if child.tag not in {"road", "junction"}]
    count = copy = 0
    while count < roads:
        for element in root:
            if element.tag in {"road", "junction"}:
                whole.append(_moved(element, copy))
                count += element.tag == "road"
        copy += 1
    root[:] = whole
    ET.ElementTree(root).write(path, encoding="UTF-8", xml_declaration=True)
    return count


def _moved(original: ET.Element, copy: int) -> ET.Element:
    """Return a road or junction with the ids and the position of a copy of the town."""
    element = deepcopy(original)
    for one in element.iter():
        for name in _REFERENCES:
            if name in one.attrib:
                one.set(name, f"{copy}-{one.get(name)}")
        if one.tag == "geometry":
            one.set("x", repr(float(one.attrib["x"]) + copy * _SPACING))
    element.set("id", f"{copy}-{element.get('id')}")
    if element.get("junction", "-1") != "-1":
        element.set("junction", f"{copy}-{element.get('junction')}")
    return element
