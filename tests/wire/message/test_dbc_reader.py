"""DBCs that are not those of the project: read as they are, or rejected with the reason."""

import re
from pathlib import Path
from typing import Any

import cantools
import pytest
from dbcs import edited
from random_lines import random_lines

from maplines_can.errors import LayoutError
from maplines_can.line import Kind, MapLine, Slot
from maplines_can.wire import Codec, Layout


def test_motorola_signals_are_supported(tmp_path: Path) -> None:
    """Counter and Kind in Motorola order at the same bits give the same bytes, also in cantools."""
    path = edited(
        tmp_path,
        (r"SG_ Counter m0 : 16\|8@1\+", "SG_ Counter m0 : 23|8@0+"),
        (r"SG_ Counter : 16\|8@1\+", "SG_ Counter : 23|8@0+"),
        (r"SG_ Kind m0 : 59\|3@1\+", "SG_ Kind m0 : 61|3@0+"),
        (r"SG_ Kind : 59\|3@1\+", "SG_ Kind : 61|3@0+"),
    )
    codec, other = Codec.from_dbc(), Codec.from_dbc(path)
    message = cantools.database.load_file(path).get_message_by_name("EgoLeftFd")  # type: ignore[union-attr]
    means, covs = random_lines(20, seed=9)
    payloads = other.encode_batch(means, covs, kind=Kind.KERB)
    assert other.decode_batch(payloads).accepted.all()
    for i, payload in enumerate(payloads):
        decoded = message.decode(payload.tobytes())
        assert (decoded["Kind"], decoded["Counter"]) == ("KERB", i)  # type: ignore[call-overload]
    # Signals of whole bytes, or within one, have the same bits in both byte orders.
    assert (payloads == codec.encode_batch(means, covs, kind=Kind.KERB)).all()


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        pytest.param((r"SG_ Beta m0", "SG_ Heading m0"), "Beta|Heading", id="mean-missing"),
        pytest.param((r' SG_ TransferId1 .*\n', ""), "TransferId", id="transfer-missing"),
        pytest.param((r' SG_ RatioBetaYOff.*\n', ""), "RatioBetaYOff|ratios", id="ratio-missing"),
        pytest.param((r'BA_ "MapLineSlot" .*\n', ""), "MapLineSlot", id="no-slots"),
        pytest.param((r'BA_ "MapLineSlot" BO_ 832 0', 'BA_ "MapLineSlot" BO_ 832 9'),
                     "0 to 7", id="slot-9"),
        pytest.param((r'BA_ "MapLineSlot" BO_ 833 1', 'BA_ "MapLineSlot" BO_ 833 0'),
                     "two messages", id="slot-twice"),
        pytest.param((r'BA_ "E2EDataId" BO_ 832 \d+', 'BA_ "E2EDataId" BO_ 832 1'),
                     "E2EDataId", id="data-id"),
        pytest.param((r'BA_ "CovarianceCode" ".*"', 'BA_ "CovarianceCode" "Magic"'),
                     "Magic", id="code"),
        pytest.param((r"SG_ Page M", "SG_ Page "), "overlapping", id="no-mux"),
        pytest.param((r"\(0.054,-32\)", "(-0.054,-4)"), "positive factor", id="negative-factor"),
        pytest.param((r"BO_ 832 EgoLeft: 8", "BO_ 832 EgoLeft: 7"), "EgoLeft", id="seven-bytes"),
        pytest.param((r"(RatioBetaC0[^(]*)\(0.0390625,0\) \[[^]]*\]", r"\1(64,0) [-1e6|1e6]"),
                     "double precision", id="ratio-too-wide"),
        pytest.param((r"Crc m0 : 0\|16@1", "Crc m0 : 0|15@1"), "differ|Crc", id="crc-width"),
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


def test_every_data_id_of_16_bits_is_accepted(tmp_path: Path) -> None:
    """The greatest one included."""
    path = edited(tmp_path, (r'("E2EDataId" BO_ (832|840)) \d+', r"\1 65535"))
    assert Layout.from_dbc(path).messages[Slot.EGO_LEFT].data_id == 65535


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


def test_each_frame_format_may_have_its_own_id_length(tmp_path: Path) -> None:
    """Classic CAN with 11 bits and CAN FD with 29 bits: frames and decoder agree."""
    fd_id = 0x80000000 | 0x18FF0048
    path = edited(tmp_path, (r"\b840\b", str(fd_id)))
    codec = Codec.from_dbc(path)
    (frame,) = codec.encode(MapLine.mean_only(Slot.EGO_LEFT, [1.0, 0, 0, 0]), fd=True)
    assert (frame.can_id, frame.is_extended) == (0x18FF0048, True)
    answer = codec.decoder().feed(frame.can_id, frame.data, 0, is_extended=True)
    assert isinstance(answer, MapLine)
    assert not codec.encode(MapLine.mean_only(Slot.EGO_LEFT, [1.0, 0, 0, 0]))[0].is_extended


@pytest.mark.parametrize("content", [None, b"", b"\xff\x00 not a DBC", b'VERSION "'])
def test_a_file_that_is_not_a_dbc_is_rejected(tmp_path: Path, content: bytes | None) -> None:
    """Missing, empty, binary or truncated: the error names the file."""
    path = tmp_path / "bad.dbc"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LayoutError, match=r"bad\.dbc"):
        Codec.from_dbc(path)


ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(
    ("pattern", "replacement", "message"),
    [
        (r"SG_ Mac : 327\|64@0", "SG_ Mac : 320|64@1", "must end with KeyId, Freshness, Mac"),
        (r"SG_ KeyId : 263\|8@0", "SG_ KeyId : 263|7@0", "KeyId must have 1 byte,"),
        (r"SG_ Freshness :.*\n", "", "must end with KeyId, Freshness, Mac"),
        (r"EgoLeftSecOc: 48", "EgoLeftSecOc: 64", "must end with KeyId, Freshness, Mac"),
        (
            r'"SecOCDataId" BO_ 848 \d+',
            '"SecOCDataId" BO_ 848 70000',
            "SecOCDataId must be a whole",
        ),
        (r'"VFrameFormat" BO_ 848 14', '"VFrameFormat" BO_ 848 0', "must be a CAN FD message"),
    ],
)
def test_a_dbc_with_another_secured_format_is_rejected(
    pattern: str, replacement: str, message: str
) -> None:
    """Otherwise the wrong bytes would be verified."""
    text, found = re.subn(
        pattern, replacement, (ROOT / "dbc" / "maplines-secoc.dbc").read_text(), count=1
    )
    assert found
    with pytest.raises(LayoutError, match=message):
        Layout.from_text(text)
