"""Imports inside maplines_can point down, file by file, and each big dependency has one door."""

import ast
import shutil
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).parents[1] / "maplines_can"

#: All modules of the product. A module imports only modules that stand before it.
ORDER = """
arrays errors input_files
gaussian mixture line map_error scene seen_lines search_tree polyline
street_shapes scenarios
propagation.valid_range propagation.misfit propagation.refit propagation.transform
propagation.linear propagation.monte_carlo
propagation.nonlinearity propagation.quadrature propagation.sigma_points propagation.motion
propagation.prediction propagation.splitting propagation.component_counts propagation.certain_range
propagation.map_lines
propagation.map_scene propagation.scene_mixture
propagation
maps.landmarks maps.lane maps.joints maps.matching maps.driven maps.routing maps.view maps.model
maps.tracking maps.town
maps.xml_tree maps.projection
maps.lanelets maps.lanelet_tags maps.osm maps.lanelet2 maps.commonroad maps.points
maps.opendrive.profiles maps.opendrive.reference_line maps.opendrive.attributes
maps.opendrive.lane_section maps.opendrive.road maps.opendrive.landmarks
maps.opendrive.boundaries maps.opendrive.links
maps.opendrive.reader maps.opendrive
maps.load maps.tour maps
wire.reasons
wire.message wire.message.attributes wire.message.dbc_limits wire.message.signals
wire.message.packing wire.message.requirement wire.message.requirements wire.message.slot_messages
wire.message.record_layout wire.message.pose_layout wire.message.dbc_messages
wire.message.dbc_reader wire.message.layout
wire.message.validation
wire.covariance.code wire.covariance.factor wire.covariance.cholesky
wire.covariance.joint wire.covariance.own_levels wire.covariance.rounding
wire.covariance.nearest_line
wire.covariance.scene_code wire.covariance.scene_encoder wire.covariance
wire.protection wire.protection.e2e
wire.message.reader wire.message.writer wire.message.components wire.message.line_writer
wire.message.raw_records wire.message.pose_records wire.message.complete_records
wire.message.scene_writer wire.message.scene_reader
wire.protection.e2e_state wire.protection.key wire.protection.secoc
wire.message.frames
wire.reception wire.reception.conflict wire.reception.deadline wire.reception.history
wire.reception.mixtures wire.reception.reassembly wire.reception.sequence
wire.reception.epochs wire.reception.poses wire.reception.scenes wire.reception.decoder
wire.reception.monitor wire.reception.settings
wire.codec
wire
bus.background bus.binary_logs bus.driver_errors bus.keys bus.load bus.log_writer bus.logs
bus.schedule bus.signals
bus.socketcan bus.bus_factory bus.link bus.stamp_clock bus.listener bus.receiver bus.tx_queue
bus.transmitter bus
ego.smooth_path ego.drive ego.pose_source ego.line_source ego.map_frame ego.columns ego.records
ego.recorded ego.route_drive
ego.localisation.sensor_errors ego.localisation.motion_model ego.localisation.measurements
ego.localisation.localisation_layer ego.localisation.association
ego.localisation.observation_models ego.localisation.confirmation
ego.localisation.correlation ego.localisation.admission
ego.localisation.odometry_stream ego.localisation.consistency ego.localisation.alignment
ego.localisation.gnss_hypotheses
ego.localisation.step ego.localisation.filter
ego.localisation ego.simulated_sensors ego.simulated_localisation
ego.scan_matching.reference ego.scan_matching.match ego.scan_matching.ndt ego.scan_matching.icp
ego.scan_matching ego
consumers.error_times consumers.consistency consumers.plausibility consumers.path
consumers.curvature_limiter
consumers.steering consumers.lane_filter consumers.lane_fusion consumers.integrity consumers
cli.output cli.parsing cli.options cli.overwriting cli.fitting_dbc cli.missing_files
cli.truth_paths cli.production cli.report cli.scenarios cli.scene_sending
cli.sending cli.stderr cli.stated_pose
cli.driving cli.ways cli.consume_input cli.consume_camera cli.consume_motion
cli.consume_check cli.consume_steer cli.consume_fusion
cli cli.__main__ cli.accuracy cli.claims cli.consume cli.decode cli.demo cli.design
cli.drive cli.figures cli.map_info cli.receive cli.send cli.study
__main__
""".split()  # noqa: SIM905 - a list of so many would take a line each
#: Commands that run the study; the others import it, and fault injection, only inside functions.
STUDY_COMMANDS = {f"cli.{name}" for name in (
    "demo", "study", "report", "production", "design", "accuracy", "claims", "figures",
)}  # fmt: skip
#: Imports inside functions of the product: what and where from. They run when an option asks.
LAZY = {
    ("cli.options", "testing"), ("cli.options", "study.codes"),
    ("cli.map_info", "study.figures.map_picture"),
    ("cli.drive", "study.drives.truth"), ("cli.driving", "study.drives.truth"),
    ("cli.driving", "testing"), ("cli.consume_fusion", "study.fusion.stream"),
    ("cli.consume_input", "study.parquet_files"),
}  # fmt: skip
#: Packages that may import a big dependency.
DOORS = {
    "can": {"bus", "testing"},
    "cantools": {"wire", "study"},
    "cryptography": {"wire"},
    "tqdm": {"cli"},
    "matplotlib": {"study"},
    "bokeh": {"study"},
    "distributed": {"study"},
    "pyarrow": {"study"},
    "lanelet2": {"maps"},
    "small_gicp": {"ego"},
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


parsed = cache(ast.parse)
for _path in PACKAGE.rglob("*.py"):  # at import: after other tests, CPython 3.11 may fail to parse
    parsed(_path.read_text())


def imports(package: Path = PACKAGE) -> Iterator[Import]:
    """Yield all imports of all files."""
    modules = {name_of(path, package): path for path in package.rglob("*.py")}
    for name, path in sorted(modules.items()):
        parents = name.split(".") if path.name == "__init__.py" and name else name.split(".")[:-1]
        tree = parsed(path.read_text())
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
                    target = target if target in modules else ".".join(base)
                    yield Import(name, target, is_own=True, is_lazy=is_lazy)


def is_product(module: str) -> bool:
    """Return whether a module is neither the study nor fault injection."""
    return module.split(".")[0] not in {"study", "testing"}


def upward(package: Path = PACKAGE) -> list[str]:
    """Return the imports that point up, or from the product to the study or to fault injection."""
    rank = {name: i for i, name in enumerate(ORDER)}
    found = []
    for importer, target, is_own, is_lazy in imports(package):
        if not is_own or not importer or not target:  # the package shows the names of all
            continue
        if is_product(importer) and not is_product(target):
            is_allowed = importer in STUDY_COMMANDS or (is_lazy and (importer, target) in LAZY)
        elif is_product(importer):
            is_allowed = rank.get(target, len(ORDER)) < rank.get(importer, -1)
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
    """Each file of the product is in the list, once."""
    files = {name_of(path, PACKAGE) for path in PACKAGE.rglob("*.py")} - {""}
    assert sorted(ORDER) == sorted(filter(is_product, files))


def test_there_is_no_circle() -> None:
    """Neither in the product nor in the study, not even by an import inside a function."""
    graph: dict[str, set[str]] = {}
    for importer, target, is_own, _ in imports():
        if is_own and importer:
            graph.setdefault(importer, set()).add(target)
    list(TopologicalSorter(graph).static_order())  # raises CycleError


@pytest.mark.parametrize(
    ("file", "line"),
    [
        pytest.param("line.py", "from .scenarios import scenario", id="value-imports-scene"),
        pytest.param(
            "wire/message/signals.py", "from .packing import Packing", id="upward-in-one-folder"
        ),
        pytest.param("wire/protection/e2e.py", "from ..codec import Codec", id="to-the-facade"),
        pytest.param("bus/link.py", "from ..testing import FaultyBus", id="product-imports-faults"),
        pytest.param("wire/codec.py", "from ..study import metrics", id="product-imports-study"),
        pytest.param(
            "cli/receive.py", "def f():\n    from ..study import sets", id="lazily-but-not-allowed"
        ),
        pytest.param("study/metrics.py", "from ..cli import main", id="study-imports-command"),
    ],
)
def test_an_upward_import_is_found(tmp_path: Path, file: str, line: str) -> None:
    """The test above can fail: each of these is found, and nothing else."""
    package = tmp_path / "maplines_can"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__", "*.dbc"))
    path = package / file
    path.write_text(f"{path.read_text()}\n{line}\n")
    assert [text.split(" imports ")[0] for text in upward(package)] == [name_of(path, package)]


def test_big_dependencies_have_one_door() -> None:
    """can is imported in bus, cantools in wire, matplotlib where figures are drawn."""
    used: dict[str, set[str]] = {door: set() for door in DOORS}
    for importer, target, is_own, _ in imports():
        if not is_own and (top := target.split(".")[0]) in DOORS:
            used[top].add(importer.split(".")[0])
    assert used == DOORS


def test_the_estimation_and_the_wire_meet_only_in_the_values() -> None:
    """A receiver needs no map, and an estimator no bus."""
    arms = ({"wire", "bus"}, {"propagation", "scenarios", "maps", "ego"})
    for importer, target, is_own, _ in imports():
        here, there = importer.split(".")[0], target.split(".")[0]
        for one, other in (arms, arms[::-1]):
            assert not (is_own and here in one and there in other), f"{importer} imports {target}"


@pytest.mark.parametrize("arm", ["wire", "propagation"])
def test_the_pure_middle_does_no_input_or_output(arm: str) -> None:
    """No clock, socket, thread or randomness of its own; wire reads its DBC and nothing else."""
    impure = {"time", "socket", "random", "threading", "os"}
    for importer, target, is_own, _ in imports():
        if importer.split(".")[0] == arm and not is_own:
            assert target.split(".")[0] not in impure, f"{importer} imports {target}"
