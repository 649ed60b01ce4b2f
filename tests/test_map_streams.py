"""The propagation of core and model on the same maps, and whether another rule would be found."""

import math
from itertools import islice
from typing import Any

import numpy as np
import pytest

from maplines_can.model import cubic_ranges, propagation, refits, stretches
from maplines_can.testing import map_streams
from maplines_can.testing.map_streams import compare_maps, core_answer, queries


def after(steps: int) -> Any:
    """Return a question that is true after so many turns."""
    turns = iter(range(steps))
    return lambda: next(turns, None) is None


def test_core_and_model_propagate_to_the_same_bits() -> None:
    assert str(compare_maps(1, after(10))) == "bit-identical on 110 queries of maps"


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

    assert reasons == {"NOT_IN_WINDOW", "ACROSS", "TOO_SHORT", "UNCERTAIN", "FEW_POINTS"}
    assert kinds == {(kind, some) for kind in map_streams.QUESTIONS for some in (True, False)}


@pytest.mark.parametrize(
    ("module", "name", "value"),
    [
        (stretches, "ERRORS", 31.0),
        (stretches, "SAGITTAS", 9.0),
        (stretches, "MOST_ERROR", 1.01),
        (stretches, "PER_FREEDOM", 2.64),
        (stretches, "TYPICAL", 1.9e-4),
        (stretches, "MOST_TYPICAL", 0.061),
        (stretches, "TYPICAL_COUNT", 1.6),
        (stretches, "STUDENT", 1.31),
        (stretches, "BETWEEN", 7.1e-4),
        (stretches, "FEW_POINTS", 9.1),
        (stretches, "BY_TYPICAL", 0.31),
        (stretches, "BY_ERROR", 0.11),
        (stretches, "FAR_APART", 10.1),
        (cubic_ranges, "DAMPING", 0.051),
        (cubic_ranges, "BULGE", 0.51),
        (cubic_ranges, "AVERAGE", 4.5),
        (cubic_ranges, "NOISE_LIMIT", 14.1),
        (cubic_ranges, "NARROW_LIMIT", 20.0),
        (cubic_ranges, "SHARED_POINTS", 21.0),
        (cubic_ranges, "SOFT", 0.11),
        (cubic_ranges, "BEHIND", 0.4),
        (cubic_ranges, "NEARLY", 4.1),
        (cubic_ranges, "SHRINK", 0.997),
        (cubic_ranges, "FAR_NOISE", (26.0, 12.0, 7.0)),
        (cubic_ranges, "MEAN_NOISE", (8.0, 6.0, 4.1)),
        (cubic_ranges, "MIN_SIGMA", 0.005),
        (cubic_ranges, "LATERAL_SHARE", 0.21),
        (cubic_ranges, "MEAN_SQUARE", 1.41),
        (cubic_ranges, "MODE_LEVELS", (2.6, 6.6)),
        (cubic_ranges, "MODE_VARIANCES", (3.8, 3.63)),
        (cubic_ranges, "LIMIT", 2.91),
        (cubic_ranges, "PLACES", 31),
        (cubic_ranges, "LONGEST", 0.39),
        (cubic_ranges, "MIN_SHAPE", 0.11),
        (cubic_ranges, "STARTS", cubic_ranges.STARTS[:-1]),
        (refits, "MIN_ADVANCE", 0.5),
        (refits, "STEP", 1.1e-4),
        (propagation, "ASIDE", 9.0),
        (propagation, "WHOLE_STEP", 0.5),
    ],
)
def test_another_number_is_found(
    monkeypatch: pytest.MonkeyPatch, module: Any, name: str, value: Any
) -> None:
    monkeypatch.setattr(module, name, value)

    assert "core and model differ" in str(compare_maps(1, after(4)))


def _turned_back(points: Any) -> Any:
    def found(rule: Any, mean: Any, cov: Any) -> Any:
        return [[x, y, 2 * mean[2] - turn] for x, y, turn in points(rule, mean, cov)]

    return found


def _one_step_shorter(longest: Any) -> Any:
    def found(seen: Any, line: int, limits: Any) -> Any:
        fitted = longest(seen, line, limits)
        return fitted and cubic_ranges.fitted_in(seen, line, fitted.begin, fitted.end - 1)

    return found


@pytest.mark.parametrize(
    ("module", "name", "other"),
    [
        pytest.param(propagation, "rule_points", _turned_back, id="sign"),
        pytest.param(refits, "longest_range", _one_step_shorter, id="range"),
        pytest.param(
            propagation,
            "sigma_points",
            lambda points: lambda *scales: points(*scales)._replace(cov_weights=[1 / 6] * 7),
            id="weight",
        ),
        pytest.param(
            propagation,
            "margin_at",
            lambda margin: lambda P, x, y: float(np.nextafter(margin(P, x, y), math.inf)),
            id="last bit",
        ),
    ],
)
def test_another_rule_is_found(
    monkeypatch: pytest.MonkeyPatch, module: Any, name: str, other: Any
) -> None:
    monkeypatch.setattr(module, name, other(getattr(module, name)))

    assert "core and model differ" in str(compare_maps(1, after(3)))
