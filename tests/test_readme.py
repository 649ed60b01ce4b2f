"""The pages: their Python examples run and print what is shown, and their links lead somewhere."""

import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("dbc/*.md")])
#: A block of Python, and the block of text right after it, if there is one: its output.
EXAMPLE = re.compile(r"(?ms)^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?")
WITH_PYTHON = [page for page in PAGES if EXAMPLE.search(page.read_text(encoding="utf-8"))]
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
