"""An altered DBC gives a right result or a refusal that says what is wrong.

``tools/altered_dbc.py`` prints the table of all alterations; cantools is the witness.
"""

import re
from dataclasses import replace

import altered_dbc
import cantools
import pytest
from dbc_alterations import ORIGINALS, Original, altered, original, pose_original
from dbc_witness import WrongResultError, check_codec

from maplines_can import Codec
from maplines_can.generation.dbc.record_spec import CONDITIONAL, DEFAULT, POSE_WITH_LEVELS, SECURED
from maplines_can.study.code_dbcs import dbc_writer_for
from maplines_can.study.codes import CODES
from maplines_can.study.comparison import codec_for
from maplines_can.values.errors import LayoutError
from maplines_can.values.line import Slot
from maplines_can.wire import Layout

#: Records in a row for the fields for which it matters that a number wraps.
RECORDS = {"Line.Counter": 300, "Line.TransferId1": 40, "Line.Component": 40}
#: Fields of which each has the same bounds as one before it.
SAME = re.compile(
    r".*(Right|TransferId[2-9]|Ratio(?!C0C1|AcrossAlong)|Pivot(?!C1|Along))"
    r"|Conditional\.(Crc|Counter|YOff|Beta|C0|Pivot.*|Inflation)|Pose\.Crc"
    r"|Scene\.(Crc|Counter|Age|Map.*|Inflation|Line1(Beta|C0|OwnPoints))"
)
FIELDS = [field for field in altered_dbc.fields() if not SAME.match(field)]


@pytest.mark.parametrize("field", FIELDS)
def test_an_altered_dbc_gives_a_right_result_or_a_refusal(field: str) -> None:
    """Each alteration of a field. With those of counters, many records are sent in a row.

    A signal of others is ignored, and sent as 0: in a page, in one message only, in the padding.
    """
    records = next((n for name, n in RECORDS.items() if field.startswith(name)), 0)
    found = list(altered_dbc.outcomes(field, records, lines=16))
    assert [(o.name, o.text) for o in found if o.result == "wrong"] == []
    assert {o.result for o in found} == {"right", "refused"}
    foreign = {o.name: o.result for o in found if o.name.startswith("foreign signal")}
    assert foreign.pop("foreign signal over another", "refused") == "refused"
    assert set(foreign.values()) <= {"right"}


def test_all_fields_are_altered() -> None:
    """With the kind of their record, since some have the names of others."""
    fields = altered_dbc.fields()
    assert {"Line.Age", "Secured.Mac", "Pose.PivotAlong", "Conditional.XMin"} <= {*fields}
    assert {"Scene.SceneCounter", "Scene.Line1OwnTilt", "messages"} <= {*fields}
    assert len(fields) == len(set(fields)) > 90 > len(FIELDS) > 50


# ---- the witness -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "field"),
    [
        ("Line", "YOff"),
        ("Pose", "MapOffset"),
        ("Conditional", "C1"),
        ("Scene", "Age"),
        ("Scene", "Line1YOff"),
    ],
)
def test_the_witness_notices_another_factor(kind: str, field: str) -> None:
    """The DBC that cantools reads differs from that of the codec."""
    own = ORIGINALS[kind]
    codec = Codec(Layout.from_dbc(own.database))
    check_codec(codec, own.database, records=2, n=16)
    with altered(own, field, "factor x 2"), pytest.raises(WrongResultError, match=field):
        check_codec(codec, own.database, records=2, n=16)


