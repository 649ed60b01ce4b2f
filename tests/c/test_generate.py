"""The files of ``maplines generate c``: they compile everywhere, and depend on the DBC only."""

import json
import os
import platform
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from support import c_core

import maplines_can
from maplines_can.cli import main
from maplines_can.wire.core_tables import MAX_LIMITS

ROOT = Path(__file__).parents[2]
SHIPPED = ("maplines.dbc", "maplines-pose.dbc", "maplines-secoc.dbc", "maplines-scene.dbc")
ALL = [f"--dbc={name}" for name in SHIPPED]


def generate(*words: str | Path) -> int:
    return main(["generate", "c", *map(str, words)])


def compile_c(folder: Path, *, cc: str = "cc", flags: tuple[str, ...] = ()) -> None:
    """Compile all C files of a folder with all warnings."""
    names = sorted(path.name for path in folder.glob("*.c"))
    command = [cc, "-std=c99", *c_core.WARNINGS, *flags, "-c", *names]
    subprocess.run(command, check=True, cwd=folder)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files of maplines.dbc and their object files."""
    folder = tmp_path_factory.mktemp("compiled")
    assert generate("--out", folder) == 0
    compile_c(folder)
    return folder


# ---- the files --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cc", "flag"),
    [
        ("gcc", "-ffast-math"), ("gcc", "-ffinite-math-only"),
        ("gcc", "-funsafe-math-optimizations"), ("clang", "-ffast-math"),
    ],
)  # fmt: skip
def test_arithmetic_that_rounds_otherwise_is_refused(compiled: Path, cc: str, flag: str) -> None:
    """GCC says since version 12 that it reorders operations."""
    if not shutil.which(cc):
        pytest.skip(f"there is no {cc}")
    ask = [cc, flag, "-dM", "-E", "-xc", os.devnull]
    macros = subprocess.run(ask, stdout=-1, text=True, check=True)
    if flag == "-funsafe-math-optimizations" and "__ASSOCIATIVE_MATH__" not in macros.stdout:
        pytest.skip(f"this {cc} has no macro for it")
    command = [cc, flag, "-fsyntax-only", "maplines.c"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=compiled)
    assert done.returncode != 0
    assert "maplines needs IEEE 754 arithmetic" in done.stderr


SHORT_DOUBLE = "maplines needs float of 24 and double of 53 binary digits"


@pytest.mark.parametrize("name", ["maplines.c", "maplines_dbc.c"])
@pytest.mark.parametrize(
    ("macro", "digits"), [("DBL_MANT_DIG", 24), ("FLT_MANT_DIG", 53), ("FLT_RADIX", 16)]
)
def test_types_of_other_digits_are_refused(
    compiled: Path, tmp_path: Path, name: str, macro: str, digits: int
) -> None:
    """By the header, so also in other files of a program."""
    changed = f"#include_next <float.h>\n#undef {macro}\n#define {macro} {digits}\n"
    (tmp_path / "float.h").write_text(changed)
    command = ["cc", "-std=c99", f"-I{tmp_path}", "-fsyntax-only", name]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=compiled)
    assert done.returncode != 0
    assert SHORT_DOUBLE in done.stderr


@pytest.mark.skipif(platform.machine() != "x86_64", reason="counts the FMA instructions of x86-64")
@pytest.mark.skipif(not shutil.which("gcc"), reason="there is no gcc")
def test_no_multiplication_is_fused(tmp_path: Path) -> None:
    """Where the CPU could, and no flag forbids it; GCC then fuses those of any other source."""
    assert generate("--out", tmp_path) == 0
    (tmp_path / "own.c").write_text("double f(double *x) { return x[0] * x[1] + x[2]; }")

    def fused(name: str) -> int:
        command = ["gcc", "-std=gnu99", "-O2", "-march=haswell", "-S", name, "-o", "-"]
        done = subprocess.run(command, stdout=-1, text=True, check=True, cwd=tmp_path)
        return done.stdout.count("vfmadd")

    assert fused("own.c") == 1
    assert fused("maplines.c") == 0


@pytest.mark.parametrize(
    ("cc", "flags"),
    [
        pytest.param("gcc", ("-O1",), id="gcc"),
        pytest.param("clang", ("-O1",), id="clang"),
        pytest.param("gcc", ("-DMAPLINES_FLOAT",), id="gcc-float"),
        pytest.param("clang", ("-DNDEBUG",), id="clang-ndebug"),
    ],
)
def test_the_files_compile_without_a_warning(
    tmp_path: Path, cc: str, flags: tuple[str, ...]
) -> None:
    """And call no function of the mathematical library but the exact ones."""
    if not shutil.which(cc):
        pytest.skip(f"there is no {cc}")
    assert generate(*ALL, "--out", tmp_path) == 0
    compile_c(tmp_path, cc=cc, flags=flags)
    assert c_core.library_functions(*tmp_path.glob("*.o")) <= c_core.EXACT


@pytest.mark.parametrize(("compiler", "standard"), [("g++", "c++17"), ("clang++", "c++20")])
def test_a_cpp_program_takes_the_headers_and_links(
    compiled: Path, compiler: str, standard: str
) -> None:
    if not shutil.which(compiler):
        pytest.skip(f"there is no {compiler}")
    (compiled / "main.cpp").write_text(
        '#include "maplines_dbc.h"\n'
        "int main() { return maplines_dbc.messages[MAPLINES_EGO_LEFT].can_id == 0x340 ? 0 : 1; }\n"
    )
    flags = [f"-std={standard}", *c_core.WARNINGS, "-Wold-style-cast"]
    objects = ["maplines.o", "maplines_dbc.o", "-lm", "-o", "program"]
    subprocess.run([compiler, *flags, "main.cpp", *objects], check=True, cwd=compiled)
    subprocess.run([compiled / "program"], check=True)


def test_nothing_but_the_interface_is_visible(compiled: Path) -> None:
    """No name of the core can collide with one of the program's."""
    if not shutil.which("nm"):
        pytest.skip("there is no nm")
    done = subprocess.run(
        ["nm", "--defined-only", "--extern-only", "maplines.o"],
        check=True, cwd=compiled, capture_output=True, text=True,
    )  # fmt: skip
    sizes = r"_(?:float|double)(?:_[a-z]+\d+){14}$"  # what the linker sees of the build
    names = [line.split()[2] for line in done.stdout.splitlines()]
    assert all(re.search(sizes, name) for name in names)
    interface = (compiled / "maplines.h").read_text()
    assert all(re.search(rf"\b{re.sub(sizes, '', name)}\(", interface) for name in names)


