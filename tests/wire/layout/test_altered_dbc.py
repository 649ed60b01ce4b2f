"""Item 2 of the assessment: an altered DBC gives a right result or a refusal.

``tools/altered_dbc.py`` prints the table of all alterations; cantools is the witness.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import altered_dbc
import cantools
import numpy as np
import pytest
from dbc_alterations import fields, original
from dbc_witness import WrongResultError, check_line

from maplines_can import Codec, Gaussian, GaussianMixture
from maplines_can.study.codes import CODES
from maplines_can.study.dbc.record_spec import SECURED, dbc_writer_for
from maplines_can.values.errors import LayoutError
from maplines_can.values.line import Kind, MapLine, Slot, Status
from maplines_can.wire import Layout

ROOT = Path(__file__).parents[3]
#: Records in a row for the fields for which it matters that a number wraps: all numbers of the
#: counter, and those of the transfer ID, which has 4 bits, twice.
RECORDS = {"Counter": 300, "TransferId": 300, "Page": 40, "Component": 40}


@pytest.mark.parametrize("field", [altered_dbc.MESSAGES, *fields()])
def test_an_altered_dbc_gives_a_right_result_or_a_refusal(field: str) -> None:
    """Each alteration of a field. With those of counters, many records are sent in a row."""
    records = next((n for name, n in RECORDS.items() if field.startswith(name)), 0)
    outcomes = [
        altered_dbc.outcome(alteration, records, lines=16)
        for alteration in altered_dbc.alterations_of(field)
    ]
    wrong = [(o.alteration.name, o.text) for o in outcomes if o.result == "wrong"]
    assert not wrong
    assert {o.result for o in outcomes} == {"right", "refused"}


GIVEN = MapLine(Slot.EGO_LEFT, Gaussian(np.zeros(4), 1e-2 * np.eye(4)), age=0.04)
MEAN_ONLY = MapLine.mean_only(Slot.EGO_LEFT, np.zeros(4), age=0.04)
MIXTURE = MapLine.of_mixture(
    Slot.EGO_LEFT, GaussianMixture(np.full(2, 0.5), (GIVEN.gaussian,) * 2), age=0.04
)


@pytest.mark.parametrize(
    ("given", "change", "words"),
    [
        pytest.param(GIVEN, {"slot": Slot.ROUTE}, "ROUTE", id="slot"),
        pytest.param(GIVEN, {"kind": Kind.KERB}, "KERB", id="kind"),
        pytest.param(GIVEN, {"age": 0.032}, "age", id="too-young"),
        pytest.param(GIVEN, {"age": 0.056}, "age", id="older-than-a-step"),
        pytest.param(GIVEN, {"age": np.inf}, "age", id="too-old-without-need"),
        pytest.param(GIVEN, {"status": Status.UNKNOWN}, "status is UNKNOWN", id="unknown"),
        pytest.param(GIVEN, {"status": Status.DIAGONAL}, "status is DIAGONAL", id="diagonal"),
        pytest.param(
            MEAN_ONLY, {"status": Status.OUT_OF_RANGE}, "OUT_OF_RANGE", id="out-of-range-but-fits"
        ),
        pytest.param(
            replace(GIVEN, status=Status.OUT_OF_RANGE), {"status": Status.FULL}, "FULL",
            id="out-of-range-unnoticed",
        ),
        pytest.param(GIVEN, {"x_max": 80.5}, "range", id="longer-range"),
        pytest.param(GIVEN, {"x_min": -0.5}, "range", id="earlier-range"),
        pytest.param(MIXTURE, {"mixture": None}, "2 components", id="mixture-as-a-gaussian"),
        pytest.param(
            GIVEN, {"gaussian": Gaussian(np.zeros(4), 0.99e-2 * np.eye(4))}, "overconfident",
            id="overconfident",
        ),
        pytest.param(
            MEAN_ONLY, {"gaussian": Gaussian(np.full(4, 0.1), np.eye(4))}, "mean is off", id="mean"
        ),
    ],
)  # fmt: skip
def test_the_witness_notices_a_wrong_line(given: MapLine, change: Any, words: str) -> None:
    """Of a line as it was sent, one property is changed."""
    codec = Codec.from_dbc()
    if given.status is not Status.OUT_OF_RANGE:
        check_line(codec, given, given)
    with pytest.raises(WrongResultError, match=words):
        check_line(codec, given, replace(given, **change))


def refusal(*edits: tuple[str, str]) -> str:
    """The message with which the original with these edits is refused."""
    text = original()
    for pattern, replacement in edits:
        text, found = re.subn(pattern, replacement, text)
        assert found, pattern
    with pytest.raises(LayoutError) as error:
        Codec(Layout.from_text(text, "my.dbc"))
    return str(error.value)


@pytest.mark.parametrize(
    ("edit", "needs"),
    [
        pytest.param((r"(Status .*: \d+)\|3@1", r"\1|2@1"), "holds 0 to 5", id="status-of-2-bits"),
        pytest.param((r"(Status .*\|3@1)\+", r"\1-"), "an unsigned type", id="status-signed"),
        pytest.param((r"(XMin .*)\(4,-20\)", r"\1(-4,8)"), "positive factor", id="x-min-negative"),
        pytest.param((r"(XMax .*)\(4,0\)", r"\1(-4,124)"), "positive factor", id="x-max-negative"),
        pytest.param((r"(Age .*)\(8,0\)", r"\1(-8,248)"), "a positive factor", id="age-negative"),
        pytest.param((r"(Age .*)\"ms\"", r'\1"s"'), 'the unit "ms"', id="age-in-seconds"),
        pytest.param((r"(Beta .*)\"rad\"", r'\1"deg"'), 'the unit "rad"', id="beta-in-degrees"),
        pytest.param((r"(Kind .*)\(1,0\)", r"\1(1,1)"), "factor 1 and offset 0", id="kind-offset"),
        pytest.param((r"(Kind .*)\(1,0\)", r"\1(-1,7)"), "factor 1 and offset 0", id="kind-factor"),
        pytest.param((r"(Counter .*\|8@1)\+", r"\1-"), "an unsigned type", id="counter-signed"),
        pytest.param((r"(Counter .*)\[0\|255\]", r"\1[0|14]"), "range of all", id="counter-range"),
        pytest.param((r"(TransferId2 .*\|)4@1", r"\g<1>3@1"), "the same length", id="transfer-3"),
        pytest.param((r"(TransferId2 .*\|4@1)\+", r"\1-"), "unsigned", id="transfer-signed"),
        pytest.param((r"(Crc .*\|16@1)\+", r"\1-"), "an unsigned type", id="crc-signed"),
        pytest.param((r"(Page\d? .*)\(1,0\)", r"\1(1,1)"), "offset 0", id="page-offset"),
        pytest.param((r"(YOff .*)\(0.0009765625,0\)", r"\1(0,0)"), "other than 0", id="factor-0"),
        pytest.param((r"(YOff .*)\[[^]]*\]", r"\1[5|-5]"), "[min|max]", id="min-above-max"),
        pytest.param(
            (r"(XMax .*)\(4,0\) \[[^]]*\]", r"\1(4,-400) [0|0]"), "no valid range", id="x-max-low"
        ),
        pytest.param((r"(PivotC1 .*)\(0.054,-32\)", r"\1(-0.054,-4)"), "positive", id="pivot"),
        pytest.param(
            (r'BA_ "E2EDataId" (BO_ \d+) \d+', r'BA_ "E2EDataId" \1 7'),
            "EGO_LEFT and slot EGO_RIGHT have the same E2EDataId", id="data-id",
        ),
        pytest.param(
            (r'BA_ "SecOCDataId" (BO_ \d+) \d+', r'BA_ "SecOCDataId" \1 7'),
            "EGO_LEFT and slot EGO_RIGHT have the same SecOCDataId", id="secoc-data-id",
        ),
    ],
)  # fmt: skip
def test_the_refusal_says_where_what_and_the_cure(edit: tuple[str, str], needs: str) -> None:
    """It names the file and the signal, what it has, what it needs and what to change."""
    text = refusal(edit)
    assert text.startswith("my.dbc: ")
    assert needs in text
    assert ";" in text


@pytest.mark.parametrize("name", ["YOff", "Age", "XMax"])
@pytest.mark.parametrize("length", [32, 64])
def test_no_signal_is_a_float(name: str, length: int) -> None:
    """SIG_VALTYPE_ 1 or 2, whatever the length."""
    layout = Layout.from_text(dbc_writer_for("Cholesky").dbc())
    signal = replace(layout[name], is_float=True, length=length, start=256, factor=1.0, offset=0.0)
    with pytest.raises(LayoutError, match=rf"{name} is .*\(float{length}\).*an integer type"):
        replace(layout, signals={**layout.signals, name: signal})


@pytest.mark.parametrize("code", CODES)
def test_the_dbc_of_each_code_is_accepted(code: str) -> None:
    """Also with finer steps, as ``maplines study`` makes them."""
    for finer in (0,) if code in ("Float16", "Float32", "MeanOnly") else (-1, 0, 2):
        Codec(Layout.from_text(dbc_writer_for(code, finer).dbc()), codes=CODES)


def test_from_dbc_takes_a_loaded_database() -> None:
    """Item 3: ``Codec.from_dbc(database)`` gives the frames of the file."""
    path = ROOT / "dbc" / "maplines.dbc"
    codec = Codec.from_dbc(cantools.database.load_file(path))  # type: ignore[arg-type]
    assert codec.layout.signals == Layout.from_dbc(path).signals
    assert codec.layout.messages == Layout.from_dbc(path).messages
    assert "the cantools database" in repr(codec)


def test_a_database_that_cantools_did_not_check_is_checked() -> None:
    """Loaded with ``strict=False``, two signals may overlap."""
    text = SECURED.dbc().replace("Kind m0 : 59|3@1", "Kind m0 : 58|3@1")
    text = text.replace("Kind : 59|3@1", "Kind : 58|3@1")
    database = cantools.database.load_string(text, "dbc", strict=False)
    with pytest.raises(LayoutError, match="the cantools database: signals Status and Kind overlap"):
        Codec.from_dbc(database)  # type: ignore[arg-type]


@pytest.mark.parametrize("given", [7, b"maplines.dbc", object()])
def test_from_dbc_refuses_what_is_no_dbc(given: object) -> None:
    """The message names what it takes."""
    with pytest.raises(TypeError, match="a path, or a Database that cantools has loaded"):
        Codec.from_dbc(given)  # type: ignore[arg-type]


def test_foreign_signals_are_ignored() -> None:
    """A signal of others in one message, and one in the padding: they are sent as 0."""
    outcomes = {
        alteration.name: altered_dbc.outcome(alteration, records=0).result
        for alteration in altered_dbc.alterations_of(altered_dbc.MESSAGES)
        if alteration.name.startswith("foreign")
    }
    assert outcomes.pop("foreign signal over another") == "refused"
    assert set(outcomes.values()) == {"right"}


def test_each_slot_is_checked_on_its_own() -> None:
    """Data IDs that differ are accepted, in any order."""
    layout = Layout.from_dbc()
    swapped = {
        slot: replace(messages, data_id=layout.messages[Slot(7 - slot)].data_id)
        for slot, messages in layout.messages.items()
    }
    assert replace(layout, messages=swapped).messages == swapped
    left = layout.messages[Slot.EGO_LEFT]
    clash = {**layout.messages, Slot.EGO_LEFT: replace(left, can_id=0x341)}
    with pytest.raises(LayoutError, match="have the same CAN ID, 833"):
        replace(layout, messages=clash)