# ---- refusals --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pattern", "replacement", "needs"),
    [
        pytest.param(r"(Status .*: \d+)\|3@1", r"\1|2@1", "3 to 53 bits", id="status-of-2-bits"),
        pytest.param(r"(Age .*)\"ms\"", r'\1"s"', 'the unit "ms"', id="age-in-seconds"),
        pytest.param(r"(PivotC1 .*)\(0.054,-32\)", r"\1(-0.054,-4)", "positive", id="pivot"),
        pytest.param(
            r'BA_ "E2EDataId" (BO_ \d+) \d+', r'BA_ "E2EDataId" \1 7',
            "EGO_LEFT and slot EGO_RIGHT have the same E2EDataId", id="data-id",
        ),
        pytest.param(
            r'BA_ "SecOCDataId" (BO_ \d+) \d+', r'BA_ "SecOCDataId" \1 7',
            "EGO_LEFT and slot EGO_RIGHT have the same SecOCDataId", id="secoc-data-id",
        ),
    ],
)  # fmt: skip
def test_the_refusal_says_where_what_and_the_cure(
    pattern: str, replacement: str, needs: str
) -> None:
    """It names the file and the signal, what it has, what it needs and what to change."""
    text, found = re.subn(pattern, replacement, original())
    assert found
    with pytest.raises(LayoutError) as error:
        Codec(Layout.from_text(text, "my.dbc"))
    assert str(error.value).startswith("my.dbc: ")
    assert needs in str(error.value)
    assert ";" in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('BA_ "MapLinePose" BO_ 860 1;', 'BA_ "MapLinePose" BO_ 860 2;', "MapLinePose must be"),
        ('BA_ "E2EDataId" BO_ 860 19804;', 'BA_ "E2EDataId" BO_ 860 7;', "pose error: its messag"),
        (
            'BA_ "MapLinePose" BO_ 860 1;',
            'BA_ "MapLinePose" BO_ 860 1;\nBA_ "MapLineSlot" BO_ 860 3;',
            "MapLineSlot and MapLinePose",
        ),
        ("BO_ 861 PoseFd: 48", "BO_ 861 PoseFd: 32", "PoseFd"),
        (" EgoRightCounter ", " EgoRightCounterX ", "there is no signal 'EgoRightCounter'"),
        (" EgoRightOwnPoints ", " EgoRightOwnPoint ", "there is no signal 'EgoRightOwnPoints'"),
    ],
)
def test_a_wrong_message_of_the_pose_error_is_refused(old: str, new: str, words: str) -> None:
    """The refusal says what is wrong."""
    assert old in pose_original()
    with pytest.raises(LayoutError, match=words):
        Layout.from_text(pose_original().replace(old, new))


@pytest.mark.parametrize("name", ["EdgeRightOwnPoints", "EdgeRightCounter", "RouteFitAhead"])
def test_a_pose_error_has_all_signals_of_a_slot_or_none(name: str) -> None:
    """Also of a slot without messages; the refusal names the signal that is missing."""
    own = Original(replace(DEFAULT, slots=(Slot.EGO_LEFT,)), "Pose(Fd)?")
    with altered(own, name, "renamed"), pytest.raises(LayoutError, match=f"no signal '{name}'"):
        Layout.from_dbc(own.database)


def test_a_pose_error_may_leave_out_slots_without_messages() -> None:
    """All signals of a slot, in all frame formats: then scenes of the others arrive."""
    titles = ("NextLeft", "NextRight", "Centre", "EdgeLeft", "EdgeRight", "Route")
    pages = tuple(
        tuple(spec for spec in page if not spec.name.startswith(titles))
        for page in POSE_WITH_LEVELS.pages
    )
    pose = replace(POSE_WITH_LEVELS, pages=pages)
    database = replace(DEFAULT, slots=(Slot.EGO_LEFT, Slot.EGO_RIGHT), pose=pose).database()
    check_codec(Codec(Layout.from_dbc(database)), database)


def test_conditional_records_need_a_pose_error_without_levels() -> None:
    """Their records have the levels; those of the pose error would be filled in by nobody."""
    writer = replace(CONDITIONAL, slots=(Slot.EGO_LEFT,))
    with pytest.raises(LayoutError, match=r"signal EgoLeftFitAhead is .*; remove it here"):
        Layout.from_dbc(replace(writer, pose=POSE_WITH_LEVELS).database())
    with pytest.raises(LayoutError, match="need a message of the pose error"):
        Layout.from_dbc(replace(writer, pose=None).database())


# ---- DBCs that are accepted ------------------------------------------------------------------


@pytest.mark.parametrize("code", CODES)
def test_the_dbc_of_each_code_is_accepted(code: str) -> None:
    """Also with finer steps, as ``maplines study`` makes them. It has no pose error."""
    for finer in (0,) if code in ("Float16", "Float32", "MeanOnly") else (-1, 0, 2):
        layout = Layout.from_dbc(replace(dbc_writer_for(code, finer), pose=None).database())
        assert (layout.pose, layout.short_pages) == (None, layout.pages)
        codec_for(layout)


def test_a_database_that_cantools_did_not_check_is_checked() -> None:
    """Loaded with ``strict=False``, two signals may overlap."""
    text = SECURED.dbc().replace("Kind m0 : 59|3@1", "Kind m0 : 58|3@1")
    text = text.replace("Kind : 59|3@1", "Kind : 58|3@1")
    database = cantools.database.load_string(text, "dbc", strict=False)
    with pytest.raises(LayoutError, match="the cantools database: signals Status and Kind overlap"):
        Codec.from_dbc(database)  # type: ignore[arg-type]