@pytest.mark.parametrize("kind", ["double", "float"])
def test_results_do_not_depend_on_the_mathematical_library(tmp_path: Path, kind: str) -> None:
    """Without optimisation each call is seen: they are those that the header names, all exact."""
    assert generate("--out", tmp_path) == 0
    compile_c(tmp_path, flags=("-fno-builtin", *(["-DMAPLINES_FLOAT"] if kind == "float" else [])))
    assert c_core.library_functions(*tmp_path.glob("*.o")) == c_core.EXACT
    interface = (tmp_path / "maplines.h").read_text()
    named = re.findall(r"<math\.h>: (.*?) all of", interface, re.DOTALL)[0]
    assert set(re.findall(r"[a-z]+\d?", named)) - {"and"} == c_core.EXACT


def test_a_program_may_define_larger_limits(tmp_path: Path) -> None:
    assert generate("--out", tmp_path) == 0
    flags = [f"-D{macro}={value}" for macro, value in MAX_LIMITS.macros.items()]
    compile_c(tmp_path, flags=tuple(flags))


def test_the_files_do_not_depend_on_folder_or_time(tmp_path: Path) -> None:
    contents = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        dbc = tmp_path / folder / "my.dbc"
        dbc.write_bytes((ROOT / "dbc" / "maplines.dbc").read_bytes())
        assert generate("--dbc", dbc, "--out", tmp_path / folder) == 0
        contents.append({p.name: p.read_bytes() for p in (tmp_path / folder).iterdir()})
    assert contents[0] == contents[1]
    assert set(contents[0]) == {
        "my.dbc", "maplines.h", "maplines_build.h", "maplines_state.h", "maplines.c", "my_dbc.h",
        "my_dbc.c", "CMakeLists.txt",
    }  # fmt: skip


# ---- the command ----------------------------------------------------------------------------


def test_json_names_the_files_and_the_build(tmp_path: Path, capsys: Any) -> None:
    assert generate("--out", tmp_path / "new" / "folder", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert all(Path(path).is_file() for path in printed["files"])
    sizes = {"max_pages": 6, "max_transfer_ids": 16, "max_components": 8, "slots": 8}
    assert printed["build"].items() >= sizes.items()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        pytest.param(["--dbc", "maplines-float16.dbc"], "'Float16' is none of", id="study"),
        pytest.param(["--name", "a-b"], "C identifier", id="name"),
        pytest.param(["--name", "_a"], "begins with a letter", id="underscore"),
        pytest.param(["--name", "a", "--name", "b"], "as many times as --dbc", id="names"),
        pytest.param(
            ["--dbc", "maplines.dbc", "--dbc", "maplines.dbc"], "a name of its own", id="twice"
        ),
        pytest.param(["--dbc", "no.dbc"], "no.dbc", id="missing"),
    ],
)
def test_what_cannot_be_generated_is_refused_by_name(
    tmp_path: Path, capsys: Any, words: list[str], message: str
) -> None:
    for what in ("c", "vectors") if len(words) == 2 else ("c",):
        assert main(["generate", what, *words, "--out", str(tmp_path / "out")]) == 1
        assert message in capsys.readouterr().err
        assert not (tmp_path / "out").exists()


