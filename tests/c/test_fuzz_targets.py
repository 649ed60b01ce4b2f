"""The targets of tools/c_fuzz.py hold for random inputs: its hours of fuzzing are no test."""

import subprocess

import pytest
from random_dbc import LIMIT_SEED, random_dbc
from scene_layouts import layout_of
from support import c_core

from maplines_can.wire import Layout

SHIPPED = ("maplines.dbc", "maplines-pose.dbc", "maplines-secoc.dbc", "maplines-scene.dbc")


@pytest.mark.parametrize("target", ["frames", "encoder"])
@pytest.mark.parametrize("dbc", [*SHIPPED, "at the limits"])
def test_random_inputs_break_nothing(target: str, dbc: str) -> None:
    """200 inputs of up to 4 kB: what must hold after each step is in the targets."""
    layout = layout_of(dbc) if dbc in SHIPPED else Layout.from_text(random_dbc(LIMIT_SEED))
    main = c_core.C / "tests" / f"fuzz_{target}.c"
    program = c_core.program([main], [layout], [c_core.NAME])
    subprocess.run([str(program), "200", "1"], check=True)
