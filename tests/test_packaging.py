"""The default DBC is found in a checkout, in an editable install and from a wheel."""

import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WHERE = "import maplines_can.wire as w; w.Codec.from_dbc(); print(w.default_dbc_path())"


def run(*command, **options):
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture
def empty_python(tmp_path):
    """A fresh environment that sees this one's dependencies, but not this one's own packages.

    A .pth file may add a folder; the .pth files in that folder, such as the one
    of an editable install, are not read again.
    """
    venv.create(tmp_path / "venv", with_pip=False)
    (site,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    return tmp_path / "venv" / "bin" / "python"


def install(python, *what):
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index"]
    run(*pip, "--no-build-isolation", "--disable-pip-version-check", "--force-reinstall", *what)


def test_in_a_checkout(tmp_path):
    """Straight from the source folder, without an install."""
    found = run(sys.executable, "-c", WHERE, cwd=ROOT)
    assert Path(found) == ROOT / "dbc" / "maplines.dbc"


def test_in_an_editable_install(empty_python, tmp_path):
    """The checkout's own file, from any folder."""
    install(empty_python, "--editable", ROOT)
    found = run(empty_python, "-c", WHERE, cwd=tmp_path)
    assert Path(found) == ROOT / "dbc" / "maplines.dbc"


def test_from_a_wheel(empty_python, wheel, tmp_path):
    """The copy inside the package, the same to the last byte, and the command works."""
    install(empty_python, wheel)
    found = Path(run(empty_python, "-c", WHERE, cwd=tmp_path))
    assert found.is_relative_to(tmp_path / "venv")
    assert found.read_bytes() == (ROOT / "dbc" / "maplines.dbc").read_bytes()
    assert "highway" in run(empty_python.parent / "maplines", "scenarios", cwd=tmp_path)


def test_the_wheel_says_that_it_is_typed(wheel):
    """py.typed is in it, and nothing but the package is."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert "maplines_can/py.typed" in names
    folders = {name.split("/")[0] for name in names}
    assert {name for name in folders if not name.endswith(".dist-info")} == {"maplines_can"}
