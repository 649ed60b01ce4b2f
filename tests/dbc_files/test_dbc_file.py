"""Tables of a DBC that are kept: the same as of the DBC, or not used."""

import json
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from random_dbc import SCENE_SEED, random_dbc

from maplines_can.dbc_files import dbc_cache
from maplines_can.dbc_files.dbc_cache import PACKAGED, key_of, parsed_tables
from maplines_can.dbc_files.dbc_tables import _checksum, from_json, to_json
from maplines_can.dbc_files.parser import parse_database
from maplines_can.values import output_files
from maplines_can.values.errors import LayoutError
from maplines_can.wire import SHIPPED, Layout, default_dbc_path

TEXT = default_dbc_path().read_text()


class Cache:
    """A cache of its own, and how often a DBC is parsed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.parsed = folder, 0

    @property
    def file(self) -> Path:
        """The only file."""
        (path,) = self.folder.iterdir()
        return path


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cache:
    found = Cache(tmp_path / "cache")

    def counted(*args: Any) -> Any:
        found.parsed += 1
        return parse_database(*args)

    monkeypatch.setattr(output_files, "cache_folder", lambda: found.folder)
    monkeypatch.setattr(dbc_cache, "parse_database", counted)
    return found


@pytest.fixture
def dbc(tmp_path: Path) -> Path:
    """A DBC of a user."""
    path = tmp_path / "own.dbc"
    path.write_text(f'{TEXT}CM_ "another";\n')
    return path


@pytest.mark.parametrize("name", SHIPPED)
def test_the_tables_in_the_package_are_those_of_its_dbcs(name: str, cache: Cache) -> None:
    """As cantools parses them; so they need no cache. ``tools/make_dbc.py`` writes them."""
    path, text = default_dbc_path(name), default_dbc_path(name).read_text("utf-8")
    kept = (PACKAGED / name).with_suffix(".json").read_text("utf-8")
    key = key_of(text.encode())

    assert kept == to_json(key, parsed_tables(text, name))
    cache.parsed = 0
    if path.read_bytes() == text.encode():  # not with the line ends of Windows
        assert Layout.from_dbc(path).is_same_as(Layout.from_text(text))
        assert cache.parsed == 1  # by from_text
        assert not cache.folder.exists()


@pytest.mark.parametrize("seed", [1, SCENE_SEED, 1002])
def test_a_layout_is_the_same_with_and_without_the_cache(
    seed: int, cache: Cache, tmp_path: Path
) -> None:
    """Of random DBCs, and as from a database of cantools."""
    path, text = tmp_path / "random.dbc", random_dbc(seed)
    path.write_text(text)
    cache.parsed = 0  # by the making of the DBC
    first, second = Layout.from_dbc(path), Layout.from_dbc(path)
    of_database = Layout.from_dbc(parse_database(text, "DBC"))

    assert cache.parsed == 1
    assert first.is_same_as(second)
    assert first.is_same_as(of_database)
    assert (first.sha256, first.source) == (second.sha256, str(path))


def test_a_dbc_is_known_by_bytes_encoding_and_versions(
    cache: Cache, dbc: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not by its name."""
    Layout.from_dbc(dbc)
    copy = tmp_path / "copy.dbc"
    copy.write_bytes(dbc.read_bytes())
    assert Layout.from_dbc(copy).source == str(copy)
    assert cache.parsed == 1

    Layout.from_dbc(dbc, encoding="cp1252")
    assert cache.parsed == 2
    dbc.write_text(f"{dbc.read_text()}\n")
    Layout.from_dbc(dbc)
    assert cache.parsed == 3
    monkeypatch.setattr("maplines_can.__version__", "another")
    Layout.from_dbc(dbc)
    assert cache.parsed == 4


def test_what_is_said_of_a_dbc_is_said_each_time(cache: Cache, dbc: Path) -> None:
    """An uncertain unit, with the name that the file has now."""
    dbc.write_bytes(TEXT.replace('"rad"', '"rad"', 1).encode() + _other_message("℃", "cp950"))
    texts = []
    for _ in range(2):
        with pytest.warns(UserWarning, match=r"own\.dbc: .* whether '¢J' is right") as found:
            Layout.from_dbc(dbc)
        texts.append([str(one.message) for one in found])

    assert texts[0] == texts[1]
    assert (cache.parsed, len(texts[0])) == (1, 1)


def _other_message(unit: str, encoding: str) -> bytes:
    return f'\nBO_ 5 Other: 8 X\n SG_ Temp : 0|8@1+ (1,0) [0|0] "{unit}" X\n'.encode(encoding)


