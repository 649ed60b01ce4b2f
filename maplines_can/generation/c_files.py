"""The C core as files for an ECU: header, source, tables of DBCs, and a build."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path

from ..values.errors import LayoutError
from ..wire.layout.message_layout import Layout
from .c_build import ALL, Build, Features, build_of
from .c_tables import tables_of

#: The interface, and what it includes.
HEADERS = ("maplines.h", "maplines_build.h", "maplines_state.h")
#: A section of internal.h that declares what a source defines: its title gives the order.
_SECTION = re.compile(r"^/\* -+ (\w+\.c)\b", re.MULTILINE)
_LOCAL_INCLUDE = re.compile(r'^#include "(\w+\.h)"\n', re.MULTILINE)
_SYSTEM_INCLUDE = re.compile(r"^#include <\w+\.h>\n", re.MULTILINE)
_MACRO = re.compile(r"^ *# *define (\w+)", re.MULTILINE)
#: Where the sources of the header are edited by section.
_MARKER = re.compile(r"^/\* \w+: (?:begin|end) \*/\n", re.MULTILINE)
#: Storage class in a library that lacks a feature, which may leave functions without a caller.
UNUSED = " MAPLINES_UNUSED"
#: What a source is for: all of it is within this condition.
_CONDITION = re.compile(r'^#include "internal.h"\n\n#if (.+)\n\n', re.MULTILINE)
_GUARD = re.compile(r"^#ifndef (\w+_H)\n#define \1\n(.*)^#endif\n\Z", re.MULTILINE | re.DOTALL)


def c_files(dbcs: Mapping[str, Layout], features: Features = ALL) -> dict[str, str]:
    """Return the files of the C core for one or more DBCs, by their names.

    They depend on nothing but the DBCs, the features and the version of this package.

    Args:
        dbcs: layouts by the start of the names of their tables, a C identifier.
        features: that the program needs.

    Raises:
        LayoutError: a DBC has no C, needs a feature that is left out, or a name is not an
            identifier; the message has the cure.
        ValueError: the features make no library; see ``build_of``.
    """
    for name in dbcs:
        check_name(name)
    build = build_of(dbcs, features)
    files = headers(build) | {"maplines.c": source(build)}
    for name, layout in dbcs.items():
        tables = tables_of(layout, name, build)
        files |= {f"{name}_dbc.h": tables.header, f"{name}_dbc.c": tables.source}
    return files | {"CMakeLists.txt": cmake(list(dbcs))}


def check_name(name: str) -> None:
    """Check the start of the names of tables.

    Raises:
        LayoutError: it is not an identifier of C, begins with an underscore, or is long.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,39}", name):
        raise LayoutError(
            f"the name of tables must be a C identifier of at most 40 characters that begins with "
            f"a letter, got {name!r}"
        )


def core_folder() -> Path:
    """Return the folder of the C core: in the installed package, or the checkout.

    Raises:
        FileNotFoundError: it is in neither place.
    """
    packaged = Path(str(resources.files(__package__.partition(".")[0]))) / "c"
    checkout = Path(__file__).parents[2] / "c"
    for folder in (packaged, checkout):
        if (folder / "src").is_dir():
            return folder
    raise FileNotFoundError(f"the C core is neither at {packaged} nor at {checkout}; reinstall")


def headers(build: Build) -> dict[str, str]:
    """Return ``maplines.h`` of a build, and what it includes; a program may define larger sizes."""
    text = _text("include/maplines.h")
    for macro, value in build.macros.items():
        text = re.sub(rf"(?<=#define {macro} )\w+", str(value), text)
    included = {name: _text(f"include/{name}") for name in HEADERS if name != "maplines.h"}
    return {"maplines.h": _MARKER.sub("", text)} | included


def source(build: Build, internal: str = "static") -> str:
    """Return ``maplines.c``: all sources in one, where what the header does not name is static.

    Args:
        build: what the library has.
        internal: storage class of those; nothing, if other sources call them.
    """
    found = {path.name for path in (core_folder() / "src").glob("*.c")}
    order = [name for name in _SECTION.findall(_text("src/internal.h")) if name in found]
    sources = {name: _text(f"src/{name}") for name in [*order, *sorted(found.difference(order))]}
    sources = {name: text for name, text in sources.items() if _belongs(text, build)}
    if len(sources) < len(found):
        internal += UNUSED
    headers: dict[str, str] = {}
    for text in sources.values():
        _add_headers(text, headers)
    shared = set(_MACRO.findall("".join(headers.values())))
    parts = [*headers.values(), *(_apart(name, text, shared) for name, text in sources.items())]
    body = "\n".join(_LOCAL_INCLUDE.sub("", part).strip("\n") + "\n" for part in parts)
    return "".join(
        (
            "/* The C core of maplines in one file; maplines.h is its manual. */\n",
            '#include "maplines.h"\n\n',
            *sorted(set(_SYSTEM_INCLUDE.findall(body))),
            "\n",
            _UNUSED_MACRO if UNUSED in internal else "",
            f"#define MAPLINES_INTERNAL {internal}".rstrip() + "\n\n",
            re.sub(r"\n{3,}", "\n\n", _SYSTEM_INCLUDE.sub("", body)),
        )
    )


def propagation_sources() -> dict[str, str]:
    """Return the files that propagate lines of a map, beside ``maplines.c`` that is not static."""
    folder = core_folder() / "propagation"
    files = {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.iterdir())}
    return {"internal.h": _text("src/internal.h")} | files


def _belongs(text: str, build: Build) -> bool:
    """Return whether a library has anything of a source."""
    condition = _CONDITION.search(text)
    return condition is None or build.has(condition[1])


