#!/usr/bin/env python3
"""Run a command in the project's own environment, which is made on first use.

    python3 tools/run.py maplines demo     the main job
    python3 tools/run.py pytest            the tests

The environment is the folder .venv of this checkout; nothing outside it is
touched. It is made again when pyproject.toml changes. Needs Python 3.11 or later
with venv, and a package index that pip can reach; nothing else.
"""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
BIN = VENV / ("Scripts" if os.name == "nt" else "bin")
STAMP = VENV / "installed"
#: The command of a user needs no more than the package and what draws its pictures.
EXTRAS = {"maplines": "plot"}


def main(command):
    if not command or command[0] in ("-h", "--help"):
        print(__doc__)
        return 0
    if sys.version_info < (3, 11):  # noqa: UP036 - run by whatever python3 there is
        return fail(f"Python 3.11 or later is needed, this is {sys.version.split()[0]}")
    extra = EXTRAS.get(command[0], "dev")
    if not is_installed(extra) and (problem := install(extra)):
        return fail(problem)
    os.environ["PATH"] = f"{BIN}{os.pathsep}{os.environ.get('PATH', '')}"
    os.environ["VIRTUAL_ENV"] = str(VENV)
    try:
        return subprocess.run([find(command[0]), *command[1:]], check=False).returncode
    except FileNotFoundError:
        return fail(f"there is no command {command[0]!r} in {VENV} or on the path")
    except KeyboardInterrupt:
        return 130


def find(name):
    """The environment's own command; python means its python."""
    own = BIN / (name + (".exe" if os.name == "nt" else ""))
    return str(own) if own.exists() else name


def is_installed(extra):
    state, _, extras = (STAMP.read_text() if STAMP.exists() else "").partition(" ")
    return state == wanted() and extra in extras.split()


def wanted():
    source = (ROOT / "pyproject.toml").read_bytes() + f"{ROOT} {sys.version}".encode()
    return hashlib.sha256(source).hexdigest()


def install(extra):
    """Make the environment; returns what went wrong, or None."""
    print(f"run.py: setting up {VENV} (once) ...", file=sys.stderr, flush=True)
    made = subprocess.run([sys.executable, "-m", "venv", str(VENV)], check=False)
    if made.returncode:
        return "venv failed; on Debian and Ubuntu: apt-get install python3-venv"
    pip = [find("python"), "-m", "pip", "--disable-pip-version-check", "install", "-qq"]
    extras = ["dev", "plot"] if extra == "dev" else [extra]
    if subprocess.run([*pip, "--editable", f"{ROOT}[{','.join(extras)}]"], check=False).returncode:
        return "pip could not install the project; see its message above"
    STAMP.write_text(f"{wanted()} {' '.join(extras)}")
    return None


def fail(message):
    print(f"run.py: {message}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
