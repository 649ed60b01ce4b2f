"""Requirements on the signals of a record, at their edges."""

from dataclasses import replace
from typing import Any

import pytest
from scene_layouts import layout_of, pose_layout_of

from maplines_can.values.errors import LayoutError
from maplines_can.values.line import Slot
from maplines_can.wire import Layout
from maplines_can.wire.layout.requirements import REQUIREMENTS, check, check_record
from maplines_can.wire.layout.signals import Signal

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


POSE = pose_layout_of("maplines-pose.dbc").signals
LEVELS = Layout.from_dbc().pose.signals  # type: ignore[union-attr]
#: Those of one slot.
ONE_SLOT = {name: s for name, s in LEVELS.items() if "Own" not in name or "Route" in name}
CONDITIONAL = layout_of("maplines-pose.dbc").signals


@pytest.mark.parametrize(
    ("signals", "name", "change", "words"),
    [
        # numbers that are sent unchanged
        pytest.param(SIGNALS, "Crc", {"length": 15, "raw_max": 2**15 - 1}, "16 bits", id="crc-15"),
        pytest.param(SIGNALS, "Crc", {"big_endian": True, "start": 7}, "Intel", id="crc-motorola"),
        pytest.param(SIGNALS, "Crc", {"start": 1}, "a byte boundary", id="crc-at-bit-1"),
        pytest.param(SIGNALS, "Crc", {"raw_max": 65534}, "the range of all its", id="crc-range"),
        pytest.param(SIGNALS, "Kind", {"raw_max": 6}, "holds 0 to 7", id="kind-to-6"),
        pytest.param(SIGNALS, "Status", {"raw_max": 5}, "", id="status-to-5"),
        pytest.param(SIGNALS, "Status", {"raw_min": 1}, "holds 0 to 5", id="status-from-1"),
        pytest.param(SIGNALS, "ComponentIndex", {"factor": 2.0}, "factor 1 and", id="index-factor"),
        pytest.param(SIGNALS, "ComponentCount", {"offset": 0.5}, "whole offset", id="count-offset"),
        pytest.param(SIGNALS, "ComponentCount", {"factor": 2.0}, "factor 1 and", id="count-factor"),
        pytest.param(SIGNALS, "ComponentCount", {"raw_min": 1}, "holds 1;", id="count-from-2"),
        pytest.param(CONDITIONAL, "HasCovariance", {"raw_max": 0}, "holds 0 to 1", id="flag"),
        # quantities
        pytest.param(SIGNALS, "YOff", {"length": 53}, "overlap", id="53-bits"),
        pytest.param(SIGNALS, "YOff", {"length": 54}, "at most 53 bits", id="54-bits"),
        pytest.param(SIGNALS, "C1", {"factor": 1e-30}, "", id="least-factor"),
        pytest.param(SIGNALS, "C1", {"factor": 9.9e-31}, "other than 0", id="less-than-least"),
        pytest.param(SIGNALS, "C1", {"factor": -1e-30}, "", id="least-negative-factor"),
        pytest.param(SIGNALS, "YOff", {"offset": 1e30}, "", id="farthest"),
        pytest.param(SIGNALS, "YOff", {"offset": -1.01e30}, "values up to", id="beyond"),
        pytest.param(SIGNALS, "YOff", {"raw_min": 5, "raw_max": 5}, "", id="one-value"),
        pytest.param(SIGNALS, "YOff", {"raw_min": 6, "raw_max": 5}, "contains a val", id="none"),
        pytest.param(SIGNALS, "YOff", {"unit": ""}, "", id="no-unit"),
        pytest.param(SIGNALS, "YOff", {"unit": "cm"}, 'the unit "m"', id="centimetres"),
        pytest.param(SIGNALS, "ComponentWeight", {"unit": "-"}, "", id="dimensionless"),
        pytest.param(SIGNALS, "Age", {"offset": -1.0}, "0 ms or more", id="age-from-minus-1"),
        pytest.param(SIGNALS, "Age", {"raw_min": 29}, "", id="three-ages"),
        pytest.param(SIGNALS, "Age", {"raw_min": 30}, "at least three values", id="two-ages"),
        # levels, also those of each slot in the pose error
        pytest.param(POSE, "MapOffset", {"raw_min": 1}, "raw values 0 and 1", id="level-from-1"),
        pytest.param(POSE, "MapOffset", {"raw_max": 0}, "raw values 0 and 1", id="level-to-0"),
        pytest.param(POSE, "MapOffset", {"raw_max": 1}, "", id="level-to-1"),
        pytest.param(ONE_SLOT, "RouteOwnLateral", {"signed": True}, "unsigned", id="slot-level"),
        pytest.param(ONE_SLOT, "RouteOwnLateral", {"offset": -200.0}, "", id="octave-200"),
        pytest.param(ONE_SLOT, "RouteOwnLateral", {"offset": -201.0}, "-200 to 200", id="201"),
        pytest.param(CONDITIONAL, "OwnShape", {"offset": -10.0}, "", id="spacing-10"),
        pytest.param(CONDITIONAL, "OwnShape", {"offset": -10.01}, r"2\^-10 to 2\^10", id="10.01"),
        pytest.param(
            CONDITIONAL, "OwnShape", {"factor": 1.0, "offset": -200.0}, "distances f", id="reach"
        ),
        pytest.param(CONDITIONAL, "OwnShape", {"offset": 3.625}, "", id="to-10"),
        pytest.param(CONDITIONAL, "OwnShape", {"offset": 3.63}, "distances fr", id="to-10.005"),
        pytest.param(CONDITIONAL, "OwnShape", {"unit": ""}, 'unit "octave"', id="some-spacing"),
        pytest.param(ONE_SLOT, "RouteOwnShape", {"offset": 2.0**-10}, "", id="spacing-from-1024th"),
        pytest.param(ONE_SLOT, "RouteOwnShape", {"offset": 2.0**-11}, "distances", id="2048th"),
        pytest.param(ONE_SLOT, "RouteOwnShape", {"offset": 0.0}, "distances", id="spacing-0"),
        pytest.param(ONE_SLOT, "RouteOwnShape", {"factor": 4.0}, "", id="spacing-to-1020"),
        pytest.param(ONE_SLOT, "RouteOwnShape", {"factor": 4.1}, "distances", id="spacing-to-1045"),
        pytest.param(ONE_SLOT, "RouteOwnShape", {"unit": "octave"}, "", id="spacing-in-octaves"),
        pytest.param(ONE_SLOT, "RouteOwnShape", {"unit": "m"}, 'unit "octave"', id="spacing-in-m"),
        pytest.param(LEVELS, "RouteOwnShape", {"factor": 0.01}, "for all slots", id="one-slot"),
        pytest.param(LEVELS, "EgoLeftQuartic", {"offset": 0.01}, "for all slots", id="first-slot"),
        # finer parts of the mean
        pytest.param(
            CONDITIONAL,
            "YOffFine",
            {"signed": False, "raw_min": 0, "raw_max": 7},
            "",
            id="one-step-from-0",
        ),
        pytest.param(CONDITIONAL, "YOffFine", {"raw_min": -3}, "one step of YOff", id="7-eighths"),
        pytest.param(CONDITIONAL, "BetaFine", {"factor": 2.0**-15}, "one step of Beta", id="two"),
        pytest.param(CONDITIONAL, "C0", {"factor": 2.0**-16}, "one step of C0", id="half-a-step"),
        pytest.param(CONDITIONAL, "C1", {"factor": -(2.0**-20)}, "", id="mean-of-negative-factor"),
        pytest.param(
            CONDITIONAL, "C1Fine", {"factor": -(2.0**-24)}, "positive", id="negative-fine"
        ),
        pytest.param(CONDITIONAL, "YOffFine", {"offset": 100.0}, "holds 0", id="fine-beyond-0"),
        pytest.param(
            CONDITIONAL,
            "C1Fine",
            {"length": 36, "factor": 2.0**-56, "raw_min": -(2**35), "raw_max": 2**35 - 1},
            "overlap",
            id="53-bits-together",
        ),
        pytest.param(
            CONDITIONAL,
            "C1Fine",
            {"length": 37, "factor": 2.0**-57, "raw_min": -(2**36), "raw_max": 2**36 - 1},
            "at most 53 bits together",
            id="54-bits-together",
        ),
        pytest.param(
            {**POSE, "YOffFine": replace(CONDITIONAL["YOffFine"], start=120)},
            "YOffFine",
            {},
            "overlap",
            id="fine-without-a-mean",
        ),
        pytest.param(CONDITIONAL, "C1Fine", {"unit": "1/m"}, r'unit "1/m\^2"', id="unit-of-fine"),
        # counters of slots
        pytest.param(POSE, "RouteCounter", {"length": 2, "raw_max": 3}, "3 bits or", id="2-bits"),
        pytest.param(POSE, "RouteCounter", {"raw_max": 6}, "the range of all", id="counter-to-6"),
        # several signals together
        pytest.param(SIGNALS, "Page0", {"raw_max": 2}, "number all pages", id="pages-to-2"),
        pytest.param(SIGNALS, "Page2", {"length": 1, "raw_max": 1}, "same bits", id="short-page"),
        pytest.param(SIGNALS, "Page1", {"start": 190}, "same bits in each page", id="page-of-2"),
        pytest.param(SIGNALS, "TransferId3", {"length": 3, "raw_max": 7}, "same len", id="ids"),
        pytest.param(
            SIGNALS, "Counter", {"length": 4, "raw_max": 15}, "", id="counter-as-transfer-id"
        ),
        pytest.param(SIGNALS, "ComponentIndex", {"raw_max": 6}, "ComponentCount minus", id="6"),
        pytest.param(SIGNALS, "XMax", {"raw_max": 0, "offset": -20.0}, "no valid r", id="x-equal"),
        pytest.param(SIGNALS, "XMax", {"raw_max": 0, "offset": -19.0}, "", id="x-above"),
        # places
        pytest.param(SIGNALS, "Inflation", {"start": 254}, "within|must lie in", id="beyond-end"),
        pytest.param(SIGNALS, "Inflation", {"start": 248}, "overlap", id="over-another"),
    ],
)
def test_a_signal_of_a_record_at_the_edge(
    signals: Any, name: str, change: dict[str, Any], words: str
) -> None:
    """Accepted at the edge, and refused with the reason one beyond it."""
    record = {**signals, name: replace(signals[name], **change)}
    if words:
        with pytest.raises(LayoutError, match=words):
            check_record(record, "my.dbc")
    else:
        check_record(record, "my.dbc")


