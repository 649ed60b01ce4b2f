"""Libraries in C that lack features: they compile, and receive as the model with their sizes."""

from __future__ import annotations

import math
import re
import struct
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scene_layouts import layout_of
from support import c_core
from support.c_core import LIBRARIES, SMALL

from maplines_can import Slot
from maplines_can.generation.c_build import ALL, Build, Features, build_of
from maplines_can.generation.c_files import c_files
from maplines_can.generation.vector_files import vector_files
from maplines_can.model.decoder import Receiver, View
from maplines_can.model.records import Line
from maplines_can.model.scenes import Scene
from maplines_can.model.settings import Sizes
from maplines_can.testing.hostile_streams import PROFILES, Question, Step, Stream, traffics_of
from maplines_can.values.errors import LayoutError
from maplines_can.wire import POSE, Layout, Owner, Reason
from maplines_can.wire.layout.pose_layout import number_of

#: Receivers that lack something: the core of the package, which has all, is in tests/model.
RECEIVERS = [name for name, (_, own) in LIBRARIES.items() if own.receiver and own != ALL]
#: Profiles with the default settings, which a library for an ECU has.
STANDARD = [profile for profile in PROFILES if not profile.settings and profile.stale_cycles == 3]
#: Libraries that clang compiles, too.
CLANG = ("small", "sender")
#: Frames of each stream; the model takes ten times as long for whole scenes.
FRAMES, SCENE_FRAMES = 150, 40


def written(name: str, folder: Path) -> None:
    dbc, features = LIBRARIES[name]
    for file, text in c_files({"harness": layout_of(dbc)}, features).items():
        (folder / file).write_text(text)


@pytest.mark.parametrize(
    ("name", "cc"),
    [
        *((name, "gcc") for name, (_, own) in LIBRARIES.items() if not own.receiver),
        *product(CLANG, ["clang"]),
    ],
)
def test_a_library_compiles_without_a_warning(name: str, cc: str, tmp_path: Path) -> None:
    """Those of receivers are compiled below."""
    written(name, tmp_path)
    flags = [*c_core.WARNINGS, "-std=c99", "-O1", "-ffp-contract=off", "-c"]
    subprocess.run([cc, *flags, "maplines.c", "harness_dbc.c"], check=True, cwd=tmp_path)


C99 = ["gcc", "-std=c99", "-ffp-contract=off"]
PROGRAM = """\
#include "harness_dbc.h"
int main(void) { maplines_line_t line = {0}; return maplines_y(&line, 0) > 0; }
"""
TABLES = '#include "harness_dbc.h"\nint main(void) { return harness_dbc.has_pose; }\n'


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the small library, its object file, and programs that use it."""
    folder = tmp_path_factory.mktemp("small")
    written("small", folder)
    (folder / "program.c").write_text(PROGRAM)
    (folder / "tables.c").write_text(TABLES)
    subprocess.run([*C99, "-c", "maplines.c"], check=True, cwd=folder)
    return folder


def told(folder: Path, *command: str) -> tuple[bool, str]:
    """Return whether a compiler takes a program, and what it says."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return done.returncode == 0, done.stderr


def test_what_is_left_out_is_not_there(small: Path) -> None:
    """Neither in the interface nor in the tables."""
    tables = (small / "harness_dbc.c").read_text()
    assert "straight" not in tables
    assert "slot_levels" not in tables
    assert "MAPLINES_CENTRE" not in tables
    call = '#include "maplines.h"\nint main(void) { return sizeof(%s) > 0; }\n'
    for name, is_there in (("&maplines_latest", True), ("&maplines_encode_line", False),
                           ("&maplines_latest_scene", False), ("maplines_encoder_t", False),
                           ("MAPLINES_NEXT_RIGHT", True), ("MAPLINES_CENTRE", False)):  # fmt: skip
        (small / "call.c").write_text(call % name)
        assert told(small, *C99, "-Werror", "-fsyntax-only", "call.c")[0] == is_there, name


