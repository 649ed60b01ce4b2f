#!/usr/bin/env python3
"""Write maplines_can/core/declarations.py: what cffi makes of core.h and what it includes.

python3 tools/run.py python tools/make_declarations.py     after a change of these headers
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path
from zlib import crc32

from build_core import MACROS
from cffi import FFI

ROOT = Path(__file__).resolve().parents[1]
PATH = ROOT / "maplines_can" / "core" / "declarations.py"
#: Standard headers, whose types cffi knows.
HEADERS = {
    "float.h": "#define FLT_RADIX 2\n#define FLT_MANT_DIG 24\n#define DBL_MANT_DIG 53\n",
    "stdbool.h": "",
    "stddef.h": "",
    "stdint.h": "#define INT64_C(value) value\n",
}


def declarations() -> str:
    """Return the Python file."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in HEADERS.items():
            (Path(folder) / name).write_text(text)
        command = [os.environ.get("CC", "cc"), "-E", "-P", "-nostdinc", f"-I{folder}"]
        command += MACROS
        command += [f"-I{ROOT / 'c' / name}" for name in ("include", "logs")]
        command += [str(ROOT / "c" / "core" / "core.h")]
        text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        ffi = FFI()
        ffi.cdef("\n".join(line for line in text.splitlines() if not line.startswith("#")))
        ffi.set_source("maplines_can.core.declarations", None)
        path = Path(folder) / "declarations.py"
        ffi.emit_python_code(str(path))
        made = path.read_text()
        checksum = f"{crc32(made.encode()):#010x}"
        return f"{made}\n# Of all above; the library has it, too.\nCHECKSUM = {checksum}\n"


if __name__ == "__main__":
    PATH.write_text(declarations())
