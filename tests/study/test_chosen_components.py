"""False positives of the numbers of components that are chosen by nonlinearity."""

from typing import Any

import pytest

from maplines_can import MonteCarlo
from maplines_can.propagation import Mixture, component_counts, nonlinearity
from maplines_can.simulation import scenario
from maplines_can.study.representations import (
    Approximation,
    evaluate_approximation,
    true_distribution,
)
from maplines_can.study.roads import paper_refit
from maplines_can.values.line import Slot


@pytest.mark.filterwarnings("ignore:.* draws are ill-posed")
@pytest.mark.parametrize(
    ("name", "parts", "before", "after"),
    [
        pytest.param("production", 1, 0.02, 0.02, id="production"),
        pytest.param("street-turn", 1, 0.13, 0.13, id="street-turn"),
        pytest.param("street-turn-10deg", 3, 0.14, 0.05, id="street-turn-10deg"),
        pytest.param("highway", 5, 0.43, 0.10, id="highway"),
        pytest.param("highway-10deg", 5, 0.43, 0.11, id="highway-10deg"),
    ],
)
def test_false_positives_of_the_chosen_components(
    name: str, parts: int, before: float, after: float
) -> None:
    """Where more than one component is chosen, most false positives go.

    In street-turn the nonlinearity, which is of second order, is 0.23. The far end of the line is
    80 deg from the x axis, where the third order counts, too: of beta and c1 it makes a curved arc.
    """
    example = scenario(name)
    refit = paper_refit(example, Slot.EGO_RIGHT)
    truth = true_distribution(MonteCarlo(200_000, 0).samples(refit, example.ego).values)

    def false_positives(k: Any) -> Any:
        mixture = Approximation(*Mixture(k).moments(refit, example.ego))
        return evaluate_approximation(truth, mixture, (name, str(k), "before")).false_positives

    (k,) = component_counts([nonlinearity(refit, example.ego).amount])
    assert k == parts
    assert false_positives(k) < after
    if k > 1:
        assert false_positives(1) > before
