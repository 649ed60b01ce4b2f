"""Tables of inputs, as spreadsheets and scripts write them."""

from pathlib import Path

import pytest

from maplines_can.cosimulation.csv_tables import read_inputs
from maplines_can.values.errors import FmuError

ROWS = [(0.0, {("node", "gain"): "1.5"}), (0.5, {("node", "name"): "a"})]


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(b"time,node.gain,node.name\n0,1.5,\n0.5,,a\n", id="commas"),
        pytest.param(b"\xef\xbb\xbftime,node.gain,node.name\n0,1.5,\n0.5,,a\n", id="mark"),
        pytest.param(b"time;node.gain;node.name\r\n0;1.5;\r\n0.5;;a\r\n", id="semicolons"),
        pytest.param(b"time\tnode.gain\tnode.name\n0\t1.5\t\n0.5\t\ta", id="tabs"),
        pytest.param(b"time, node.gain, node.name\n\n0,1.5,\n0.5,,a\n", id="blanks"),
        pytest.param(b'"time","node.gain","node.name"\n"0","1.5",""\n"0.5","","a"\n', id="quotes"),
    ],
)
def test_inputs_are_read(tmp_path: Path, data: bytes) -> None:
    """The forms that the other readers of CSV take: a byte order mark, semicolons, tabs."""
    path = tmp_path / "in.csv"
    path.write_bytes(data)
    assert read_inputs(path, ["node"]) == ROWS


@pytest.mark.parametrize(
    ("data", "message"),
    [
        pytest.param(b"", "first column must be 'time', got", id="empty"),
        pytest.param(b"time,node.gain\n0,\xff\n", "is not a CSV file", id="not-utf-8"),
        pytest.param(b"time,node.gain\n0\n", "line 2: has 1 cells", id="short-row"),
        pytest.param(b"time,node.gain\n1,1\n0,1\n", "line 3: time must not fall", id="falls"),
        pytest.param(b"time,other.gain\n", "the nodes are node", id="node"),
        pytest.param(b"time," + b"x" * 70_000, "line 1 has more than", id="long"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "in.csv"
    path.write_bytes(data)
    with pytest.raises(FmuError, match=message):
        read_inputs(path, ["node"])
