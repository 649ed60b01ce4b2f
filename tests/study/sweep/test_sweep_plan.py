"""The plan of a study: its checks, and the theory of the default code."""

import math
from typing import Any

import pytest
from support.study_helpers import small

from maplines_can.study.sets import DrawnSet
from maplines_can.study.sweep.plan import Plan, codec_of, theory
from maplines_can.values.errors import StudyError


def test_theory_has_a_term_for_each_field() -> None:
    """D^2 / 24 for a ratio of step D, (D ln 2)^2 / 12 for a pivot of D octaves."""
    terms = theory(codec_of(Plan("Cholesky")))

    assert len(terms) == 10
    assert terms["RatioC0C1"] == pytest.approx((1 / 32) ** 2 / 24)
    assert terms["PivotYOff"] == pytest.approx((0.034 * math.log(2)) ** 2 / 12)
    assert theory(codec_of(Plan("Sigmas"))) == {}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n": 0}, "n must be 1 or more"),
        ({"codes": ("Morse",)}, "there is no code 'Morse'"),
        ({"codes": ("Cholesky", "Cholesky")}, "different"),
        ({"finer_bits": (-9,)}, "Cholesky with -9 bits"),
        ({"codes": ("Float32",), "finer_bits": (1,)}, "add 0"),
        ({"sets": [DrawnSet("road"), DrawnSet("road")]}, "different names"),
        ({"sets": []}, "one or more"),
    ],
)
def test_an_invalid_study_is_refused(changes: Any, message: str) -> None:
    """The constructor raises."""
    with pytest.raises(StudyError, match=message):
        small(**changes)
