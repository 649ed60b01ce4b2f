"""DBCs that are not those of the project: read as they are, or rejected with the reason."""

from pathlib import Path
from typing import Any

import cantools
import pytest
from dbc_alterations import original
from support.dbcs import edited, edited_text

from maplines_can.values.errors import LayoutError
from maplines_can.values.line import Slot
from maplines_can.wire import Codec, Layout


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        pytest.param((r'BA_ "MapLineSlot" .*\n', ""), "MapLineSlot", id="no-slots"),
        pytest.param((r'BA_ "E2EDataId" BO_ 832 \d+', 'BA_ "E2EDataId" BO_ 832 1'),
                     "E2EDataId", id="data-id"),
        pytest.param((r"(RatioBetaC0[^(]*)\(0.0390625,0\) \[[^]]*\]", r"\1(64,0) [-1e6|1e6]"),
                     "double precision", id="ratio-too-wide"),
        pytest.param((r'1 "FULL" 2 "DIAGONAL"', '1 "DIAGONAL" 2 "FULL"'),
                     "value 1 the name DIAGONAL, which belongs to the value 2", id="swapped-names"),
    ],
)  # fmt: skip
def test_an_unsuitable_dbc_is_rejected_with_the_reason(
    tmp_path: Path, edit: Any, words: str
) -> None:
    """The message names the file and what is wrong."""
    path = edited(tmp_path, edit)
    with pytest.raises(LayoutError, match=words) as error:
        Codec.from_dbc(path)
    assert "edited.dbc" in str(error.value)


@pytest.mark.parametrize(
    ("kind", "value"),
    [("FLOAT 0 65535", "19776.5"), ("STRING", '"left"')],
    ids=["fraction", "text"],
)
def test_a_data_id_that_is_no_whole_number_is_rejected(
    tmp_path: Path, kind: str, value: str
) -> None:
    """It is neither rounded nor replaced by another number."""
    path = edited(
        tmp_path,
        (r'("E2EDataId") INT 0 65535', rf"\1 {kind}"),
        (r'("E2EDataId") 0;', r'\1 "0";' if kind == "STRING" else r"\1 0;"),
        (r'("E2EDataId" BO_ (832|840)) \d+', rf"\1 {value}"),
        (r'("E2EDataId" BO_ (?!832|840)\d+) (\d+)', r'\1 "\2"' if kind == "STRING" else r"\1 \2"),
    )
    with pytest.raises(LayoutError, match=r"EgoLeft: E2EDataId must be a whole number from 0 to"):
        Codec.from_dbc(path)


#: A DBC of two slots: five pages, a CAN FD message with padding, and an authenticated one.
ORIGINAL = original()


def of_message(number: int, pattern: str, replacement: str) -> tuple[str, str]:
    """An edit within the signals of one message only."""
    return rf"(BO_ {number} [^\n]*\n(?: SG_ [^\n]*\n)*?){pattern}", rf"\1{replacement}"


