"""The archive of an FMU: descriptions, sources, binaries; it builds from its own sources."""

import re
import shutil
import subprocess
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path

import pytest
from scene_layouts import layout_of
from support import c_core
from support.fmu_nodes import Node, generate, library

from maplines_can import LayoutError
from maplines_can.cli import main
from maplines_can.generation.fmu import archive, compilers
from maplines_can.generation.fmu.xml_files import BUS
from maplines_can.maps import town_path

fmpy = pytest.importorskip("fmpy", reason="the headers of FMI and the importer come from fmpy")
C = Path(__file__).parents[2] / "c"
LS_BUS = Path(__file__).parents[3] / "shared" / "fmi" / "ls-bus"
NODES = [
    ("receiver", "maplines.dbc"),
    ("receiver", "maplines-pose.dbc"),
    ("receiver", "maplines-scene.dbc"),
    ("sender", "maplines.dbc"),
    ("map_sender", "maplines.dbc"),
]
#: Options of a sender with a map: a short route.
MAP = ["--map", str(town_path()), "--route", "15:0:-1..14:0:1"]


def options(node: str) -> list[str]:
    """Return the words that generate a node."""
    return ["sender", *MAP] if node == "map_sender" else [node]


@pytest.fixture(scope="module", params=NODES, ids="-".join)
def fmu(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    node, dbc = request.param
    path = tmp_path_factory.mktemp("fmu") / f"{node}.fmu"
    assert main(["generate", "fmu", *options(node), "--dbc", dbc, "--out", str(path)]) == 0
    return path


def content(path: Path, name: str) -> str:
    with zipfile.ZipFile(path) as opened:
        return opened.read(name).decode()


def test_fmpy_finds_no_problems(fmu: Path) -> None:
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(fmu)) == []


@pytest.mark.parametrize(
    ("name", "schema"),
    [
        ("modelDescription.xml", "fmi3ModelDescription.xsd"),
        ("terminalsAndIcons/terminalsAndIcons.xml", "fmi3TerminalsAndIcons.xsd"),
        ("sources/buildDescription.xml", "fmi3BuildDescription.xsd"),
    ],
)
def test_descriptions_have_the_form_of_the_schemas(fmu: Path, name: str, schema: str) -> None:
    etree = pytest.importorskip("lxml.etree")
    path = resources.files("fmpy") / "schema" / "fmi3" / schema
    etree.XMLSchema(file=str(path)).assertValid(etree.fromstring(content(fmu, name).encode()))


def test_the_manifest_is_that_of_the_standard(fmu: Path) -> None:
    """As its schema fixes the attributes, which imports one from the web."""
    text = content(fmu, "extra/org.fmi-standard.fmi-ls-bus/fmi-ls-manifest.xml")
    assert 'fmi-ls:fmi-ls-name="org.fmi-standard.fmi-ls-bus"' in text
    assert 'fmi-ls:fmi-ls-version="1.0.0"' in text
    assert 'isBusSimulationFMU="false"' in text
    schema = LS_BUS / "schema" / "fmi3LayeredStandardBusManifest.xsd"
    if schema.exists():
        assert BUS in schema.read_text()
        assert 'fixed="Layered Standard for the simulation of bus' in schema.read_text()


