"""The map of CONTRIBUTING.md is true: its files exist, and folders say what they may import."""

import ast
import re

import pytest
from test_layers import IMPORTS, PACKAGE, ROOMS, name_of

ROOT = PACKAGE.parent
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
#: Names of files on the page, by the end of their path.
FILE = re.compile(r"(?<![\w/.*-])[\w./-]+\.(?:pyi?|c|h|toml)\b")
#: The generator of FMUs writes it.
GENERATED = "variables.h"
FOLDERS = sorted(name_of(path, PACKAGE) for path in PACKAGE.rglob("__init__.py"))[1:]
PRODUCT = {room.split(".")[0] for room in ROOMS} - {"cli"} | {"engines"}


def test_the_files_of_the_page_exist() -> None:
    tops = ("maplines_can", "c", "tools", "tests", "docs")
    files = [*ROOT.glob("*.*"), *(path for top in tops for path in (ROOT / top).rglob("*.*"))]
    paths = [f"/{path.relative_to(ROOT).as_posix()}" for path in files]
    named = {one for one in FILE.findall(PAGE) if one != GENERATED}
    assert len(named) > 100
    assert {one for one in named if not any(path.endswith(f"/{one}") for path in paths)} == set()


def test_the_drawing_has_all_folders() -> None:
    drawing = PAGE.split("```")[1]
    for folder in FOLDERS:
        if "." not in folder or folder.startswith("wire."):
            assert f"{folder.split('.')[-1]}/" in drawing, folder


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_says_what_it_may_import(folder: str) -> None:
    """Its docstring has a sentence with the folders: in quotes, or "the product" for all of it."""
    path = PACKAGE.joinpath(*folder.split("."), "__init__.py")
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    (sentence,) = re.findall(r"It may import (.*?)\.(?=\s|$)", text, re.DOTALL)
    allowed = {folder, *re.findall(r"``([\w.]+)``", sentence)}
    allowed |= PRODUCT if "the product" in sentence else set()
    found = {
        one.target
        for one in IMPORTS
        if one.is_own and one.target and is_within(one.importer, folder)
    }
    assert {one for one in found if not any(is_within(one, name) for name in allowed)} == set()


def is_within(module: str, folder: str) -> bool:
    return f"{module}.".startswith(f"{folder}.")
