"""The command ``maplines map``."""

from __future__ import annotations

import argparse
import json
import re
from collections import Counter
from typing import Any

import numpy as np

from ..maps import Map, Skipped, link_gaps, load, town_path
from ..maps.formats.load import SHIPPED
from ..maps.point_quality import EVERY, MAX_PLACES, PointQuality, point_quality
from ..values.arrays import count_text
from .command_line import add_command, add_json, number, option_group, progress_bar
from .file_arguments import add_force, check_new

__all__ = ["add_map"]

DESCRIPTION = """\
Print what is in a map: roads, lanes by type, extent, projection, and what is not used of the file
and why. Then how good the points of the lines are: how far they stand apart, how noisy they look,
and how certain a line would be for a car that knows its pose exactly. The map is OpenDRIVE,
Lanelet2, CommonRoad, GeoJSON or CSV, also compressed by gzip."""
#: What distinguishes reasons of the same kind: quoted text, and numbers with ids around them.
_VALUES = re.compile(r"'[^']*'|[-+]?\b[\d.:e+-]*\d\b")


def add_map(commands: Any) -> None:
    """Add the command ``map``."""
    parser = add_command(
        commands, "map", _map, DESCRIPTION, "maplines map town.xodr --plot town.png"
    )
    add = parser.add_argument
    add(
        "file",
        nargs="?",
        metavar="FILE",
        help=f"map; of this package there is {', '.join(SHIPPED)} (default)",
    )
    add(
        "--projection",
        metavar="PROJ",
        help="PROJ string of the frame for a map in WGS84, such as '+proj=utm +zone=32' "
        "(default: that of the file, or else one around the map)",
    )
    add(
        "--seed",
        type=number(int, 0, 2**32),
        default=0,
        help=f"seed of the {MAX_PLACES} places for the certainty of lines on a map with more than "
        f"{EVERY * MAX_PLACES / 1000:g} km of lanes (default: 0)",
    )
    output = option_group(parser, "output")
    output.add_argument(
        "--plot",
        metavar="FILE.png",
        help="draw the lanes, boundaries and driving directions; the suffix is the format "
        "(needs matplotlib)",
    )
    add_force(parser)
    add_json(parser)


def _map(arguments: argparse.Namespace) -> int:
    check_new(arguments, arguments.plot)
    road_map = load(arguments.file or town_path(), arguments.projection)
    summary = summary_of(road_map)
    with progress_bar(" places", leave=False) as progress:
        quality = point_quality(road_map, arguments.seed, progress)
    if arguments.plot:
        from ..pictures.map_picture import draw_map

        draw_map(road_map, arguments.plot)
    if arguments.json:
        print(json.dumps(summary | {"points": quality.as_dict(), "plot": arguments.plot}, indent=2))
    else:
        print("\n".join([*text_lines(summary), "", *quality_lines(quality)]))
        if arguments.plot:
            print(f"\n{arguments.plot}: the picture")
    return 0


def summary_of(road_map: Map) -> dict[str, Any]:
    """Return what is in a map, for JSON."""
    lanes = list(road_map.lanes.values())
    lines = [line for lane in lanes for line in (lane.left, lane.right)]
    lines += road_map.polylines.values()
    points = np.concatenate([line.points for line in lines])
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    drivable = [lane for lane in lanes if lane.type.is_drivable]
    every = [(*(v for _, v in lane.speed_limits), lane.speed_limit) for lane in drivable]
    limits = [limit for own in every for limit in own if limit is not None]
    types = Counter(lane.type for lane in lanes)
    return {
        "name": road_map.name,
        "roads": {"count": len(road_map.roads), "km": _km(road_map.roads.values())},
        "junctions": len({lane.junction for lane in lanes} - {None}),
        "lanes": {
            kind.value: {"count": n, "km": _km(lane for lane in lanes if lane.type is kind)}
            for kind, n in types.most_common()
        },
        "drivable": {
            "count": len(drivable),
            "km": _km(drivable),
            "without_successor": sum(not lane.successors for lane in drivable),
        },
        "polylines": len(road_map.polylines),
        "extent": {"x": [low[0], high[0]], "y": [low[1], high[1]]},
        "projection": road_map.projection,
        "traffic": "left-hand" if road_map.left_hand_traffic else "right-hand",
        "speed_limits_kmh": [round(3.6 * v, 3) for v in (min(limits), max(limits))]
        if limits
        else None,
        "skipped": _grouped(road_map.skipped),
        "link_gaps": _grouped(link_gaps(road_map.lanes)),
    }


def _km(parts: Any) -> float:
    """Return the length of lanes or roads [km]."""
    return round(sum(part.length for part in parts) / 1000, 3)


