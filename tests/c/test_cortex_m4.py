"""On a Cortex-M4 in QEMU the core gives the numbers of this host, and passes the test vectors.

What it takes there is what docs/embedding.md says, within 10 %.
"""

from pathlib import Path

import arm
import cortex_m4
import pytest
from call_graph import CallGraph
from cortex_libraries import LIBRARIES, OPTIONS, measured

from maplines_can.cli import main

pytestmark = pytest.mark.skipif(
    not arm.is_installed(), reason="no arm-none-eabi-gcc or no qemu-system-arm"
)


#: Tables of the page are those of one compiler.
IS_THAT_OF_THE_PAGE = arm.is_installed() and cortex_m4.is_of_this_compiler(
    cortex_m4.table_of_page("sizes")
)


@pytest.mark.parametrize(
    ("name", "bound"),
    [
        ("Cortex-M4, double", cortex_m4.TOLERANCE),
        ("Cortex-M4, float", 0.0),
        ("Cortex-M4, double, `maplines-pose.dbc`", cortex_m4.TOLERANCE),
    ],
)
def test_the_board_has_the_numbers_of_this_host(tmp_path: Path, name: str, bound: float) -> None:
    """Lines and scenes of recorded frames; memory and time are those of the page.

    The vectors of maplines.dbc pass, too, by the program that anyone can use.
    """
    target = cortex_m4.TARGETS[name]
    found = cortex_m4.measure_in(tmp_path, target)

    assert found["largest difference"] <= bound
    assert found["bytes"]["static data"] == 0
    if IS_THAT_OF_THE_PAGE:
        table = cortex_m4.target_table({name: found})
        assert cortex_m4.changes(table, cortex_m4.table_of_page("cortex")) == []
    if target.dbc == "maplines.dbc":
        assert main(["generate", "vectors", "--out", str(tmp_path)]) == 0
        programs = cortex_m4.build(tmp_path, target, [tmp_path / "run_vectors.c"], "maplines")
        vectors = tmp_path / "maplines.txt"
        board = arm.on_board(programs["board"], target.cpu, vectors)
        assert board == arm.run([programs["host"], vectors])
        assert " 0 failed" in board


@pytest.mark.skipif(not IS_THAT_OF_THE_PAGE, reason="another compiler than that of the page")
@pytest.mark.parametrize(
    "name",
    [
        "all",
        "receiver, `maplines-scene.dbc`",
        "receiver of lines, 4 slots",
        "sender of lines, 4 slots",
    ],
)
def test_a_library_takes_what_the_page_says(name: str) -> None:
    """Bytes, greatest counts of the cases that were searched, and the deepest stack."""
    found = measured(*LIBRARIES[name])

    for call in found.calls.values():
        assert call.written <= call.stack
    for table, now in cortex_m4.library_tables({name: found}).items():
        assert cortex_m4.changes(now, cortex_m4.table_of_page(table)) == []


SOURCE = """\
#include <math.h>
#include <stdbool.h>
#define ALONE static __attribute__((noinline))
ALONE bool deep(const double *state, const void *context, double *value)
{
    volatile double place[100];
    place[0] = state[0];
    *value = sqrt(place[0]);
    return context != 0;
}
ALONE double by_pointer(bool (*volatile function)(const double *, const void *, double *))
{
    double value = 2;
    return function(&value, &value, &value) ? value : 0;
}
double maplines_outer_double_1(void) { return by_pointer(deep) + 1; }
double maplines_circle_double_1(int n);
ALONE double half(int n) { return maplines_circle_double_1(n / 2) * 2; }
double maplines_circle_double_1(int n) { return n > 0 ? half(n) + 1 : 0; }
int main(void) { return maplines_outer_double_1() + maplines_circle_double_1(3) > 9; }
"""


def test_the_deepest_stack_is_that_of_a_path_of_calls(tmp_path: Path) -> None:
    """By a pointer, and in the C library, too; there is none of functions that call themselves."""
    source, program = tmp_path / "program.c", tmp_path / "program.elf"
    source.write_text(SOURCE)
    made = source.with_suffix(".o")
    arm.run([arm.CC, *OPTIONS, "-fcallgraph-info=su", "-c", source, "-o", made])
    arm.run([arm.CC, *OPTIONS, *arm.START, "-Wl,--gc-sections", made, "-lm", "-o", program])
    graph = CallGraph(source, program)

    found = graph.deepest("maplines_outer")

    assert found.functions[1:4] == ("by_pointer", "deep", "sqrt")
    assert 800 + 4 * 8 < found.stack < 1000
    with pytest.raises(ValueError, match="half calls maplines_circle"):
        graph.deepest("maplines_circle")
