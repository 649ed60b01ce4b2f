#!/usr/bin/env python3
"""Search for what takes the C core the most instructions on a Cortex-M4, in QEMU.

    greatest_found.py                      all DBCs of the tables, 20 minutes
    greatest_found.py --seconds 60         shorter
    greatest_found.py --dbc maplines.dbc   one of them

The search begins with the cases of the last one. Others are parts of the hostile streams of
maplines_can.testing, classic and CAN FD, and lines of its streams of senders.
Those that take the most of a kind of call are changed at random (a signal to its limits or to any
value, frames that are left out, sent twice or exchanged), and kept if they take more. They are
written to tools/greatest/, for the tables of docs/embedding.md: cortex_m4.py --write. A count of
them is the greatest that was found, not a bound.

Run it in the environment of the project: python3 tools/run.py python tools/greatest_found.py
"""

from __future__ import annotations

import random
import struct
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from arm import is_installed
from cortex_libraries import CASES, DBCS, LIBRARIES, built, cases_of
from reporting import parser_of

from maplines_can.cli.options import layout_from
from maplines_can.model.records import intact, written
from maplines_can.model.whole_scenes import write_whole
from maplines_can.model.writer import Draft
from maplines_can.testing.hostile_streams import (
    PROFILES,
    FrameStep,
    Question,
    Step,
    Stream,
    traffics_of,
)
from maplines_can.testing.sender_streams import random_draft
from maplines_can.values.line import Slot
from maplines_can.wire import POSE, Layout
from maplines_can.wire.layout.record_signals import PAGE_BYTES
from maplines_can.wire.layout.scene_layout import SceneLayout

#: Frames of a part of a stream: enough for a line that is usable.
FRAMES = 150
#: Parts of streams in one turn, and changed cases.
PARTS, CHANGES = 4, 24
#: Share of the time for streams, before cases are changed.
STREAMS = 0.4

#: Libraries for which cases are searched, by their DBC: those without mixtures drop some of others.
SEARCHED = {
    DBCS[0]: ("all", "receiver of lines, 4 slots"),
    DBCS[1]: ("all, `maplines-pose.dbc`",),
    DBCS[2]: ("receiver, `maplines-scene.dbc`",),
}

#: What a receiver is given, or a line that a sender is given.
Case = tuple[Step | Draft, ...]


def rows_of(case: Case) -> list[str]:
    """Return the steps of a case as greatest.c reads them."""
    rows = []
    for step in case:
        if isinstance(step, Question):
            rows.append(f"S {step.t_ns}")
        elif isinstance(step, Draft):
            numbers = [step.x_min, step.x_max, step.age, *step.mean, *chain(*step.cov)]
            bits = " ".join(struct.pack(">d", number).hex() for number in numbers)
            rows.append(f"I {int(step.slot) % 4:x} {int(step.status):x} 0 {bits}")
        else:
            is_extended = int(step.is_extended)
            rows.append(f"F {step.t_ns} {step.can_id:x} {is_extended} {step.data.hex()}")
    return rows


def parts(layout: Layout, rng: random.Random) -> Iterator[Case]:
    """Yield parts of hostile streams, of all slots or of four; each cycle ends with a scene."""
    profiles = [one for one in PROFILES if not one.settings and one.stale_cycles == 3]
    while True:
        seed = rng.randrange(10**6)
        stream = Stream(traffics_of(layout, seed), rng.choice(profiles), seed)
        count = len(layout.messages)
        slots = rng.sample([*layout.messages], min(count, rng.choice([4, count])))
        owners = {POSE, *slots, *(layout.messages_of.keys() - layout.messages.keys())}
        steps = (
            step
            for step in stream.steps()
            if isinstance(step, FrameStep)
            and layout.message_of_id.get((step.can_id, step.is_extended), (POSE,))[0] in owners
        )
        part: list[Step] = []
        for step in islice(steps, FRAMES):
            if part and abs(step.t_ns - part[-1].t_ns) > 5_000_000:
                part.append(Question("scene", Slot.EGO_LEFT, part[-1].t_ns))
            part.append(step)
        yield (*part, Question("scene", Slot.EGO_LEFT, part[-1].t_ns))


