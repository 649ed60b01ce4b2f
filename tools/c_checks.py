#!/usr/bin/env python3
"""Check the C core and its shared library: form, warnings, and what four analysers find.

    c_checks.py                the quick checks whose programs are installed; others are named
    c_checks.py compile misra  only these
    c_checks.py --long         the others: the tests with sanitizers, on other targets, coverage
    c_checks.py --list         the names of the checks
    c_checks.py --json         the findings as JSON

The exit status is 1 if there is a finding, and with --strict also if a program is missing. Run it
in the environment of the project: python3 tools/run.py python tools/c_checks.py

The long checks run the tests of tests/c with another compiler, and with an emulator if that is for
another processor; so can you:

    MAPLINES_CC=clang MAPLINES_CFLAGS="-O1 -fsanitize=address,undefined" pytest tests/c
    MAPLINES_CC=s390x-linux-gnu-gcc MAPLINES_EMULATOR="qemu-s390x -L /usr/s390x-linux-gnu" ...

Rules of MISRA C:2012 from which the core deviates are in c/MISRA.md, each with its reason; a
finding of another rule fails.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from reporting import parser_of

from maplines_can import MapError, Polyline, Slot
from maplines_can.generation.c_files import c_files
from maplines_can.generation.fmu import SentRoute
from maplines_can.generation.fmu.archive import sources_of as fmu_sources
from maplines_can.values.route_lines import RouteLines
from maplines_can.wire.layout.message_layout import Layout

ROOT = Path(__file__).resolve().parents[1]
C = ROOT / "c"
INCLUDE = [f"-I{C / name}" for name in ("include", "src", "propagation", "core", "logs")]
WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Wstrict-prototypes",
            "-Wmissing-prototypes", "-Wdouble-promotion", "-Wundef", "-Werror"]  # fmt: skip
#: Least share of the branches that the tests take [%].
MIN_BRANCHES = 98.0
#: Tests of streams, which compare the library with the model.
STREAM_TESTS = ("tests/model", "tests/test_map_streams.py", "tests/test_log_streams.py")
#: Tests of what callers give the library: sizes, arrays, objects and files of any kind.
DOOR_TESTS = (
    "tests/wire/test_encoder.py", "tests/wire/test_encoder_arguments.py",
    "tests/wire/reception/test_decoder_object.py", "tests/propagation/test_map_scene.py",
    "tests/wire/layout/test_packing.py",
    "tests/bus/test_candump_logs.py", "tests/bus/test_asc_logs.py", "tests/bus/test_blf_logs.py",
    "tests/bus/test_pcap_logs.py",
)  # fmt: skip
#: All that run the library.
CORE_TESTS = (
    "tests/core", "tests/values", "tests/wire", "tests/propagation",
    "tests/bus/test_candump_logs.py", "tests/bus/test_asc_logs.py", "tests/bus/test_blf_logs.py",
    "tests/bus/test_pcap_logs.py",
)  # fmt: skip
THREAD_TESTS = ("tests/wire/test_threads.py",)
#: Clang warns of all that it warns of before it makes code; gcc does not.
OUTPUT = {"gcc": ["-o", "/dev/null", "-c"], "clang": ["-fsyntax-only"]}
#: Variants that are compiled: flags after those of the language.
VARIANTS: tuple[list[str], ...] = ([], ["-DMAPLINES_FLOAT"], ["-DNDEBUG"])
FINDING = re.compile(r"(?:warning|error|style|performance|portability|information): ")

Findings = list[str]


def sources() -> list[str]:
    """Return the sources of the core."""
    return [str(path) for path in sorted((C / "src").glob("*.c"))]


def sources_of_package() -> list[str]:
    """Return the sources of the core, and those of the propagation."""
    return [*sources(), *map(str, sorted((C / "propagation").glob("*.c")))]


def library_sources() -> list[str]:
    """Return what only the shared library has: loops over arrays, and readers of logs."""
    return [str(path) for name in ("core", "logs") for path in sorted((C / name).glob("*.c"))]


def all_files() -> list[str]:
    """Return all C files: of the core, its library, the tests and the examples."""
    return [str(path) for path in sorted(C.rglob("*.[ch]")) if "build" not in path.parts]


def run(
    command: Sequence[str], environment: Mapping[str, str] | None = None, folder: Path = ROOT
) -> tuple[int, list[str]]:
    """Return the status of a command in a folder, and the lines that it prints."""
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=folder, env=environment
    )
    return done.returncode, [*done.stdout.splitlines(), *done.stderr.splitlines()]


def check_format() -> Findings:
    """The files have the format of c/.clang-format."""
    _, lines = run(["clang-format", "--dry-run", "--Werror", "-style=file", *all_files()])
    return [line for line in lines if "error:" in line]


def check_compile() -> Findings:
    """Gcc and clang compile all C as C99 and the headers as C++17 and C++20 without a warning."""
    findings = []
    for compiler in ("gcc", "clang"):
        if shutil.which(compiler) is None:
            continue
        for variant in VARIANTS:
            flags = ["-std=c99", "-O2", "-ffp-contract=off", *WARNINGS, *variant, *INCLUDE]
            is_double = "-DMAPLINES_FLOAT" not in variant
            for source in [*sources_of_package(), *(library_sources() if is_double else [])]:
                status, lines = run([compiler, *flags, *OUTPUT[compiler], source])
                findings += [f"{compiler}: {line}" for line in lines if FINDING.search(line)]
                if status and not findings:
                    findings.append(f"{compiler}: {source} does not compile")
    return findings + list(_headers_as_cpp())


def _headers_as_cpp() -> Iterator[str]:
    """Yield what C++ compilers say of all headers that are generated for three DBCs."""
    dbcs = {
        name: Layout.from_dbc(ROOT / "dbc" / f"{name}.dbc")
        for name in ("maplines", "maplines-pose", "maplines-scene")
    }
    files = c_files({name.replace("-", "_"): layout for name, layout in dbcs.items()})
    headers = [name for name in files if name.endswith(".h")]
    with tempfile.TemporaryDirectory() as folder:
        for name in headers:
            (Path(folder) / name).write_text(files[name])
        source = Path(folder) / "headers.cpp"
        source.write_text("".join(f'#include "{name}"\n' for name in headers))
        flags = ["-Wall", "-Wextra", "-Wconversion", "-Wold-style-cast", "-Wpedantic", "-Wshadow",
                 "-Werror", "-fsyntax-only", str(source)]  # fmt: skip
        for compiler in filter(shutil.which, ("g++", "clang++", "arm-none-eabi-g++")):
            for standard in ("-std=c++17", "-std=c++20"):
                status, lines = run([compiler, standard, *flags])
                yield from (f"{compiler} {standard}: {line}" for line in lines if status and line)


def check_fmu() -> Findings:
    """Gcc, clang, cppcheck and clang-tidy find nothing in the nodes of FMUs."""
    path = Polyline([[0, 0], [1, 0]])
    lines = RouteLines(path, (0.0,), ({Slot.EGO_LEFT: path},))
    route = SentRoute("any", lines, list(Slot), (-4.0, 80.0), MapError(), 1.0)
    dbcs = Layout.from_dbc(), Layout.from_dbc(ROOT / "dbc" / "maplines-scene.dbc")
    nodes: list[tuple[str, SentRoute | None, Layout]]
    nodes = [("receiver", None, dbc) for dbc in dbcs]
    nodes += [("sender", given, dbcs[0]) for given in (None, route)]
    return [finding for node in nodes for finding in _findings_of_node(*node)]


def _findings_of_node(node: str, route: SentRoute | None, layout: Layout) -> Iterator[str]:
    """Yield what compilers and analysers say of a node with the tables of a DBC."""
    sources, _ = fmu_sources(node, layout, route)
    with tempfile.TemporaryDirectory() as folder:
        headers = Path(folder) / "fmi"
        headers.mkdir()
        for name, text in sources.items():
            ((headers if name.startswith("fmi3") and name.endswith(".h") else Path(folder)) /
             name).write_text(text)  # fmt: skip
        own = [f"{folder}/{path.name}" for path in sorted((C / "fmu").glob("*.c"))
               if path.name in sources]  # fmt: skip
        flags = ["-std=c99", f"-isystem{headers}", f"-I{folder}"]
        for compiler in filter(shutil.which, ("gcc", "clang")):
            for path in [*own, f"{folder}/variables.c"]:
                command = [compiler, *flags, "-O2", *WARNINGS, "-c", path, "-o", "/dev/null"]
                status, lines = run(command)
                yield from (f"{compiler}: {line}" for line in lines if status)
        if shutil.which("cppcheck"):
            suppressed = (
                "missingInclude",
                "missingIncludeSystem",
                "unusedFunction",
                "unmatchedSuppression",
            )
            command = ["cppcheck", "--quiet", "--enable=all", "--inconclusive", "--std=c99",
                       "--template={file}:{line}: {severity}: {message} [{id}]",
                       *(f"--suppress={name}" for name in suppressed), *FLOATS, *own]  # fmt: skip
            yield from (line for line in run(command)[1] if FINDING.search(line))
        if shutil.which("clang-tidy"):
            config = f"--config-file={C / '.clang-tidy'}"
            command = ["clang-tidy", config, "--quiet", *own, "--", *flags]
            yield from (line for line in run(command)[1] if FINDING.search(line))


def check_analyzer() -> Findings:
    """GCC's -fanalyzer finds nothing."""
    findings = []
    for source in sources_of_package():
        flags = ["-std=c99", "-O2", "-fanalyzer", *INCLUDE, "-c", source, "-o", "/dev/null"]
        findings += [line for line in run(["gcc", *flags])[1] if FINDING.search(line)]
    return findings


