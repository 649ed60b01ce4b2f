"""Facts of one moment of a bus or a log: all lines, their states, and what was dropped, as JSON.

They are what the page and the terminal show, and what goes over the network: means and covariances,
about 1 kB for a cycle. Bands are computed where they are drawn.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bus.receiver import ReceivedLines
from ..values.gaussian import Gaussian
from ..values.line import MapLine
from ..values.mixture import GaussianMixture
from ..values.scene import Scene
from ..wire import Decoder, Layout, Reason, SceneView, SlotStats, SlotView

#: Significant digits of numbers: what tells any two floats of single precision apart.
DIGITS = 9

Facts = dict[str, Any]
#: Rows and columns of the upper triangle of (n, n), in the order of its numbers in facts.
triangle = cache(np.triu_indices)


def facts_of(source: Decoder | ReceivedLines, layout: Layout, now_ns: int | None = None) -> Facts:
    """Return the facts of a decoder, or of a receiver, at a time, for JSON.

    Units are SI. A number that is infinite or unknown is None.

    ==========  ====================================================================================
    key         meaning
    ==========  ====================================================================================
    t           time [s]
    slots       by name, of those of which something came: ``state``, ``status``, ``age``,
                ``stale``, ``usable``, ``two_senders``, ``left_out`` (a reason), and ``line``
    line        ``t`` of its first frame, ``kind``, ``status``, ``x`` (range), ``mean``, ``cov``
                (upper triangle, 10 numbers), and ``mixture``: [weight, mean, cov] of each component
    scene       of the newest pose error: ``t``, ``age``, ``usable``, ``state``, ``slots`` in their
                order, ``joint`` (covariance of their parameters, upper triangle) and ``pose`` (over
                along, across and heading, upper triangle); None before the first
    messages    by owner, the members of ``SlotStats``
    counts      dropped frames by reason
    lines       number of lines received
    ==========  ====================================================================================

    Args:
        source: what has received the lines.
        layout: of its DBC.
        now_ns: the time on the clock of the frames' time stamps [ns]; None for that of a receiver.

    Raises:
        ValueError: a decoder has no clock, and no time is given.
    """
    stats = source if isinstance(source, Decoder) else source.stats()
    views = [source.latest(slot, now_ns) for slot in layout.slots]  # type: ignore[arg-type]
    messages = source.messages(now_ns)  # type: ignore[arg-type]
    scene = None if layout.pose is None else source.latest_scene(now_ns)  # type: ignore[arg-type]
    t_ns = source.now_ns() if isinstance(source, ReceivedLines) and now_ns is None else now_ns
    return {
        "t": _seconds(t_ns),
        "slots": {
            view.slot.name: _slot(view) for view in views if view.line or view.left_out is not None
        },
        "scene": None if scene is None else _scene(scene),
        "messages": {
            getattr(owner, "name", owner): own._asdict() | _names(own)
            for owner, own in messages.items()
        },
        "counts": {reason.name: n for reason, n in stats.counts.items()},
        "lines": stats.lines,
    }


def _slot(view: SlotView) -> Facts:
    return {
        **_names(view),
        "age": _known(view.age),
        "stale": view.stale,
        "usable": view.usable,
        "two_senders": view.two_senders,
        "left_out": None if view.left_out is None else view.left_out.name,
        "line": None if view.line is None else line_facts(view.line),
    }


def _names(view: SlotView | SlotStats) -> Facts:
    status = None if view.status is None else view.status.name
    return {"state": view.state.name, "status": status}


def line_facts(line: MapLine) -> Facts:
    """Return the facts of a line, as ``line`` in `facts_of`."""
    return {
        "t": _seconds(line.t_ns),
        "kind": line.kind.name,
        "status": line.status.name,
        "x": [_known(line.x_min), _known(line.x_max)],
        **_moments(line.gaussian),
        "mixture": None if line.mixture is None else _components(line.mixture),
    }


def scene_facts(scene: Scene) -> Facts:
    """Return the lines of a scene by slot, the order of the slots, and the joint covariance."""
    return {
        "slots": [line.slot.name for line in scene.lines],
        "lines": {line.slot.name: line_facts(line) for line in scene.lines},
        "joint": _upper(scene.cov),
    }


def _moments(gaussian: Gaussian) -> Facts:
    return {"mean": _rounded(gaussian.mean), "cov": _upper(gaussian.cov)}


def _components(mixture: GaussianMixture) -> list[list[Any]]:
    each = zip(_rounded(mixture.weights), mixture.means, mixture.covs, strict=True)
    return [[weight, _rounded(mean), _upper(cov)] for weight, mean, cov in each]


def _scene(view: SceneView) -> Facts | None:
    if view.received is None or view.scene is None:
        return None
    return {
        "t": _seconds(view.received.t_ns),
        "age": _known(view.age),
        "usable": view.usable,
        "state": view.state.name,
        "slots": [line.slot.name for line in view.scene.lines],
        "joint": _upper(view.scene.cov),
        "pose": _upper(view.scene.pose_error.cov),
    }


def _upper(cov: NDArray[np.float64]) -> list[float | None]:
    return _rounded(cov[triangle(len(cov))])


def _rounded(values: NDArray[np.float64]) -> list[float | None]:
    return [_known(value) for value in values.tolist()]


def _known(value: float) -> float | None:
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None


def _seconds(t_ns: int | None) -> float | None:
    return None if t_ns is None else t_ns / 1e9


#: Dropped frames that are no fault: those of other messages, and those that wait for others.
NO_FAULT = {Reason.FOREIGN.name, Reason.PENDING.name}
#: Counters of an owner, and what they count.
_COUNTERS = {
    "lost": "lost",
    "repeated": "repeated",
    "wrong_sequence": "out of sequence",
    "errors": "wrong",
    "no_new_data": "missing in their cycle",
}


def changes(before: Facts, now: Facts) -> list[str]:
    """Return what a person should see that has changed from facts to later ones, as texts.

    These are states, senders, records that are lost or wrong, dropped frames, and lines that are
    left out. Those of a start, such as INIT to VALID, are there, too.

    >>> old = {"slots": {}, "messages": {}, "counts": {"FOREIGN": 1}}
    >>> changes(old, old | {"counts": {"FOREIGN": 9, "CRC": 2}})
    ['2 frames dropped: CRC']
    """
    found = []
    for owner, own in now["messages"].items():
        name = owner.replace("_", " ").lower()
        old = before["messages"].get(owner, {"state": "NODATA"})
        if own["state"] != old["state"]:
            found.append(f"{name}: {old['state']} -> {own['state']}")
        if own["two_senders"] and not old.get("two_senders"):
            found.append(f"{name}: two senders")
        for key, what in _COUNTERS.items():
            n = own[key] - old.get(key, 0)
            if n and not (key == "no_new_data" and old["state"] == "INVALID"):  # that says so
                found.append(f"{name}: {n} {what}")
    for slot, own in now["slots"].items():
        old = before["slots"].get(slot, {"left_out": None})
        if own["left_out"] != old["left_out"]:
            what = "back" if own["left_out"] is None else f"left out: {own['left_out']}"
            found.append(f"{slot.replace('_', ' ').lower()}: {what}")
    for reason, count in now["counts"].items():
        n = count - before["counts"].get(reason, 0)
        if n and reason not in NO_FAULT:
            found.append(f"{n} frame{'s' * (n != 1)} dropped: {reason}")
    return found
