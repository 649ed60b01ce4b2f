"""``maplines decode FILE`` prints blocks: the bytes of ``maplines decode -``, frame by frame."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scene_layouts import layout_of
from support.fixtures import Capture, Patch

from maplines_can.cli import main
from maplines_can.recordings.row_texts import number_texts
from maplines_can.testing.hostile_streams import PROFILES, FrameStep, Stream, traffics_of
from maplines_can.wire import default_dbc_path

FRAMES = 120  #: of each profile
OPTIONS: tuple[list[str], ...] = (
    [],
    ["--at", "0,20.5,40"],
    ["--channel", "can1"],
    ["--csv", "--at=-4,60,80", "--slots", "ego-left,next-left"],
)


def log_text(dbc: str, *, timed: bool) -> str:
    """Return streams with all faults as the output of candump, each on a channel of its own."""
    rows = []
    for seed, profile in enumerate(PROFILES):
        steps = Stream(traffics_of(layout_of(dbc), seed), profile, seed).steps()
        frames = (step for step in steps if isinstance(step, FrameStep))
        for step in itertools.islice(frames, FRAMES):
            can_id = f"{step.can_id & 0x1FFFFFFF:08X}" if step.is_extended else f"{step.can_id:03X}"
            data = step.data[:64]
            if timed:
                mark = "#" if len(data) <= 8 else "##0"
                t = 1.7e9 + step.t_ns % 10**12 / 1e9
                rows.append(f"({t:.6f}) can{seed % 3} {can_id}{mark}{data.hex().upper()}\n")
            else:
                rows.append(f"  can{seed % 3}  {can_id}   [{len(data)}]  {data.hex(' ').upper()}\n")
    return "".join(rows)


@pytest.mark.parametrize("dbc", ["maplines.dbc", "maplines-pose.dbc", "maplines-scene.dbc"])
@pytest.mark.parametrize("timed", [True, False])
def test_a_file_is_printed_as_a_pipe(
    dbc: str, timed: bool, tmp_path: Path, capsys: Capture, monkeypatch: Patch
) -> None:
    """Loss, hostile bytes, two senders, mixtures, several channels, with and without times."""
    path, printed = tmp_path / "drive.log", 0
    path.write_text(log_text(dbc, timed=timed))
    for options in OPTIONS:
        base = ["--dbc", str(default_dbc_path(dbc)), *options]
        status = main(["decode", str(path), *base])
        of_file = capsys.readouterr()
        with path.open() as pipe:
            monkeypatch.setattr("sys.stdin", pipe)
            assert main(["decode", "-", *base]) == status
        of_pipe = capsys.readouterr()
        assert of_file.out == of_pipe.out
        assert of_file.err == of_pipe.err.replace("maplines: -:", f"maplines: {path}:")
        printed += len(of_file.out)
        if not options:
            rows = [json.loads(row) for row in of_file.out.splitlines()]
            assert len({row["channel"] for row in rows}) == 3
            assert {row["t"] is None for row in rows} == {not timed}
            assert dbc != "maplines.dbc" or any(row["mixture"] for row in rows)
    assert printed


@given(st.lists(st.floats() | st.floats(-1e-3, 1e-3) | st.sampled_from([1e-5, 1e16, -0.0])))
def test_a_number_is_the_shortest_text(values: list[float]) -> None:
    expected = [repr(one) if np.isfinite(one) else "" for one in values]
    assert number_texts(np.array(values), "") == expected