#: Cppcheck does not read the headers of the system.
FLOATS = ("-DFLT_RADIX=2", "-DFLT_MANT_DIG=24", "-DDBL_MANT_DIG=53")


def check_cppcheck() -> Findings:
    """Cppcheck finds nothing in any class of its checks."""
    suppressed = ("missingIncludeSystem", "unusedFunction", "unmatchedSuppression")
    command = ["cppcheck", "--quiet", "--enable=all", "--inconclusive", "--std=c99",
               "--inline-suppr", "--template={file}:{line}: {severity}: {message} [{id}]",
               *(f"--suppress={name}" for name in suppressed), *FLOATS, *INCLUDE,
               *sources_of_package(), *library_sources()]  # fmt: skip
    return [line for line in run(command)[1] if FINDING.search(line)]


def check_misra() -> Findings:
    """The core keeps to MISRA C:2012, but for the rules of c/MISRA.md."""
    command = ["cppcheck", "--quiet", "--addon=misra", "--std=c99", "--inline-suppr",
               "--template={file}:{line}: {severity}: {message} [{id}]",
               *FLOATS, *INCLUDE, *sources()]  # fmt: skip
    deviations = set(re.findall(r"^\| (\d+\.\d+) \|", (C / "MISRA.md").read_text(), re.MULTILINE))
    findings, seen = [], set()
    for line in run(command)[1]:
        if found := re.search(r"misra-c2012-(\d+\.\d+)", line):
            seen.add(found[1])
            if found[1] not in deviations:
                findings.append(line)
    unneeded = sorted(deviations - seen)
    return findings + [f"c/MISRA.md: no finding of rule {rule}: remove it" for rule in unneeded]