def test_the_same_dbc_gives_the_same_bytes(
    fmu: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compiled anew for one node, which stands for the others."""
    if fmu.stem == "sender":
        monkeypatch.setattr(compilers, "library", library)
    again = tmp_path / "again.fmu"
    with zipfile.ZipFile(fmu) as opened:
        assert opened.namelist()[0] == "modelDescription.xml"
    (dbc,) = re.findall(r"[\w-]+\.dbc", fmpy.read_model_description(str(fmu)).description)
    assert main(["generate", "fmu", *options(fmu.stem), "--dbc", dbc, "--out", str(again)]) == 0
    assert again.read_bytes() == fmu.read_bytes()


@pytest.mark.parametrize("fmu", NODES[2::2], indirect=True, ids="-".join)
def test_it_builds_from_its_sources(fmu: Path, tmp_path: Path) -> None:
    """With the files and definitions of its build description, and nothing else.

    Of the mathematical library, it calls what is exact: without optimisation, each call is seen.
    """
    fmpy.extract(str(fmu), str(tmp_path / "fmu"))
    shutil.rmtree(tmp_path / "fmu" / "binaries")
    build = fmpy.read_model_description(str(fmu)).buildConfigurations[0]
    files = build.sourceFileSets[0]
    folder = tmp_path / "fmu" / "sources"
    assert sorted(files.sourceFiles) == sorted(path.name for path in folder.glob("*.c"))
    library = tmp_path / "fmu" / "binaries" / fmpy.platform_tuple
    library.mkdir(parents=True)
    flags = [f"-D{each.name}={each.value}" for each in files.preprocessorDefinitions]
    flags += ["-std=c99", "-O0", "-fno-builtin", "-ffp-contract=off", "-fPIC", "-shared"]
    out = library / f"{build.modelIdentifier}.so"
    subprocess.run(["cc", *flags, *files.sourceFiles, "-lm", "-o", out], check=True, cwd=folder)
    others = global_names(out, options=["-D"]) - functions_of_fmi(fmu)
    assert all(name.startswith(f"{build.modelIdentifier}_") for name in others)
    found = c_core.library_functions(out)
    assert {"sqrt", "frexp", "ldexp"} <= found <= c_core.EXACT | {"fmax", "fmin", "trunc"}
    node = Node(fmu, tmp_path / "fmu")
    assert node.get("CAN.state") == 1
    node.close()


def global_names(*files: Path, options: Sequence[str] = ()) -> set[str]:
    """Return the global names that object files or libraries define."""
    command = ["nm", "-g", "--defined-only", "--format=posix", *options, *map(str, files)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return {row.split()[0] for row in printed.splitlines() if " " in row}


def functions_of_fmi(fmu: Path) -> set[str]:
    header = content(fmu, "sources/fmi3Functions.h")
    return set(re.findall(r"^#define (fmi3\w+) +fmi3FullName", header, re.MULTILINE))


def test_a_library_exports_the_functions_of_fmi_only(fmu: Path, tmp_path: Path) -> None:
    fmpy.extract(str(fmu), str(tmp_path))
    library = next(tmp_path.glob("binaries/*-linux/*.so"))
    assert global_names(library, options=["-D"]) == functions_of_fmi(fmu)


def test_source_fmus_are_linked_into_one_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All their global names begin with the model identifier, or with a prefix that is stated."""
    monkeypatch.setattr(archive, "binaries", lambda *_: {})
    objects: list[Path] = []
    words: list[str] = []
    references: dict[str, str] = {}
    for node, prefix in (("sender", ""), ("receiver", "stated_")):
        path = tmp_path / f"{node}.fmu"
        generate(node, path)
        description = fmpy.read_model_description(str(path))
        fmpy.extract(str(path), str(tmp_path / node))
        folder = tmp_path / node / "sources"
        files = description.buildConfigurations[0].sourceFileSets[0]
        needed = [each for each in files.preprocessorDefinitions if not each.optional]
        flags = [f"-D{each.name}={each.value}" for each in needed]
        flags += [f"-DFMI3_FUNCTION_PREFIX={prefix}"] if prefix else []
        command = ["cc", "-std=c99", "-O0", *flags, "-c", *files.sourceFiles]
        subprocess.run(command, check=True, cwd=folder)
        own = sorted(folder.glob("*.o"))
        names = global_names(*own)
        prefix = prefix or f"{description.coSimulation.modelIdentifier}_"
        assert {prefix + name for name in functions_of_fmi(path)} < names
        assert all(name.startswith(prefix) for name in names)
        objects += own
        words.append(description.guid)
        references |= {
            f"{node} {each.name}": str(each.valueReference) for each in description.modelVariables
        }
    inputs = ("valid", "mean[1]", "cov[1,1]", "cov[2,2]", "cov[3,3]", "cov[4,4]", "x_max")
    words += [references[f"sender EGO_LEFT.{name}"] for name in inputs]
    words += [references[f"receiver EGO_LEFT.{name}"] for name in ("y[1]", "usable")]
    program = tmp_path / "program"
    include = f"-I{tmp_path / 'sender' / 'sources'}"
    main = C / "tests" / "static_fmus.c"
    command = ["cc", "-std=c99", include, main, *objects, "-lm", "-o", program]
    subprocess.run(command, check=True)
    printed = subprocess.run([program, *words], check=True, capture_output=True, text=True).stdout
    assert printed == "1.75 1\n"


@pytest.mark.skipif(shutil.which("x86_64-w64-mingw32-gcc") is None, reason="there is no MinGW")
def test_a_library_for_windows_is_inside(fmu: Path) -> None:
    with zipfile.ZipFile(fmu) as opened:
        name = next(each for each in opened.namelist() if each.endswith(".dll"))
        assert name == f"binaries/x86_64-windows/maplines_{fmu.stem}.dll"
        assert opened.read(name)[:2] == b"MZ"


def test_without_compilers_there_are_the_sources(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    path = tmp_path / "new" / "receiver.fmu"
    assert main(["generate", "fmu", "receiver", "--out", str(path)]) == 0
    assert "no C compiler" in capsys.readouterr().out
    with zipfile.ZipFile(path) as opened:
        assert not any(name.startswith("binaries/") for name in opened.namelist())
    assert main(["generate", "fmu", "receiver", "--out", str(path)]) != 0  # it exists


def test_without_fmpy_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("maplines_can.generation.fmu.archive.util.find_spec", lambda _: None)
    assert main(["generate", "fmu", "receiver", "--out", str(tmp_path / "r.fmu")]) != 0
    assert 'pip install -e ".[fmi]"' in capsys.readouterr().err


def test_a_dbc_that_a_node_cannot_have_is_refused() -> None:
    """A sender of lines takes complete records; without keys, a message must have no MAC."""
    for dbc, what in (("maplines-pose.dbc", "conditional"), ("maplines-scene.dbc", "whole scenes")):
        with pytest.raises(LayoutError, match=what):
            archive.fmu_of("sender", layout_of(dbc))
    layout = layout_of("maplines-secoc.dbc")
    secured = {
        slot: replace(own, can_id=None, fd_can_id=None) for slot, own in layout.messages.items()
    }
    with pytest.raises(LayoutError, match="authenticated"):
        archive.fmu_of("receiver", replace(layout, messages=secured, pose=None))