def _grouped(skipped: Any) -> list[dict[str, Any]]:
    """Return the reasons with their numbers and their first examples, most frequent first.

    >>> _grouped([Skipped("line 1", "it ends at 5 m"), Skipped("line 2", "it ends at 7.5 m")])
    [{'count': 2, 'why': 'it ends at 5 m', 'where': 'line 1'}]
    """
    first: dict[str, Skipped] = {}
    counts: Counter[str] = Counter()
    for one in skipped:
        kind = _VALUES.sub("#", one.why)
        first.setdefault(kind, one)
        counts[kind] += 1
    return [
        {"count": n, "why": first[kind].why, "where": first[kind].where}
        for kind, n in counts.most_common()
    ]


def text_lines(summary: dict[str, Any]) -> list[str]:
    """Return the summary as lines of text."""
    (x0, x1), (y0, y1) = summary["extent"]["x"], summary["extent"]["y"]
    size = f"{(x1 - x0) / 1000:.2f} x {(y1 - y0) / 1000:.2f} km"
    roads, drivable, limits = (summary[key] for key in ("roads", "drivable", "speed_limits_kmh"))
    rows = [
        ("roads", f"{roads['count']}, {roads['km']:.2f} km"),
        ("junctions", f"{summary['junctions']}"),
        ("extent", f"x {x0:.1f} to {x1:.1f} m, y {y0:.1f} to {y1:.1f} m ({size})"),
        ("projection", " ".join((summary["projection"] or "none").split())),
        ("traffic", summary["traffic"]),
        ("speed limits", f"{limits[0]:.0f} to {limits[1]:.0f} km/h" if limits else "none"),
        (
            "drivable",
            f"{count_text(drivable['count'], 'lane')}, {drivable['km']:.2f} km; "
            f"without a successor: {drivable['without_successor']}",
        ),
    ]
    if summary["polylines"]:
        rows.append(("other lines", f"{summary['polylines']}"))
    lines = [summary["name"], *(f"  {name:<14}{value}" for name, value in rows)]
    if summary["lanes"]:
        lines += ["", f"  {'type of lane':<18}{'lanes':>7}{'km':>10}"]
    for kind, lanes in summary["lanes"].items():
        lines.append(f"  {kind:<18}{lanes['count']:>7}{lanes['km']:>10.2f}")
    for key, title in (("skipped", "not used, or assumed"), ("link_gaps", "links with gaps")):
        count = sum(group["count"] for group in summary[key])
        lines += ["", f"  {title}: {count or 'none'}"]
        for group in summary[key]:
            lines.append(f"  {group['count']:>6} x {group['why']}\n{'':>11}first: {group['where']}")
    return lines


def quality_lines(quality: PointQuality) -> list[str]:
    """Return what the points of a map tell as lines of text."""
    low, median, high = (_length(value) for value in quality.spacing)
    rows = [
        f"  points of the lines: {quality.points}",
        f"    one every {median}; {low} to {high} over 90 % of the length",
    ]
    if quality.noise is None:
        rows.append("    noise: not known, as no line has five points")
    else:
        low, median, high = (_length(value) for value in quality.noise)
        rows.append(f"    noise as they show it: {median}; {low} to {high} over 90 % of the length")
    if not quality.places:
        return rows
    rows += [
        "",
        f"  lines for a car that knows its pose exactly, at {quality.places} places on the lanes",
        f"    given: {quality.lines}"
        + ("" if quality.reach is None else f", {quality.reach:.0f} m ahead (median)"),
    ]
    rows += [f"    left out: {n}, {why}" for why, n in quality.left_out.items()]
    rows += ["", f"    {'ahead':<8}{'lines':>7}{'sigma: median':>16}{'95 % are within':>18}"]
    for at in quality.sigmas:
        cells = ["-" if value is None else _length(value) for value in (at.median, at.high)]
        rows.append(f"    {at.x:>3} m   {at.lines:>7}{cells[0]:>16}{cells[1]:>18}")
    return rows


def _length(metres: float) -> str:
    """Return a length in a unit that suits it.

    >>> _length(0.0004), _length(0.0312), _length(1.21), _length(140)
    ('0.4 mm', '3.1 cm', '1.2 m', '140 m')
    """
    for unit, factor, most in (("mm", 1e3, 0.00995), ("cm", 1e2, 0.995)):
        if metres < most:
            return f"{metres * factor:.2g} {unit}" if metres * factor >= 0.1 else f"< 0.1 {unit}"
    return f"{metres:.2g} m" if metres < 99.5 else f"{metres:.0f} m"