def test_a_dbc_of_which_cantools_logs_something_is_not_kept(
    cache: Cache, dbc: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """So that it is logged each time: here, two foreign messages have one name."""
    rows = 'BO_ {} Twice: 8 X\n SG_ S : 0|8@1+ (1,0) [0|0] "" X\n'
    dbc.write_text(f"{TEXT}\n{rows.format(5)}\n{rows.format(6)}\n")
    logged = []
    for _ in range(2):
        caplog.clear()
        Layout.from_dbc(dbc)
        logged.append(caplog.messages)

    assert logged[0] == logged[1] != []
    assert cache.parsed == 2


@pytest.mark.parametrize(
    ("data", "encoding"),
    [
        pytest.param(b"BO_ 1 A", None, id="no-dbc"),
        pytest.param(TEXT.replace("MapLineSlot", "Other").encode(), None, id="no-lines"),
        pytest.param(TEXT.replace('"1/m"', '"1/km"').encode(), None, id="wrong-unit"),
        pytest.param(TEXT.encode() + "°".encode("cp1252"), "utf-8", id="encoding"),
        pytest.param(TEXT.encode(), "utf-9", id="no-encoding"),
    ],
)
def test_an_error_is_the_same_each_time(
    data: bytes, encoding: str | None, cache: Cache, dbc: Path
) -> None:
    """A DBC that is refused is not kept."""
    dbc.write_bytes(data)
    errors = []
    for _ in range(2):
        with pytest.raises(LayoutError) as error:
            Layout.from_dbc(dbc, encoding=encoding)
        errors.append(str(error.value))

    assert errors[0] == errors[1]
    assert not cache.folder.exists()


def _forged(change: Callable[[Any], None]) -> Callable[[str], str]:
    """Return a function that changes the content, and makes its checksum right."""

    def forged(text: str) -> str:
        document = json.loads(text)
        change(document["content"])
        document["checksum"] = _checksum(document["key"], document["content"])
        return json.dumps(document)

    return forged


def _set(*place: Any, to: Any) -> Callable[[str], str]:
    def change(content: Any) -> None:
        for step in place[:-1]:
            content = content[step]
        content[place[-1]] = to

    return _forged(change)


#: Places of the first signal in the content, and of the first message.
SIGNAL, MESSAGE = (0, 0, 0), (1, 0)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda _: "", id="empty"),
        pytest.param(lambda text: text[:-100], id="cut"),
        pytest.param(lambda text: text.replace("0.0009765625", "0.0019765625"), id="edited"),
        pytest.param(lambda text: text.replace('"key":"', '"key":"0'), id="of-another-dbc"),
        pytest.param(_set(*SIGNAL, 2, to=10**12), id="length"),
        pytest.param(_set(*SIGNAL, 6, to=math.nan), id="factor"),
        pytest.param(_set(*MESSAGE, -1, to=99), id="index"),
        pytest.param(_set(2, to=None), id="no-tables"),
    ],
)
def test_a_file_that_is_not_what_was_written_is_not_used(
    change: Callable[[str], str], cache: Cache, dbc: Path
) -> None:
    """The DBC is read anew, in silence, and kept again."""
    expected = Layout.from_dbc(dbc)
    cache.file.write_text(change(cache.file.read_text()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = Layout.from_dbc(dbc)

    assert found.is_same_as(expected)
    assert cache.parsed == 2
    assert Layout.from_dbc(dbc).is_same_as(expected)
    assert cache.parsed == 2


def test_tables_are_the_same_after_json() -> None:
    """To the last bit, infinite numbers and names beyond ASCII included."""
    tables = parsed_tables(TEXT, "DBC")._replace(doubt="ä", covariance_code=1.5)
    (first, *others) = tables.messages
    signal = first.signals[0]._replace(factor=0.1, maximum=math.inf, unit="°", names=((1, "ö"),))
    tables = tables._replace(messages=(first._replace(signals=(signal,)), *others))

    assert from_json("key", to_json("key", tables)) == tables
    assert from_json("another", to_json("key", tables)) is None


@pytest.mark.parametrize("sign", ["", "-"])
def test_a_number_that_no_float_has_is_infinite(sign: str) -> None:
    """An integer of 400 digits was an OverflowError; now the signal is refused by its name."""
    text = TEXT.replace("(0.0009765625,0)", f"(0.0009765625,{sign}1{400 * '0'})")
    with pytest.raises(LayoutError, match=r"signal YOff is .* needs"):
        Layout.from_text(text)
