"""The self-test of the arithmetic: it passes with IEEE 754, and names what differs."""

import platform
import shutil
import subprocess
from pathlib import Path

import pytest
from support import c_core

SOURCE = c_core.C / "src" / "self_test.c"
MAIN = """\
#include "maplines.h"
#include <stdio.h>
int main(void)
{
    const char *wrong = maplines_self_test();
    puts(wrong == NULL ? "right" : wrong);
    return 0;
}
"""


def said(folder: Path, cc: str, *flags: str, more: str = "") -> str:
    """Return what the self-test says in a program that is compiled with these flags."""
    if not shutil.which(cc):
        pytest.skip(f"there is no {cc}")
    (folder / "main.c").write_text(MAIN + more)
    sources = [str(SOURCE), str(SOURCE.with_name("elementary.c")), "main.c"]
    include = [f"-I{c_core.C / name}" for name in ("include", "src")]
    command = [cc, "-std=c99", "-w", *flags, *include, *sources, "-lm", "-o", "program"]
    subprocess.run(command, check=True, cwd=folder)
    program = folder / "program"
    return subprocess.run([program], check=True, capture_output=True, text=True).stdout.strip()


@pytest.mark.parametrize("flags", [["-O0"], ["-O3"], ["-Os"], ["-O2", "-DMAPLINES_FLOAT=1"]])
@pytest.mark.parametrize("cc", ["gcc", "clang"])
def test_it_passes_with_the_arithmetic_of_ieee_754(
    tmp_path: Path, cc: str, flags: list[str]
) -> None:
    assert said(tmp_path, cc, "-ffp-contract=off", *flags) == "right"


@pytest.mark.parametrize("level", ["-O1", "-O2", "-Os"])
@pytest.mark.parametrize(
    ("flags", "wrong"),
    [
        ("-freciprocal-math", "quotient"),
        ("-fassociative-math -fno-signed-zeros -fno-trapping-math", "sum"),
        ("-funsafe-math-optimizations", "quotient"),
    ],
)
def test_options_of_clang_without_a_macro_are_found(
    tmp_path: Path, level: str, flags: str, wrong: str
) -> None:
    """Alone, -fassociative-math has no effect in clang."""
    assert said(tmp_path, "clang", level, *flags.split()) == wrong


needs_x86_64 = pytest.mark.skipif(platform.machine() != "x86_64", reason="for x86-64")


@needs_x86_64
def test_fused_multiplications_are_found(tmp_path: Path) -> None:
    """The source forbids them, which this option of clang overrules."""
    if "fma" not in Path("/proc/cpuinfo").read_text().split():
        pytest.skip("this CPU has none")
    assert said(tmp_path, "clang", "-O2", "-mfma", "-ffp-contract=fast") == "product and sum"


@needs_x86_64
def test_a_cpu_that_flushes_subnormal_numbers_is_found(tmp_path: Path) -> None:
    """As a library that is linked with -ffast-math sets it, for the whole program."""
    mode = "__attribute__((constructor)) static void set(void) { __builtin_ia32_ldmxcsr(0x9FC0); }"
    assert said(tmp_path, "gcc", "-O2", more=mode) == "subnormal number"
