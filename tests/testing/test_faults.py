"""Faults are parsed from text; each error has the key, the value and what is allowed."""

import math
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from maplines_can.testing import FaultKind, Faults, Interval, ScriptedFault


def test_a_script_from_a_file(tmp_path: Path) -> None:
    """Comments and empty lines are ignored; the others are read by ``ScriptedFault.parse``."""
    path = tmp_path / "faults.txt"
    path.write_text("# what frame value\n\nloss 3  # gone\nflip 20-29 3\n")
    assert Faults.parse(f"script={path},seed=3").script == (
        ScriptedFault(FaultKind.LOST, 3, 3),
        ScriptedFault(FaultKind.FLIPPED, 20, 29, 3),
    )


def test_the_keys_of_a_text_are_the_fields() -> None:
    faults = Faults.parse(
        "loss=0.1, dup=0.2, flip=0.3, flip_bits=2, depth=5, flood=10, flood_ids=0x340-0x342+7,"
        "direction=send, seed=0x10"
    )
    assert faults == Faults(
        loss=0.1, duplicate=0.2, flip=0.3, flip_bits=2, depth=5, flood=10,
        flood_ids=(range(0x340, 0x343), 7), direction="send", seed=16,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("text", "words"),
    [
        pytest.param("", "must be KEY=VALUE,KEY=VALUE, got ''", id="empty"),
        pytest.param("loss", "must be KEY=VALUE", id="no-value"),
        pytest.param("lost=0.1", "'lost' is unknown; use loss, duplicate (dup)", id="key"),
        pytest.param("loss=much", "loss must be a number, got 'much'", id="no-number"),
        pytest.param("loss=1.5", "loss must be in [0, 1], got 1.5", id="above"),
        pytest.param("loss=-0.1", "loss must be in [0, 1], got -0.1", id="below"),
        pytest.param("loss=nan", "loss must be in [0, 1], got nan", id="nan"),
        pytest.param("loss=0.1,loss=0.2", "loss is given twice", id="twice"),
        pytest.param("dup=0.1,duplicate=0.2", "duplicate is given twice", id="twice-by-alias"),
        pytest.param(
            "corrupt=0.1,flip=0.1",
            "corrupt includes flip; give one",
            id="corrupt-and-one",
        ),
        pytest.param("corrupt=2", "corrupt must be in [0, 1], got 2", id="corrupt"),
        pytest.param(
            "flip=0.6,garbage=0.6",
            "wrong_id, garbage must be 1 at most, got 1.2",
            id="sum",
        ),
        pytest.param("depth=0", "depth must be a whole number in [1, 10000] frames", id="depth"),
        pytest.param("depth=1.5", "depth must be a whole number", id="half-a-frame"),
        pytest.param("delay=-1", "delay must be in [0, 3600] s, got -1", id="delay"),
        pytest.param("flood=1,flood_ids=x", "flood_ids must look like 0x340-0x347+0", id="ids"),
        pytest.param("flood_ids=0x20000000", "CAN IDs in [0, 0x1fffffff]", id="id-range"),
        pytest.param("flood_ids=5-3", "CAN IDs in", id="ids-backwards"),
        pytest.param("direction=up", "direction must be both, send, receive, got 'up'", id="way"),
        pytest.param("seed=-1", "seed must be a whole number in [0, 1.84467e+19]", id="seed"),
        pytest.param(f"seed=0x{'f' * 400}", "19], got more than 1e308", id="seed-of-400-digits"),
        pytest.param(f"loss=0x{'f' * 400}", "1], got more than 1e308", id="loss-of-400-digits"),
        pytest.param(f"corrupt=0x{'f' * 400}", "1], got more than 1e308", id="corrupt-of-400"),
        pytest.param(
            "script=/dev/zero", "/dev/zero must have 1,000,000 bytes at most", id="endless"
        ),
        pytest.param("script=/nowhere", "script /nowhere cannot be read: No such", id="script"),
        # intervals
        pytest.param("loss=1@", "such as loss=1@2.0-2.6, got '1@'", id="none"),
        pytest.param("loss=1@2", "must be @FROM-TO or @FROM- [s]", id="one-time"),
        pytest.param("loss=1@-2", "must be @FROM-TO", id="no-begin"),
        pytest.param("loss=1@-2--1", "must be @FROM-TO", id="negative"),
        pytest.param("loss=1@a-b", "got '1@a-b'", id="no-numbers"),
        pytest.param("loss=1@2-3+", "must be @FROM-TO", id="plus"),
        pytest.param("loss=1@2-3@4-5", "must be @FROM-TO", id="twice"),
        pytest.param("loss=1@nan-2", "must be @FROM-TO", id="nan"),
        pytest.param(
            "loss=1@2.6-2.0",
            "interval of loss must have 0 <= begin < end [s], got 2.6 to 2",
            id="back",
        ),
        pytest.param("dup=1@2-2", "interval of duplicate must have 0 <= begin", id="empty"),
        pytest.param("loss=2@1-2", "loss must be in [0, 1], got 2", id="value"),
        pytest.param("loss=@1-2", "loss must be a number, got ''", id="no-value"),
        pytest.param("loss=0@1-2", "loss has an interval but is 0", id="zero"),
        pytest.param("seed=7@1-2", "seed cannot have an interval; loss, duplicate", id="seed"),
        pytest.param("direction=send@1-2", "direction cannot have an interval", id="direction"),
        pytest.param("flood=1,flood_ids=5@1-2", "flood_ids cannot have an interval", id="ids"),
        pytest.param("lost=1@1-2", "'lost' is unknown; use loss", id="unknown"),
        pytest.param("schedule=1", "'schedule' is unknown; use loss", id="schedule"),
        pytest.param("loss=1@1-2,loss=0.1", "loss is given twice", id="two-values"),
        pytest.param(
            "flip=0.6@1-3,garbage=0.6@2-4",
            "garbage must be 1 at most, got 1.2",
            id="sum-of-overlap",
        ),
    ],
)
def test_a_wrong_text_raises(text: str, words: str) -> None:
    """The message has what is wrong and what is allowed, in one line."""
    with pytest.raises(ValueError, match="faults: ") as caught:
        Faults.parse(text)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("loss", "must be WORD FRAME [VALUE]"),
        ("loss 1 2 3", "must be WORD FRAME [VALUE]"),
        ("burn 1", "'burn' is unknown; use loss, duplicate, reorder"),
        ("flood 1", "'flood' is unknown"),
        ("loss 0", "frames must be N or N-M from 1 on, got 0-0"),
        ("loss 5-3", "frames must be N or N-M from 1 on, got 5-3"),
        ("loss 1-", "frames must be N or N-M from 1 on, got '1-'"),
        (f"loss {'9' * 5000}", "frames must be N or N-M from 1 on, got '999"),
        (f"loss 1 0x{'f' * 400}", "'loss' takes no value, got more than 1e308"),
        (
            f"wrong_id 1 0x{'f' * 400}",
            "number in [0, 5.36871e+08], got more than 1e308",
        ),
        ("loss x", "frames must be N or N-M from 1 on, got 'x'"),
        ("loss 1 2", "'loss' takes no value, got 2"),
        ("reorder 1 0", "must be a whole number in [1, 10000] frames, got 0"),
        ("reorder 1 1.5", "must be a whole number in [1, 10000] frames, got 1.5"),
        ("flip 1 many", "must be a number, got 'many'"),
        ("truncate 1 9", "a length of CAN: 0, 1, 2"),
        ("delay 1 -1", "must be in [0, 3600] s, got -1"),
    ],
)
def test_a_wrong_line_of_a_script_raises(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "faults.txt"
    path.write_text(f"dup 1\n{line}\n")
    with pytest.raises(ValueError, match=r"faults: .*faults.txt, line 2: ") as caught:
        Faults.parse(f"script={path}")
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("loss", None, "loss must be in [0, 1], got None"),
        ("seed", "1", "seed must be a whole number in [0, 1.84467e+19], got '1'"),
        ("flood_ids", None, "flood_ids must be a tuple, got None"),
        ("flood_ids", ("a",), "flood_ids must be CAN IDs in [0, 0x1fffffff] or ranges"),
        ("flood_ids", (0.5,), "or ranges of them, got 0.5"),
        ("script", 3, "script must be a tuple, got 3"),
        ("script", ["loss 3"], "script must contain ScriptedFault objects, got 'loss 3'"),
    ],
)
def test_a_value_of_a_wrong_type_raises(field: str, value: Any, words: str) -> None:
    with pytest.raises(TypeError, match="faults: ") as caught:
        Faults(**{field: value})
    assert words in str(caught.value)