@pytest.mark.parametrize(
    ("edits", "words"),
    [
        pytest.param([("Page M", "Number M")], "one multiplexer, named Page", id="another-name"),
        pytest.param([("(?m)^( SG_ .*) m4 ", r"\1 m5 ")], r"got \[0, 1, 2, 3, 5\]", id="page-gap"),
        pytest.param(
            [of_message(840, " SG_ Kind :", " SG_ Kind M :")], "must not have a multiplexer",
            id="fd-multiplexer",
        ),
        pytest.param([("EgoLeft: 8", "EgoLeft: 16")], "8 bytes, got 16", id="long-page"),
        pytest.param([("EgoLeftFd: 48", "EgoLeftFd: 50")], "got 50 bytes", id="fd-length"),
        pytest.param(
            [(r" SG_ Page(\d) ", r" SG_ Number\1 ")], "must have pages of 8 bytes", id="no-pages"
        ),
        pytest.param(
            [(r" SG_ Counter .*\n", "")], "no signal '(Counter|TransferId0)'", id="no-counter"
        ),
        pytest.param(
            [(r'BA_ "E2EDataId" BO_ 8(32|40|48) .*\n', "")],
            "slot EGO_LEFT: its messages need the same attribute E2EDataId", id="no-data-id",
        ),
        pytest.param(
            [(r'"E2EDataId" BO_ (832|840|848) \d+', r'"E2EDataId" BO_ \1 65536')],
            "E2EDataId must be a whole number from 0 to 65535", id="data-id-of-17-bits",
        ),
        pytest.param(
            [(r'"SecOCDataId" BO_ 848 \d+', '"SecOCDataId" BO_ 848 65536')],
            "SecOCDataId must be a whole number from 0 to 65535", id="secoc-data-id-of-17-bits",
        ),
        pytest.param(
            [(r'"GenMsgCycleTime" BO_ 832 50', '"GenMsgCycleTime" BO_ 832 3600001')],
            "GenMsgCycleTime must be .* 3600000, got 3600001", id="longer-than-an-hour",
        ),
        pytest.param(
            [of_message(848, r" SG_ KeyId : 391", " SG_ KeyId : 399"),
             of_message(848, r" SG_ Freshness : 399\|56", " SG_ Freshness : 407|48")],
            "EgoLeftSecOc, EgoRightSecOc must have the same lengths", id="lengths-of-one-slot",
        ),
        pytest.param(
            [of_message(848, r" SG_ Mac : 455\|64@0", " SG_ Mac : 455|63@0")],
            "Mac must have 1 to 8 bytes, and end in byte 63", id="odd-mac",
        ),
        pytest.param(
            [of_message(848, r" SG_ KeyId : 391\|8@0", " SG_ KeyId : 391|7@0")],
            "KeyId must have 1 byte,", id="key-id-of-7-bits",
        ),
        pytest.param(
            [of_message(848, r" SG_ Freshness [^\n]*\n", "")],
            "must end with KeyId, Freshness, Mac", id="no-freshness",
        ),
        pytest.param(
            [of_message(848, r" SG_ Freshness : 399\|56@0", " SG_ Freshness : 392|56@1")],
            "Freshness must have 3 to 7 bytes, and end in byte 55", id="intel-freshness",
        ),
        pytest.param(
            [(r" SG_ KeyId : 391", " SG_ KeyId : 439"),
             (r" SG_ Freshness : 399\|56", " SG_ Freshness : 447|8")],
            "Freshness .* needs 24 to 56 bits", id="freshness-of-1-byte",
        ),
    ],
)  # fmt: skip
def test_a_dbc_that_describes_no_record_is_refused(
    edits: list[tuple[str, str]], words: str
) -> None:
    """With the first reason that is found."""
    with pytest.raises(LayoutError, match=words):
        Layout.from_text(edited_text(ORIGINAL, *edits))


def test_a_whole_number_at_the_ends_of_its_range() -> None:
    """Of data IDs and of a cycle time; it may also be written as text."""
    text = edited_text(
        ORIGINAL,
        (r'"E2EDataId" BO_ (832|840|848) \d+', r'"E2EDataId" BO_ \1 0'),
        (r'"SecOCDataId" BO_ 848 \d+', '"SecOCDataId" BO_ 848 0'),
        (r'"SecOCDataId" BO_ 849 \d+', '"SecOCDataId" BO_ 849 65535'),
        (r'"GenMsgCycleTime" BO_ 832 50', '"GenMsgCycleTime" BO_ 832 3600000'),
        (r'BA_ "GenMsgCycleTime" BO_ (833|841|849) .*\n', ""),
        (r'"MapLineSlot" INT 0 7', '"MapLineSlot" STRING '),
        (r'("MapLineSlot") 0;', r'\1 "0";'),
        (r'("MapLineSlot" BO_ \d+) (\d)', r'\1 "\2"'),
    )
    layout = Layout.from_text(text)
    left, right = (layout.messages[slot] for slot in (Slot.EGO_LEFT, Slot.EGO_RIGHT))
    assert (left.data_id, left.secured_data_id, right.secured_data_id) == (0, 0, 65535)
    assert (left.cycle_ms, right.cycle_ms) == (3_600_000, 0)


