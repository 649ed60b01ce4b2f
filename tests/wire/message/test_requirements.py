"""Requirements on the signals of a record, at their edges."""

from dataclasses import replace

import pytest

from maplines_can.errors import LayoutError
from maplines_can.wire import Layout
from maplines_can.wire.message.requirements import REQUIREMENTS, check, check_record
from maplines_can.wire.message.signals import Signal

SIGNALS = Layout.from_dbc().signals


def refusal(signal: Signal) -> str:
    """The message with which a signal is refused; empty if it meets its requirements."""
    try:
        check(signal, REQUIREMENTS[signal.name], "my.dbc")
    except LayoutError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(("bits", "accepted"), [(3, False), (4, True), (16, True)])
def test_a_counter_needs_4_bits(bits: int, accepted: bool) -> None:
    """With fewer, lost records cannot be told from late ones."""
    counter = replace(SIGNALS["Counter"], length=bits, raw_max=2**bits - 1)
    assert ("4 bits or more" not in refusal(counter)) is accepted
    assert (not refusal(counter)) is accepted


@pytest.mark.parametrize(
    ("name", "raw_min", "raw_max", "values"),
    [
        pytest.param("Status", 0, 4, "0 to 5, all values of Status", id="several-values"),
        pytest.param("ComponentIndex", 1, 7, "0", id="one-value"),
    ],
)
def test_a_refusal_names_the_values_that_the_range_must_hold(
    name: str, raw_min: int, raw_max: int, values: str
) -> None:
    """Several as first and last, one alone."""
    text = refusal(replace(SIGNALS[name], raw_min=raw_min, raw_max=raw_max))
    assert f"a range that holds {values};" in text


@pytest.mark.parametrize(
    ("factor", "offset", "raw_min", "raw_max", "accepted"),
    [
        pytest.param(0.125, 0.125, 0, 7, True, id="from-1/8-to-1"),
        pytest.param(0.125, 0.125, 1, 7, False, id="1/8-out-of-range"),
        pytest.param(0.125, 0.125, 0, 6, False, id="1-out-of-range"),
        pytest.param(0.125, 0.0, 0, 8, True, id="with-0"),
        pytest.param(0.333333333333, 0.333333333334, 0, 2, True, id="12-digits"),
        pytest.param(0.33333333333, 0.33333333334, 0, 2, False, id="11-digits"),
        pytest.param(0.333333333333, 0.0, 0, 7, False, id="not-exactly-1"),
        pytest.param(0.3, 0.1, 0, 7, False, id="not-1/n"),
        pytest.param(3.0, 1.0, 0, 7, False, id="above-1"),
    ],
)
def test_weights_are_multiples_of_1_over_n_up_to_1(
    factor: float, offset: float, raw_min: int, raw_max: int, accepted: bool
) -> None:
    """Else the weights of a mixture could not add up to 1. A DBC may round 1/n to 12 digits."""
    weight = replace(
        SIGNALS["ComponentWeight"], factor=factor, offset=offset, raw_min=raw_min, raw_max=raw_max
    )
    assert (not refusal(weight)) is accepted


@pytest.mark.parametrize(
    ("name", "start", "words"),
    [
        pytest.param("TransferId1", 63, "to lie in its page", id="from-the-page-before"),
        pytest.param("TransferId1", 64, "overlap", id="first-bits-of-the-page"),
        pytest.param("TransferId1", 124, "overlap", id="last-bits-of-the-page"),
        pytest.param("TransferId1", 125, "to lie in its page", id="into-the-page-after"),
        pytest.param("TransferId1", 186, "to lie in its page", id="in-the-page-after"),
        pytest.param("TransferId3", 186, "to lie in its page", id="in-the-page-before"),
        pytest.param("TransferId3", 192, "overlap", id="first-bits-of-the-last-page"),
    ],
)
def test_a_transfer_id_lies_in_its_page(name: str, start: int, words: str) -> None:
    """Anywhere in it, where no other signal is."""
    with pytest.raises(LayoutError, match=words):
        check_record({**SIGNALS, name: replace(SIGNALS[name], start=start)}, "my.dbc")
