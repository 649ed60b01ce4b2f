"""Inside maplines_can imports point down, and each big dependency has one door."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "maplines_can"
LAYERS = [
    ["errors", "arguments", "arrays"],
    ["gaussian", "mixture", "line", "polyline"],
    ["scenarios", "propagation", "wire", "maps"],
    ["bus", "ego", "consumers"],
    ["study", "view"],
    ["cli"],
]
#: Who may import it. matplotlib and scipy.stats cost a second, and stay out of the start.
DOORS = {"can": {"bus"}, "cantools": {"wire"}, "matplotlib": {"study"}, "tqdm": {"cli"}}
DOORS |= {"cryptography": {"wire"}}
DOORS |= {"bokeh": {"study"}, "distributed": {"study"}, "pyarrow": {"study"}}
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}


def imports():
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                yield from ((parts, 0, alias.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                names = [node.module] if node.module else [a.name for a in node.names]
                yield from ((parts, node.level, name) for name in names)


def test_imports_point_down():
    """A module imports from lower layers, or from its own room among equals below the top."""
    seen = 0
    for parts, level, name in imports():
        target = name.split(".")[0]
        if parts == ("__init__",) or level != len(parts):
            continue
        seen += 1
        same_layer_value = len(parts) == 1 and target in LAYERS[1] and parts[0] in LAYERS[1]
        assert RANK[target] < RANK[parts[0]] or same_layer_value, f"{parts} imports {name}"
    assert seen > 50


def test_values_do_not_import_each_other_in_a_circle():
    """Among the values, mixture builds on gaussian, and line on both."""
    pairs = {
        (parts[0], name)
        for parts, level, name in imports()
        if len(parts) == 1 and level == 1 and parts[0] in LAYERS[1] and name in LAYERS[1]
    }
    assert pairs == {("mixture", "gaussian"), ("line", "gaussian"), ("line", "mixture")}


def test_big_dependencies_have_one_door():
    """can is imported in bus, cantools in wire, matplotlib where figures are drawn."""
    used = {door: set() for door in DOORS}
    for parts, level, name in imports():
        top = name.split(".")[0]
        if not level and top in DOORS:
            used[top].add(parts[0])
    assert used == DOORS


def test_the_two_arms_meet_only_in_the_values():
    """A receiver needs no map, and an estimator no bus."""
    for parts, level, name in imports():
        if level == len(parts) and parts[0] in {"wire", "bus"}:
            assert name.split(".")[0] not in {"propagation", "scenarios", "maps", "ego"}
        if level == len(parts) and parts[0] in {"propagation", "scenarios"}:
            assert name.split(".")[0] not in {"wire", "bus"}


@pytest.mark.parametrize("room", ["wire", "propagation"])
def test_the_pure_middle_does_no_input_or_output(room):
    """No clock, no socket, no randomness of its own; wire reads its DBC and nothing else."""
    for parts, level, name in imports():
        if parts[0] == room and not level:
            assert name.split(".")[0] not in {"time", "socket", "random", "threading", "os"}