@pytest.mark.parametrize(
    ("multiplexers", "words"),
    [
        pytest.param("Inner Page 0-0; A Inner 0-0; B Page 1-1;", "one multiplexer", id="two"),
        pytest.param("A Page 0-1; B Page 1-1;", "A must be in one page or in all", id="two-pages"),
    ],
)
def test_a_signal_is_in_one_page(multiplexers: str, words: str) -> None:
    """Of one multiplexer, or of none and so in all pages."""
    inner = ' SG_ Inner m0M : 2|2@1+ (1,0) [0|0] "" E\n' if "Inner" in multiplexers else ""
    values = "".join(f"SG_MUL_VAL_ 832 {text};\n" for text in multiplexers.split(";")[:-1])
    text = (
        'VERSION ""\n\nBU_: E\n\nBO_ 832 EgoLeft: 8 E\n'
        f' SG_ Page M : 0|2@1+ (1,0) [0|0] "" E\n{inner}'
        ' SG_ A m0 : 8|8@1+ (1,0) [0|0] "" E\n SG_ B m1 : 16|8@1+ (1,0) [0|0] "" E\n\n'
        'BA_DEF_ BO_ "MapLineSlot" INT 0 7;\nBA_DEF_DEF_ "MapLineSlot" 0;\n'
        f'BA_ "MapLineSlot" BO_ 832 0;\n{values}'
    )
    with pytest.raises(LayoutError, match=words):
        Layout.from_text(text)


def test_only_messages_of_map_lines_need_their_own_can_id() -> None:
    """A database may be of several DBCs."""
    database = cantools.database.load_string(ORIGINAL, "dbc")
    assert isinstance(database, cantools.database.can.Database)
    foreign = 'VERSION ""\n\nBU_: E\n\nBO_ {} {}: 8 E\n SG_ A : 0|8@1+ (1,0) [0|0] "" E\n'
    for number, name in ((100, "A"), (100, "B"), (0x80000000 | 832, "C")):
        database.add_dbc_string(foreign.format(number, name))
    assert Layout.from_dbc(database).messages.keys() == {Slot.EGO_LEFT, Slot.EGO_RIGHT}
    database.add_dbc_string(foreign.format(832, "D"))
    with pytest.raises(LayoutError, match="EgoLeft and D have the same CAN ID, 832"):
        Layout.from_dbc(database)


@pytest.mark.parametrize(
    ("low", "high", "is_whole"),
    [
        pytest.param(0, 0, True, id="none"),
        pytest.param(-1e300, 1e300, True, id="wider"),
        pytest.param(-32, 31.999, True, id="rounded"),
        pytest.param(-31.9996, 31.9986, True, id="by-less-than-half-a-step"),
        pytest.param(-31.9994, 31.999, False, id="from-a-step-later"),
        pytest.param(-32, 31.9985, False, id="to-a-step-earlier"),
        pytest.param(5, -5, False, id="empty"),
    ],
)
def test_the_range_of_a_signal_is_that_of_its_bits(low: float, high: float, is_whole: bool) -> None:
    """[min|max] of YOff in steps of 2^-10 m; a bound may be rounded to decimals."""
    as_it_was = r"( SG_ YOff .*\|)\d+@1- \([^)]*\) \[[^\]]*\]"
    numbers = rf"\g<1>16@1- (0.0009765625,0) [{low!r}|{high!r}]"
    text = edited_text(ORIGINAL, (as_it_was, numbers))
    if is_whole:
        signal = Layout.from_text(text)["YOff"]
        assert (signal.raw_min, signal.raw_max) == (-32768, 32767)
    else:
        with pytest.raises(LayoutError, match=r"YOff is .* needs the range \[min\|max\] of all"):
            Layout.from_text(text)
