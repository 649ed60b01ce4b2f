"""The runner of all evidence: command line, tables, and the bounds of ``bounds.toml``."""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import re
import time
import tomllib
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from reporting import bar, fill_tables, parser_of, print_table, progress

from .figures import Statistic, flat

__all__ = ["Evidence", "bar", "evidence", "progress"]

FOLDER = Path(__file__).parent
DOCS = FOLDER.parents[1] / "docs"
#: Width of the names of printed figures.
WIDTH = 48

Figures = Mapping[str, Any]


class Evidence(NamedTuple):
    """A function that measures."""

    name: str
    measure: Callable[..., Figures]

    @property
    def about(self) -> str:
        """What it measures."""
        return (self.measure.__doc__ or "").split("\n", 1)[0]

    @property
    def options(self) -> dict[str, tuple[Any, Any]]:
        """Type and default of each option."""
        hints = typing.get_type_hints(self.measure)
        parameters = inspect.signature(self.measure).parameters
        return {name: (hints[name], one.default) for name, one in parameters.items()}

    @property
    def quick(self) -> dict[str, Any] | None:
        """Options of its quickest form; None if it needs a bus, or a quiet machine."""
        own = (one for one in promises() if one.get("evidence") == self.name)
        given = next((one["quick"] for one in own if "quick" in one), None)
        if given is None:
            return None
        return {k: tuple(v) if isinstance(v, list) else v for k, v in given.items()}


REGISTRY: dict[str, Evidence] = {}


def evidence(measure: Callable[..., Figures]) -> Callable[..., Figures]:
    """Register a function as evidence."""
    module, own = measure.__module__.rpartition(".")[2], measure.__name__
    name = module if own == module else f"{module}.{own}"
    REGISTRY[name] = Evidence(name, measure)
    return measure


@cache
def promises() -> list[dict[str, Any]]:
    """Return the promises, with their sections and bounds."""
    sections = tomllib.loads((FOLDER / "bounds.toml").read_text(encoding="utf-8"))
    return [{"section": name} | one for name, rows in sections.items() for one in rows]


def modules() -> list[str]:
    """Return the names of the modules with evidence."""
    named = {one["evidence"].partition(".")[0] for one in promises() if "evidence" in one}
    return sorted(named | {"pictures"})


def chosen(names: Sequence[str]) -> list[Evidence]:
    """Return the evidence of names: of functions, or of modules with all of their functions.

    Raises:
        ValueError: there is none of this name.
    """
    found = []
    for name in names:
        module = name.partition(".")[0]
        if module not in modules():
            raise ValueError(f"there is no evidence {name!r}; there are {', '.join(modules())}")
        importlib.import_module(f"evidence.{module}")
        every = [key for key in REGISTRY if key.partition(".")[0] == module]
        own = [key for key in every if name in (key, module)]
        if not own:
            raise ValueError(f"there is no evidence {name!r}; there are {', '.join(every)}")
        found += [REGISTRY[key] for key in own]
    return found


# ---- options ---------------------------------------------------------------------------------


def parsed(text: str, kind: Any) -> Any:
    """Return the value of an option of a type.

    >>> parsed("1e6", int), parsed("true", bool), parsed("a,b, c", tuple[str, ...])
    (1000000, True, ('a', 'b, c'))
    >>> parsed("", tuple[str, ...])
    ()
    """
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is types.UnionType:
        return parsed(text, arguments[0])
    if origin is tuple:
        return tuple(parsed(part, arguments[0]) for part in re.split(r",(?! )", text) if text)
    if origin is typing.Literal:
        if text not in arguments:
            raise ValueError(f"must be one of {', '.join(arguments)}, got {text!r}")
        return text
    if kind is bool:
        return {"true": True, "false": False}[parsed(text, typing.Literal["true", "false"])]
    if kind is int:
        return int(float(text))
    return kind(text)


def settings(one: Evidence, texts: Mapping[str, str], *, quick: bool) -> dict[str, Any]:
    """Return the options of an evidence; those that it does not have are an error.

    Raises:
        ValueError: there is no such option, or its value is wrong.
    """
    found = dict(one.quick or {}) if quick else {}
    for name, text in texts.items():
        if name not in one.options:
            raise ValueError(f"{one.name} has no option {name!r}; it has {', '.join(one.options)}")
        try:
            found[name] = parsed(text, one.options[name][0])
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    return found


# ---- bounds ----------------------------------------------------------------------------------


def bounds_of(name: str, *, quick: bool) -> list[dict[str, Any]]:
    """Return the bounds of an evidence, or those of its quick form."""
    found = [one for one in promises() if one.get("evidence") == name]
    every = [bound for promise in found for bound in promise.get("bounds", ())]
    return [bound for bound in every if not (quick and bound.get("full"))]


def matching(figures: Figures, pattern: str) -> list[tuple[str, Any]]:
    """Return paths and values of the figures of a pattern, in which * stands for any text."""
    wanted = re.compile(".*".join(map(re.escape, pattern.split("*"))))
    return [(path, value) for path, value in flat(figures) if wanted.fullmatch(path)]


