"""A checkout, an editable install and a wheel find the default DBC; the wheel is complete."""

import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
FIND_DBC = "import maplines_can.wire as w; w.Codec.from_dbc(); print(w.default_dbc_path())"
BIN = "Scripts" if sys.platform == "win32" else "bin"


def run(*command: str | Path, **options: Any) -> str:
    """Run a command, check that it succeeds, and return its output."""
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT)
    (path,) = folder.glob("*.whl")
    return path


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


def test_from_a_wheel(empty_python: Path, wheel: Path, tmp_path: Path) -> None:
    """An installed wheel finds its own copy, equal to the last byte, and its command works."""
    install(empty_python, wheel)
    found = Path(run(empty_python, "-c", FIND_DBC, cwd=tmp_path))
    assert found.is_relative_to(tmp_path / "venv")
    assert found.read_bytes() == (ROOT / "dbc" / "maplines.dbc").read_bytes()
    assert "highway" in run(empty_python.parent / "maplines", "scenarios", cwd=tmp_path)
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
    """The wheel has the three DBCs of the package, equal to the last byte."""
    files = (ROOT / "dbc").glob("*.dbc")
    expected = {f"maplines_can/dbc/{path.name}": path.read_bytes() for path in files}
    with zipfile.ZipFile(wheel) as archive:
        found = {name: archive.read(name) for name in archive.namelist() if name.endswith(".dbc")}

    assert len(found) == 3
    assert expected == found
