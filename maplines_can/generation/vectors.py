"""Test vectors: frames with times, and what a receiver makes of them.

The vectors are cases, and each case begins with a new receiver with its default settings. Its steps
are frames and questions, with the answers of ``Decoder``. They are written twice: as text, one step
a line, which a program without a JSON library can read; and as JSON.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..values.elementary import tan
from ..values.line import MapLine, Slot
from ..wire.codec import Codec
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import Owner, number_of
from ..wire.protection.key import Key
from ..wire.protection.secoc import Authenticator
from ..wire.reception.check import Reason

FORMAT = "maplines-vectors-1"
#: Where the lateral position of a line is given [m].
PLACES = (0.0, 20.0, 40.0, 80.0)
#: Name of the file that describes the JSON.
SCHEMA = "vectors.schema.json"


class VectorKey(NamedTuple):
    """Key of a receiver, which is no secret, and its bounds of a freshness value."""

    secret: bytes
    key_id: int = 1
    window_ns: int = 1_000_000_000
    not_before: int = 0  #: [us]


class Vectors(NamedTuple):
    """The files of the vectors of a DBC."""

    text: str
    json: str


class Case:
    """One case: a new receiver, and the steps that it goes through.

    Each method is a step; it asks the receiver and keeps the answer.

    Args:
        layout: of the DBC.
        name: of the case.
        about: a sentence.
        key: of the receiver; None: it has none.
        detailed: the values of each line that is completed are part of the answer.
    """

    def __init__(
        self,
        layout: Layout,
        name: str,
        about: str,
        *,
        key: VectorKey | None = None,
        detailed: bool = False,
    ) -> None:
        self.name, self.about, self.key = name, about, key
        self.steps: list[dict[str, Any]] = []
        self._detailed, self._now = detailed, 0
        authenticator = None
        if key is not None:
            authenticator = Authenticator(
                Key(key.secret, key.key_id),
                clock=lambda: self._now,
                window_ns=key.window_ns,
                not_before=key.not_before,
            )
        self._decoder = Codec(layout, authenticator).decoder()
        self._has_whole_scenes = layout.scene is not None

    def frame(
        self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False
    ) -> Sequence[MapLine] | Reason:
        """Feed a frame, which is received at ``t_ns`` [ns]; return the answer."""
        self._now = t_ns
        answer = self._decoder.feed(can_id, data, t_ns, is_extended=is_extended)
        step: dict[str, Any] = {
            "step": "frame",
            "t_ns": t_ns,
            "can_id": can_id,
            "is_extended": is_extended,
            "data": data.hex(),
        }
        if isinstance(answer, Reason):
            step["reason"] = answer.name
        else:
            step["complete"] = [line.slot.name for line in answer]
            if self._detailed:
                step["lines"] = [_line(line) for line in answer]
        self.steps.append(step)
        return answer

    def expire(self, t_ns: int) -> None:
        """Drop what has timed out."""
        self._decoder.expire(t_ns)
        self.steps.append({"step": "expire", "t_ns": t_ns})

    def view(self, slot: Slot, now_ns: int) -> None:
        """Ask for the newest line of a slot, and whether it may be used."""
        view = self._decoder.latest(slot, now_ns)
        self.steps.append(
            {
                "step": "view",
                "t_ns": now_ns,
                "slot": slot.name,
                "state": view.state.name,
                "status": _status(view.status),
                "age": _numbers([view.age]),
                "is_stale": view.stale,
                "two_senders": view.two_senders,
                "is_usable": view.usable,
            }
        )
        if self._has_whole_scenes:
            self.steps[-1]["left_out"] = "NONE" if view.left_out is None else view.left_out.name

    def stats(self, owner: Owner, now_ns: int) -> None:
        """Ask for the counters of the E2E checks of an owner."""
        stats = self._decoder.messages(now_ns).get(owner)
        if stats is None:
            return
        self.steps.append(
            {
                "step": "stats",
                "t_ns": now_ns,
                "owner": _name(owner),
                "state": stats.state.name,
                "status": _status(stats.status),
                "ok": stats.ok,
                "lost": stats.lost,
                "repeated": stats.repeated,
                "wrong_sequence": stats.wrong_sequence,
                "errors": stats.errors,
                "no_new_data": stats.no_new_data,
                "two_senders": stats.two_senders,
            }
        )

    def scene(self, now_ns: int) -> None:
        """Ask for the newest scene, with the joint covariance of its lines."""
        view = self._decoder.latest_scene(now_ns)
        lines = () if view.scene is None else view.scene.lines
        cov = np.zeros((0, 0)) if view.scene is None else view.scene.cov
        self.steps.append(
            {
                "step": "scene",
                "t_ns": now_ns,
                "state": view.state.name,
                "status": _status(view.status),
                "age": _numbers([view.age]),
                "is_stale": view.stale,
                "two_senders": view.two_senders,
                "is_usable": view.usable,
                "slots": [line.slot.name for line in lines],
                "lines": [_line(line) for line in lines],
                "joint": _numbers(_upper(cov)),
            }
        )
        if self._has_whole_scenes:
            left_out = {} if view.scene is None else view.scene.left_out
            self.steps[-1]["left_out"] = {
                slot.name: left_out[slot].name for slot in sorted(left_out)
            }

    def counts(self) -> None:
        """Ask for the numbers of frames and lines."""
        decoder = self._decoder
        counts = {reason.name: decoder.counts[reason] for reason in Reason}
        self.steps.append(
            {
                "step": "counts",
                "frames": decoder.frames,
                "delivered": decoder.lines,
                "pending": decoder.pending,
                "counts": {name: n for name, n in counts.items() if n},
            }
        )


def vectors_of(cases: Iterable[Case], dbc: str, dbc_sha256: str) -> Vectors:
    """Return the files of cases.

    Args:
        cases: of one DBC.
        dbc: its name.
        dbc_sha256: hash of the DBC file.
    """
    all_cases = list(cases)
    rows = [row for case in all_cases for row in _case_text(case)]
    body = "".join(f"{row}\n" for row in [*rows, f"end {len(all_cases)}"])
    digest = hashlib.sha256(body.encode()).hexdigest()
    head = [FORMAT, f"dbc {dbc}", f"dbc-sha256 {dbc_sha256}", f"sha256 {digest}"]
    text = "".join(f"{line}\n" for line in head) + body
    content = {
        "$schema": SCHEMA,
        "format": FORMAT,
        "dbc": {"name": dbc, "sha256": dbc_sha256},
        "sha256": digest,
        "places": list(PLACES),
    }
    opening = json.dumps(content, indent=1)[: -len("\n}")]
    parts = ",\n".join(map(_case_json, all_cases))
    return Vectors(text, f'{opening},\n "cases": [\n{parts}\n ]\n}}\n')


# ---- values -----------------------------------------------------------------------------------


def _line(line: MapLine) -> dict[str, Any]:
    """Return what is stated of a line; of one that is out of range, neither mean nor covariance."""
    values: dict[str, Any] = {
        "slot": line.slot.name,
        "kind": line.kind.name,
        "status": line.status.name,
        "components": 1 if line.mixture is None else len(line.mixture.weights),
        "t_ns": line.t_ns,
        "range": _numbers([line.x_min, line.x_max]),
        "age": _numbers([line.age]),
    }
    if line.status.name == "OUT_OF_RANGE":
        return values
    return values | {
        "mean": _numbers(line.gaussian.mean),
        "cov": _numbers(_upper(line.gaussian.cov)),
        "y": _numbers(_lateral(line, x) for x in PLACES),
        "sigma": _numbers(_lateral_sigma(line, x) for x in PLACES),
    }


def _lateral(line: MapLine, x: float) -> float:
    """Return the lateral position at x: ``MapLine.y``, the same on any machine.

    It is NaN outside of the range, as is its standard deviation.
    """
    if not line.is_valid_at(x):
        return math.nan
    y_off, beta, c0, c1 = line.gaussian.mean.tolist()
    return float(y_off + x * float(tan(beta)) + x * x / 2 * c0 + x * x * x / 6 * c1)


def _lateral_sigma(line: MapLine, x: float) -> float:
    """Return the standard deviation of it: ``MapLine.y_sigma``, the same on any machine."""
    if not line.is_valid_at(x):
        return math.nan
    slope = float(tan(line.gaussian.mean[1]))
    J = (1.0, x * (1 + slope * slope), x * x / 2, x * x * x / 6)
    variance = 0.0
    for i, row in enumerate(line.gaussian.cov.tolist()):
        for j, entry in enumerate(row):
            variance += J[i] * entry * J[j]
    return math.sqrt(max(variance, 0.0))


def _upper(cov: Any) -> list[float]:
    """Return the upper triangle of a symmetric matrix, by rows."""
    return [float(cov[i, j]) for i in range(len(cov)) for j in range(i, len(cov))]


def _numbers(values: Iterable[float]) -> dict[str, list[Any]]:
    """Return floating-point numbers in both notations; JSON has only finite decimals."""
    numbers = [float(value) for value in values]
    return {
        "hex": [_hex(value) for value in numbers],
        "decimal": [value if math.isfinite(value) else None for value in numbers],
    }


def _hex(value: float) -> str:
    """Return a number as C reads and writes it, without zeros at its end.

    >>> _hex(1.5), _hex(0.0), _hex(math.inf), _hex(-1.0), _hex(math.nan)
    ('0x1.8p+0', '0x0p+0', 'inf', '-0x1p+0', 'nan')
    """
    mantissa, p, exponent = value.hex().partition("p")
    return f"{mantissa.rstrip('0').rstrip('.') if '.' in mantissa else mantissa}{p}{exponent}"


def _status(status: Any) -> str:
    return "NONE" if status is None else str(status.name)


def _name(owner: Owner) -> str:
    return number_of(owner).name


# ---- as text and JSON -------------------------------------------------------------------------


def _case_text(case: Case) -> Iterator[str]:
    """Yield the lines of a case."""
    yield f"case {case.name}"
    yield f"about {case.about}"
    if case.key is not None:
        secret, key_id, window_ns, not_before = case.key
        yield f"key {key_id} {secret.hex()} {window_ns // 1000} {not_before}"
    for step in case.steps:
        yield " ".join(map(str, _words(step)))
        for line in step.get("lines", ()):
            yield " ".join(["line", *map(str, _line_words(line))])
            for name in ("mean", "cov", "y", "sigma"):
                if name in line:
                    yield " ".join([name, *line[name]["hex"]])
        if step.get("slots"):
            yield " ".join(["joint", *step["joint"]["hex"]])


def _words(step: Mapping[str, Any]) -> Iterator[Any]:
    """Yield the words of a step."""
    kind = step["step"]
    yield kind
    if kind == "counts":
        yield from (step["frames"], step["delivered"], step["pending"])
        yield from (f"{name}={n}" for name, n in step["counts"].items())
        return
    yield step["t_ns"]
    if kind == "frame":
        yield f"{step['can_id']:x}{'x' if step['is_extended'] else ''}"
        yield step["data"] or "-"
        yield from [step["reason"]] if "reason" in step else ["COMPLETE", *step["complete"]]
    elif kind == "stats":
        names = ("ok", "lost", "repeated", "wrong_sequence", "errors", "no_new_data")
        yield from (step["owner"], step["state"], step["status"])
        yield from (step[name] for name in names)
        yield int(step["two_senders"])
    elif kind in ("view", "scene"):
        yield from [step["slot"]] if kind == "view" else []
        yield from (step["state"], step["status"], step["age"]["hex"][0])
        yield from (int(step[name]) for name in ("is_stale", "two_senders", "is_usable"))
        yield from step.get("slots", ())
        if "left_out" in step:
            left_out = step["left_out"]
            yield from (
                [f"{slot}={why}" for slot, why in left_out.items()]
                if kind == "scene"
                else [left_out]
            )


def _line_words(line: Mapping[str, Any]) -> Iterator[Any]:
    yield from (line[name] for name in ("slot", "kind", "status", "components", "t_ns"))
    yield from (*line["range"]["hex"], *line["age"]["hex"])


def _case_json(case: Case) -> str:
    """Return a case as JSON, one step a line."""
    head: dict[str, Any] = {"name": case.name, "about": case.about}
    if case.key is not None:
        secret, key_id, window_ns, not_before = case.key
        head["key"] = {
            "secret": secret.hex(),
            "key_id": key_id,
            "window_us": window_ns // 1000,
            "not_before_us": not_before,
        }
    steps = ",\n".join(f"   {json.dumps(step)}" for step in case.steps)
    return f'  {json.dumps(head)[:-1]}, "steps": [\n{steps}\n  ]}}'
