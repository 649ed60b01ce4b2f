"""Deepest stack of the functions of a library on a Cortex-M, by its call graph.

gcc writes the calls of a source, and the stack of each of its functions (-fcallgraph-info=su). Of
libgcc and the C library there is no such file: the stack of their functions is what the
instructions in a linked program take. So no path of calls takes more than is said here, but for
functions that the caller has given (of SecOC), which no graph knows.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from arm import run

#: What stands in the source where a function is called that the caller has given.
OF_THE_CALLER = ("mac(", "now_us(")
#: The other functions that are called by pointers: all of the type maplines_function_t.
BY_POINTER = re.compile(r"\bbool (\w+)\(const double \*\w+, const void \*\w+, double \*\w+\)\s*\{")
NODE = re.compile(r'^node: \{ title: "([^"]+)" .*\\n(\d+) bytes \(([\w,]+)\)', re.MULTILINE)
EDGE = re.compile(r'^edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"(?: label: "\S+?:(\d+):)?',
                  re.MULTILINE)  # fmt: skip
#: A public function in the graph: the name that a linker sees carries the build.
PUBLIC = re.compile(r"(maplines_\w+?)_(?:double|float)_\w+")
#: Instructions that lower the stack pointer, and those that go on elsewhere.
PUSH = re.compile(r"(?:push|stmdb|stmfd)\S*\s+(?:sp!, )?\{(.*)\}")
STORE = re.compile(r"strd?(?:\.w)?\s.*\[sp, #-(\d+)\]!")
LOWER = re.compile(r"sub(?:w|\.w)?\s+sp,(?: sp,)? #(\d+)")
BRANCH = re.compile(r"(?:b|bl|b[a-z]{2}|cbn?z)(?:\.[nw])?\s+(?:r\d+, )?([0-9a-f]+) <")
LEAVES = re.compile(r"(?:b(?:\.[nw])?|bx)\s|.*\bpc\}|ldr(?:\.w)?\s+pc,|udf")


class Deepest(NamedTuple):
    """The path of calls that takes most of the stack."""

    stack: int  #: [byte]
    functions: tuple[str, ...]


class CallGraph:
    """Functions of a source, and of the libraries with which it is linked.

    Args:
        source: that was compiled with -fcallgraph-info=su; its graph is beside it.
        program: that has its object.

    Raises:
        ValueError: the stack of a function is not constant.
    """

    def __init__(self, source: Path, program: Path) -> None:
        text = source.read_text(encoding="utf-8")
        graph = source.with_suffix(".ci").read_text(encoding="utf-8")
        lines = text.splitlines()
        self._stacks: dict[str, int] = {}
        for title, stack, kind in NODE.findall(graph):
            if kind == "dynamic":
                raise ValueError(f"the stack of {title} is {kind}")
            self._stacks[title] = int(stack)
        given = set(BY_POINTER.findall(text))
        pointed = [title for title in self._stacks if _base(title) in given]
        self._calls: dict[str, set[str]] = {title: set() for title in self._stacks}
        for caller, called, line in EDGE.findall(graph):
            if called != "__indirect_call":  # one that is the same as another has no node
                self._calls[caller].add(called if called in self._stacks else _base(called))
            elif not any(word in lines[int(line) - 1] for word in OF_THE_CALLER):
                self._calls[caller].update(pointed)
        found = ((PUBLIC.fullmatch(title), title) for title in self._stacks)
        #: The public functions of the source, by their names in the header.
        self.public = {match[1]: title for match, title in found if match is not None}
        for name, stack, called in _of_libraries(program):
            if name not in self._stacks:
                self._stacks[name], self._calls[name] = stack, called
        self._found: dict[str, Deepest] = {}

    def deepest(self, function: str) -> Deepest:
        """Return the path from a public function, by its name in the header, that takes most.

        Raises:
            KeyError: there is no such function, or one that is called is not in the program.
            ValueError: functions call each other in a circle.
        """
        return self._deepest(self.public[function], ())

    def _deepest(self, title: str, above: tuple[str, ...]) -> Deepest:
        if title in above:
            raise ValueError(f"{' calls '.join([*above, title])}: no greatest stack")
        if title not in self._found:
            below = (self._deepest(name, (*above, title)) for name in self._calls[title])
            stack, functions = max(below, default=Deepest(0, ()))
            own = self._stacks[title]
            self._found[title] = Deepest(own + stack, (_base(title), *functions))
        return self._found[title]


def _base(title: str) -> str:
    """Return the name of a function in the source: without its file and what a clone adds."""
    return title.rpartition(":")[2].partition(".")[0]


def _of_libraries(program: Path) -> Iterator[tuple[str, int, set[str]]]:
    """Yield name, stack and called functions of each function of a program, by its instructions.

    A function that falls through to the next one calls it. A branch into another function is a
    call of it, wherever it goes.
    """
    names: dict[int, list[str]] = {}
    for address, name in re.findall(r"^(\w+) [tTwW] (\S+)$", run(["arm-none-eabi-nm", program]),
                                    re.MULTILINE):  # fmt: skip
        names.setdefault(int(address, 16) & ~1, []).append(name)
    listing = run(["arm-none-eabi-objdump", "-d", "--no-show-raw-insn", program])
    blocks = re.findall(r"^([0-9a-f]{8}) <\S+>:\n((?:.+\n)+)", listing, re.MULTILINE)
    starts = [int(address, 16) for address, _ in blocks]
    for (_, text), start, end in zip(blocks, starts, [*starts[1:], 1 << 32], strict=True):
        steps = [row.split("\t", 1)[1] for row in text.splitlines() if "\t" in row]
        steps = [step for step in steps if not step.startswith((".", "nop"))]
        stack, targets = 0, set[int]()
        for step in steps:
            if found := PUSH.match(step):
                stack += 4 * len(found[1].split(","))
            elif found := STORE.match(step) or LOWER.match(step):
                stack += int(found[1])
            elif found := BRANCH.match(step):
                targets.add(int(found[1], 16))
        if steps and not LEAVES.match(steps[-1]):
            targets.add(end)
        called = {
            max((s for s in starts if s <= target), default=start)
            for target in targets
            if not start <= target < end
        }
        for name in names.get(start, []):
            yield name, stack, {names[one][0] for one in called if one in names}
