"""DBCs that would exhaust memory or time."""

import os
from pathlib import Path

import pytest

from maplines_can.dbc_files.parser import default_dbc_path, read_text
from maplines_can.values.errors import LayoutError
from maplines_can.wire import Layout

MESSAGE = "BO_ 0 M: 8 E\n"
SIGNAL = '@1+ (1,0) [0|15] "" E\n'


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("BO_ 0 M: 65536 E\n", id="message"),
        pytest.param("BO_ 0 M : // so long\n 65536E\n", id="message-with-a-remark"),
        pytest.param(f"{MESSAGE} SG_ a m1 : 2147483648|4{SIGNAL}", id="start"),
        pytest.param(f"BO_ 0 M: 8 E SG_ a\n:\n0 | 2147483648{SIGNAL}", id="length"),
        pytest.param(
            f"{MESSAGE} SG_ a m1 : 0|4{SIGNAL} SG_MUL_VAL_ 0 a b1 0-1,\n0-2147483648;\n", id="range"
        ),
        pytest.param('BA_DEF_ BO_ "A" INT 0 1e30865535;\n', id="exponent"),
        pytest.param('BA_ "A" "1.5E30865535";\n', id="exponent-in-quotes"),
    ],
)
def test_a_dbc_that_would_exhaust_memory_or_time_is_rejected(text: str) -> None:
    """cantools makes lists and integers as long as these numbers say; found by the fuzzer."""
    with pytest.raises(LayoutError, match="too many digits"):
        Layout.from_text(text)


def test_large_numbers_elsewhere_are_accepted() -> None:
    """In comments, remarks, identifiers and ranges of values."""
    comments = 'CM_ "BO_ 0 M: 65536 E and SG_ a : 1000000|4";\n// SG_ b : 1000000|4\n'
    extra = f'BO_ 2566844926 Other: 8 E\n SG_ a : 0|32@1+ (1,0) [0|4294967295] "" E\n{comments}'
    text = default_dbc_path().read_text(encoding="cp1252")
    place = text.index("BO_ ")
    assert Layout.from_text(text[:place] + extra.replace(comments, "") + text[place:] + comments)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        pytest.param(f'CM_ "{"x" * 300_000}";\n', "262144 characters", id="text"),
        pytest.param('CM_ "' + r"\"" * 300_000 + '";\n', "262144 characters", id="escaped-text"),
        pytest.param('VAL_ 1 S 0 "a" ;' * 300_000, "1250000 words and signs", id="words"),
    ],
)
def test_a_dbc_of_too_many_words_is_rejected(text: str, words: str) -> None:
    """Each takes cantools an object; within the limits it takes less than 300 MB."""
    with pytest.raises(LayoutError, match=f"is too large: .*{words}"):
        Layout.from_text(text)


def test_a_file_of_16_megabytes_is_read_and_a_larger_one_is_not(tmp_path: Path) -> None:
    """A pipe or a device may never end."""
    path = tmp_path / "large.dbc"
    path.touch()
    for size in (16 * 10**6, 16 * 10**6 + 1):
        os.truncate(path, size)
        if size > 16 * 10**6:
            with pytest.raises(LayoutError, match=r"large\.dbc: is too large: .* 16,000,000 bytes"):
                read_text(path)
        else:
            assert len(read_text(path)) == size
