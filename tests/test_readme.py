"""The Python examples of the pages run as they stand, and print what the pages show."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: A block of Python, and the block of text after it, if there is one: its output.
EXAMPLE = re.compile(r"^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("page", ["README.md", "docs/python.md"])
def test_examples_run_and_print_what_the_page_shows(page, capsys, monkeypatch, tmp_path):
    """The blocks of a page continue each other; they need neither hardware nor other files."""
    monkeypatch.chdir(tmp_path)
    examples = EXAMPLE.findall((ROOT / page).read_text(encoding="utf-8"))
    namespace = {}

    assert examples
    for code, output in examples:
        exec(compile(code, page, "exec"), namespace)  # noqa: S102 - our own page
        assert capsys.readouterr().out == output
