#!/usr/bin/env python3
"""Run a command in the environment of the project. The first run makes the environment.

    python3 tools/run.py maplines demo     the command of the package
    python3 tools/run.py pytest            the tests

The environment is the folder .venv of this checkout; nothing outside it changes. It is made
again when pyproject.toml or the C of the core changes. This needs Python 3.11 or later with venv,
and a package index that pip can reach; without a C compiler, pip fetches one (100 MB).
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
BIN = VENV / ("Scripts" if os.name == "nt" else "bin")
#: Holds the hash of what was installed, and the extras.
STAMP = VENV / "installed"
#: Extras by command; every other command needs all development tools.
EXTRAS = {"maplines": "plot"}


def main(command: list[str]) -> int:
    """Run the command and return its exit status."""
    if not command or command[0] in ("-h", "--help"):
        print(__doc__)
        return 0
    if sys.version_info < (3, 11):  # noqa: UP036 - any python3 may run this file
        return fail(f"Python 3.11 or later is needed, this is {sys.version.split()[0]}")
    extra = EXTRAS.get(command[0], "dev")
    if not is_installed(extra) and (problem := install(extra)):
        return fail(problem)
    os.environ["PATH"] = f"{BIN}{os.pathsep}{os.environ.get('PATH', '')}"
    os.environ["VIRTUAL_ENV"] = str(VENV)
    try:
        if os.name != "nt":  # the command takes this process over, and so its signals
            os.execvp(find(command[0]), [find(command[0]), *command[1:]])  # noqa: S606
        return subprocess.run([find(command[0]), *command[1:]], check=False).returncode
    except FileNotFoundError:
        return fail(f"there is no command {command[0]!r} in {VENV} or on the path")
    except KeyboardInterrupt:
        return 130


def find(name: str) -> str:
    """Return the path of a command in the environment; a command of the system keeps its name."""
    own = BIN / (name + (".exe" if os.name == "nt" else ""))
    return str(own) if own.exists() else name


def is_installed(extra: str) -> bool:
    """Return whether the environment is up to date and has the extra."""
    state, _, extras = (STAMP.read_text() if STAMP.exists() else "").partition(" ")
    return state == source_hash() and extra in extras.split()


def source_hash() -> str:
    """Return the hash of what the environment is made from."""
    folders = [ROOT / "c" / name for name in ("include", "src", "propagation", "core")]
    built = sorted(path for folder in folders for path in folder.glob("*.[ch]"))
    files = [ROOT / "pyproject.toml", ROOT / "tools" / "build_core.py", *built]
    source = b"".join(path.read_bytes() for path in files) + f"{ROOT} {sys.version}".encode()
    return hashlib.sha256(source).hexdigest()


def install(extra: str) -> str | None:
    """Make the environment; return the error message, or None."""
    print(f"run.py: setting up {VENV} (once) ...", file=sys.stderr, flush=True)
    made = subprocess.run([sys.executable, "-m", "venv", str(VENV)], check=False)
    if made.returncode:
        return "venv failed; on Debian and Ubuntu: apt-get install python3-venv"
    pip = [find("python"), "-m", "pip", "--disable-pip-version-check", "install", "-qq"]
    extras = ["dev", "plot"] if extra == "dev" else [extra]
    command = [*pip, "--editable", f"{ROOT}[{','.join(extras)}]"]
    if subprocess.run(command, check=False).returncode:
        return "pip could not install the project; see its message above"
    STAMP.write_text(f"{source_hash()} {' '.join(extras)}")
    return None


def fail(message: str) -> int:
    """Print an error and return the exit status."""
    print(f"run.py: {message}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
