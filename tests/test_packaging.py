"""A checkout, an editable install and a wheel find the default DBC; the wheel is complete.

An install builds the C core. Where there is no C compiler, pip is told to fetch one.
"""

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import build_core
import pytest

from maplines_can.cli import main
from maplines_can.core import PATH

ROOT = Path(__file__).parents[1]
FIND_DBC = "import maplines_can.wire as w; w.Codec.from_dbc(); print(w.default_dbc_path())"
BIN = "Scripts" if sys.platform == "win32" else "bin"


def run(*command: str | Path, cwd: Path | None = None, **variables: str) -> str:
    """Run a command with more variables, check that it succeeds, and return its output."""
    env = os.environ | variables
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd, env=env)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of the checkout, with the core of the checkout instead of compiling it again."""
    folder = tmp_path_factory.mktemp("wheel")
    compiler = folder / "compiler.py"
    compiler.write_text(
        f"import shutil, sys\nshutil.copy({str(PATH)!r}, sys.argv[sys.argv.index('-o') + 1])\n"
    )
    build = (sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT)
    run(*build, CC=f"{sys.executable} {compiler}")
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture
def empty_python(tmp_path: Path, wheel: Path) -> Path:
    """A fresh environment with the wheel; it sees the dependencies of this one.

    A .pth file may add a folder; the .pth files in that folder, such as the one
    of an editable install, are not read again.
    """
    environment = tmp_path / "venv"
    venv.create(environment, with_pip=False)
    site = Path(sysconfig.get_path("purelib", "venv", {"base": str(environment)}))
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    python = environment / BIN / "python"
    install = (sys.executable, "-m", "pip", "--python", python, "install", "--no-deps")
    run(*install, "--no-index", "--disable-pip-version-check", "--force-reinstall", wheel)
    return python


def test_in_a_checkout_and_an_editable_install(tmp_path: Path) -> None:
    """The source folder works without an install; its editable install, from any folder."""
    for options, cwd in (("-S", ROOT), ("-P", tmp_path)):
        path = {"PYTHONPATH": sysconfig.get_path("purelib")} if options == "-S" else {}
        found = run(sys.executable, options, "-c", FIND_DBC, cwd=cwd, **path)
        assert Path(found) == ROOT / "dbc" / "maplines.dbc"


def test_from_a_wheel(empty_python: Path, tmp_path: Path) -> None:
    """An installed wheel finds its own copy, equal to the last byte, and its command works."""
    found = Path(run(empty_python, "-c", FIND_DBC, cwd=tmp_path))
    assert found.is_relative_to(tmp_path / "venv")
    assert found.read_bytes() == (ROOT / "dbc" / "maplines.dbc").read_bytes()
    said = run(empty_python.parent / "maplines", "--version", cwd=tmp_path)
    assert "core built with" in said
    for what in ("c", "vectors"):
        run(empty_python.parent / "maplines", "generate", what, "--out", "ecu", cwd=tmp_path)
        assert main(["generate", what, "--out", str(tmp_path / "own")]) == 0
    written = [{p.name: p.read_bytes() for p in (tmp_path / d).iterdir()} for d in ("ecu", "own")]
    assert written[0] == written[1]


def test_the_content_of_the_wheel(wheel: Path) -> None:
    """Every DBC, equal to the last byte, py.typed, the map and one library; no tests or tools."""
    dbcs = (ROOT / "dbc").glob("*.dbc")
    expected = {f"maplines_can/dbc/{path.name}": path.read_bytes() for path in dbcs}
    example = Path("maplines_can/restbus/example-car.dbc")
    expected[str(example)] = (ROOT / example).read_bytes()
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        found = {name: archive.read(name) for name in names if name.endswith(".dbc")}
    assert len(found) == 5
    assert expected == found
    files = ("py.typed", "maps/town.xodr", "desk/page/index.html", "desk/page/view.js")
    assert {f"maplines_can/{name}" for name in files} <= set(names)
    folders = {name.split("/")[0] for name in names}
    assert {name for name in folders if not name.endswith(".dist-info")} == {"maplines_can"}
    libraries = [name for name in names if name.endswith(PATH.suffix)]
    assert libraries == [f"maplines_can/core/{PATH.name}"]


def test_the_tag_of_a_wheel(wheel: Path) -> None:
    """One wheel of a platform serves all versions of Python: it has no part of one."""
    _, _, python, abi, platform = wheel.stem.split("-")
    assert (python, abi) == ("py3", "none")
    assert platform == sysconfig.get_platform().replace("-", "_").replace(".", "_")


@pytest.mark.skipif(sys.platform == "win32", reason="CC is of other systems")
@pytest.mark.parametrize(
    ("compiler", "reason"),
    [
        pytest.param("no-such-compiler", "'no-such-compiler' cannot be run", id="missing"),
        pytest.param("false", "'false' fails", id="fails"),
    ],
)
def test_a_compiler_that_builds_nothing(
    compiler: str,
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The build ends with its name, and the library of the checkout stays as it is."""
    own = PATH.stat().st_mtime_ns
    monkeypatch.setenv("CC", compiler)
    hook = build_core.CoreHook(str(ROOT), {}, None, None, str(tmp_path), "wheel")  # type: ignore[arg-type]

    with pytest.raises(SystemExit):
        hook.initialize("editable", {})

    assert f"maplines_can: the compiler {reason}" in capsys.readouterr().err
    assert own == PATH.stat().st_mtime_ns


def test_a_compiler_is_fetched_where_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is a requirement of the build then, for platforms that it knows."""
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", "")
    hook = build_core.CoreHook.__new__(build_core.CoreHook)

    assert hook.dependencies() == ["ziglang>=0.13"]
    monkeypatch.setattr("platform.machine", lambda: "pdp11")
    assert hook.dependencies() == []
    with pytest.raises(build_core.BuildError, match=r"ziglang has none for .*apt-get install gcc"):
        build_core.compiler()
