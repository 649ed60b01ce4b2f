"""Expressions as cases of a test, and their evaluation."""

from __future__ import annotations

import asyncio
import re
import sys
from collections.abc import Iterator
from functools import cache, partial
from typing import Any

import numpy as np
import pytest

import maplines_can as ml
from maplines_can import bus, propagation, testing, wire
from maplines_can.generation.dbc.record_spec import DEFAULT
from maplines_can.values import line

#: Cases that name files, permissions or an interface of Linux.
LINUX = re.compile(r'/dev/|/proc/|/etc/|"/"|open\.key|socketcan')


def evaluate(expression: str) -> Any:
    """Return the value of an expression; its names are the public ones and those of `_objects`."""
    codec = _objects()["codec"]
    with ml.Link(interface="virtual", channel="bad-input") as link:
        names = _objects() | {"link": link, "decoder": codec.decoder(), "monitor": codec.decoder()}
        value = eval(expression, names)  # noqa: S307 - our own expressions
        return list(value) if isinstance(value, Iterator) else value


def cases(*rows: tuple[Any, ...]) -> list[Any]:
    """Return the rows as parameters of a test, each with its first value as its id."""
    other_system = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux")
    return [
        pytest.param(
            *row, id=row[0] or "nothing", marks=[other_system] if LINUX.search(row[0]) else []
        )
        for row in rows
    ]


@cache
def _objects() -> dict[str, Any]:
    """Return the public names, and an object of each kind."""
    names = {
        name: getattr(module, name)
        for module in (
            ml.localisation,
            ml.consumers,
            ml,
            propagation,
            wire,
            bus,
            testing,
            ml.simulation,
        )
        for name in module.__all__
    }
    cov = np.diag([0.1, 0.01, 1e-3, 1e-4]) ** 2
    one = ml.Gaussian(np.array([1.75, 0, 0, 0]), cov)
    asymmetric, indefinite = np.eye(4), np.eye(4)
    asymmetric[0, 1] = indefinite[0, 1] = indefinite[1, 0] = 2.0
    road = ml.Polyline(np.array([[x, 2.0] for x in range(-20, 100, 5)]))
    codec = ml.Codec.from_dbc()
    return names | {
        "lateral": line.lateral,
        "lateral_jacobian": line.lateral_jacobian,
        "transform_line": line.transform_line,
        "nan": np.nan,
        "inf": np.inf,
        "eye": np.eye,
        "full": np.full,
        "zeros": np.zeros,
        "ones": lambda n: np.ones((n, n)),
        "Queue": asyncio.Queue,
        "codec": codec,
        "layout": codec.layout,
        "one": one,
        "ego": ml.Gaussian(np.zeros(3), np.eye(3) * 1e-4),
        "road": road,
        "asymmetric": asymmetric,
        "indefinite": indefinite,
        "line": ml.MapLine(ml.Slot.EGO_LEFT, one),
        "received": ml.MapLine(ml.Slot.EGO_LEFT, one, t_ns=0),
        "refit": ml.Refit(road, [0, 0, 0], window=(-20, 80)),
        "frame": ml.Frame(1, bytes(8)),
        "key": wire.Key(bytes(range(16))),
        "encode": partial(codec.batch.encode, [[0, 0, 0, 0]], [np.eye(4)]),
        "dbc": _slots,
        "edited": _edited,
        "without": _without,
        "status": _status_names,
    }


def _status_names(payloads: Any) -> list[str]:
    batch = _objects()["codec"].batch.decode(payloads)
    return [ml.Status(status).name for status in batch.status]


def _slots(text: str = "") -> int:
    """Return the number of slots of a DBC."""
    return len(ml.Codec(wire.Layout.from_text(text, "the DBC")).layout.messages)


def _edited(old: str, new: str, *, classic: bool = False) -> int:
    """Return the number of slots of the default DBC after an edit.

    Args:
        old: a text of the DBC.
        new: its replacement.
        classic: leave out the messages of CAN FD, which must hold the same signals.
    """
    text = DEFAULT.dbc()
    if classic:
        text = re.sub(r"BO_ \d+ \w+Fd:.*?\n\n", "", text, flags=re.DOTALL)
        text = re.sub(r"^(?:CM_|BA_|VAL_)[^\n]*? (84[0-7]|861) [^;]*;\n", "", text, flags=re.M)
    assert old in text
    return _slots(text.replace(old, new))


def _without(signal: str) -> int:
    """Return the number of slots of the default DBC after the removal of a signal."""
    text = re.sub(rf"(?m)^ SG_ {signal} .*\n", "", DEFAULT.dbc())
    return _slots(re.sub(rf"(?m)^(?:CM_ SG_|VAL_) \d+ {signal} [^;]*;\n", "", text))
