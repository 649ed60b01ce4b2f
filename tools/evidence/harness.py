"""Command line, progress, tables and bounds of all evidence."""

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

from reporting import bar, fill_tables, parser_of, progress

from .figures import Statistic, flat

__all__ = ["Evidence", "bar", "evidence", "progress"]

FOLDER = Path(__file__).parent
DOCS = FOLDER.parents[1] / "docs"
#: Modules that help the others.
HELPERS = {"__init__", "__main__", "harness", "figures"}
#: More columns than this are printed as several tables.
MAX_COLUMNS = 16
#: Rows whose columns have more names than this are printed as lists.
MAX_DEPTH = 2

Figures = Mapping[str, Any]


class Evidence(NamedTuple):
    """A function that measures."""

    name: str
    measure: Callable[..., Figures]
    quick: Mapping[str, Any]  #: options of its quickest form
    in_real_time: bool  #: it needs a bus and a quiet machine, so there is no quick form

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


REGISTRY: dict[str, Evidence] = {}
#: Functions that return a table of a page of docs, by page and name of the table.
TABLES: dict[tuple[str, str], Callable[[], str]] = {}


def evidence(
    *, in_real_time: bool = False, **quick: Any
) -> Callable[[Callable[..., Figures]], Callable[..., Figures]]:
    """Register a function as evidence, with the options of its quickest form."""

    def register(measure: Callable[..., Figures]) -> Callable[..., Figures]:
        module, own = measure.__module__.rpartition(".")[2], measure.__name__
        name = module if own == module else f"{module}.{own}"
        REGISTRY[name] = Evidence(name, measure, quick, in_real_time)
        return measure

    return register


def table(page: str, name: str) -> Callable[[Callable[[], str]], Callable[[], str]]:
    """Register a function that returns a table of a page of docs."""

    def register(write: Callable[[], str]) -> Callable[[], str]:
        TABLES[page, name] = write
        return write

    return register


def modules() -> list[str]:
    """Return the names of the modules with evidence."""
    texts = {path.stem: path.read_text(encoding="utf-8") for path in sorted(FOLDER.glob("*.py"))}
    return [name for name, text in texts.items() if name not in HELPERS and "\n@evidence" in text]


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
        own = [one for key, one in REGISTRY.items() if name in (key, key.partition(".")[0])]
        if not own:
            every = [key for key in REGISTRY if key.partition(".")[0] == module]
            raise ValueError(f"there is no evidence {name!r}; there are {', '.join(every)}")
        found += own
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
    found = dict(one.quick) if quick else {}
    for name, text in texts.items():
        if name not in one.options:
            raise ValueError(f"{one.name} has no option {name!r}; it has {', '.join(one.options)}")
        try:
            found[name] = parsed(text, one.options[name][0])
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    return found


# ---- bounds ----------------------------------------------------------------------------------


@cache
def promises() -> list[dict[str, Any]]:
    """Return the promises, with their bounds."""
    text = (FOLDER / "bounds.toml").read_text(encoding="utf-8")
    found: list[dict[str, Any]] = tomllib.loads(text)["promise"]
    return found


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


# ---- results ---------------------------------------------------------------------------------


