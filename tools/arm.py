"""Compiler and emulator for a Cortex-M, and what the project builds for it."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

EXAMPLE = Path(__file__).resolve().parents[1] / "c" / "examples" / "cortex_m4"
CC, QEMU = "arm-none-eabi-gcc", "qemu-system-arm"
#: Boards: options of the compiler, machine of QEMU. The second one has an FPU of double precision.
BOARDS = {
    "cortex-m4": (["-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16"], "mps2-an386"),
    "cortex-m7": (["-mcpu=cortex-m7", "-mfpu=fpv5-d16"], "mps2-an500"),
}
FLAGS = ["-std=gnu99", "-ffp-contract=off", "-ffunction-sections", "-fdata-sections", "-DNDEBUG"]
#: Of a program that begins with startup.c, and prints by the emulator.
START = ["-nostartfiles", "--specs=rdimon.specs", f"-T{EXAMPLE / 'link.ld'}",
         "-Wl,--no-warn-rwx-segments", EXAMPLE / "startup.c"]  # fmt: skip


def is_installed() -> bool:
    """Return whether the compiler and the emulator are here."""
    return shutil.which(CC) is not None and shutil.which(QEMU) is not None


def gcc_version() -> str:
    """Return the version of the compiler, such as 12.2."""
    found = re.match(r"\d+\.\d+", run([CC, "-dumpfullversion"]))
    return "" if found is None else found[0]


def on_board(program: Path, cpu: str, *arguments: object) -> str:
    """Return what a program prints on the board; one instruction takes 8 ns there."""
    words = ",".join(f"arg={word}" for word in (program.name, *arguments))
    semihosting = ["-semihosting-config", f"enable=on,target=native,{words}"]
    machine = ["-M", BOARDS[cpu][1], "-nographic", "-monitor", "none", "-serial", "null"]
    return run([QEMU, *machine, "-icount", "shift=3", *semihosting, "-kernel", program])


def run(command: Sequence[object]) -> str:
    """Return the output of a command.

    Raises:
        SystemExit: it failed.
    """
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)} ended with {done.returncode}:\n{done.stderr}")
    return done.stdout
