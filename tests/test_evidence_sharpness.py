"""The evidence of sharp lines: its true lines, its points, and what it finds."""

import numpy as np
import pytest
from evidence.harness import bounds_of, missed
from evidence.sampled_lines import TrueLine
from evidence.sharpness import Errors, add_beyond

from maplines_can import Gaussian, MapLine, Slot

STRAIGHT = TrueLine(-50.0, 100.0, lambda s: np.column_stack([s, 0 * s]), lambda x: 0 * x)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_lines_that_are_too_certain_are_found(scale: float) -> None:
    """Lines that are drawn from their Gaussian, and those of half its sigma."""
    rng, errors = np.random.default_rng(4), Errors()
    root = np.diag([0.05, 2e-3, 1e-4, 2e-6])
    for _ in range(2000):
        mean = root @ rng.standard_normal(4)
        cov = scale**2 * root @ root
        line = MapLine(Slot.EGO_LEFT, Gaussian(mean, cov), x_min=-20.0, x_max=80.0)
        errors.evaluate(line, STRAIGHT)
        errors.lines += 1
    found = errors.figures()
    assert found["ratio"] == pytest.approx(1 / scale, rel=4 / np.sqrt(2 * 2000))
    text = "\n".join(
        missed({"all closed forms": {"5 m": found}}, bounds_of("sharpness.lines", quick=True))
    )
    for words in ("beyond 3 sigma", "2nd"):
        assert (words in text) is (scale < 1)


@pytest.mark.parametrize(("radius", "beyond"), [(5.0, False), (4.0, True)])
def test_a_turn_at_the_end_is_three_sigma_if_a_car_can_drive_it(
    radius: float, beyond: bool
) -> None:
    """2 m beyond the end of a line that is known exactly; nothing where the turn leads back."""
    line = MapLine(Slot.EGO_LEFT, Gaussian(np.zeros(4), np.zeros((4, 4))), x_max=12.0)

    def turns(x: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            return np.where(x <= 12.0, 0.0, radius - np.sqrt(radius**2 - (x - 12.0) ** 2))

    pairs: dict[str, list[np.ndarray]] = {}
    add_beyond(line, TrueLine(-50.0, 17.0, lambda s: s, turns), (-20.0, 80.0), pairs)
    (start, end) = ((z / s)[1] for z, s in pairs["all ends"])
    assert start == 0.0  # it goes on straight
    assert (abs(end) > 3.2) == beyond
    assert [one.shape[1] for one in pairs["cut ends"]] == [6, 2 if beyond else 3]
