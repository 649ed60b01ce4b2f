"""Senders of core and model on the same random lines, and whether another rule would be found."""

from collections import Counter
from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
import pytest

from maplines_can import Status
from maplines_can.core import ffi, lib
from maplines_can.model import covariance, mixtures, nearest_line, scene_sender
from maplines_can.model.signals import read
from maplines_can.testing.sender_comparison import STREAMS, compare_senders
from maplines_can.testing.sender_streams import bits
from maplines_can.wire import POSE, SHIPPED, Codec, Layout, default_dbc_path

LAYOUT = Layout.from_dbc()
WHOLE = "maplines-scene.dbc"


def after(steps: int) -> Any:
    """Return a question that is true after so many turns."""
    turns = iter(range(steps))
    return lambda: next(turns, None) is None


def test_core_and_model_write_and_read_the_same_records() -> None:
    layouts = [Layout.from_dbc(default_dbc_path(name)) for name in SHIPPED]

    found = compare_senders(layouts, 1, after(8))

    assert str(found) == "bit-identical on 1320 records of senders"


def answers(dbc: str, name: str, steps: int, seed: int = 3) -> Iterator[tuple[Layout, Any]]:
    """Yield answers of the model that are those of the core."""
    codec, stream = Codec(Layout.from_dbc(default_dbc_path(dbc))), STREAMS[name]
    for given in islice(stream.inputs(codec.layout, np.random.default_rng(seed)), steps):
        answer = stream.model(codec.layout, given)
        assert bits(stream.core(codec, given)) == bits(answer)
        yield codec.layout, answer


def test_the_streams_of_an_ecu_reach_every_refusal() -> None:
    """Each mistake of a caller, also of settings; and frames with and without a MAC."""
    met = Counter[str]()
    for dbc, name, steps in (
        ("maplines-secoc.dbc", "lines of an ECU", 500),
        ("maplines-secoc.dbc", "mixtures of an ECU", 60),
        ("maplines-secoc.dbc", "scenes of an ECU", 30),
        (WHOLE, "scenes of an ECU", 8),
        ("maplines.dbc", "settings", 70),
        ("maplines-secoc.dbc", "settings", 70),
    ):
        for _, answer in answers(dbc, name, steps):
            if name == "settings":
                met.update(text for text in (answer[0], answer[3]) if text)
            else:
                met[answer[0] if isinstance(answer[0], str) else "sent"] += 1
                met["authenticated"] += answer[1] not in (0, None)
                met.update(answer[2] if name == "scenes of an ECU" and answer[1] != 0 else ())
    refusals = {ffi.string(lib.maplines_refusal_name(i)).decode() for i in range(1, 16)}
    problems = {name for name in met if " must " in name}
    assert refusals - {"NO_COVARIANCE"} <= met.keys()  # a conditional DBC has no such stream
    assert {"sent", "authenticated", "UNSENT", "IN_SCENE", "PLACE"} <= met.keys()
    assert len(problems) >= 14


def test_the_streams_of_a_seed_reach_every_rule() -> None:
    """Each status and reason, complete and refused scenes, levels and all entries."""
    met = Counter[str]()
    for layout, record in answers("maplines.dbc", "lines", 100):
        met[Status(read(layout["Status"], record)).name] += 1
    for _, sent in answers("maplines.dbc", "mixtures", 40):
        met[f"{len(sent)} components"] += 1
    for _, found in answers("maplines.dbc", "records", 100):
        met[found if isinstance(found, str) else "read"] += 1
    for _, sent in answers("maplines.dbc", "scenes", 5):
        met["complete" if sent is not None else "refused"] += 1
    for layout, sent in answers("maplines-pose.dbc", "scenes", 30, seed=0):
        records, left_out = ({}, {}) if sent is None else sent
        met.update(left_out.values())
        for owner, record in records:
            if owner != POSE:
                met["entries" if read(layout["HasCovariance"], record) else "levels"] += 1
    for _, sent in answers(WHOLE, "sequences", 4):
        for records, left_out in (one for one in sent if one is not None):
            met.update(f"{why} of a whole scene" for why in left_out.values())
            met[f"{len(records)} records of a whole scene"] += 1
    reached = {
        *(status.name for status in Status),
        *("1 components", "2 components", "4 components", "read", "MIXED", "CRC", "CONTENT"),
        *("complete", "refused", "entries", "levels", "ACROSS", "RANGE", "MEAN", "COVARIANCE"),
        *(f"{why} of a whole scene" for why in ("RANGE", "COVARIANCE")),
        *(f"{count} records of a whole scene" for count in (1, 2)),
    }
    assert {name for name in reached if not met[name]} == set()


@pytest.mark.parametrize("name", STREAMS)
def test_streams_are_the_same_on_any_machine(name: str) -> None:
    first, second = (STREAMS[name].inputs(LAYOUT, np.random.default_rng(1)) for _ in range(2))
    for _ in range(20):
        assert str(next(first)) == str(next(second))


@pytest.mark.parametrize(
    ("module", "name", "value"),
    [
        (covariance, "MARGIN", 1e-4),
        (covariance, "LIFTS", 0),
        (covariance, "ATTEMPTS", 1),
        (covariance, "ROUNDING", 1e-2),
        (nearest_line, "SHORTER", 0.7),
        (nearest_line, "MAX_DEVIATION", 0.2),
        (mixtures, "MORE", 1e-2),
        (scene_sender, "POSE_SLACK", 1.02),
    ],
)
def test_another_rule_is_found(
    monkeypatch: pytest.MonkeyPatch, module: Any, name: str, value: Any
) -> None:
    monkeypatch.setattr(module, name, value)

    assert "core and model differ" in str(compare_senders([LAYOUT], 1, after(90)))


def test_last_bits_count() -> None:
    """An answer is another one if a float differs in its last bit, or in the sign of 0."""
    assert bits([1.0]) != bits([float(np.nextafter(1.0, 2))])
    assert bits(0.0) != bits(-0.0)
    assert bits(np.array([float("nan")])) == bits([float("nan")])
