"""Imports inside maplines_can point down, file by file, and each big dependency has one door."""

import ast
from collections.abc import Iterable, Iterator
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).parents[1] / "maplines_can"

#: Folders of the product, from the binding of C up. A folder imports only those before it:
#: the core is what stands before the maps.
ROOMS = (
    "core", "values", "propagation", "dbc_files",
    "wire.layout", "wire.protection", "wire.reception", "wire",
    "generation",
    "logs", "bus", "recordings", "desk", "cosimulation",
    "maps", "maps.formats", "localisation", "consumers", "simulation", "pictures", "restbus", "cli",
)  # fmt: skip
#: Modules that stand lower than their folder.
BELOW = {"values.errors": "core", "engines": "values"}
#: Commands that run the study; the others import it, and fault injection, only inside functions.
STUDY_COMMANDS = {f"cli.{name}" for name in (
    "study", "design", "selftest", "paper",
)}  # fmt: skip
#: What the model may import of the package: the types of lines, and what a DBC says.
OF_MODEL = ("values.errors", "values.line", "values.scene", "wire.layout")
#: Who may import the model: the comparison of core and model, which ``maplines selftest`` runs.
MODEL_USERS = {f"testing.{name}" for name in (
    "hostile_streams", "back_to_back", "sender_streams", "ecu_streams", "map_streams",
)}  # fmt: skip
#: Imports inside functions of the product: what and where from. They run when an option asks.
LAZY = {
    ("cli.options", "testing"), ("cli.options", "study.comparison"),
    ("cli.options", "study.code_dbcs"),
    ("simulation.round_trip", "testing"), ("simulation.transmission", "testing"),
    ("restbus.frame_faults", "testing"),
    ("cosimulation.connections", "testing"), ("cosimulation.runner", "testing"),
}  # fmt: skip
#: Packages that may import a big dependency.
DOORS = {
    "can": {"bus", "logs", "testing", "restbus"},
    "cantools": {"dbc_files", "generation", "restbus"},
    "cryptography": {"wire"},
    "tqdm": {"cli"},
    "matplotlib": {"pictures", "study", "recordings"},
    "bokeh": {"study", "recordings"},
    "distributed": {"engines"},
    "pyarrow": {"simulation", "study", "recordings"},
    "fmpy": {"cosimulation"},
    "small_gicp": {"localisation"},
    "pyproj": {"maps"},
    "rosbags": {"recordings"},
    "osi3": {"recordings"},
}


class Import(NamedTuple):
    """An import of a module of this package, or of another one."""

    importer: str
    target: str
    is_own: bool
    is_lazy: bool  #: inside a function, or for type checkers only


def name_of(path: Path, package: Path) -> str:
    """Return the dotted name of a file below the package; that of a package is its folder."""
    parts = path.relative_to(package).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {name_of(path, PACKAGE): path for path in PACKAGE.rglob("*.py")}


def imports_of(name: str, text: str) -> Iterator[Import]:
    """Yield the imports of a module of the package with this text."""
    is_folder = FILES[name].name == "__init__.py" and name
    parents, tree = name.split(".") if is_folder else name.split(".")[:-1], ast.parse(text)
    lazy = {
        id(node)
        for parent in ast.walk(tree)
        if isinstance(parent, ast.FunctionDef | ast.AsyncFunctionDef)
        or (isinstance(parent, ast.If) and ast.unparse(parent.test) == "TYPE_CHECKING")
        for node in ast.walk(parent)
    }
    for node in ast.walk(tree):
        is_lazy = id(node) in lazy
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(name, alias.name, is_own=False, is_lazy=is_lazy)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield Import(name, node.module or "", is_own=False, is_lazy=is_lazy)
        elif isinstance(node, ast.ImportFrom):
            base = parents[: len(parents) - node.level + 1]
            base += node.module.split(".") if node.module else []
            for alias in node.names:
                target = ".".join([*base, alias.name])
                target = target if target in FILES else ".".join(base)
                yield Import(name, target, is_own=True, is_lazy=is_lazy)


#: At import: after other tests, CPython 3.11 may fail to parse.
IMPORTS = [one for name, path in FILES.items() for one in imports_of(name, path.read_text())]


def rank(module: str) -> int:
    """Return the place of a module's folder in the order; names of a whole folder come last."""
    module = BELOW.get(module, module)
    around = [room for room in ROOMS if f"{module}.".startswith(f"{room}.")]
    inside = [room for room in ROOMS if f"{room}.".startswith(f"{module}.")]
    return max(ROOMS.index(room) for room in inside or [max(around, key=len, default="cli")])


def is_product(module: str) -> bool:
    """Return whether a module is neither the study, fault injection nor the model."""
    return module.split(".")[0] not in {"study", "testing", "model"}