def _add_headers(text: str, headers: dict[str, str]) -> None:
    """Add the internal headers that a source includes, each after those that it includes."""
    for name in _LOCAL_INCLUDE.findall(text):
        if name != "maplines.h" and name not in headers:
            inner = _GUARD.sub(r"\2", _text(f"src/{name}"))
            _add_headers(inner, headers)
            headers[name] = inner


def _apart(name: str, text: str, shared: set[str]) -> str:
    """Return a source with a title, whose macros end with it but for shared ones."""
    title = f"/* ==== {name} {'=' * (88 - len(name))} */\n\n"
    macros = dict.fromkeys(macro for macro in _MACRO.findall(text) if macro not in shared)
    return "".join([title, text.rstrip("\n"), "\n\n", *(f"#undef {name}\n" for name in macros)])


def cmake(names: list[str]) -> str:
    """Return ``CMakeLists.txt`` of a static library with the tables of these names."""
    sources = ["maplines.c", *(f"{name}_dbc.c" for name in names)]
    headers = [*HEADERS, *(f"{name}_dbc.h" for name in names)]
    version = re.findall(r'#define MAPLINES_VERSION "(.+)"', _text("include/maplines.h"))[0]
    return CMAKE.format(version=version, sources=" ".join(sources), headers=" ".join(headers))


def _text(name: str) -> str:
    return (core_folder() / name).read_text(encoding="utf-8")


_UNUSED_MACRO = """\
#ifdef __GNUC__
#define MAPLINES_UNUSED __attribute__((unused)) // the feature that calls it was left out
#else
#define MAPLINES_UNUSED
#endif
"""
CMAKE = """\
# The library maplines: in a project of yours, add_subdirectory() and link maplines::maplines.
# Installed, find_package(maplines) and pkg-config find it.
cmake_minimum_required(VERSION 3.13)
project(maplines VERSION {version} LANGUAGES C)
include(GNUInstallDirs)

add_library(maplines STATIC {sources})
add_library(maplines::maplines ALIAS maplines)
target_include_directories(
  maplines PUBLIC $<BUILD_INTERFACE:${{CMAKE_CURRENT_SOURCE_DIR}}>
                  $<INSTALL_INTERFACE:${{CMAKE_INSTALL_INCLUDEDIR}}>)
set_target_properties(
  maplines PROPERTIES C_STANDARD 99 C_STANDARD_REQUIRED ON C_EXTENSIONS OFF
                      POSITION_INDEPENDENT_CODE ON)
# A fused multiplication would give other bits than the Python package.
include(CheckCCompilerFlag)
check_c_compiler_flag(-ffp-contract=off MAPLINES_HAS_FP_CONTRACT)
if(MAPLINES_HAS_FP_CONTRACT)
  target_compile_options(maplines PRIVATE -ffp-contract=off)
endif()
if(NOT MSVC)
  target_link_libraries(maplines PUBLIC m)
endif()

install(TARGETS maplines EXPORT maplines ARCHIVE DESTINATION "${{CMAKE_INSTALL_LIBDIR}}")
install(FILES {headers} DESTINATION "${{CMAKE_INSTALL_INCLUDEDIR}}")
set(MAPLINES_PACKAGE "${{CMAKE_INSTALL_LIBDIR}}/cmake/maplines")
install(
  EXPORT maplines
  NAMESPACE maplines::
  FILE maplinesConfig.cmake
  DESTINATION "${{MAPLINES_PACKAGE}}")
include(CMakePackageConfigHelpers)
write_basic_package_version_file(maplinesConfigVersion.cmake COMPATIBILITY SameMinorVersion)
install(FILES "${{CMAKE_CURRENT_BINARY_DIR}}/maplinesConfigVersion.cmake"
        DESTINATION "${{MAPLINES_PACKAGE}}")

# For pkg-config, with paths from its own place on, so that all can be moved. From a folder that is
# absolute none is known: the prefix is then that of the installation, which may have its own.
if(IS_ABSOLUTE "${{CMAKE_INSTALL_LIBDIR}}")
  set(prefix "@PREFIX@")
else()
  file(RELATIVE_PATH up "/${{CMAKE_INSTALL_LIBDIR}}/pkgconfig" /)
  string(REGEX REPLACE "/$" "" prefix "\\${{pcfiledir}}/${{up}}")
endif()
foreach(folder IN ITEMS LIBDIR INCLUDEDIR)
  string(REPLACE " " "\\\\ " ${{folder}} "${{CMAKE_INSTALL_${{folder}}}}")
  if(NOT IS_ABSOLUTE "${{${{folder}}}}")
    string(PREPEND ${{folder}} "\\${{prefix}}/")
  endif()
endforeach()
set(pc "${{CMAKE_CURRENT_BINARY_DIR}}/maplines.pc")
file(WRITE "${{pc}}.in" "prefix=${{prefix}}
Name: maplines
Description: The lines of a digital map on a CAN bus, with their uncertainty
Version: ${{PROJECT_VERSION}}
Cflags: -I${{INCLUDEDIR}}
Libs: -L${{LIBDIR}} -lmaplines -lm
")
install(CODE [[string(REPLACE " " "\\\\ " PREFIX "${{CMAKE_INSTALL_PREFIX}}")]])
install(CODE "configure_file(\\"${{pc}}.in\\" \\"${{pc}}\\" @ONLY)")
install(FILES "${{pc}}" DESTINATION "${{CMAKE_INSTALL_LIBDIR}}/pkgconfig")
"""
