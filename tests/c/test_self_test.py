"""The self-test of the arithmetic: it passes with IEEE 754, and names what differs."""

import platform
import shutil
import struct
import subprocess
from math import sqrt
from pathlib import Path

import numpy as np
import pytest
from support import c_core

from maplines_can.model.elementary import atan, exp2, log2, sin_cos, tan

SOURCE = c_core.C / "src" / "self_test.c"
MASK = 2**64 - 1
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


def fold(folded: dict[str, int], name: str, *values: float) -> None:
    """Fold the bits of numbers into those of others: FNV-1a by 64 bits."""
    for value in values:
        (bits,) = struct.unpack("<Q", struct.pack("<d", value))
        folded[name] = ((folded.get(name, 0) ^ bits) * 0x100000001B3) & MASK


def model() -> dict[str, int]:
    """Return what the cases give in Python, by their names."""
    folded: dict[str, int] = {}
    quotients = [0.0] * 8
    state = 1
    for i in range(160):
        numbers = []
        for _ in range(3):
            state = (state * 1664525 + 1013904223) & 0xFFFFFFFF
            numbers.append(1.0 + state * 2.0**-32)
        x, y, z = numbers
        quotients[i % 8] = x / y
        ratio, other = x / z, y / z
        third = ratio / 3.0
        fold(folded, "quotient", ratio, other, 1.0 / z, third)
        total = 0.0
        for quotient in quotients:
            total = total + quotient
        fold(folded, "sum", total, (x + ratio) - x)
        fold(folded, "product and sum", ratio * other - third)
        root = sqrt(other)
        fold(folded, "square root", root, x / root)
        fold(folded, "subnormal number", (ratio * 2.0**-1000) * (other * 2.0**-40))
        fold(folded, "float", *singles(*map(np.float32, numbers)))
        if i % 8 == 0:
            fold(folded, "power of 2", exp2(64.0 * x - 96.0))
            fold(folded, "logarithm", log2(x * x - 0.5))
            fold(folded, "sine and cosine", *sin_cos(16.0 * y - 24.0))
            fold(folded, "tangent", tan(y - 1.5))
            fold(folded, "arc tangent", atan(4.0 * z - 6.0))
    return folded


def singles(x: np.float32, y: np.float32, z: np.float32) -> list[float]:
    """Return the numbers of a round in single precision."""
    ratio, other = x / z, y / z
    third = ratio / np.float32(3)
    back = (x + ratio) - x
    return [float(v) for v in (ratio, other, third, back, ratio * other - third, np.sqrt(other))]


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
