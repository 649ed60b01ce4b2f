"""tools/vcan as a command: its help, wrong usage, and what it passes on."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

VCAN = Path(__file__).parents[1] / "tools" / "vcan"


def vcan(*args: Any, cwd: Any = None, **settings: Any) -> Any:
    env = {k: v for k, v in os.environ.items() if not k.startswith("VCAN_") or k == "VCAN_CACHE"}
    return subprocess.run(
        [VCAN, *args],
        env=env | settings,
        cwd=cwd,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


def missing_kernel() -> str:
    """Reason why no kernel with SocketCAN is available without a download; empty if one is."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (AttributeError, OSError):
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        cache = Path(os.environ.get("VCAN_CACHE") or Path(home) / "vcan-uml")
        kernels = Path("/usr/bin/linux.uml"), cache / "user-mode-linux/usr/bin/linux.uml"
        if not any(kernel.exists() for kernel in kernels):
            return "no SocketCAN here and no guest in the cache yet: run `tools/vcan true` once"
    return ""


@pytest.mark.parametrize(
    ("args", "settings", "words"),
    [
        pytest.param([], {}, "usage: tools/vcan COMMAND", id="no-command"),
        pytest.param(["--hepl"], {}, "unknown option --hepl", id="unknown-option"),
        pytest.param(["true"], {"VCAN_TIMEOUT": "1 'm"}, "whole seconds, got '1 'm'", id="limit"),
        pytest.param(["true"], {"VCAN_MEM": "1G"}, "a number of MB, got '1G'", id="memory"),
    ],
)
def test_wrong_usage_is_status_2(args: Any, settings: Any, words: str) -> None:
    refused = vcan(*args, **settings)

    assert (refused.returncode, refused.stdout) == (2, "")
    assert words in refused.stderr


@pytest.mark.skipif(bool(missing_kernel()), reason=missing_kernel() or "-")
def test_the_command_runs_as_it_would_here(tmp_path: Path) -> None:
    """Arguments, environment, directory, both outputs and the status are passed unchanged."""
    args = ["a  b", "it's", '"', "", "*", "$HOME", "two\nlines", "é", "--", "-n"]
    env = {"V_QUOTES": "'\"` \\", "V_LINES": "a\nb ", "V_EMPTY": "", "V.odd": "x"}
    env["BASH_FUNC_timeout%%"] = "() {  echo an exported function; exit 1\n}"
    folder = tmp_path / 'a folder\'s "name"'
    folder.mkdir()
    script = (
        "import json, os, sys, socket\n"
        "env = {k: v for k, v in os.environ.items() if k in json.loads(sys.argv[1])}\n"
        "can = [name for _, name in socket.if_nameindex() if name.startswith('vcan')]\n"
        "print(json.dumps([sys.argv[2:], env, os.getcwd(), can]))\n"
        "sys.stderr.write('to stderr')\n"
        "sys.exit(7)\n"
    )

    run = vcan(sys.executable, "-c", script, json.dumps(list(env)), *args, cwd=folder, **env)

    assert (run.returncode, run.stderr) == (7, "to stderr")
    assert [args, env, str(folder)] == json.loads(run.stdout)[:3]
    assert {"vcan0", "vcan1", "vcan2"} <= set(json.loads(run.stdout)[3])
