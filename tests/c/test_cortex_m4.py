"""On a Cortex-M4 in QEMU the core gives the numbers of this host, and passes the test vectors."""

from typing import Any

import cortex_m4
import pytest

from maplines_can.cli import main

pytestmark = pytest.mark.skipif(
    not cortex_m4.is_installed(), reason="no arm-none-eabi-gcc or no qemu-system-arm"
)


@pytest.mark.parametrize(
    ("target", "bound"),
    [
        pytest.param(cortex_m4.Target(), cortex_m4.TOLERANCE, id="double"),
        pytest.param(cortex_m4.Target(single=True), 0.0, id="float"),
        pytest.param(cortex_m4.Target(cpu="cortex-m7"), 0.0, id="double-with-fpu"),
        pytest.param(cortex_m4.Target("maplines-pose.dbc", single=True), 0.0, id="conditional"),
    ],
)
def test_the_board_has_the_numbers_of_this_host(target: Any, bound: Any) -> None:
    """Lines and scenes of recorded frames; there is no static data, and the stack is small."""
    found = cortex_m4.measure(target)

    assert found["largest difference"] <= bound
    assert found["bytes"]["static data"] == 0
    assert max(found["stack"].values()) < 24_000
    assert found["instructions"]["feed, a frame that waits for others"] < 3_000


@pytest.mark.parametrize("single", [False, True], ids=["double", "float"])
def test_the_vectors_pass_on_the_board(tmp_path: Any, single: Any) -> None:
    """All of maplines.dbc, by the program that anyone can use."""
    assert main(["generate", "vectors", "--out", str(tmp_path)]) == 0
    target = cortex_m4.Target(single=single)
    programs = cortex_m4.build(tmp_path, target, [tmp_path / "run_vectors.c"], "maplines")
    vectors = tmp_path / "maplines.txt"

    board = cortex_m4.on_board(programs["board"], target.cpu, vectors)

    assert board == cortex_m4.run([programs["host"], vectors])
    assert " 0 failed" in board
