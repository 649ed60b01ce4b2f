"""A checkout, an editable install and a wheel find the default DBC; the wheel is complete.

With a C compiler, an install has the extension module; without one, it computes in Python alone.
"""

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path
from typing import Any

import pytest

from maplines_can import native

ROOT = Path(__file__).parents[1]
FIND_DBC = "import maplines_can.wire as w; w.Codec.from_dbc(); print(w.default_dbc_path())"
BIN = "Scripts" if sys.platform == "win32" else "bin"


def run(*command: str | Path, cc: str | None = None, **options: Any) -> str:
    """Run a command on no forced path, check that it succeeds, and return its output.

    Args:
        command: program and arguments.
        cc: C compiler of this run.
        options: of subprocess.run.
    """
    environment = {name: value for name, value in os.environ.items() if name != "MAPLINES_NATIVE"}
    environment |= {"CC": cc} if cc else {}
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=environment, **options
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()


def built(folder: Path, **options: Any) -> Path:
    """Return a wheel of the checkout."""
    build = (sys.executable, "-m", "build", "--wheel", "--no-isolation")
    run(*build, "--outdir", folder, ROOT, **options)
    (path,) = folder.glob("*.whl")
    return path


def extensions(wheel: Path) -> list[str]:
    """Return the names of the extension modules in a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return [name for name in archive.namelist() if "_native" in name]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("wheel"))


@pytest.fixture
def empty_python(tmp_path: Path) -> Path:
    """A fresh environment that sees the dependencies of this one, but not its own packages.

    A .pth file may add a folder; the .pth files in that folder, such as the one
    of an editable install, are not read again.
    """
    environment = tmp_path / "venv"
    venv.create(environment, with_pip=False)
    site = Path(sysconfig.get_path("purelib", "venv", {"base": str(environment)}))
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    return environment / BIN / "python"


def install(python: Path, *what: str | Path) -> None:
    """Install into the environment of a Python, without the network."""
    pip: list[str | Path] = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        python,
        "install",
        "--no-deps",
        "--no-index",
    ]
    run(*pip, "--no-build-isolation", "--disable-pip-version-check", "--force-reinstall", *what)


def test_in_a_checkout() -> None:
    """The source folder works without an install."""
    found = run(sys.executable, "-c", FIND_DBC, cwd=ROOT)
    assert Path(found) == ROOT / "dbc" / "maplines.dbc"


def test_in_an_editable_install(empty_python: Path, tmp_path: Path) -> None:
    """An editable install finds the file of the checkout, from any folder."""
    install(empty_python, "--editable", ROOT)
    found = run(empty_python, "-c", FIND_DBC, cwd=tmp_path)
    assert Path(found) == ROOT / "dbc" / "maplines.dbc"
    said = run(empty_python.parent / "maplines", "--version", cwd=tmp_path)
    assert ("computes in C (built with" in said) is native.is_active


def test_from_a_wheel(empty_python: Path, wheel: Path, tmp_path: Path) -> None:
    """An installed wheel finds its own copy, equal to the last byte, and its command works."""
    install(empty_python, wheel)
    found = Path(run(empty_python, "-c", FIND_DBC, cwd=tmp_path))
    assert found.is_relative_to(tmp_path / "venv")
    assert found.read_bytes() == (ROOT / "dbc" / "maplines.dbc").read_bytes()
    assert "highway" in run(empty_python.parent / "maplines", "scenarios", cwd=tmp_path)
    said = run(empty_python.parent / "maplines", "--version", cwd=tmp_path)
    assert ("computes in C (built with" in said) is native.is_active
    for what in ("c", "vectors"):
        generate = ("generate", what, "--out")
        run(empty_python.parent / "maplines", *generate, "ecu", cwd=tmp_path)
        run(sys.executable, "-m", "maplines_can", *generate, tmp_path / "own", cwd=ROOT)
    written = [{p.name: p.read_bytes() for p in (tmp_path / d).iterdir()} for d in ("ecu", "own")]
    assert written[0] == written[1]


def test_the_wheel_has_the_package_and_nothing_else(wheel: Path) -> None:
    """The wheel has py.typed and the map, and no tests or tools."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {"maplines_can/py.typed", "maplines_can/maps/town.xodr"} <= set(names)
    folders = {name.split("/")[0] for name in names}
    assert {name for name in folders if not name.endswith(".dist-info")} == {"maplines_can"}


def test_the_wheel_has_every_dbc(wheel: Path) -> None:
    """The wheel has the DBCs of the lines and that of the restbus, equal to the last byte."""
    files = (ROOT / "dbc").glob("*.dbc")
    expected = {f"maplines_can/dbc/{path.name}": path.read_bytes() for path in files}
    example = Path("maplines_can/restbus/example-car.dbc")
    expected[str(example)] = (ROOT / example).read_bytes()
    with zipfile.ZipFile(wheel) as archive:
        found = {name: archive.read(name) for name in archive.namelist() if name.endswith(".dbc")}

    assert len(found) == 4
    assert expected == found


@pytest.mark.skipif(not native.is_active, reason="needs a C compiler")
def test_the_tag_of_a_wheel_with_the_extension_module(wheel: Path) -> None:
    """One wheel of a platform serves all versions of Python; a free-threaded one has its own."""
    _, _, python, abi, platform = wheel.stem.split("-")
    (extension,) = extensions(wheel)

    assert platform == sysconfig.get_platform().replace("-", "_").replace(".", "_")
    if sysconfig.get_config_var("Py_GIL_DISABLED"):
        assert abi.endswith("t")
    else:
        assert (python, abi) == ("cp311", "abi3")
        assert sys.platform == "win32" or ".abi3." in extension


@pytest.mark.skipif(sys.platform == "win32", reason="CC is of other systems")
def test_a_wheel_without_a_compiler(tmp_path: Path) -> None:
    """It is one for all platforms, and the extension module of the checkout stays as it is."""
    own = sorted((path, path.stat().st_mtime_ns) for path in ROOT.glob("maplines_can/_native*"))

    pure = built(tmp_path, cc="no-such-compiler")

    assert pure.stem.endswith("-py3-none-any")
    assert extensions(pure) == []
    after = ROOT.glob("maplines_can/_native*")
    assert own == sorted((path, path.stat().st_mtime_ns) for path in after)