def upward(imports: Iterable[Import] = IMPORTS) -> list[str]:
    """Return those of imports that point up, or from the product to the study, the model or faults.

    The model imports types and layouts only.
    """
    found = []
    for importer, target, is_own, is_lazy in imports:
        if not is_own or not importer or not target:  # the package shows the names of all
            continue
        if importer.startswith("model"):
            is_allowed = target.startswith(("model", *OF_MODEL))
        elif target.startswith("model"):
            is_allowed = importer in MODEL_USERS
        elif is_product(importer) and not is_product(target):
            is_allowed = importer in STUDY_COMMANDS or (is_lazy and (importer, target) in LAZY)
        elif is_product(importer):
            is_allowed = rank(target) <= rank(importer)
        else:
            above = {"study", "cli"} if importer.startswith("testing") else {"cli"}
            is_allowed = target.split(".")[0] not in above
        if not is_allowed:
            found.append(f"{importer} imports {target}")
    return found


def test_imports_point_down() -> None:
    """No file imports one that stands after it, and the product imports no study."""
    assert upward() == []


def test_the_order_is_complete() -> None:
    """Each folder of the product is in the list, and nothing stands beside the folders."""
    top = {path.name for path in PACKAGE.iterdir() if path.suffix in ("", ".py")}
    rooms = {room.split(".")[0] for room in ROOMS}
    single = {"__init__.py", "__main__.py", "engines.py"}
    assert top - {"__pycache__"} == rooms | {"study", "testing", "model"} | single


def test_a_file_name_stands_for_one_thing() -> None:
    """Only a rule and its model share a name, and a command and what it runs."""
    paths = [path for path in PACKAGE.rglob("*.py") if not path.name.startswith("__")]
    product = [path.name for path in paths if path.parent.name not in ("model", "cli")]
    assert [name for name in set(product) if product.count(name) > 1] == []


def test_there_is_no_circle() -> None:
    """Neither in the product nor in the study, not even by an import inside a function."""
    graph: dict[str, set[str]] = {}
    for importer, target, is_own, _ in IMPORTS:
        if is_own and importer:
            graph.setdefault(importer, set()).add(target)
    list(TopologicalSorter(graph).static_order())  # raises CycleError


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("values.line", "from ..propagation import Refit"),
        ("bus.link", "from ..maps import Map"),
        ("propagation.motion", "from ..localisation import Localisation"),
        ("wire.codec", "from ..bus import Link"),
        ("wire.layout.record_signals", "from ..protection.key import Key"),
        ("maps.road_map", "from .formats.load import load"),
        ("wire.protection.key", "from ..codec import Codec"),
        ("bus.link", "from ..testing import FaultyBus"),
        ("wire.codec", "from ..study import metrics"),
        ("cli.receive", "def f():\n    from ..study import sets"),
        ("study.metrics", "from ..cli import main"),
        ("wire.codec", "def f():\n    from ..model.decoder import Receiver"),
        ("cli.selftest", "from ..model import e2e"),
        ("model.e2e", "from ..wire.reception.check import Reason"),
        ("model.e2e", "from ..values.linalg import eigen"),
    ],
)
def test_an_upward_import_is_found(module: str, line: str) -> None:
    """The test above can fail."""
    assert len(upward(imports_of(module, line))) == 1


def test_big_dependencies_have_one_door() -> None:
    """can is imported in bus, cantools in dbc_files, matplotlib where figures are drawn."""
    used: dict[str, set[str]] = {door: set() for door in DOORS}
    for importer, target, is_own, _ in IMPORTS:
        if not is_own and (top := target.split(".")[0]) in DOORS:
            used[top].add(importer.split(".")[0])
    assert used == DOORS


def test_the_estimation_and_the_wire_meet_only_in_the_values() -> None:
    """A receiver needs no map, and an estimator no bus."""
    arms = ({"wire", "logs", "bus"}, {"propagation", "maps", "localisation"})
    for importer, target, is_own, _ in IMPORTS:
        here, there = importer.split(".")[0], target.split(".")[0]
        for one, other in (arms, arms[::-1]):
            assert not (is_own and here in one and there in other), f"{importer} imports {target}"


@pytest.mark.parametrize("arm", ["wire", "propagation"])
def test_the_pure_middle_does_no_input_or_output(arm: str) -> None:
    """No clock, socket, thread or randomness of its own; wire reads its DBC and nothing else."""
    impure = {"time", "socket", "random", "threading", "os"}
    for importer, target, is_own, _ in IMPORTS:
        if importer.split(".")[0] == arm and not is_own:
            assert target.split(".")[0] not in impure, f"{importer} imports {target}"