def missed(figures: Figures, bounds: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the bounds that figures miss; a figure that is None is not there."""
    for bound in bounds:
        excepted = {p for text in bound.get("but", ()) for p, _ in matching(figures, text)}
        for path, value in matching(figures, bound["figure"]):
            if value is None or path in excepted:
                continue
            for side in ("min", "max", "equal", "yes"):
                if side in bound and not is_kept(value, side, bound[side]):
                    yield f"{path} is {shown(value)}, {side} {bound[side]:g}"


def is_kept(value: Any, side: str, bound: float) -> bool:
    """Return whether a value keeps a bound, with the room of a statistic."""
    room = value.room(bound) if isinstance(value, Statistic) else 0.0
    if side == "min":
        return bool(value >= bound - room)
    if side == "max":
        return bool(value <= bound + room)
    return bool(value == bound)


def run(one: Evidence, options: Mapping[str, Any], *, quick: bool) -> dict[str, Any]:
    """Return the figures of an evidence, and the bounds that they miss."""
    started = time.perf_counter()
    figures = one.measure(**options)
    seconds = round(time.perf_counter() - started, 1)
    misses = list(missed(figures, bounds_of(one.name, quick=quick)))
    return {"figures": figures, "missed": misses, "seconds": seconds}


def shown(value: Any) -> str:
    """Return a value as text."""
    if value is None:
        return "-"
    if isinstance(value, list | tuple):
        return ", ".join(map(shown, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


# ---- pages -----------------------------------------------------------------------------------


def bound_text(bound: Mapping[str, Any]) -> str:
    """Return a bound as the page of the promises has it."""
    name = bound.get("name", bound["figure"].replace("*/", "").replace("*", "").strip("/"))
    unit = f" {bound['unit']}" if "unit" in bound else ""
    scale = 100 if bound.get("unit") == "%" else 1
    low, high, equal = (
        f"{scale * bound[side]:.6g}" if side in bound else None for side in ("min", "max", "equal")
    )
    if equal is not None:
        return f"{name} = {equal}{unit}"
    if low is not None and high is not None:
        return f"{name} {low} to {high}{unit}"
    if low is not None:
        return f"{name} ≥ {low}{unit}"
    return str(name) if high is None else f"{name} ≤ {high}{unit}"


def promises_table() -> str:
    """Return the tables of docs/promises.md."""
    sections: dict[str, list[str]] = {}
    for promise in promises():
        options = promise.get("full", "").split()
        measured = " ".join(["tools/evidence", promise.get("evidence", ""), *options])
        command = f"`{promise.get('command', measured)}`"
        bounds = "; ".join(bound_text(one) for one in promise.get("bounds", ())) or "-"
        cells = promise["promise"], bounds, command, promise["seen"], promise["conditions"]
        row = " | ".join(" ".join(cell.split()) for cell in cells)
        sections.setdefault(promise["section"], []).append(f"| {row} |")
    head = ["| promise | bounds | command | seen | conditions |", "|---|---|---|---|---|"]
    parts = ["\n".join([f"## {name}", "", *head, *rows]) for name, rows in sections.items()]
    return "\n\n".join(parts)


def pages() -> dict[Path, str]:
    """Return the pages of docs with their tables as they should be."""
    from .checksum import rates_table

    tables = {
        "promises.md": ("promises", promises_table),
        "assurance.md": ("residual", rates_table),
    }
    found = {}
    for page, (name, write) in tables.items():
        path = DOCS / page
        found[path] = fill_tables(path.read_text(encoding="utf-8"), "evidence", {name: write()})
    return found


# ---- the command -----------------------------------------------------------------------------


def main(doc: str | None, argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = parser_of(doc)
    parser.prog = "evidence"
    parser.add_argument("names", nargs="*", metavar="NAME", help="of a module, or MODULE.FUNCTION")
    parser.add_argument("--quick", action="store_true", help="with few samples")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--write", action="store_true", help="write the tables of the docs")
    arguments = parser.parse_intermixed_args(argv)
    if arguments.write:
        for path, text in pages().items():
            path.write_text(text, encoding="utf-8")
        return 0
    texts = dict(word.split("=", 1) for word in arguments.names if "=" in word)
    names = [word for word in arguments.names if "=" not in word]
    quick = arguments.quick
    try:
        every = chosen(names or modules())
        if not names:
            print(*listed(every), sep="\n")
            return 0
        every = [one for one in every if not (quick and one.quick is None)]
        jobs = [(one, settings(one, texts, quick=quick)) for one in every]
    except ValueError as error:
        parser.error(str(error))
    return report({one.name: run(one, own, quick=quick) for one, own in jobs}, arguments)


def listed(every: Iterable[Evidence]) -> Iterator[str]:
    """Yield the lines of the list of all evidence."""
    for one in every:
        yield f"{one.name:28} {one.about}"
        for name, (_, default) in one.options.items():
            text = ",".join(map(str, default)) if isinstance(default, tuple) else str(default)
            yield f"{'':28}   {name}={text}"


def report(results: Mapping[str, Any], arguments: argparse.Namespace) -> int:
    """Print results and return the exit status: 1 if a bound is missed."""
    is_missed = any(result["missed"] for result in results.values())
    if arguments.json:
        print(json.dumps(results, indent=2, default=lambda number: number.item()))
        return int(is_missed)
    for name, result in results.items():
        print(f"\n{name}, {result['seconds']} s\n")
        print_table(result["figures"], WIDTH)
        print("", *(f"MISSED  {text}" for text in result["missed"]), sep="\n")
    print("" if is_missed else "All bounds are met.")
    return int(is_missed)