def test_the_linker_says_which_size_differs(small: Path) -> None:
    """As docs/embedding.md has it: the name that is missing and the one that is there."""
    page = (c_core.C.parent / "docs" / "embedding.md").read_text(encoding="utf-8")
    (printed,) = re.findall(r"(?m)^undefined reference to `(\w+)'$", page)
    assert printed.count("slots3") == 1
    subprocess.run([*C99, "-DMAPLINES_SLOTS=3", "-c", "program.c"], check=True, cwd=small)
    symbols = [
        subprocess.check_output(["nm", f"{name}.o"], cwd=small, text=True).splitlines()
        for name in ("program", "maplines")
    ]
    assert any(line.endswith(f" U {printed}") for line in symbols[0])
    assert any(line.endswith(f" T {printed.replace('slots3', 'slots4')}") for line in symbols[1])


@pytest.mark.parametrize(
    "macro", ["FLOAT=1", "SLOTS=3", "HISTORY=64", "WINDOW=64", "SECOC=1", "SLOTS=4"]
)
def test_files_of_different_builds_do_not_link(small: Path, macro: str) -> None:
    """Whichever function they call. The library has four slots."""
    command = [*C99, f"-DMAPLINES_{macro}", "program.c", "maplines.o", "-lm", "-o", "program"]
    is_linked, errors = told(small, *command)
    assert is_linked == (macro == "SLOTS=4")
    assert ("undefined reference" in errors) != is_linked


@pytest.mark.parametrize("macro", ["SLOTS=5", "SCENES=1", "SLOTS=4"])
def test_tables_of_another_build_do_not_link(small: Path, macro: str) -> None:
    """They have other members, so a decoder would read beyond them."""
    subprocess.run([*C99, f"-DMAPLINES_{macro}", "-c", "harness_dbc.c"], check=True, cwd=small)
    is_linked, errors = told(small, *C99, "tables.c", "harness_dbc.o", "-o", "program")
    assert is_linked == (macro == "SLOTS=4")
    assert ("undefined reference" in errors) != is_linked


@pytest.mark.parametrize("macro", [
    "RECEIVER=2", "RECEIVER=0 -DMAPLINES_SENDER=0", "SCENES=-1", "SLOTS=0", "SLOTS=9",
    "MAX_PAGES=17", "MAX_TRANSFER_IDS=0", "MAX_COMPONENTS=65", "TRANSFERS=3", "HISTORY=100",
    "EPOCHS=0", "WINDOW=256",
])  # fmt: skip
def test_a_size_that_the_code_does_not_have_is_refused(macro: str, small: Path) -> None:
    sizes = f"-DMAPLINES_{macro}".split()
    is_taken, errors = told(small, *C99, "-fsyntax-only", *sizes, "maplines.h")
    assert f'#error "{"maplines without " if " " in macro else ""}MAPLINES_' in errors
    assert not is_taken


BUILT = tempfile.TemporaryDirectory()  # of the libraries that several tests link
OPTIONS = ("-std=c99", "-O1", "-ffp-contract=off", *c_core.WARNINGS)


@cache
def compiled(name: str) -> Path:
    """Return a folder with the files of a library and their object files."""
    folder = Path(BUILT.name) / name
    folder.mkdir()
    written(name, folder)
    subprocess.run(["cc", *OPTIONS, "-c", "maplines.c", "harness_dbc.c"], check=True, cwd=folder)
    return folder


def linked(main: Path, folder: Path) -> Path:
    """Return a program with the library of a folder."""
    program = folder / main.stem
    objects = [folder / "maplines.o", folder / "harness_dbc.o"]
    sources = [str(path) for path in (main, *objects)]
    command = ["cc", *OPTIONS, f"-I{folder}", *sources, "-lm", "-o", str(program)]
    subprocess.run(command, check=True)
    return program


# ---- beside the model -------------------------------------------------------------------------


