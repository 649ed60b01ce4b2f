"""Command lines, progress bars and result tables of the tools."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from tqdm import tqdm

T = TypeVar("T")


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser that prints the docstring of a tool as its help, line breaks included."""
    return argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def bar(total: int, what: str | None = None, **options: Any) -> tqdm[Any]:
    """Return a progress bar to be updated by hand; it is shown on a terminal only."""
    return tqdm(desc=what, total=total, disable=not sys.stderr.isatty(), **options)


def progress(steps: Iterable[T], what: str, total: int | None = None) -> Iterable[T]:
    """Iterate over the steps with a progress bar; it is shown on a terminal only."""
    return tqdm(steps, desc=what, total=total, disable=not sys.stderr.isatty())


def report(result: Mapping[str, Any], as_json: bool, width: int) -> int:
    """Print a result and return the exit status: 0 if its entry "met" is true, else 1."""
    if as_json:
        print(json.dumps(result, indent=2))
    else:
        print_table(result, width)
    return 0 if result["met"] else 1


def print_table(result: Mapping[str, Any], width: int, indent: int = 0) -> None:
    """Print names and values; the entries of a nested mapping are indented below its name."""
    for key, value in result.items():
        if isinstance(value, Mapping):
            print(" " * indent + f"{key}:")
            print_table(value, width, indent + 4)
        else:
            text = f"{value:.6g}" if isinstance(value, float) else value
            print(" " * indent + f"{key:<{width}}{text}")


def fill_tables(page: str, tool: str, tables: Mapping[str, str]) -> str:
    """Return a page of docs with each table put between the marks that name it and its tool."""
    for name, table in tables.items():
        begin, end = f"<!-- {name}: written by tools/{tool} -->\n", f"\n<!-- end of {name} -->"
        before, rest = page.split(begin)
        page = f"{before}{begin}{table}{end}{rest.split(end)[1]}"
    return page
