#!/usr/bin/env python3
"""Count what there is to read: lines by folder, public names, large functions, double names.

    sizes.py [CHECKOUT]    the tables, of this checkout or of another one
    sizes.py --json        the same as JSON
    sizes.py --check       the exit status is 1 if a function, a name of a class or the words of the
                           pages are beyond a limit

Run it in the environment of the project: python3 tools/run.py python tools/sizes.py

    lines        of a file, all of them
    code         lines without blank ones, comments and docstrings
    depth        of the blocks (if, for, while, try, with, match) of a function, one in the other
    parameters   of a function, without self and cls
    words        of the pages for users and developers that are written by hand: without numbers,
                 blocks of code, and the tables that a tool writes

A function is listed if it has more than 50 lines of code, a depth of more than 4 or more than 6
parameters; a class, if another module of the package has one of this name.
"""

from __future__ import annotations

import ast
import io
import json
import re
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from reporting import parser_of

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "maplines_can"
MAX_CODE, MAX_DEPTH, MAX_PARAMETERS = 50, 4, 6
#: Pages whose words are counted, and how many these may be.
PAGES = ("README.md", "CONTRIBUTING.md", "dbc/README.md", "docs/*.md")
MAX_WORDS = 35_000
#: What of a page is not written as words by hand: tables of a tool, and blocks of code.
NOT_BY_HAND = re.compile(
    r"(?ms)^<!-- (\w+): written by .*?^<!-- end of \1 -->|^ *```.*?^ *```$|^ {4}\S[^\n]*"
)
BLOCKS = (ast.If, ast.For, ast.While, ast.Try, ast.With, ast.Match, ast.AsyncFor, ast.AsyncWith)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
           tokenize.ENCODING, tokenize.ENDMARKER}  # fmt: skip


class Module(NamedTuple):
    """A Python file."""

    name: str  #: path below the checkout
    tree: ast.Module
    code: frozenset[int]  #: numbers of its lines with code
    lines: int


class Function(NamedTuple):
    """A function and its size."""

    place: str
    name: str
    code: int
    depth: int
    parameters: int

    @property
    def is_large(self) -> bool:
        """Whether one of its sizes is beyond the limit."""
        sizes = self.code > MAX_CODE, self.depth > MAX_DEPTH, self.parameters > MAX_PARAMETERS
        return any(sizes)


def modules(root: Path, folder: str) -> Iterator[Module]:
    """Yield all Python files of a folder of a checkout."""
    for path in sorted((root / folder).rglob("*.py")):
        text = path.read_text()
        tree = ast.parse(text)
        code: set[int] = set()
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type not in _LAYOUT:
                code.update(range(token.start[0], token.end[0] + 1))
        for node in ast.walk(tree):
            if isinstance(node, (ast.Module, ast.ClassDef, *FUNCTIONS)) and ast.get_docstring(node):
                code -= {*range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1)}
        name = str(path.relative_to(root))
        yield Module(name, tree, frozenset(code), len(text.splitlines()))


def depth(node: ast.AST) -> int:
    """Return the depth of the blocks below a node; an elif is no deeper than its if."""
    deepest = 0
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (*FUNCTIONS, ast.ClassDef)):
            continue  # has a depth of its own
        is_elif = isinstance(node, ast.If) and isinstance(child, ast.If) and child in node.orelse
        is_elif = is_elif and len(node.orelse) == 1  # type: ignore[attr-defined]
        deeper = isinstance(child, BLOCKS) and not is_elif
        deepest = max(deepest, deeper + depth(child))
    return deepest