def check_tidy() -> Findings:
    """Clang-tidy finds nothing with the checks of c/.clang-tidy."""
    config = f"--config-file={C / '.clang-tidy'}"
    command = ["clang-tidy", config, "--quiet", *sources_of_package(), *library_sources(), "--",
               "-std=c99", *INCLUDE]  # fmt: skip
    return [line for line in run(command)[1] if FINDING.search(line)]


def findings_with(compiler: str, flags: str = "-O2", emulator: str = "", **more: str) -> Findings:
    """Run the tests of the core with a compiler, its arguments, and an emulator of its target."""
    settings = {"MAPLINES_CC": compiler, "MAPLINES_CFLAGS": flags, "MAPLINES_EMULATOR": emulator}
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "tests/c"]
    status, lines = run(command, os.environ | settings | more)
    failed = [line for line in lines if re.match(r"(FAILED|ERROR) ", line)]
    return failed or ([*lines[-3:]] if status else [])


def check_sanitizers() -> Findings:
    """The tests pass with the address and undefined-behaviour sanitizers of clang."""
    checks = "-fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all"
    return findings_with("clang", f"-O1 -g {checks}")


def findings_of_library(flags: str, tests: Sequence[str], folder: Path, **more: str) -> Findings:
    """Run tests with a library that is built with other flags, into a copy of the checkout."""
    skipped = shutil.ignore_patterns(".*", "maplines.so", "__pycache__", "build")
    copy = folder / "copy"
    shutil.copytree(ROOT, copy, ignore=skipped)
    settings = os.environ | {"PYTHONPATH": str(copy), "CFLAGS": flags, "LDFLAGS": flags}
    build = [sys.executable, str(copy / "tools" / "build_core.py")]
    status, lines = run(build, settings | {name: more[name] for name in more if name == "CC"})
    if status:
        return lines[-3:]
    command = [sys.executable, "-X", "dev", "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests]
    status, lines = run(command, settings | more, copy)  # Python finds the package there first
    return lines[-20:] if status else []


def check_library() -> Findings:
    """The tests of the library through Python pass with the sanitizers of gcc."""
    flags = "-fsanitize=address,undefined -fno-sanitize-recover=undefined -g -O1"
    library = run(["gcc", "-print-file-name=libasan.so"])[1][0]
    with tempfile.TemporaryDirectory() as folder:
        # CPython leaks a little at its end.
        settings = {"CC": "gcc", "LD_PRELOAD": library, "ASAN_OPTIONS": "detect_leaks=0"}
        # What streams reach depends on the model, and not on the library.
        tests = [*STREAM_TESTS, *DOOR_TESTS, "-k", "not a_fault_of and not reach_every"]
        return findings_of_library(flags, tests, Path(folder), **settings)


def check_threads() -> Findings:
    """Tests of threads pass with the thread sanitizer of gcc."""
    library = run(["gcc", "-print-file-name=libtsan.so"])[1][0]
    with tempfile.TemporaryDirectory() as folder:
        settings = {"CC": "gcc", "LD_PRELOAD": library, "TSAN_OPTIONS": "exitcode=66"}
        return findings_of_library(
            "-fsanitize=thread -g -O1", THREAD_TESTS, Path(folder), **settings
        )


def check_optimised() -> Findings:
    """The tests pass with gcc and clang, without optimisation and with all of it."""
    return [
        f"{compiler} {level}: {line}"
        for compiler in filter(shutil.which, ("gcc", "clang"))
        for level in ("-O0", "-O3")
        for line in findings_with(compiler, level)
    ]


def check_aarch64() -> Findings:
    """The tests pass on AArch64, which has fused multiplications."""
    return findings_with("aarch64-linux-gnu-gcc", emulator="qemu-aarch64 -L /usr/aarch64-linux-gnu")


def check_s390x() -> Findings:
    """The tests pass on s390x, which is big-endian."""
    return findings_with("s390x-linux-gnu-gcc", emulator="qemu-s390x -L /usr/s390x-linux-gnu")


def check_armhf() -> Findings:
    """The tests pass on a 32-bit ARM."""
    return findings_with("arm-linux-gnueabihf-gcc", emulator="qemu-arm -L /usr/arm-linux-gnueabihf")


#: Whether each branch of a file is taken, by its place and outcome.
Branches = dict[tuple[Any, ...], bool]


def branches_of(file: Mapping[str, Any]) -> Branches:
    """Return the branches of a file that llvm-cov exports: both outcomes of each condition.

    A branch is taken if it is in any of the builds. Assertions have none: they are compiled out,
    since no test can make one fail, and a function has to be the same in all programs.
    """
    branches: Branches = {}
    for line, column, last_line, last_column, trues, falses, *_ in file["branches"]:
        for outcome, count in ((True, trues), (False, falses)):
            place = (line, column, last_line, last_column, outcome)
            branches[place] = branches.get(place, False) or count > 0
    return branches


def share_of(branches: Branches) -> float:
    """Return the share of branches that are taken [%]."""
    return 100 * sum(branches.values()) / len(branches) if branches else 100.0


def described(branches: Branches) -> str:
    """Return how many branches are taken."""
    return f"{share_of(branches):.2f} % of {len(branches)} branches"


def missing_lines(branches: Branches) -> str:
    """Return the lines of a file with branches that are not taken."""
    return " ".join(map(str, sorted({place[0] for place, taken in branches.items() if not taken})))


def check_coverage() -> Findings:
    """The tests take at least 98 % of the branches of the core: of the library, and for an ECU."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        flags = "-O0 -g -DNDEBUG -fprofile-instr-generate -fcoverage-mapping"
        cache = folder / "programs"
        cache.mkdir()
        profiles = {"LLVM_PROFILE_FILE": f"{folder}/%p-%m.profraw"}
        findings = findings_with("clang", flags, TMPDIR=str(cache), **profiles)
        findings += findings_of_library(
            flags, [*STREAM_TESTS, *CORE_TESTS], folder, CC="clang", **profiles
        )
        merged = f"{folder}/merged.profdata"
        raw = [str(path) for path in folder.glob("*.profraw")]
        run(["llvm-profdata", "merge", "-sparse", *raw, "-o", merged])
        programs = [*cache.glob("maplines-c-*/*"), *folder.glob("copy/maplines_can/core/*.so")]
        objects = [part for path in programs if path.is_file() for part in ("-object", str(path))]
        command = ["llvm-cov", "export", "-format=text", f"-instr-profile={merged}", *objects[1:]]
        exported = next((line for line in run(command)[1] if line.startswith("{")), None)
    if exported is None:
        return [*findings, "llvm-cov exports nothing"]
    files: dict[str, Branches] = {}
    for file in json.loads(exported)["data"][0]["files"]:
        path = Path(file["filename"])
        if path.parts[-3:-1] == ("c", "src"):  # in the checkout, or in its copy
            own = files.setdefault(path.name, {})
            for place, taken in branches_of(file).items():
                own[place] = own.get(place, False) or taken
    for name, branches in sorted(files.items()):
        if share_of(branches) < MIN_BRANCHES:
            print(f"{name:<20} {described(branches)}: lines {missing_lines(branches)}")
    everything = {
        (name, *place): taken for name, own in files.items() for place, taken in own.items()
    }
    print(f"{'all files':<20} {described(everything)}")
    if share_of(everything) < MIN_BRANCHES:
        findings.append(f"{described(everything)} are taken, fewer than {MIN_BRANCHES} %")
    return findings


#: Checks by name, with the programs that each one needs.
QUICK: dict[str, tuple[Callable[[], Findings], tuple[str, ...]]] = {
    "format": (check_format, ("clang-format",)),
    "compile": (check_compile, ("gcc",)),
    "fmu": (check_fmu, ("gcc",)),
    "cppcheck": (check_cppcheck, ("cppcheck",)),
    "misra": (check_misra, ("cppcheck",)),
    "analyzer": (check_analyzer, ("gcc",)),
    "tidy": (check_tidy, ("clang-tidy",)),
}
LONG: dict[str, tuple[Callable[[], Findings], tuple[str, ...]]] = {
    "library": (check_library, ("gcc",)),
    "threads": (check_threads, ("gcc",)),
    "sanitizers": (check_sanitizers, ("clang",)),
    "optimised": (check_optimised, ("gcc",)),
    "coverage": (check_coverage, ("clang", "llvm-cov", "llvm-profdata")),
    "aarch64": (check_aarch64, ("aarch64-linux-gnu-gcc", "qemu-aarch64")),
    "s390x": (check_s390x, ("s390x-linux-gnu-gcc", "qemu-s390x")),
    "armhf": (check_armhf, ("arm-linux-gnueabihf-gcc", "qemu-arm")),
}
CHECKS = QUICK | LONG


def main() -> int:
    """Run the checks; return the exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("names", nargs="*", metavar="CHECK", help=", ".join(CHECKS))
    parser.add_argument("--list", action="store_true", help="print the names of the checks")
    parser.add_argument("--long", action="store_true", help="run the long checks")
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")
    parser.add_argument("--strict", action="store_true", help="fail if a program is missing")
    options = parser.parse_args()
    if unknown := sorted({*options.names} - CHECKS.keys()):
        parser.error(f"unknown check {', '.join(unknown)}; there are {', '.join(CHECKS)}")
    if options.list:
        print("\n".join(f"{name:<10} {check.__doc__}" for name, (check, _) in CHECKS.items()))
        return 0
    found: dict[str, Findings] = {}
    missing: dict[str, list[str]] = {}
    for name in options.names or (LONG if options.long else QUICK):
        check, programs = CHECKS[name]
        if lacking := [program for program in programs if shutil.which(program) is None]:
            missing[name] = lacking
            continue
        found[name] = check()
    if options.json:
        print(json.dumps({"findings": found, "missing": missing}, indent=2))
    else:
        for name, findings in found.items():
            print(f"{name:<10} {f'{len(findings)} findings' if findings else 'clean'}")
            print("".join(f"    {line}\n" for line in findings), end="")
        for name, lacking in missing.items():
            print(f"{name:<10} not run: {', '.join(lacking)} is not installed")
    return int(any(found.values()) or (options.strict and bool(missing)))


if __name__ == "__main__":
    sys.exit(main())
