"""The pages: their Python examples run and print what is shown, and their links lead somewhere."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from maplines_can.cli import _parser, main

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("dbc/*.md")])
#: A block of Python, and the block of text right after it, if there is one: its output. What a page
#: names as a file has a test of its own.
EXAMPLE = re.compile(r"(?ms)(?<!` is:\n\n)^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?")
WITH_PYTHON = [page for page in PAGES if EXAMPLE.search(page.read_text(encoding="utf-8"))]
#: A block of commands, and a command in it up to the end of its line, a pipe, or what follows it.
SHELL = re.compile(r"(?ms)^```sh\n(.*?)^```\n")
COMMAND = re.compile(r"(?m)(?:^|[|;'\s])(maplines [^|;&>'#\n]*)")
CODE = re.compile(r"(?ms)^```.*?^```|`[^`\n]*`")
LINK = re.compile(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]+))?\)")


@pytest.mark.parametrize("page", WITH_PYTHON, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_item_11_examples_run_as_pasted_and_print_what_the_page_shows(
    page: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each example runs alone, unless its page says that they continue each other.

    They need neither hardware nor other files.
    """
    monkeypatch.chdir(tmp_path)
    text = page.read_text(encoding="utf-8")
    namespace: dict[Any, Any] = {}

    for code, output in EXAMPLE.findall(text):
        if "The examples continue each other" not in text:
            namespace = {}
        exec(compile(code, page.name, "exec"), namespace)  # noqa: S102 - our own page
        assert capsys.readouterr().out == output


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of each command ``maplines`` in the blocks of a page, without the name."""
    for block in SHELL.findall(text):
        for command in COMMAND.findall(block.replace("\\\n", " ")):
            yield shlex.split(command)[1:]


def test_commands_are_found() -> None:
    """In a line, in a continued one, in quotes and in a pipe."""
    block = (
        "```sh\nmaplines a b \\\n  -c # d\nsh -c 'maplines e & sleep 1'\nx | maplines f -\n```\n"
    )
    assert [*commands(block)] == [["a", "b", "-c"], ["e"], ["f", "-"]]


WITH_COMMANDS = [page for page in PAGES if any(commands(page.read_text(encoding="utf-8")))]


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_of_the_pages_have_the_options_that_are_shown(page: Path) -> None:
    """The parser of the command takes them; what they do is another test's matter."""
    for words in commands(page.read_text(encoding="utf-8")):
        assert callable(_parser(words).parse_args(words).run), words


#: Exit status of the commands that say something by it: ``check`` sees the shift.
STATUS = {"consume check": 3}


@pytest.mark.parametrize("section", ["Drive on a map", "Localisation and consumers"])
def test_commands_of_the_readme_run_as_pasted(
    section: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """In an empty folder, one after the other; for 8 s of the drive instead of a minute."""
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(rf"(?ms)^## {section}\n(.*?)^## ", text)
    found = [*commands(block)]
    assert len(found) >= 2
    outputs = {}
    for words in found:
        assert "--seconds" not in words or words[words.index("--seconds") + 1] == "60"
        short = ["8" if word == "60" else word for word in words]

        assert main(short) == STATUS.get(" ".join(words[:2]), 0), words
        outputs[" ".join(words[:2])] = capsys.readouterr().out
    if section == "Drive on a map":
        assert outputs["accuracy drive.blf"].startswith("The sender is right")
        assert (tmp_path / "accuracy.png").stat().st_size > 10_000
    else:
        rows = outputs["consume steer"].splitlines()
        assert len(rows) > 5
        assert {row.split()[2] for row in rows[1:]} <= {"DRIVING", "SLOWING"}
        assert "DRIVING" in rows[-1]
        assert "no lane" not in outputs["consume fusion"].splitlines()[-1]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_files_and_headings(page: Any) -> None:
    """Every relative link has its file, and every fragment a heading there."""
    for path, fragment in LINK.findall(CODE.sub("", page.read_text(encoding="utf-8"))):
        target = (page.parent / path).resolve() if path else page

        assert target.exists(), f"{page.name}: {path}"
        assert not fragment or fragment in anchors(target), f"{page.name}: {path}#{fragment}"


def anchors(page: Any) -> Any:
    """Anchors of the headings of a page, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
