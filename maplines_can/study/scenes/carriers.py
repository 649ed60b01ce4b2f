"""What codes make of scenes: records of single lines, and records with the pose error.

A record of a single line says nothing of the others, so its receiver takes lines as independent.
With the pose error, a receiver has the joint covariance: from complete records with levels in the
Pose message, from records that are conditional on the pose error, or from a whole scene in a frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...generation.dbc.dbc_writer import DbcWriter
from ...generation.dbc.record_spec import CONDITIONAL, DEFAULT, WHOLE_SCENES
from ...values.linalg import block_diagonal
from ...values.line import Status, lateral_jacobian
from ...values.scene import Scene
from ...values.text_table import aligned
from ...wire.layout.cholesky import CholeskyCode
from ...wire.layout.record_signals import (
    FINE_SIGNALS,
    OWN_SIGNALS,
    PARAMETER_SIGNALS,
    POSE_ROWS,
    TILT,
)
from ..code_dbcs import dbc_writer_for
from ..comparison import AnyCodec, codec_for, sent_scene, transmit
from .random_scenes import RESOLUTION, information, joint_limit, noise_floor, random_scene

Array = NDArray[np.float64]
Row = dict[str, Any]


class Carrier(NamedTuple):
    """Records with the pose error, and the frames that they are sent in."""

    writer: DbcWriter
    fd: bool = False


#: Records with the pose error, by the name of the code. In CAN FD, conditional records always have
#: all entries of their covariance.
WITH_POSE = {
    "Cholesky and Pose": Carrier(DEFAULT),
    CONDITIONAL.covariance_code: Carrier(CONDITIONAL),
    f"{CONDITIONAL.covariance_code}, FD": Carrier(CONDITIONAL, fd=True),
    f"{WHOLE_SCENES.covariance_code}, FD": Carrier(WHOLE_SCENES, fd=True),
}
#: Records of single lines in about as many bits as lines of a whole scene take, with its share of
#: the pose error: means of 60 bits and covariances of 45.
AT_SCENE_BITS = "Cholesky, few bits"
_FEWER_OF_MEAN = {"YOff": -4, "Beta": -4, "C0": -4, "C1": -5}
_FEWER_OF_COVARIANCE = -6
#: Where width and centre of the ego lane are compared [m].
X = 20.0
#: Where single lines are, or at their ends [m].
FAR = 80.0


@lru_cache
def codec_of(code: str) -> AnyCodec:
    """Return the codec of a code, a name of ``codes.CODES`` or of those above."""
    if code in WITH_POSE:
        writer = WITH_POSE[code].writer
    elif code == AT_SCENE_BITS:
        writer = dbc_writer_for("Cholesky", _FEWER_OF_COVARIANCE, _FEWER_OF_MEAN)
    else:
        writer = dbc_writer_for(code)
    return codec_for(writer.layout())


def evaluations(code: str, scenes: Sequence[Scene]) -> Iterator[dict[str, Any]]:
    """Yield the figures of each scene as sent by a code.

    Args:
        code: as of ``codec_of``.
        scenes: the scenes, with at least the lines of the ego lane as the first two.
    """
    codec = codec_of(code)
    if code in WITH_POSE:
        fd = WITH_POSE[code].fd
        yield from (with_pose(codec, scene, fd=fd) for scene in scenes)
    else:
        yield from _independent(codec, scenes)


def with_pose(codec: AnyCodec, scene: Scene, *, fd: bool = False) -> dict[str, Any]:
    """Return the figures of a scene as sent by a codec with a message of the pose error."""
    prepared, frames, decoded = sent_scene(codec, scene, fd=fd)
    lines, members = len(prepared.sent_slots), len(prepared.members)
    full = lines
    if codec.layout.scene is not None:
        full = 0
    elif codec.layout.is_conditional and not fd:
        full = sum(len(frames[slot]) == codec.layout.pages for slot in prepared.sent_slots)
    row = {
        "frames": sum(map(len, frames.values())),
        "mean_bits": lines * _bits(codec, PARAMETER_SIGNALS),
        "joint_bits": joint_bits(codec, lines, members, full),
        "left_out": len(scene.lines) - members,
        "all_entries": full,
    }
    if codec.layout.is_conditional and full:
        row["mean_bits"] += full * _bits(codec, FINE_SIGNALS)
    if decoded is None or not members:
        return row
    places = np.array([scene.index[line.slot] for line in decoded.lines])
    floor = noise_floor(decoded.means, decoded.fit_ranges, RESOLUTION)
    return row | compare(scene, places, decoded.means, decoded.cov, floor)


def joint_bits(codec: AnyCodec, lines: int, members: int, full: int) -> int:
    """Return the bits of a scene's joint covariance: of the pose error, and of each line.

    Args:
        codec: of a DBC with a message of the pose error.
        lines: that are sent.
        members: of these that belong to the pose error.
        full: of these that are sent with all entries of their covariance.
    """
    layout, pose = codec.layout, codec.layout.pose
    if pose is None:
        raise ValueError("the DBC has no message of the pose error")
    of_pose = (*CholeskyCode(pose, POSE_ROWS).signals, pose["MapOffset"], pose["MapHeading"])
    bits = sum(signal.length for signal in of_pose)
    own = (*OWN_SIGNALS, TILT, "Quartic", "HasCovariance")
    if layout.scene is not None:
        return bits + members * _bits(codec, [name for name in own if name in layout.signals])
    single = sum(signal.length for signal in CholeskyCode(layout).signals)
    if layout.is_conditional:
        levels = _bits(codec, [name for name in own if name in layout.signals])
        return bits + members * levels + full * single
    of_slot = sum(pose[f"EgoLeft{name}"].length for name in (*OWN_SIGNALS, "Quartic"))
    return bits + members * of_slot + lines * single


def _bits(codec: AnyCodec, names: Sequence[str]) -> int:
    return sum(codec.layout[name].length for name in names)


def _independent(codec: AnyCodec, scenes: Sequence[Scene]) -> Iterator[dict[str, Any]]:
    means = np.concatenate([scene.means for scene in scenes])
    covs = np.array([line.gaussian.cov for scene in scenes for line in scene.lines])
    batch = transmit(codec, means, covs)
    good = batch.accepted & (batch.status != Status.OUT_OF_RANGE)
    bits = sum(signal.length for signal in codec.covariance.signals)
    start = 0
    for scene in scenes:
        lines = len(scene.lines)
        here = start + np.flatnonzero(good[start : start + lines])
        row = {
            "frames": lines * codec.layout.pages,
            "mean_bits": lines * _bits(codec, PARAMETER_SIGNALS),
            "joint_bits": lines * bits,
            "left_out": lines - len(here),
            "all_entries": lines,
        }
        if len(here):
            cov = block_diagonal(batch.cov[here])
            floor = np.diag(np.tile(codec.resolution, len(here)))
            row |= compare(scene, here - start, batch.mean[here], cov, floor)
        start += lines
        yield row


def compare(
    scene: Scene,
    places: NDArray[np.intp],
    means: Array,
    cov: Array,
    floor: Array,
) -> dict[str, Any]:
    """Return the figures of a decoded scene against the covered target.

    The covered target is the true joint covariance, plus the square of the errors of the means and
    the resolution of the means.

    Args:
        scene: the scene as sent.
        places: (L,) places of the decoded lines in it.
        means: (L, 4) decoded means.
        cov: (4 L, 4 L) decoded joint covariance.
        floor: (4 L, 4 L) covariance of the resolution of the means.
    """
    keep = (4 * places[:, None] + np.arange(4)).ravel()
    d = (means - scene.means[places]).ravel()
    error = scene.cov[np.ix_(keep, keep)] + np.outer(d, d)
    target = error + floor
    blocks = [np.s_[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] for i in range(len(places))]
    definite, kl = _divergence(target, cov)
    row = {
        "not_positive_definite": not definite,
        "overconfident": not definite or _largest_ratio(error, cov) > 1,
        "kl_joint": kl,
        "kl_lines": [_divergence(target[block], cov[block])[1] for block in blocks],
        "far": [
            sigma_ratio(lateral_jacobian(mean, min(FAR, line.x_max)), cov[block], target[block])
            for mean, line, block in zip(
                means, (scene.lines[k] for k in places), blocks, strict=True
            )
        ],
    }
    if [*places[:2]] == [0, 1] and all(line.x_min <= X <= line.x_max for line in scene.lines[:2]):
        left, right = lateral_jacobian(means[:2], X)
        for name, J in (("width", [*left, *-right]), ("centre", [*left / 2, *right / 2])):
            row[name] = sigma_ratio(np.array(J), cov[:8, :8], target[:8, :8])
    return row


def sigma_ratio(J: Array, decoded: Array, target: Array) -> float:
    """Return the ratio of the standard deviations of a quantity with the derivatives J."""
    variances = [float(J @ S @ J) for S in (decoded, target)]
    return math.sqrt(max(0.0, variances[0] / variances[1]))


def _divergence(true: Array, decoded: Array) -> tuple[bool, float]:
    """Return whether a decoded covariance is definite, and the KL; infinite if it is not."""
    scale = np.sqrt(true.diagonal())
    A, B = (S / scale / scale[:, None] for S in (true, decoded))
    try:
        L = np.linalg.cholesky(B)
    except np.linalg.LinAlgError:
        return False, math.inf
    half = np.linalg.solve(L, np.linalg.cholesky(A))
    log_det = 2 * np.linalg.slogdet(half)[1]
    return True, float(((half**2).sum() - len(true) - log_det) / 2)


def _largest_ratio(error: Array, decoded: Array) -> float:
    """Return the largest eigenvalue of an error in the metric of a decoded covariance."""
    scale = np.sqrt(decoded.diagonal())
    L = np.linalg.cholesky(decoded / scale / scale[:, None])
    half = np.linalg.solve(L, error / scale / scale[:, None])
    W = np.linalg.solve(L, half.T)
    return float(np.linalg.eigvalsh((W + W.T) / 2)[-1])


# ---- the table of random scenes -----------------------------------------------------------------

#: The limit holds at high rates only: at this many bits for each parameter and more.
MIN_RATE = 1.0
#: Quantities of the ego lane.
LANE = ("width", "centre")


def scenes_chunk(lines: int, index: int, n: int, codes: Sequence[str], seed: int) -> dict[str, Any]:
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


def scenes_rows(lines: int, chunks: Iterable[Mapping[str, Any]]) -> Iterator[Row]:
    """Yield a row for each code, from all chunks of scenes with a number of lines."""
    informations: list[Any] = []
    of_codes: dict[str, list[Row]] = {}
    for result in chunks:
        informations += result["information"]
        for code, scenes in result["codes"].items():
            of_codes.setdefault(code, []).extend(scenes)
    for code, scenes in of_codes.items():
        yield {"lines": lines, "code": code} | scene_figures(
            code, lines, scenes, np.array(informations)
        )


def scene_figures(code: str, lines: int, scenes: Sequence[Row], informations: np.ndarray) -> Row:
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


#: Heads of the columns of ``scene_cells``.
SCENE_HEAD = (
    *("code", "frames", "mean", "cov", "limit", "over", "indefinite", "overconfident"),
    *("KL line", "99 %", "KL joint", "y 50 %", "99 %", "width 50 %", "99 %", "centre 50 %", "99 %"),
    *("left out", "all entries"),
)


def scenes_text(table: Sequence[Row]) -> str:
    """Format the table ``scenes`` as plain text."""
    parts = []
    for lines in dict.fromkeys(row["lines"] for row in table):
        of_lines = [row for row in table if row["lines"] == lines]
        cells = [scene_cells(row) for row in of_lines]
        parts.append(f"{of_lines[0]['scenes']} scenes of {lines} lines, bits of a scene")
        parts += ["  " + line for line in aligned([SCENE_HEAD, *cells], left=1).splitlines()]
        parts.append("")
    parts += [
        "limit: the fewest bits that can send the joint covariance with this KL; over: bits of the",
        "covariances above it. Without the pose error, the limit is for the sum of the KL of",
        "the lines. y, width, centre: sigma of a line at 80 m or its end, of the ego lane at 20 m,",
        "over that of the covered target. all entries: share of lines whose record has a whole",
        "covariance. Frames are classic ones, or with FD those of CAN FD.",
    ]
    return "\n".join(parts)


def scene_cells(row: Row) -> list[str]:
    """Return the cells of a row of the table ``scenes``, for ``SCENE_HEAD``."""

    def known(name: str) -> float | None:
        value = row.get(name)
        return None if value is None or value != value else value

    def cell(name: str, form: str) -> str:
        return "-" if (value := known(name)) is None else f"{value:{form}}"

    def share(name: str) -> str:
        return f"{100 * value:.3g} %" if (value := known(name)) else "-" if value is None else "0"

    return [
        row["code"],
        f"{row['frames']:.1f}",
        *(cell(name, ".0f") for name in ("mean_bits", "joint_bits", "limit_bits", "over_bits")),
        *(share(name) for name in ("not_positive_definite", "overconfident")),
        *(cell(name, ".3g") for name in ("kl_line_mean", "kl_line_p99", "kl_joint_mean")),
        *(cell(f"{name}_p{p}", ".4g") for name in ("far", *LANE) for p in (50, 99)),
        share("left_out"),
        share("all_entries") if row["has_joint"] else "-",
    ]