def functions(module: Module) -> Iterator[Function]:
    """Yield all functions of a module."""
    for node in ast.walk(module.tree):
        if isinstance(node, FUNCTIONS):
            own = range(node.lineno, (node.end_lineno or 0) + 1)
            given = node.args
            names = [one.arg for one in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
            parameters = len([name for name in names if name not in ("self", "cls")])
            code = len(module.code.intersection(own))
            yield Function(f"{module.name}:{node.lineno}", node.name, code, depth(node), parameters)


def public_names(package: list[Module]) -> dict[str, list[str]]:
    """Return the names in ``__all__`` of each module that has it."""
    found = {}
    for module in package:
        for node in module.tree.body:
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
                found[module.name] = [str(name) for name in ast.literal_eval(node.value)]
    return found


def double_names(package: list[Module]) -> dict[str, list[str]]:
    """Return the public classes whose name another module has, too, and these modules."""
    places = defaultdict(list)
    for module in package:
        for node in module.tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(module.name)
    return {name: found for name, found in sorted(places.items()) if len(found) > 1}


def folders_of(name: str) -> list[str]:
    """Return the rows that a file is counted in: those of the package, too, by its folders."""
    top, *below = Path(name).parts
    if top != PACKAGE:
        return [top]
    return [f"{PACKAGE}, all", f"{PACKAGE}/{below[0]}" if len(below) > 1 else f"{PACKAGE}/*.py"]


def words(root: Path) -> dict[str, int]:
    """Return the words of each page that are written by hand."""
    paths = sorted(path for pattern in PAGES for path in root.glob(pattern))
    texts = {path: NOT_BY_HAND.sub("", path.read_text(encoding="utf-8")) for path in paths}
    return {
        str(path.relative_to(root)): sum(map(_is_word, text.split()))
        for path, text in texts.items()
    }


def _is_word(text: str) -> bool:
    return any(letter.isalpha() for letter in text)


def measured(root: Path) -> dict[str, Any]:
    """Return all tables of a checkout."""
    found = {top: list(modules(root, top)) for top in (PACKAGE, "tools", "tests")}
    folders: dict[str, dict[str, int]] = defaultdict(lambda: {"files": 0, "lines": 0, "code": 0})
    for module in (one for of_top in found.values() for one in of_top):
        for row in (folders[name] for name in folders_of(module.name)):
            row["files"] += 1
            row["lines"] += module.lines
            row["code"] += len(module.code)
    for place, pattern in ((PACKAGE, "*.dbc"), ("dbc", "*.dbc"), ("docs", "*.md")):
        texts = [path.read_bytes() for path in (root / place).rglob(pattern)]
        lines = sum(len(text.splitlines()) for text in texts)
        folders[f"{place}, {pattern}"] = {"files": len(texts), "lines": lines, "code": 0}
    package = found[PACKAGE]
    large = [one for of_top in found.values() for module in of_top for one in functions(module)
             if one.is_large]  # fmt: skip
    names = public_names(package)
    return {
        "folders": folders,
        "public names": {place: len(own) for place, own in names.items()},
        "different public names": len({name for own in names.values() for name in own}),
        "large functions": [one._asdict() for one in large],
        "class names with two places": double_names(package),
        "words": words(root),
    }


def main() -> int:
    """Print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("checkout", type=Path, nargs="?", default=ROOT, metavar="CHECKOUT")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--check", action="store_true", help="fail beyond a limit in the package")
    arguments = parser.parse_args()
    result = measured(arguments.checkout)
    large, double = result["large functions"], result["class names with two places"]
    of_package = [one for one in large if one["place"].startswith(PACKAGE)]
    n_words = sum(result["words"].values())
    if arguments.json:
        print(json.dumps(result, indent=2))
    else:
        print(f"{'folder':<28}{'files':>7}{'lines':>8}{'code':>8}")
        for name, row in sorted(result["folders"].items()):
            print(f"{name:<28}{row['files']:>7}{row['lines']:>8}{row['code'] or '':>8}")
        print("\npublic names, in __all__:")
        for place, n in result["public names"].items():
            print(f"{n:>7}  {place}")
        print(f"{result['different public names']:>7}  different ones")
        print(f"\n{len(large)} large functions, {len(of_package)} of them in the package:")
        print("   code  depth  parameters")
        for one in large:
            sizes = f"{one['code']:>7}{one['depth']:>7}{one['parameters']:>12}"
            print(f"{sizes}  {one['place']} {one['name']}")
        print(f"\n{len(double)} names of public classes are defined in two modules:")
        for name, places in double.items():
            print(f"  {name:<24}{' '.join(places)}")
        print("\nwords written by hand:")
        for page, n in result["words"].items():
            print(f"{n:>7}  {page}")
        print(f"{n_words:>7}  all pages, at most {MAX_WORDS}")
    return 1 if arguments.check and (of_package or double or n_words > MAX_WORDS) else 0


if __name__ == "__main__":
    sys.exit(main())
