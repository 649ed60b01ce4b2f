"""tools/soak.py on few lines."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_soak_runs() -> None:
    """A short run keeps its promises and exits with 0."""
    command = [sys.executable, ROOT / "tools" / "soak.py", "--lines", "2000", "--json"]
    command += ["--only", "classic", "fd", "bus", "checksum"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)  # type: ignore[arg-type]
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(done.stdout)
    for part in ("classic", "fd"):
        assert result[part]["lines sent"] == 2000
        assert 0 < result[part]["delivered"] < 2000
        assert result[part]["lines delivered twice"] == 0