def steps_of(layout: Layout, seed: int, frames: int) -> Iterator[Step]:
    """Yield a stream of each profile, one after the other, a day apart."""
    traffics = traffics_of(layout, seed)
    for i, profile in enumerate(STANDARD):
        left = frames
        for step in Stream(traffics, profile, 100 * seed + i).steps():
            yield step
            left -= not isinstance(step, Question)
            if not left:
                break


def asked(step: Step) -> str:
    """Return a step as the harness reads it."""
    if not isinstance(step, Question):
        return f"F {step.t_ns} {step.can_id:x} {int(step.is_extended)} {step.data.hex()}"
    if step.kind == "latest":
        return f"L {int(step.slot)} {step.t_ns}"
    return f"{ {'expire': 'E', 'scene': 'N', 'statistics': 'S'}[step.kind] } {step.t_ns}"


def real(value: float) -> str:
    return struct.pack(">d", value).hex()


def of_line(line: Line) -> str:
    head = f"line {int(line.slot)} {int(line.kind)} {int(line.status)} {line.t_ns}"
    numbers = map(real, (line.x_min, line.x_max, line.age, *line.mean))
    return " ".join([head, *numbers, covariance(line.cov)])


def covariance(rows: Sequence[Sequence[float]]) -> str:
    numbers = [real(x) for row in rows for x in row]
    return " ".join(["cov", str(len(numbers)), *numbers])


def of_scene(view: View, build: Build) -> str:
    flags = (view.is_stale, view.may_be_two, view.is_usable)
    words = ["scene", view.state, view.status or "NONE", *(str(int(flag)) for flag in flags)]
    words.append(real(view.age))
    if isinstance(scene := view.content, Scene):
        shapes = zip(scene.lines, scene.fit_ranges, scene.quartics, strict=True)
        for line, fit_range, quartic in shapes:
            words += [view.slot_states[line.slot], of_line(line), *map(real, (*fit_range, quartic))]
        pose = scene.pose
        sigmas = pose.correlation_time, pose.offset_sigma, pose.heading_sigma
        words += [str(pose.counter), str(pose.t_ns), *map(real, sigmas), covariance(scene.cov)]
        if build.scene_records:
            words += [scene.left_out.get(slot, "IN_SCENE") for slot in [*Slot][: build.slots]]
    return " ".join(words)


def without_covariances(row: str) -> tuple[str, list[np.ndarray]]:
    """Return an answer without its covariances, and these."""
    words, covs = row.split(" "), []
    while "cov" in words:
        at = words.index("cov")
        end = at + 2 + int(words[at + 1])
        numbers = [struct.unpack(">d", bytes.fromhex(word))[0] for word in words[at + 2 : end]]
        n = math.isqrt(len(numbers))
        covs.append(np.array(numbers).reshape(n, n))
        del words[at:end]
    return " ".join(words), covs


def answered(model: Receiver, step: Step, build: Build) -> str:
    """Return what the harness prints for a step."""
    if not isinstance(step, Question):
        found = model.feed(step.can_id, step.data, step.t_ns, is_extended=step.is_extended)
        text = found if isinstance(found, str) else "".join(f" {of_line(one)}" for one in found)
    elif step.kind == "latest":
        view = model.latest(step.slot, step.t_ns)
        flags = (view.is_stale, view.may_be_two, view.is_usable)
        words = ["view", view.state, view.status or "NONE", *(str(int(flag)) for flag in flags)]
        words += [view.left_out or "IN_SCENE"] if build.scene_records else []
        line = [of_line(view.content)] if isinstance(view.content, Line) else []
        text = " ".join([*words, real(view.age), *line])
    elif step.kind == "scene":
        text = of_scene(model.latest_scene(step.t_ns), build)
    elif step.kind == "expire":
        model.expire(step.t_ns)
        text = ""
    else:
        model.elapse(step.t_ns)
        text = "".join(of_check(model, owner) for owner in model.checks)
    lost = sum(check.lost for owner, check in model.checks.items() if owner != POSE)
    numbers = [model.frames, model.lines, model.line_frames, lost, model.pending]
    return f"{text} | {' '.join(map(str, [*numbers, *(model.counts[r.name] for r in Reason)]))}"


