"""Table of codes on random scenes, with their bits over the joint rate-distortion limit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ..text_table import aligned
from .carriers import AT_SCENE_BITS, WITH_POSE, evaluations
from .source import RESOLUTION, information, joint_limit, random_scene

Row = dict[str, Any]

#: The limit holds at high rates only: at this many bits for each parameter and more.
MIN_RATE = 1.0
#: Quantities of the ego lane.
LANE = ("width", "centre")


def chunk(lines: int, index: int, n: int, codes: Sequence[str], seed: int) -> dict[str, Any]:
    """Return the figures of some random scenes, as JSON values.

    Args:
        lines: in each scene.
        index: of the chunk.
        n: number of scenes.
        codes: names of ``CODES``; those of ``carriers`` are added.
        seed: of the study.
    """
    rng = np.random.default_rng([seed, lines, index])
    drawn = [random_scene(lines, rng) for _ in range(n)]
    scenes = [one.scene for one in drawn]
    return {
        "information": [information(one, RESOLUTION).tolist() for one in drawn],
        "codes": {
            code: list(evaluations(code, scenes)) for code in (*codes, AT_SCENE_BITS, *WITH_POSE)
        },
    }


def rows(lines: int, chunks: Iterable[Mapping[str, Any]]) -> Iterator[Row]:
    """Yield a row for each code, from all chunks of scenes with a number of lines."""
    informations: list[Any] = []
    of_codes: dict[str, list[Row]] = {}
    for result in chunks:
        informations += result["information"]
        for code, scenes in result["codes"].items():
            of_codes.setdefault(code, []).extend(scenes)
    for code, scenes in of_codes.items():
        yield {"lines": lines, "code": code} | figures(code, lines, scenes, np.array(informations))


def figures(code: str, lines: int, scenes: Sequence[Row], informations: np.ndarray) -> Row:
    """Return the columns of a code, from its figures of each scene.

    The divergence at which the limit is taken is that of the joint covariance. For records of
    single lines, it is the sum of those of the lines, as if the receiver knew the rest.
    """
    has_joint = code in WITH_POSE
    row: Row = {"scenes": len(scenes), "has_joint": has_joint}
    for name in ("frames", "mean_bits", "joint_bits"):
        row[name] = float(np.mean([scene[name] for scene in scenes]))
    for name in ("left_out", "all_entries"):
        row[name] = float(np.mean([scene[name] for scene in scenes])) / lines
    decoded = [scene for scene in scenes if "kl_joint" in scene]
    for name in ("not_positive_definite", "overconfident"):
        row[name] = float(np.mean([scene[name] for scene in decoded])) if decoded else None
    definite = [scene for scene in decoded if not scene["not_positive_definite"]]
    kl_lines = [kl for scene in definite for kl in scene["kl_lines"]]
    row["kl_line_mean"] = float(np.mean(kl_lines)) if definite else None
    row["kl_line_p99"] = float(np.quantile(kl_lines, 0.99)) if definite else None
    joint = [scene["kl_joint"] for scene in definite]
    row["kl_joint_mean"] = float(np.mean(joint)) if definite else None
    by_name = {name: [scene[name] for scene in definite if name in scene] for name in LANE}
    by_name["far"] = [ratio for scene in definite for ratio in scene["far"]]
    for name, ratios in by_name.items():
        for percent in (50, 99):
            value = float(np.quantile(ratios, percent / 100)) if ratios else None
            row[f"{name}_p{percent}"] = value
    if len(definite) < len(scenes):
        return row
    kl = float(np.mean(joint)) if has_joint else lines * float(np.mean(kl_lines))
    if kl > 0:
        limit = joint_limit(informations, kl)
        bits = float(limit.bits(kl))
        if bits >= MIN_RATE * limit.dimension:
            row |= {"limit_kl": kl, "limit_bits": bits, "limit_se_bits": limit.entropy_se_bits}
            row |= {"limit_dimension": limit.dimension, "over_bits": row["joint_bits"] - bits}
    return row


#: Heads of the columns of ``cells_of``.
HEAD = (
    *("code", "frames", "mean", "cov", "limit", "over", "indefinite", "overconfident"),
    *("KL line", "99 %", "KL joint", "y 50 %", "99 %", "width 50 %", "99 %", "centre 50 %", "99 %"),
    *("left out", "all entries"),
)


def text(table: Sequence[Row]) -> str:
    """Format the table ``scenes`` as plain text."""
    parts = []
    for lines in dict.fromkeys(row["lines"] for row in table):
        of_lines = [row for row in table if row["lines"] == lines]
        cells = [cells_of(row) for row in of_lines]
        parts.append(f"{of_lines[0]['scenes']} scenes of {lines} lines, bits of a scene")
        parts += ["  " + line for line in aligned([HEAD, *cells], left=1).splitlines()]
        parts.append("")
    parts += [
        "limit: the fewest bits that can send the joint covariance with this KL; over: bits of the",
        "covariances above it. Without the pose error, the limit is for the sum of the KL of",
        "the lines. y, width, centre: sigma of a line at 80 m or its end, of the ego lane at 20 m,",
        "over that of the covered target. all entries: share of lines whose record has a whole",
        "covariance. Frames are classic ones, or with FD those of CAN FD.",
    ]
    return "\n".join(parts)


def cells_of(row: Row) -> list[str]:
    """Return the cells of a row of the table ``scenes``, for ``HEAD``."""

    def number(name: str, digits: int) -> str:
        value = row.get(name)
        return "-" if value is None or value != value else f"{value:.{digits}g}"

    def whole(name: str) -> str:
        value = row.get(name)
        return "-" if value is None or value != value else f"{value:.0f}"

    return [
        row["code"],
        f"{row['frames']:.1f}",
        *(whole(name) for name in ("mean_bits", "joint_bits", "limit_bits", "over_bits")),
        *(_share(row[name]) for name in ("not_positive_definite", "overconfident")),
        *(number(name, 3) for name in ("kl_line_mean", "kl_line_p99", "kl_joint_mean")),
        *(number(f"{name}_p{p}", 4) for name in ("far", *LANE) for p in (50, 99)),
        _share(row["left_out"]),
        _share(row["all_entries"]) if row["has_joint"] else "-",
    ]


def _share(value: float | None) -> str:
    return "-" if value is None or value != value else f"{100 * value:.3g} %" if value else "0"