# ---- the build ------------------------------------------------------------------------------


needs_cmake = pytest.mark.skipif(not shutil.which("cmake"), reason="there is no cmake")
PROGRAM = """\
#include "maplines_dbc.h"
int main(void) { return maplines_dbc.max_components == 8 ? 0 : 1; }
"""
CONSUMER = """\
cmake_minimum_required(VERSION 3.13)
project(consumer C)
find_package(maplines REQUIRED)
add_executable(program main.c)
target_link_libraries(program maplines::maplines)
"""


def cmake(*words: str | Path) -> str:
    """Run CMake; return what it prints."""
    done = subprocess.run(["cmake", *words], check=True, capture_output=True, text=True)
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The build folder of the library, which is configured for a prefix that does not exist."""
    folder = tmp_path_factory.mktemp("built library")
    assert generate("--out", folder / "c") == 0
    cmake("-S", folder / "c", "-B", folder / "build", "-DCMAKE_INSTALL_PREFIX=/configured")
    cmake("--build", folder / "build")
    return folder / "build"


#: Folders of an installation: its prefix, those of the library and the headers, and where the
#: prefix is moved to. They are in a temporary folder, and some are below the prefix.
INSTALLATIONS = [
    pytest.param("other", "lib", "include", "other", id="prefix-at-installation"),
    pytest.param("one", "lib/x86_64-linux-gnu", "include/maplines", "two/in here", id="moved"),
    pytest.param("out of it", "{}/li b", "include", "out of it", id="absolute-library-only"),
]


@needs_cmake
@pytest.mark.parametrize(("prefix", "library", "include", "moved"), INSTALLATIONS)
def test_an_installed_library_is_found(
    built: Path, tmp_path: Path, prefix: str, library: str, include: str, moved: str
) -> None:
    """By pkg-config and by CMake, wherever it is: also where the prefix has a space."""
    place = tmp_path.resolve()
    library, include = library.format(place), include.format(place)
    cmake(f"-DCMAKE_INSTALL_LIBDIR={library}", f"-DCMAKE_INSTALL_INCLUDEDIR={include}", built)
    cmake("--install", built, "--prefix", place / prefix)
    (place / moved).parent.mkdir(exist_ok=True)
    (place / prefix).rename(place / moved)
    libraries, headers = place / moved / library, place / moved / include
    assert (headers / "maplines_dbc.h").exists()
    (place / "main.c").write_text(PROGRAM)
    if shutil.which("pkg-config"):
        ask = ["pkg-config", "--cflags", "--libs", "maplines"]
        there = os.environ | {"PKG_CONFIG_PATH": str(libraries / "pkgconfig")}
        printed = subprocess.run(ask, check=True, stdout=-1, text=True, env=there).stdout
        found = {Path(flag[2:]).resolve() for flag in shlex.split(printed) if flag[1] in "IL"}
        assert found == {libraries, headers}
        command = ["cc", "main.c", *shlex.split(printed), "-o", "by_pkg_config"]
        subprocess.run(command, check=True, cwd=place)
        subprocess.run([place / "by_pkg_config"], check=True)
    if Path(library).is_absolute() > Path(include).is_absolute():
        return  # the package of CMake has the prefix of the configuration then
    (place / "CMakeLists.txt").write_text(CONSUMER)
    config = f"-Dmaplines_DIR={libraries / 'cmake' / 'maplines'}"
    cmake("-S", place, "-B", place / "consumer", config)
    cmake("--build", place / "consumer")
    subprocess.run([place / "consumer" / "program"], check=True)


@needs_cmake
@pytest.mark.parametrize(
    ("version", "is_found"),
    [("0.1", True), ("0.1.0 EXACT", True), ("0.1.99", False), ("0.0.9", False)],
)  # fmt: skip
def test_cmake_finds_the_version_that_is_asked_for(
    built: Path, tmp_path: Path, version: str, is_found: bool
) -> None:
    """Another minor version may have another interface, as long as the major one is 0."""
    assert maplines_can.__version__ == "0.1.0", "change the versions above"
    cmake("-DCMAKE_INSTALL_LIBDIR=lib", "-DCMAKE_INSTALL_INCLUDEDIR=include", built)
    cmake("--install", built, "--prefix", tmp_path / "installed")
    (tmp_path / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.13)\nproject(consumer NONE)\n"
        f"find_package(maplines {version})\nmessage(STATUS found=${{maplines_FOUND}})\n"
    )
    prefix = f"-DCMAKE_PREFIX_PATH={tmp_path / 'installed'}"
    printed = cmake("-S", tmp_path, "-B", tmp_path / "consumer", prefix)
    assert f"-- found={int(is_found)}" in printed