@pytest.mark.parametrize(("steps", "accepted"), [(7, False), (8, True)])
def test_each_component_needs_a_step_of_weight(steps: int, accepted: bool) -> None:
    """Eight components of a seventh do not add up to 1."""
    factor = round(1 / steps, 12)
    weight = replace(
        SIGNALS["ComponentWeight"], factor=factor, offset=1 - factor * (steps - 1),
        raw_max=steps - 1,
    )  # fmt: skip
    assert not refusal(weight)
    record = {**SIGNALS, "ComponentWeight": weight}
    if accepted:
        check_record(record, "my.dbc")
    else:
        with pytest.raises(LayoutError, match="at least as many steps as the greatest"):
            check_record(record, "my.dbc")


@pytest.mark.parametrize(("bits", "accepted"), [(16, False), (24, True), (56, True)])
def test_a_freshness_value_has_3_bytes_or_more(bits: int, accepted: bool) -> None:
    freshness = Signal("Freshness", 0, bits, False, False, 1.0, 0.0, "us", 0, 2**bits - 1)
    assert ("3 bytes or more" not in refusal(freshness)) is accepted


@pytest.mark.parametrize(("bits", "accepted"), [(2, False), (3, True), (4, True)])
def test_a_counter_of_a_slot_is_no_longer_than_that_of_its_records(
    bits: int, accepted: bool
) -> None:
    """Its low bits are what the pose error states; here it has 3."""
    pose = pose_layout_of("maplines-pose.dbc")
    counters = {Slot.ROUTE: replace(SIGNALS["Counter"], length=bits)}
    if accepted:
        pose.check_slots(counters, levels=False)
    else:
        with pytest.raises(LayoutError, match=r"RouteCounter .* at most 2 bits"):
            pose.check_slots(counters, levels=False)
    with pytest.raises(LayoutError, match="EgoLeftOwnLateral"):
        pose.check_slots(counters, levels=True)


def test_a_record_of_the_pose_error_without_one_of_its_pages_is_refused() -> None:
    """Pages 0 and 2 are not a record; neither is one without pages."""
    pose = pose_layout_of("maplines-pose.dbc")
    later = {"Page1": "Page2", "TransferId1": "TransferId2"}
    signals = {later.get(name, name): signal for name, signal in pose.signals.items()}
    with pytest.raises(LayoutError, match=r"numbered 0, 1, ..., got \[0, 2\]"):
        replace(pose, signals=signals)
    with pytest.raises(LayoutError, match=r"numbered 0, 1, ..., got \[\]"):
        replace(pose, signals={n: s for n, s in signals.items() if not n.startswith("Page")})