def changed(case: Case, layout: Layout, rng: random.Random) -> Case:
    """Return a case with a change: of records, or of what is sent, and when."""
    steps, what = [*case], rng.random()
    i = rng.randrange(len(steps))
    if what < 0.5:
        share = rng.choice([0.0, 0.1, 1.0])
        of_lines = () if layout.scene else layout.signals
        wanted = rng.choice([*of_lines, *(layout.pose.signals if layout.pose else ())])
        for k, step in enumerate(steps):
            if isinstance(step, FrameStep) and (k == i or rng.random() < share):
                steps[k] = _with_other_values(step, layout, wanted, rng)
    elif what < 0.75 and len(steps) > 1:
        chosen = steps[i]
        if isinstance(chosen, FrameStep) and rng.random() < 0.2:
            steps = [step for step in steps if getattr(step, "can_id", 0) != chosen.can_id]
        else:
            del steps[i : i + 2 ** rng.randrange(len(steps).bit_length())]
    elif what < 0.85:
        steps.insert(rng.randrange(len(steps)), steps[i])
    elif what < 0.95:
        j = rng.randrange(len(steps))
        steps[i], steps[j] = steps[j], steps[i]
    else:
        steps = [one for step in steps for one in _as_pages(step, layout)]
    return tuple(steps) or case


def _with_other_values(
    step: FrameStep, layout: Layout, wanted: str, rng: random.Random
) -> FrameStep:
    """Return the frame of a record with other values of a signal, or of a few."""
    owner, is_whole = layout.message_of_id.get((step.can_id, step.is_extended), (None, False))
    if owner is None or not is_whole:
        return step
    own, data_id = layout.record_of(owner), layout.messages_of[owner].data_id
    lengths = {own.record_bytes}
    if not isinstance(own, SceneLayout):
        lengths.add(PAGE_BYTES * own.short_pages)
    for length in lengths:
        raw = intact(own, step.data[:length], data_id)
        if isinstance(raw, str):
            continue
        names = {wanted, *rng.sample([*own.signals], rng.choice([0, 0, 1, 4]))}
        for name in (names & raw.keys()) - {"Counter"}:
            signal = own[name]
            value = rng.randint(signal.raw_min, signal.raw_max)
            raw[name] = rng.choice([signal.raw_min, signal.raw_max, value, value])
        record = (
            write_whole(own, raw, (), length, data_id)
            if isinstance(own, SceneLayout)
            else written(own, dict.fromkeys(own.signals, 0) | raw, data_id)
        )
        return step._replace(data=record.ljust(len(step.data), b"\0"))
    return step


def _as_pages(step: Step | Draft, layout: Layout) -> Iterator[Step | Draft]:
    """Yield a record that is one frame as its pages, and any other step as it is."""
    if isinstance(step, FrameStep):
        owner, is_whole = layout.message_of_id.get((step.can_id, step.is_extended), (None, False))
        messages = None if owner is None or not is_whole else layout.messages_of[owner]
        if messages is not None and messages.can_id is not None:
            for start in range(0, len(step.data), PAGE_BYTES):
                page = step.data[start : start + PAGE_BYTES]
                yield step._replace(
                    can_id=messages.can_id, is_extended=messages.is_extended, data=page
                )
            return
    yield step


def lines(layout: Layout, seed: int) -> Iterator[Case]:
    """Yield lines of a stream of senders; none if they are sent with the pose error only."""
    rng = np.random.default_rng(seed)
    while not layout.is_conditional:
        yield (random_draft(rng, layout),)


class Found(NamedTuple):
    """The case that takes the most of a kind of call."""

    instructions: int
    case: Case