def shown(value: Any) -> str:
    """Return a value as text."""
    if value is None:
        return "-"
    if isinstance(value, list | tuple):
        return ", ".join(map(shown, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def as_text(figures: Figures, indent: int = 0) -> Iterator[str]:
    """Yield lines of figures: rows of the same columns as tables, others as a list."""
    pad = " " * indent
    if (tables := tables_of(figures)) is not None:
        for title, columns in tables.items():
            yield from [f"{pad}{title}:"] * bool(title)
            yield from (pad + line for line in markdown(figures, columns, title))
        return
    for name, value in figures.items():
        if isinstance(value, Mapping):
            yield f"{pad}{name}:"
            yield from as_text(value, indent + 4)
        else:
            yield f"{pad}{name:<{max(48 - indent, 1)}} {shown(value)}"


def tables_of(figures: Figures) -> dict[str, list[str]] | None:
    """Return the columns of the tables of rows, by title; None if the figures are no rows."""
    if len(figures) < 2 or not all(isinstance(row, Mapping) for row in figures.values()):
        return None
    if max(map(depth, figures.values())) > MAX_DEPTH:
        return None
    every = [name for row in figures.values() for name, _ in flat(row)]
    columns = list(dict.fromkeys(every))
    if len(every) < 0.6 * len(columns) * len(figures):  # the rows have few columns in common
        return None
    if len(columns) <= MAX_COLUMNS:
        return {"": columns}
    grouped: dict[str, list[str]] = {}
    for name in columns:
        head, _, own = name.partition("/")
        grouped.setdefault(head if own else "", []).append(name)
    return grouped


def depth(figures: Any) -> int:
    """Return how many names lead to a figure."""
    if not isinstance(figures, Mapping):
        return 0
    return 1 + max(map(depth, figures.values()), default=0)


def markdown(rows: Figures, columns: Sequence[str], title: str = "") -> list[str]:
    """Return the lines of a table in Markdown; columns of a title are without it."""
    cells = [["", *(name.removeprefix(f"{title}/") for name in columns)]]
    for name, row in rows.items():
        values = dict(flat(row))
        cells.append([name, *(shown(values.get(column)) for column in columns)])
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [
        "| " + " | ".join(f"{c:<{w}}" for c, w in zip(row, widths, strict=True)) + " |"
        for row in cells
    ]
    return [lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]]


def run(one: Evidence, options: Mapping[str, Any], *, quick: bool) -> dict[str, Any]:
    """Return the figures of an evidence, and the bounds that they miss."""
    started = time.perf_counter()
    figures = one.measure(**options)
    seconds = round(time.perf_counter() - started, 1)
    misses = list(missed(figures, bounds_of(one.name, quick=quick)))
    return {"figures": figures, "missed": misses, "seconds": seconds}


# ---- pages -----------------------------------------------------------------------------------


def bound_text(bound: Mapping[str, Any]) -> str:
    """Return a bound as the page of the promises has it."""
    name = bound.get("name", bound["figure"].replace("*/", "").replace("*", "").strip("/"))
    unit = f" {bound['unit']}" if "unit" in bound else ""
    scale = 100 if bound.get("unit") == "%" else 1
    texts = {
        side: f"{scale * bound[side]:.6g}{unit}"
        for side in ("min", "max", "equal")
        if side in bound
    }
    match texts:
        case {"min": low, "max": high}:
            return f"{name} {low.removesuffix(unit)} to {high}"
        case {"min": low}:
            return f"{name} ≥ {low}"
        case {"max": high}:
            return f"{name} ≤ {high}"
        case {"equal": value}:
            return f"{name} = {value}"
    return str(name)


def promises_table() -> str:
    """Return the tables of docs/promises.md."""
    sections: dict[str, list[str]] = {}
    for promise in promises():
        command = promise.get("command")
        if command is None:
            command = f"`tools/evidence {promise['evidence']}{' ' * ('options' in promise)}"
            command += f"{promise.get('options', '')}`"
        bounds = "; ".join(bound_text(one) for one in promise.get("bounds", ())) or "-"
        cells = promise["promise"], bounds, command, promise["seen"], promise["conditions"]
        row = " | ".join(" ".join(cell.split()) for cell in cells)
        sections.setdefault(promise["section"], []).append(f"| {row} |")
    head = ["| promise | bounds | command | seen | conditions |", "|---|---|---|---|---|"]
    parts = ["\n".join([f"## {name}", "", *head, *rows]) for name, rows in sections.items()]
    return "\n\n".join(parts)


TABLES["promises.md", "promises"] = promises_table


def pages() -> dict[Path, str]:
    """Return the pages of docs with their tables as they should be."""
    for module in modules():
        if "\n@table" in (FOLDER / f"{module}.py").read_text(encoding="utf-8"):
            importlib.import_module(f"evidence.{module}")
    found: dict[Path, str] = {}
    for (page, name), write in TABLES.items():
        path = DOCS / page
        text = found.get(path, path.read_text(encoding="utf-8"))
        found[path] = fill_tables(text, "evidence", {name: write()})
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
    try:
        every = chosen(names or modules())
        if not names:
            print(*listed(every), sep="\n")
            return 0
        every = [one for one in every if not (arguments.quick and one.in_real_time)]
        jobs = [(one, settings(one, texts, quick=arguments.quick)) for one in every]
    except ValueError as error:
        parser.error(str(error))
    quick = arguments.quick
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
        print(f"\n{name}, {result['seconds']} s\n", *as_text(result["figures"]), sep="\n")
        print("", *(f"MISSED  {text}" for text in result["missed"]), sep="\n")
    print("" if is_missed else "All bounds are met.")
    return int(is_missed)