def of_check(model: Receiver, owner: Owner) -> str:
    check = model.checks[owner]
    if check.status is None:
        return ""
    counts = check.statuses
    numbers = (
        counts["OK"] + counts["OKSOMELOST"], check.lost, counts["REPEATED"], counts["ERROR"],
        counts["WRONGSEQUENCE"], counts["NONEWDATA"],
    )  # fmt: skip
    words = [check.state, check.status, int(check.senders.are_two), *numbers]
    return f" check {number_of(owner).name} {' '.join(map(str, words))}"


def receives_as_the_model(name: str, seed: int, frames: int) -> int:
    """Check that a library answers every step as the model with its sizes; return how many."""
    dbc, features = LIBRARIES[name]
    layout = layout_of(dbc)
    build = build_of({"harness": layout}, features)
    sizes = Sizes(
        build.slots, bool(build.scenes), build.max_components, build.transfers, build.history,
        build.epochs, bool(build.line_records),
    )  # fmt: skip
    program = linked(c_core.C / "tests" / "stream_harness.c", compiled(name))
    kinds = {"statistics"}
    kinds |= {"expire"} if build.line_records else set()
    kinds |= {"scene"} if build.scenes and layout.pose is not None else set()
    slots = layout.slots[: build.slots]
    steps = [
        step
        for step in steps_of(layout, seed, frames)
        if not isinstance(step, Question)
        or step.kind in kinds
        or (step.kind == "latest" and step.slot in slots)
    ]
    done = subprocess.run(
        [program], input="\n".join(map(asked, steps)) + "\n", capture_output=True,
        text=True, check=True,
    )  # fmt: skip
    model = Receiver(layout, sizes=sizes)
    rows = done.stdout.splitlines()
    for i, (step, row) in enumerate(zip(steps, rows, strict=True)):
        expected = answered(model, step, build)
        if features.single:  # numbers are rounded, what becomes of frames is the same
            row, expected = (text.split("|")[1] for text in (row, expected))
        same, covs = without_covariances(row)
        assert (same, len(covs)) == (without_covariances(expected)[0], len(covs)), (i, asked(step))
        for cov, other in zip(covs, without_covariances(expected)[1], strict=True):
            # A program sums the products of the factor; the model may have them from a sum.
            scale = np.sqrt(np.outer(other.diagonal(), other.diagonal()))
            assert (np.abs(cov - other) <= 1e-11 * scale).all(), (i, asked(step))
    return len(steps)


@pytest.mark.parametrize("name", RECEIVERS)
def test_a_library_receives_as_the_model_with_its_sizes(name: str) -> None:
    frames = SCENE_FRAMES if name.startswith("scenes") else FRAMES
    assert receives_as_the_model(name, seed=1, frames=frames) > frames * len(STANDARD)


# ---- what cannot be ---------------------------------------------------------------------------


def test_what_makes_no_library_is_refused() -> None:
    complete, conditional = (layout_of(f"maplines{name}.dbc") for name in ("", "-pose"))
    with pytest.raises(ValueError, match="a receiver, a sender or both"):
        build_of({"x": complete}, Features(receiver=False, sender=False))
    for slots in (0, 9):
        with pytest.raises(ValueError, match=f"from 1 to 8, got {slots}"):
            build_of({"x": complete}, Features(slots=slots))
    with pytest.raises(LayoutError, match="conditional on the pose error"):
        build_of({"x": conditional}, SMALL)


@pytest.mark.parametrize("name", ["two slots", "no secoc", "small, float"])
def test_its_vectors_pass(name: str) -> None:
    """There are no cases for what the library has not."""
    (dbc, features), folder = LIBRARIES[name], compiled(name)
    pytest.importorskip("cryptography")
    for file, text in vector_files(layout_of(dbc), "harness", features).items():
        (folder / file).write_text(text)
    program = linked(folder / "run_vectors.c", folder)
    done = subprocess.run(
        [program, folder / "harness.txt"], capture_output=True, text=True, check=True
    )
    assert " 0 failed" in done.stdout
