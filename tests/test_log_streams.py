"""Parsers of logs of core and model on the same bytes, and whether another rule would be found."""

import re
from collections import Counter
from itertools import islice
from typing import Any

import can
import pytest

from maplines_can.testing import log_streams
from maplines_can.testing.log_streams import compare_logs, core_answer, logs


def test_core_and_model_parse_the_same_frames() -> None:
    assert str(compare_logs(1, lambda: True)) == "bit-identical on 50 damaged logs"


def test_the_stream_has_frames_and_what_is_left_to_python_of_each_form() -> None:
    """Frames of classic CAN and CAN FD, and of BLF all that is skipped."""
    met = Counter[Any]()
    for step in islice(logs(2), 120):
        for _, frames, (_, _, _, _, lengths, _), _, other, _, _ in core_answer(step):
            met[step.form, "frames"] += frames
            met[step.form, "left"] += frames < step.capacity
            met.update((step.form, "long") for length in lengths if length > 8)
            met.update(
                ("skipped", kind) for kind, n in enumerate(other[:5]) if step.form == "blf" and n
            )
    forms = ("candump", "asc", "asc10", "blf")
    assert all(met[form, "frames"] > 100 and met[form, "left"] > 10 for form in forms)
    assert all(met[form, "long"] > 5 for form in ("candump", "asc", "blf"))
    assert all(met["skipped", kind] for kind in range(5))


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("MAX_DISORDER_NS", 10**8 - 1),
        ("MAX_CHANNELS", 255),
        ("FD_LENGTHS", (*range(9), 12, 16, 20, 24, 32, 48, 63)),
        ("_CANDUMP", re.compile(log_streams._CANDUMP.pattern.replace(b"{1,64}", b"{1,63}"))),
        ("_TAIL", re.compile(log_streams._TAIL.pattern.replace(b"4096", b"4095"))),
        ("_NO_FRAMES", {**log_streams._NO_FRAMES, 74: 4}),
        ("_REMOTE", 0),
    ],
)
def test_another_rule_is_found(monkeypatch: pytest.MonkeyPatch, name: str, other: Any) -> None:
    monkeypatch.setattr(log_streams, name, other)
    turns = iter(range(12))

    found = compare_logs(1, lambda: next(turns, None) is None)

    assert "core and model differ" in str(found)


def test_python_can_reads_the_frames_of_the_model(tmp_path: Any) -> None:
    """A witness from outside: what the model takes of candump -L, python-can reads alike."""
    rows = list[bytes]()
    for step in islice(logs(5), 200):
        if step.form == "candump":
            lines = step.data.split(b"\n")
            rows += [row + b"\n" for row in lines if log_streams._candump(row + b"\n", 0)]
    plain = [row for row in rows if b"\r" not in row and b"##" not in row]
    path = tmp_path / "drive.log"
    path.write_bytes(b"".join(plain))
    expected = [log_streams._candump(row, 0) for row in plain]

    with can.CanutilsLogReader(path) as reader:
        found = [(m.arbitration_id, m.is_extended_id, m.channel, bytes(m.data)) for m in reader]

    frames = [one[1] for one in expected if one is not None and not isinstance(one[1], int)]
    assert len(found) > 100
    assert found == [(f.can_id, f.is_extended, f.channel, f.data) for f in frames]
