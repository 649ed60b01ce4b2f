"""Received lines, slots and counters as text, JSON and CSV."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TextIO

import numpy as np

from ..values.arrays import count_text
from ..values.line import PARAMETERS, Estimate, LeftOut, MapLine, Slot, Status
from ..values.scene import Scene
from ..wire import POSE, E2EState, Owner, ProfileStatus, SceneView, SlotStats, SlotView

#: Distances at which the ego lane is printed [m], and its lines.
LANE_X = (0.0, 20.0, 40.0)
LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
UPPER_TRIANGLE = [(i, j) for i in range(4) for j in range(i, 4)]


def slot_text(slot: str) -> str:
    """Return the name of a slot for a reader.

    >>> slot_text("EGO_LEFT")
    'ego left'
    """
    return slot.replace("_", " ").lower()


def owner_text(owner: Owner) -> str:
    """Return the name of the owner of a record for a reader.

    >>> owner_text(Slot.EGO_LEFT), owner_text("pose"), owner_text("scene2")
    ('ego left', 'pose error', 'scene2')
    """
    if isinstance(owner, Slot):
        return slot_text(owner.name)
    return "pose error" if owner == POSE else owner


def lost_text(records: int, *, scenes: bool) -> str:
    """Return how many records are lost, as text.

    >>> lost_text(1, scenes=False), lost_text(2, scenes=True)
    ('1 line lost by its counter', '2 scene messages lost by their counters')
    """
    by = "its counter" if records == 1 else "their counters"
    return f"{count_text(records, 'scene message' if scenes else 'line')} lost by {by}"


def left_out_text(left_out: Mapping[Slot, LeftOut]) -> str:
    """Return the lines that are left out, with their reasons, as text.

    >>> left_out_text({Slot.EGO_LEFT: LeftOut.ACROSS})
    "left out: ego left (the line is across the car's x axis)"
    """
    each = [f"{slot_text(slot.name)} ({reason})" for slot, reason in left_out.items()]
    return f"left out: {', '.join(each)}"


def line_text(line: MapLine) -> str:
    """Return a line as one row of text; if it is not usable, the reason instead of its values."""
    status = line.status.name.replace("_", " ").lower()
    head = f"{(line.t_ns or 0) / 1e9:.3f}  {slot_text(line.slot.name):<10}  {status:<9}  "
    if line.status is Status.OUT_OF_RANGE:
        return f"{head}not usable: the line does not fit the message"
    if not line.is_usable:
        return f"{head}not usable: too old, the sender no longer vouches for it"
    mean, sigma = line.gaussian.mean, line.gaussian.sigma
    return (
        f"{head}y_off {mean[0]:+.3f} ± {sigma[0]:.3f} m  beta {np.degrees(mean[1]):+.2f} ± "
        f"{np.degrees(sigma[1]):.2f} deg  c0 {1e3 * mean[2]:+.3f} ± {1e3 * sigma[2]:.3f} /km  "
        f"c1 {1e6 * mean[3]:+.2f} ± {1e6 * sigma[3]:.2f} /km^2  "
        f"x {line.x_min:.0f}..{line.x_max:.0f} m  age {1e3 * line.age:.0f} ms"
    )


def line_dict(line: MapLine, view: SlotView, at: Sequence[float] = ()) -> dict[str, Any]:
    """Return all fields of a line as it arrived, for JSON; an infinite age is None.

    Args:
        line: that was received.
        view: of its slot then; its state and a second sender decide, too, whether it is "usable".
        at: distances x [m]; "at" has the position there and its standard deviation, if the line
            has values and x is in its range.
    """
    here = [x for x in at if line.is_usable and line.x_min <= x <= line.x_max]
    y = [(float(line.y(x)), float(line.y_sigma(x))) for x in here]
    positions = [{"x": x, "y": one, "sigma": s} for x, (one, s) in zip(here, y, strict=True)]
    return ({"at": positions} if at else {}) | {
        "t": None if line.t_ns is None else line.t_ns / 1e9,
        "slot": line.slot.name,
        "kind": line.kind.name,
        "status": line.status.name,
        "usable": view._replace(line=line, stale=False).usable,
        "state": view.state.name,
        "two_senders": view.two_senders,
        "x_min": line.x_min,
        "x_max": line.x_max,
        "age": line.age if math.isfinite(line.age) else None,
        "components": 1 if line.mixture is None else len(line.mixture.weights),
        "mean": dict(zip(PARAMETERS, line.gaussian.mean.tolist(), strict=True)),
        "cov": line.gaussian.cov.tolist(),
        "mixture": None
        if line.mixture is None
        else {
            "weights": line.mixture.weights.tolist(),
            "means": line.mixture.means.tolist(),
            "covs": line.mixture.covs.tolist(),
        },
    }


def pose_errors_text(count: int) -> str:
    """Return the number of pose errors as text, to follow that of lines; empty without any.

    >>> pose_errors_text(3), pose_errors_text(0)
    (' and 3 pose errors', '')
    """
    return f" and {count_text(count, 'pose error')}" if count else ""


def unsent_texts(down: int, full: int, overruns: int) -> list[str]:
    """Return what a transmitter has not sent, as texts; none of a number that is 0.

    >>> unsent_texts(0, 1, 2)
    ['1 line given up with a full queue', '2 periods skipped because the sender was late']
    """
    return [
        f"{count_text(count, noun)} {why}"
        for count, noun, why in (
            (down, "line", "given up while the interface was down"),
            (full, "line", "given up with a full queue"),
            (overruns, "period", "skipped because the sender was late"),
        )
        if count
    ]


def scene_text(view: SceneView) -> str:
    """Return the width and the centre of the ego lane in one row; empty if it was not received.

    Two senders are named, since the lane may then be that of another car.
    """
    lane = [] if view.scene is None else _lane(view.scene)
    if view.received is None or not lane:
        return ""
    head = f"{view.received.t_ns / 1e9:.3f}  {'ego lane':<10}  "
    at = "/".join(f"{x:g}" for x, _, _ in lane)
    widths = ", ".join(f"{width.value:.3f} ± {width.sigma:.3f}" for _, width, _ in lane)
    centres = ", ".join(f"{centre.value:+.3f} ± {centre.sigma:.3f}" for _, _, centre in lane)
    warning = "  not usable: two senders" * view.two_senders
    return f"{head}at {at} m: width {widths} m  centre {centres} m{warning}"


def scene_dict(view: SceneView) -> dict[str, Any]:
    """Return a scene with the joint covariance of its lines, for JSON; empty before the first.

    An age or a correlation time that is infinite is None. "left_out" is there if a line is.
    """
    if view.received is None:
        return {}
    scene, age = view.received.scene, view.received.age
    time, lane = scene.pose_error.correlation_time, _lane(scene)
    left_out = {slot.name: reason.name for slot, reason in scene.left_out.items()}
    return ({"left_out": left_out} if left_out else {}) | {
        "t": view.received.t_ns / 1e9,
        "scene": [line.slot.name for line in scene.lines],
        "age": age if math.isfinite(age) else None,
        "usable": view.usable,
        "two_senders": view.two_senders,
        "pose_error": {
            "cov": scene.pose_error.cov.tolist(),
            "correlation_time": time if math.isfinite(time) else None,
        },
        "joint": {"mean": scene.means.ravel().tolist(), "cov": scene.cov.tolist()},
        "width": [{"x": x} | _estimate(width) for x, width, _ in lane],
        "centre": [{"x": x} | _estimate(centre) for x, _, centre in lane],
    }


def is_another_scene(view: SceneView, before: SceneView) -> bool:
    """Return whether a view shows another scene than the one before; each may show none."""
    if view.received is None or before.received is None:
        return False
    new, old = view.received, before.received
    return (new.counter, new.t_ns) != (old.counter, old.t_ns)


def _lane(scene: Scene) -> list[tuple[float, Estimate, Estimate]]:
    """Return the width and the centre of the ego lane at ``LANE_X`` where both lines are valid."""
    if not all(slot in scene.index for slot in LANE):
        return []
    low, high = scene.x_range(LANE)
    return [(x, scene.width(x), scene.centre(x)) for x in LANE_X if low <= x <= high]


def _estimate(estimate: Estimate) -> dict[str, float]:
    return {"value": float(estimate.value), "sigma": float(estimate.sigma)}


def write_csv(
    out: TextIO, lines: Iterable[tuple[str, MapLine, SlotView]], at: Sequence[float] = ()
) -> None:
    """Write lines with their channels and the views of their slots as a table with a header.

    Each number is the shortest decimal that reads back as the same floating-point number. A mixture
    is written with the mean and covariance of the whole. A line that is out of range or too old has
    empty cells instead of its range, mean and covariance.
    """
    writer = csv.writer(out, lineterminator="\n")
    columns = ["t", "channel", "slot", "kind", "status", "usable", "state", "two_senders"]
    values = ["x_min", "x_max", "age", "components", *PARAMETERS]
    values += [f"cov_{PARAMETERS[i]}_{PARAMETERS[j]}" for i, j in UPPER_TRIANGLE]
    places = [f"{name}{x:g}" for x in at for name in ("y", "sigma")]
    writer.writerow([*columns, *values, *places])
    for channel, line, view in lines:
        row = line_dict(line, view, at)
        cells = [row["t"], channel, row["slot"], row["kind"], row["status"]]
        cells += [str(row["usable"]).lower(), row["state"], str(row["two_senders"]).lower()]
        if line.is_usable:
            cells += [row["x_min"], row["x_max"], row["age"], row["components"]]
            cells += [*row["mean"].values(), *(row["cov"][i][j] for i, j in UPPER_TRIANGLE)]
        else:
            cells += [""] * len(values)
        known = {one["x"]: one for one in row.get("at", ())}
        cells += [known[x][name] if x in known else "" for x in at for name in ("y", "sigma")]
        writer.writerow(cells)
        out.flush()  # a reader of a pipe gets each line at once


def check_text(stats: SlotStats) -> str:
    """Return the E2E state of a slot and its counters as text.

    INVALID without data is how a sender normally ends, not an error in its data.
    """
    is_silent = stats.status is ProfileStatus.NONEWDATA and stats.state is E2EState.INVALID
    state = f"no data any more, {stats.state.name}" if is_silent else stats.state.name
    return (
        f"{state}; {stats.ok} ok, {stats.lost} lost, {stats.repeated} repeated, "
        f"{stats.wrong_sequence} wrong sequence, {count_text(stats.errors, 'error')}, "
        f"{count_text(stats.no_new_data, 'cycle')} without data"
        + ("; TWO SENDERS on this slot, or a path that duplicates frames" * stats.two_senders)
    )


def check_dict(stats: SlotStats) -> dict[str, Any]:
    """Return the E2E state of a slot and its counters, for JSON."""
    status = None if stats.status is None else stats.status.name
    return stats._asdict() | {"state": stats.state.name, "status": status}


def counts_text(counts: Mapping[str, int]) -> str:
    """Return the counters that are not zero as text, sorted by name.

    >>> counts_text({"CRC": 2, "FOREIGN": 1, "TIMEOUT": 0}), counts_text({})
    ('2 crc, 1 foreign', 'none')
    >>> counts_text({"the data do not fit the message ESP": 3})
    'the data do not fit the message ESP (3)'
    """
    return (
        ", ".join(
            f"{name} ({n})" if " " in name else f"{n} {name.lower()}"
            for name, n in sorted(counts.items())
            if n
        )
        or "none"
    )


def faults_text(counts: Mapping[str, int]) -> str:
    """Return the counters of injected faults as text."""
    kinds = {name: n for name, n in counts.items() if name not in ("frames", "passed", "held")}
    return (
        f"of {count_text(counts['frames'], 'frame')}: {counts_text(kinds)}; "
        f"{counts['passed']} passed on, {counts['held']} held back"
    )