class Search:
    """Greatest cases of a library.

    Args:
        layout: of the messages.
        program: greatest.c with the library.
        cases: to begin with.
        seed: of all that is drawn.
    """

    def __init__(self, layout: Layout, program: Path, cases: Sequence[Case], seed: int) -> None:
        self._layout, self._program = layout, program
        self._random = random.Random(seed)  # noqa: S311 - no secret
        self._parts, self._lines = parts(layout, self._random), lines(layout, seed)
        self.found: dict[str, Found] = {}
        self._take(cases)

    def take_parts(self) -> None:
        """Take some parts of streams."""
        self._take([*islice(self._parts, PARTS), *islice(self._lines, 10 * PARTS)])

    def change(self) -> None:
        """Change the greatest cases."""
        rng, cases = self._random, list[Case]()
        best = [one.case for one in self.found.values() if not isinstance(one.case[0], Draft)]
        for _ in range(CHANGES):
            case = rng.choice(best)
            for _ in range(rng.choice([1, 1, 2, 3])):
                case = changed(case, self._layout, rng)
            cases.append(case)
        self._take([*cases, *islice(self._lines, CHANGES)])

    def _take(self, cases: Sequence[Case]) -> None:
        for case, counts in zip(cases, counted(self._program, cases), strict=True):
            for kind, instructions in counts.items():
                best = self.found.get(kind)
                if best is None or _is_better(instructions, case, best):
                    self.found[kind] = Found(instructions, case)


def _is_better(instructions: int, case: Case, best: Found) -> bool:
    """Return whether a case takes more; or nothing less and is shorter."""
    longer = len(case) >= len(best.case)
    return instructions > best.instructions if longer else instructions >= best.instructions


def counted(program: Path, cases: Sequence[Case]) -> list[dict[str, int]]:
    """Return the greatest instructions of each kind of call in each case."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cases"
        file.write_text(text_of(cases), encoding="ascii")
        found = cases_of(program, file)
    found += [{} for _ in range(len(cases) - len(found))]
    return [{kind: count for kind, (count, _) in case.items()} for case in found]


def text_of(cases: Sequence[Case]) -> str:
    """Return the file of cases."""
    return "N\n".join("".join(f"{row}\n" for row in rows_of(case)) for case in cases)


def read_cases(text: str) -> list[Case]:
    """Return the cases of a file."""
    return [tuple(step_of(row) for row in case.splitlines()) for case in text.split("N\n") if case]


def step_of(row: str) -> Step | Draft:
    """Return a step of a file of cases."""
    what, *words = row.split()
    if what == "S":
        return Question("scene", Slot.EGO_LEFT, int(words[0]))
    if what == "F":
        data = bytes.fromhex("".join(words[3:]))
        return FrameStep(int(words[1], 16), data, words[2] == "1", int(words[0]), 0)
    x_min, x_max, age, *rest = struct.unpack(">23d", bytes.fromhex("".join(words[3:])))
    mean: Any = rest[:4]
    cov: Any = [rest[i : i + 4] for i in range(4, 20, 4)]
    slot, status = Slot(int(words[0], 16)), int(words[1], 16)
    return Draft(slot, mean, cov, status=status, x_min=x_min, x_max=x_max, age=age)


def searched(dbc: str, name: str, seconds: float, seed: int, before: list[Case]) -> list[Case]:
    """Return the greatest cases of a library, of these and others."""
    layout = layout_from(dbc)
    with built(*LIBRARIES[name]) as programs:
        search = Search(layout, programs.greatest, before, seed)
        begin = time.monotonic()
        while (passed := time.monotonic() - begin) < seconds or not search.found:
            if passed < STREAMS * seconds:
                search.take_parts()
            else:
                search.change()
        for kind, one in search.found.items():
            print(f"{name}, {kind}: {one.instructions} in {len(one.case)} steps", flush=True)
        return [one.case for one in search.found.values()]


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=int, default=1200, help="in all [s] (default: 1200)")
    parser.add_argument("--dbc", choices=DBCS, action="append", help="DBC (default: all)")
    parser.add_argument("--seed", type=int, default=1, help="of all that is drawn (default: 1)")
    options = parser.parse_args()
    if not is_installed():
        sys.exit("install gcc-arm-none-eabi with newlib, and qemu-system-arm")
    names = {dbc: SEARCHED[dbc] for dbc in options.dbc or DBCS}
    share = options.seconds / sum(map(len, names.values()))
    for dbc, libraries in names.items():
        file, cases = CASES / f"{Path(dbc).stem}.txt", list[Case]()
        before = read_cases(file.read_text(encoding="ascii") if file.exists() else "")
        for name in libraries:
            cases += searched(dbc, name, share, options.seed, before)
        file.write_text(text_of(cases), encoding="ascii")
    return 0


if __name__ == "__main__":
    sys.exit(main())
