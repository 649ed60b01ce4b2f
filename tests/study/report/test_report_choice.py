"""Which code the report recommends, computed from the tables."""

import math
from typing import Any

import pytest

from maplines_can.study.report.page import choices
from maplines_can.study.report.results import Tables


def row(code: str, frames: int, kl: float, **more: Any) -> dict[str, Any]:
    """Return what the choice reads of a row of the summary."""
    return {
        "set": "road",
        "code": code,
        "finer_bits": 0,
        "classic_frames": frames,
        "covariance_bits": 25 * frames,
        "not_positive_definite": 0.0,
        "overconfident": 0.0,
        "definite_guarantee": False,
        "covering_guarantee": False,
        "kl_p99": kl,
    } | more


def chosen(*rows: dict[str, Any]) -> list[tuple[str, str]]:
    tables = Tables(list(rows), [], [], [], [])
    return [(choice.advice, choice.reason) for choice in choices(tables)]


def test_item_12_the_least_kl_of_the_valid_codes_is_chosen() -> None:
    """A code that is overconfident is not valid, however small its KL; the reason names both."""
    ((advice, reason),) = chosen(
        row("Good", 4, 0.01, definite_guarantee=True, covering_guarantee=True),
        row("Wide", 4, 3.0),
        row("Narrow", 4, 1e-9, overconfident=0.25),
        row("Broken", 4, 1e-9, not_positive_definite=0.5),
        row("Nothing", 4, 40.0, covariance_bits=0),
    )
    assert advice == "For 4 classic CAN frames choose Good: 100 bits for the covariance."
    assert "by construction" in reason
    assert "a KL up to 0.01 nat, as if all four standard deviations were 5.2 % too large" in reason
    assert "the least of the valid codes: 3 nat with Wide." in reason
    assert "Narrow is overconfident for up to 25 % of the Gaussians" in reason
    assert "Broken is not positive definite for up to 50 % of the Gaussians" in reason
    assert "Nothing sends no covariance" in reason


def test_item_12_the_worst_set_decides() -> None:
    """A code that is valid on one set only is not chosen, nor one that is better on one set."""
    ((advice, _),) = chosen(
        row("Even", 4, 0.02),
        row("Even", 4, 0.02, set="paper"),
        row("Uneven", 4, 0.001),
        row("Uneven", 4, 0.5, set="paper"),
        row("Invalid", 4, 0.001),
        row("Invalid", 4, 0.001, set="paper", overconfident=1e-4),
        row("Missing", 4, 0.0001),
    )
    assert advice.startswith("For 4 classic CAN frames choose Even:")


def test_item_12_there_is_a_choice_where_it_changes() -> None:
    """None where no code is valid; more frames only if they improve the KL."""
    advice = [
        text
        for text, _ in chosen(
            row("Bad", 1, 1.0, overconfident=0.1),
            row("Good", 4, 0.01),
            row("Good", 5, 0.001, finer_bits=2),
            row("Late", 6, 0.1),
        )
    ]
    assert advice == [
        "For 1 classic CAN frame choose none.",
        "For 4 classic CAN frames choose Good: 100 bits for the covariance.",
        "For 5 classic CAN frames choose Good with 2 bits more in each field: 125 bits for the "
        "covariance.",
    ]


@pytest.mark.parametrize("kl", [math.nan, math.inf])
def test_a_kl_that_is_not_finite_is_the_worst(kl: float) -> None:
    ((advice, _),) = chosen(row("Endless", 4, kl), row("Good", 4, 9.0))
    assert "choose Good" in advice
