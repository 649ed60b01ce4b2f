"""A command imports only what it runs; asserted by the loaded modules, never by time."""

import json
import subprocess
import sys
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from support.fixtures import Patch
from support.lines import scenario_lines

import maplines_can
from maplines_can import Codec, map_scene
from maplines_can.bus import LogWriter
from maplines_can.cli import COMMANDS
from maplines_can.simulation import scenario
from maplines_can.wire import default_dbc_path

SHOW = "\nimport json, sys; print(json.dumps(sorted(sys.modules)))"
STATUS = "from maplines_can.cli import main\nassert main({}) == 0"
MAIN = "from maplines_can.cli import main\ntry: main({})\nexcept SystemExit: pass"


def modules_after(code: Any, path: Path | None = None) -> Any:
    """Return the modules that a fresh interpreter has loaded after some code.

    Args:
        code: to run.
        path: a folder with packages that shall be installed there.
    """
    setup = "" if path is None else f"import sys; sys.path.insert(0, {str(path)!r})\n"
    done = subprocess.run(
        [sys.executable, "-c", setup + code + SHOW], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def among(modules: Any, *packages: Any) -> Any:
    """Return the modules of some packages."""
    return [m for m in modules if any(f"{m}.".startswith(f"{package}.") for package in packages)]


STUDY = ("maplines_can.study", "maplines_can.testing", "matplotlib", "scipy.stats", "pyarrow")
#: What a command needs for a bus, or for a DBC that is not known; and what python-can loads, too.
HEAVY = ("can", "cantools", "scipy", "asammdf", "pandas", "pyarrow")


def test_the_package_imports_names_when_they_are_used() -> None:
    """Before that it has loaded no package but itself."""
    modules = modules_after("import maplines_can")
    assert among(modules, "maplines_can") == ["maplines_can"]
    assert not among(modules, "numpy", "can", "cantools", "scipy")


@pytest.mark.parametrize("has_mf4", [False, True])
def test_item_11_all_names_of_the_package_load_nothing_of_the_study(
    tmp_path: Path, has_mf4: bool
) -> None:
    """The product does not need it. What python-can itself loads is not ours.

    With the extra mf4, ``import can`` loads asammdf, and that cryptography.
    """
    if has_mf4:
        (tmp_path / "asammdf").mkdir()
        (tmp_path / "asammdf" / "__init__.py").write_text("import cryptography, tqdm\n")
    of_can = modules_after("import can", tmp_path)
    modules = [m for m in modules_after("from maplines_can import *", tmp_path) if m not in of_can]
    assert ("asammdf" in of_can) >= has_mf4
    assert among(modules, "maplines_can.wire", "maplines_can.bus", "maplines_can.propagation")
    assert not among(modules, *STUDY, "tqdm", "cryptography", "asammdf")


def test_help_of_commands_loads_neither_study_nor_bus() -> None:
    """Nor does it load other commands, or what python-can loads where the extra mf4 is there."""
    names = ["receive", "decode", "plot", "send", "map", "generate", "consume", "restbus"]
    modules = modules_after("\n".join(MAIN.format([name, "--help"]) for name in names))
    for name in names:
        assert among(modules, f"maplines_can.cli.{COMMANDS[name][0]}")
    assert not among(modules, *STUDY, "maplines_can.cli.demo", "maplines_can.cli.paper")
    assert not among(modules, *HEAVY)
    every = "\n".join(MAIN.format([name, "--help"]) for name in COMMANDS)
    assert not among(modules_after(every), "scipy")


OWN = "maplines_can.propagation", "maplines_can.simulation.scenarios"
WITHOUT_BUS = [
    ["decode", "LOG.log"],
    ["decode", "LOG.asc"],
    ["decode", "LOG.blf"],
    ["decode", "LOG.log", "--csv", "--at", "0,40"],
    ["decode", "LOG.log", "-o", "LOG.csv"],
    ["decode", "LOG.log", "--dbc", "auto"],
    ["decode", "LOG.log", "--dbc", "OTHER.dbc"],
]
#: They compute with lines.
COMPUTING = [
    ["consume", "steer", "SCENES.log", "--dbc", "maplines-pose.dbc"],
    ["generate", "c", "--out", "LOG_c"],
]


@pytest.mark.parametrize(("commands", "more"), [(WITHOUT_BUS, (*STUDY, *OWN)), (COMPUTING, ())])
def test_commands_without_a_bus_load_no_library_of_buses(
    commands: list[list[str]], more: tuple[str, ...], logs: Path, monkeypatch: Patch
) -> None:
    """Neither python-can, nor cantools for a DBC that is known, nor scipy."""
    monkeypatch.chdir(logs)
    Codec.from_dbc(logs / "OTHER.dbc")  # now it is known
    code = "\n".join(STATUS.format(command) for command in commands)

    assert not among(modules_after(code), *HEAVY, *more)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with logs of lines and of scenes, and a DBC of the user."""
    folder = tmp_path_factory.mktemp("logs")
    codec = Codec.from_dbc()
    (folder / "OTHER.dbc").write_text(f'{default_dbc_path().read_text()}CM_ "another";\n')
    encoder, lines = codec.encoder(), scenario_lines(scenario("production"))
    frames = [frame for line in lines for frame in encoder.encode(line)]
    for suffix in ("log", "asc", "blf"):
        with LogWriter(folder / f"LOG.{suffix}", 1e9) as log:
            for i, frame in enumerate(frames):
                log.write(frame, 1e9 + 0.001 * i)
    scenes = Codec.from_dbc(default_dbc_path("maplines-pose.dbc")).encoder()
    road = scenario("production")
    scene = map_scene(road.lines, road.ego, correlation_time=5.0)
    with LogWriter(folder / "SCENES.log", 1e9) as log:
        for cycle in range(20):
            own = scenes.encode_scene(scene, age=0.02).values()
            for i, frame in enumerate(chain(*own)):
                log.write(frame, 1e9 + 0.05 * cycle + 0.0005 * i)
    return folder


RECEIVE = ["receive", "--interface", "virtual", "--channel", "silent", "--timeout", "0.05"]
SEND = ["send", "--interface", "virtual", "--channel", "nobody", "--count", "1", "--rate", "100"]
PRODUCT = ("maplines_can.wire", "maplines_can.bus", "maplines_can.propagation")


@pytest.mark.parametrize(
    ("words", "loads", "none"),
    [
        (["--help"], "maplines_can.cli", (*STUDY, *PRODUCT, "numpy", "can", "cantools")),
        (["--version"], "maplines_can.cli", (*STUDY, *PRODUCT, "numpy", "can", "cantools")),
        (["study", "--help"], "maplines_can.cli", (*STUDY, *PRODUCT, "numpy", "can", "cantools")),
        (RECEIVE, "maplines_can.bus.receiver", (*STUDY, *OWN)),
        (SEND, "maplines_can.bus.transmitter", STUDY),
        ([*RECEIVE, "--faults", "loss=0.5"], "maplines_can.testing", ("maplines_can.study",)),
        (["map"], "maplines_can.maps.formats.opendrive.reader", (*STUDY, *PRODUCT[:2], "cantools")),
    ],
)
def test_a_command_loads_what_it_runs(words: list[str], loads: str, none: tuple[str, ...]) -> None:
    """But for what python-can itself loads: with the extra mf4 asammdf, pandas and more."""
    of_can = modules_after("import can") if words[0] in ("receive", "send") else []
    modules = modules_after(MAIN.format(words))
    assert loads in modules
    assert not among([m for m in modules if m not in of_can], *none)


def test_every_exported_name_is_there() -> None:
    """Each is found, and is listed by dir(); so few that a newcomer reads them all."""
    assert len(maplines_can.__all__) <= 45
    for name in maplines_can.__all__:
        assert getattr(maplines_can, name) is not None
        assert name in dir(maplines_can)


@pytest.mark.parametrize("name", ["maps", "localisation", "simulation", "consumers", "testing"])
def test_what_uses_the_core_has_names_of_its_own(name: str) -> None:
    """``ml.maps.load`` needs no import of ``maplines_can.maps``; a star import loads none of it."""
    package = getattr(maplines_can, name)
    assert name not in maplines_can.__all__
    assert not set(package.__all__) & set(maplines_can.__all__)
    for own in package.__all__:
        assert getattr(package, own) is not None
        assert own in dir(package)


def test_an_unknown_name_is_an_attribute_error() -> None:
    """As of any module."""
    with pytest.raises(AttributeError, match="module 'maplines_can' has no attribute 'nothing'"):
        _ = maplines_can.nothing  # type: ignore[attr-defined]
    with pytest.raises(ImportError, match="nothing"):
        from maplines_can import nothing  # type: ignore[attr-defined]  # noqa: F401
