"""What runs in each cycle is computed in the thread that calls it.

Threads of BLAS help with large matrices. With small ones they cost a hundred times the product
itself as soon as the cores are busy, since they wait for each other by spinning.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parent


@pytest.mark.skipif(sys.platform != "linux", reason="threads of a process are listed by Linux only")
def test_no_call_of_a_cycle_wakes_a_thread_of_blas() -> None:
    """Neither the first ones nor later ones, of NumPy's library and of SciPy's."""
    environment = {key: value for key, value in os.environ.items() if "NUM_THREADS" not in key}
    paths = [str(TESTS), str(TESTS.parent / "tools"), str(TESTS.parent)]
    done = subprocess.run(
        [sys.executable, str(TESTS / "support" / "blas_threads.py")],
        env=environment | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    if not found["controls"]:
        pytest.skip("BLAS has one thread here, even for large matrices")
    assert found["cycle"] == []