@pytest.mark.parametrize("ids", [range(0), range(-1, 3), range(3, 0x20000001), 0x20000000, -1])
def test_ids_out_of_range_raise(ids: Any) -> None:
    with pytest.raises(ValueError, match=r"flood_ids must be CAN IDs in \[0, 0x1fffffff\], got"):
        Faults(flood_ids=(0, ids))


def test_a_script_may_be_a_pipe(tmp_path: Path) -> None:
    """As with <(command) in a shell."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    threading.Thread(target=path.write_text, args=("loss 3\n",), daemon=True).start()
    assert Faults.parse(f"script={path}").script == (ScriptedFault(FaultKind.LOST, 3, 3),)


@pytest.mark.parametrize(
    ("text", "schedule"),
    [
        ("loss=1@2.0-2.6", [("loss", 2.0, 2.6)]),
        ("dup=0.5@0-.5", [("duplicate", 0.0, 0.5)]),
        ("loss=1@1e-3-2.", [("loss", 0.001, 2.0)]),
        ("flood=1000@5-, seed=3", [("flood", 5.0, math.inf)]),
        ("loss=1@2-3+5-6", [("loss", 2.0, 3.0), ("loss", 5.0, 6.0)]),
        ("delay=0.02@1-2,jitter=0.01@1-2", [("delay", 1.0, 2.0), ("jitter", 1.0, 2.0)]),
        (
            "corrupt=0.4@1-2",
            [(name, 1.0, 2.0) for name in ("flip", "truncate", "wrong_dlc", "wrong_id")],
        ),
    ],
)
def test_intervals_from_text(text: str, schedule: list[Any]) -> None:
    assert Faults.parse(text).schedule == tuple(Interval(*one) for one in schedule)


@pytest.mark.parametrize("schedule", [3, [3], [("loss", "a", "b")], [("loss", 1.0)], ["loss"]])
def test_a_schedule_of_a_wrong_type_raises(schedule: Any) -> None:
    with pytest.raises(TypeError, match="faults: schedule must"):
        Faults(loss=1.0, schedule=schedule)


def test_damage_of_one_time_after_the_other_may_sum_up_to_more() -> None:
    faults = Faults.parse("flip=0.6@1-2,garbage=0.6@2-4")
    assert (faults.at(1.5).garbage, faults.at(2.0).flip) == (0.0, 0.0)
