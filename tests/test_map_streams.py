"""The propagation of core and model on the same maps, and whether another rule would be found."""

from itertools import islice
from typing import Any

import numpy as np
import pytest

from maplines_can.model import certain_range, cubic_ranges, propagation, refits, stretches
from maplines_can.model.matrices import Row
from maplines_can.testing import map_streams
from maplines_can.testing.map_streams import compare_maps, core_answer, queries


def after(steps: int) -> Any:
    """Return a question that is true after so many turns."""
    turns = iter(range(steps))
    return lambda: next(turns, None) is None


def test_core_and_model_propagate_to_the_same_bits() -> None:
    assert str(compare_maps(1, after(20))) == "bit-identical on 210 queries of maps"


def test_the_stream_has_all_kinds_of_answers() -> None:
    """Lines that are given, and left out for each reason; scenes; refits, and none."""
    reasons, kinds = set(), set()
    for query in islice(queries(2), 150):
        answer = core_answer(query)
        if query.question == "refit":
            kinds.add((query.question, answer is not None))
            continue
        kinds.add((query.question, bool(answer[0])))
        reasons |= set(answer[-1].values())

    assert reasons == {"NOT_IN_WINDOW", "ACROSS", "TOO_SHORT", "UNCERTAIN"}
    assert kinds == {(kind, some) for kind in map_streams.QUESTIONS for some in (True, False)}


def test_the_queries_of_a_seed_are_the_same_ones() -> None:
    for first, second in islice(zip(queries(1), queries(1), strict=True), 20):
        assert str(first) == str(second)
        for one, other in zip(first.lines, second.lines, strict=True):
            assert np.array_equal(one.points, other.points)


@pytest.mark.parametrize(
    ("module", "name", "value"),
    [
        (stretches, "DIRECTION_BASE", 0.6),
        (cubic_ranges, "BEHIND", 0.4),
        (cubic_ranges, "ROUNDS", 3),
        (cubic_ranges, "SHRINK", 0.96),
        (cubic_ranges, "LIMIT", 2.91),
        (cubic_ranges, "SHARE", 0.98),
        (cubic_ranges, "NOISE_LIMIT", 2.18),
        (cubic_ranges, "MAX_SHOWN", 1.9),
        (cubic_ranges, "MIN_POINTS", 12),
        (cubic_ranges, "MIN_SHAPE", 0.11),
        (refits, "MIN_ADVANCE", 0.171),
        (refits, "MIN_PROGRESS", 0.5),
        (refits, "HALVINGS", 1),
        (certain_range, "NEWTON_STEPS", 3),
        (propagation, "TURN_MARGIN", 2.9),
        (propagation, "ASIDE", 9.0),
        (propagation, "WHOLE_STEP", 0.5),
        (propagation, "MIN_RANGE", 1.5),
        (propagation, "TRIALS", 7),
    ],
)
def test_another_number_is_found(
    monkeypatch: pytest.MonkeyPatch, module: Any, name: str, value: Any
) -> None:
    monkeypatch.setattr(module, name, value)

    assert "core and model differ" in str(compare_maps(1, after(60)))



def test_another_rule_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A swapped sign, another weight, a range one step off, and the last bit of a noise."""

    def swapped(rule: Any, mean: Row, cov: Any) -> Any:
        return [[*point[:2], 2 * mean[2] - point[2]] for point in points(rule, mean, cov)]

    points = propagation.rule_points
    monkeypatch.setattr(propagation, "rule_points", swapped)
    assert "core and model differ" in str(compare_maps(1, after(3)))
