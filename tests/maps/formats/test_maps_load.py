"""Loading: the content shows the format, and what cannot be loaded is one clear error."""

import gzip
import hashlib
import sys
from pathlib import Path

import pytest
from support.fixtures import Patch
from support.xodr_files import document, road

import maplines_can as ml
from maplines_can.study.files import read_map

TEXT = document(road())


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "town.xodr"


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(TEXT.encode(), id="plain"),
        pytest.param(b"\xef\xbb\xbf" + TEXT.encode(), id="byte-order-mark"),
        pytest.param(TEXT.replace("UTF-8", "UTF-16").encode("utf-16"), id="UTF-16"),
        pytest.param(
            TEXT.replace("UTF-8", "ISO-8859-1").replace("Main", "Maßweg").encode("latin-1"),
            id="Latin-1",
        ),
        pytest.param(TEXT.partition("\n")[2].encode(), id="no-declaration"),
        pytest.param(b"\n<!-- <a> --><!-- b -->" + TEXT.partition("\n")[2].encode(), id="comments"),
        pytest.param(gzip.compress(TEXT.encode()), id="gzip"),
        pytest.param(gzip.compress(b"\xef\xbb\xbf" + TEXT.encode()), id="gzip-byte-order-mark"),
    ],
)
@pytest.mark.parametrize("name", ["town.xodr", "town.xml", "town.xodr.gz", "town"])
def test_load_reads_an_encoding(tmp_path: Path, data: bytes, name: str) -> None:
    """Whatever the name of the file."""
    path = tmp_path / name
    path.write_bytes(data)
    road_map = ml.maps.load(path)
    assert (len(road_map.lanes), road_map.name, road_map.skipped) == (2, name, ())
    assert len(ml.maps.load(str(path)).lanes) == 2


@pytest.mark.parametrize(
    ("data", "message"),
    [
        pytest.param(b"", "town.xodr is empty", id="empty"),
        pytest.param(b" \n ", "town.xodr is empty", id="blank"),
        pytest.param(b"\x1f\x8b", "town.xodr cannot be decompressed", id="cut-gzip-header"),
        pytest.param(b"\x1f\x8bnonsense", "town.xodr cannot be read", id="not-gzip"),
        pytest.param(b"<html></html>", "XML with the root element <html>", id="another-root"),
        pytest.param(b"hello", "no known format", id="text"),
        pytest.param(bytes(range(256)), "no known format", id="binary"),
        pytest.param(b"<OpenDRIVE", "not an OpenDRIVE file: line 1", id="cut-root"),
        pytest.param(b"<OpenDRIVE/>", "contains no usable road", id="no-road"),
        pytest.param(b"<OpenDRIVE>" + b"<!-- -->" * 9000, "no usable road", id="only-comments"),
        pytest.param(b"<!-- -->" * 9000, "no known format", id="comments-without-root"),
        pytest.param(b"<?x ?>" * 9000 + b"<", "no known format", id="instructions"),
    ],
)
def test_what_cannot_be_loaded_is_an_error(path: Path, data: bytes, message: str) -> None:
    path.write_bytes(data)
    with pytest.raises(ml.maps.MapFileError, match=message):
        ml.maps.load(path)


def test_a_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ml.maps.MapFileError, match="cannot be read"):
        ml.maps.load(tmp_path)


def test_a_gzip_bomb_is_an_error(path: Path, monkeypatch: Patch) -> None:
    """The size after decompression counts."""
    monkeypatch.setattr(sys.modules["maplines_can.maps.formats.load"], "MAX_BYTES", 1 << 20)
    text = TEXT.replace("</OpenDRIVE>", "<userData>" + " " * (2 << 20) + "</userData></OpenDRIVE>")
    path.write_bytes(gzip.compress(text.encode()))
    with pytest.raises(ml.maps.MapFileError, match="more than 1 MB; divide the map"):
        ml.maps.load(path)


@pytest.mark.parametrize(
    ("limit", "value", "text", "message"),
    [
        pytest.param(
            "xml_tree.MAX_ELEMENTS",
            100,
            "<OpenDRIVE>" + "<road/>" * 101,
            "line 1: more than 100 elements; divide the map",
            id="roads",
        ),
        pytest.param(
            "xml_tree.MAX_ELEMENTS",
            100,
            "<osm><way>" + "<nd/>" * 101,
            "more than 100 elements",
            id="references-of-one-way",
        ),
        pytest.param(
            "xml_tree.MAX_TAG",
            1 << 20,
            f'<OpenDRIVE><road id="{"1" * (3 << 20)}"/>',
            "a tag has more than 1 MB",
            id="attribute",
        ),
        pytest.param(
            "points.MAX_BYTES",
            1 << 20,
            "line,x,y\n" + "a,1,2\n" * 200_000,
            "has more than 1 MB; divide the map",
            id="points",
        ),
    ],
)
def test_files_that_would_fill_the_memory_are_refused(
    path: Path, monkeypatch: Patch, limit: str, value: int, text: str, message: str
) -> None:
    """They may come as gzip bombs: what is read of them is bounded."""
    monkeypatch.setattr(f"maplines_can.maps.formats.{limit}", value)
    path = path.with_suffix(".csv.gz")
    path.write_bytes(gzip.compress(text.encode()))
    with pytest.raises(ml.maps.MapFileError, match=message):
        ml.maps.load(path)


def test_the_list_of_what_is_not_used_ends(path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("maplines_can.maps.lane.MAX_SKIPPED", 10)
    path.write_text(document(road(), '<road id=""/>' * 1000))
    skipped = ml.maps.load(path).skipped
    assert [str(one) for one in skipped[10:]] == [
        "the rest of the file: only the first 10 things that are not used are listed"
    ]


def test_the_map_of_the_package_is_found_by_name(tmp_path: Path, monkeypatch: Patch) -> None:
    """Where a map is loaded, in a folder without such a file; a file of that name comes first."""
    monkeypatch.chdir(tmp_path)
    assert ml.maps.load("town.xodr").lanes.keys() == ml.maps.load(ml.maps.town_path()).lanes.keys()
    lines, sha256 = read_map(Path("town.xodr"))
    assert len(lines) > 100
    assert sha256 == hashlib.sha256(ml.maps.town_path().read_bytes()).hexdigest()
    with pytest.raises(FileNotFoundError):
        ml.maps.load("other/town.xodr")

    Path("town.xodr").write_text(TEXT)
    assert len(ml.maps.load("town.xodr").lanes) < 10


def test_a_cut_gzip_file_gives_what_is_before(path: Path) -> None:
    """As a file that is not compressed."""
    roads = "".join(road(road_id=str(i)) for i in range(1000))
    data = gzip.compress(document(roads).encode())
    path.write_bytes(data[: len(data) // 2])
    road_map = ml.maps.load(path)
    assert 0 < len(road_map.roads) < 1000
    assert "the rest of the file is not used" in road_map.skipped[-1].why
