"""The command line as a whole: help, usage, errors and how it ends."""

import re
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from support.fixtures import Capture, Patch

import maplines_can
from maplines_can import core
from maplines_can.cli import COMMANDS, main
from maplines_can.cli import GROUPS as COMMAND_GROUPS
from maplines_can.cli.command_line import GROUPS
from maplines_can.values.errors import missing_extra

ROOT = Path(__file__).parents[2]
GROUPED = {
    group: [f"{group} {name}" for name in table] for group, (table, _) in COMMAND_GROUPS.items()
}
ALL = [*COMMANDS, *(name for names in GROUPED.values() for name in names)]


def help_of(capsys: Capture, *words: Any) -> Any:
    with pytest.raises(SystemExit, match="0"):
        main([*words, "--help"])
    return capsys.readouterr().out


def test_help_lists_every_command(capsys: Capture) -> None:
    """Each command has a line of help, and so have those that others consist of."""
    top = help_of(capsys)
    pages = [(top, COMMANDS)]
    for group, (table, about) in COMMAND_GROUPS.items():
        assert f"\n    {group} " in top
        assert about in top
        pages.append((help_of(capsys, group), table))
    for text, table in pages:
        for name, (_, about) in table.items():
            assert f"\n    {name}" in text
            assert about in " ".join(text.split())


@pytest.mark.parametrize("name", ALL)
def test_help_of_a_command(capsys: Capture, name: Any) -> None:
    """Each describes itself and gives an example; no option says that its default is None."""
    text = help_of(capsys, *name.split())
    assert text.startswith(f"usage: maplines {name} ")
    assert f"maplines {name} " in text.split("example")[1]
    assert not re.search(r"default: (None|False)|\) \(default", " ".join(text.split()))
    sections = re.split(r"(?m)^(\S.*):\n", text)
    titles = [title for title in sections[1::2] if title in GROUPS]
    assert titles == [title for title in GROUPS if title in titles]
    if name in {"demo", "send", "receive", "drive", "consume fusion", "design"}:
        assert len(titles) >= 2  # and they hold all options but --help
        options = sections[sections.index("options") + 1]
        assert re.findall(r"(?m)^  (-\S+)", options) == ["-h,"]


def test_every_command_is_in_the_readme() -> None:
    readme = (ROOT / "README.md").read_text()
    assert [name for name in [*COMMANDS, *COMMAND_GROUPS] if f"maplines {name}" not in readme] == []


def test_version(capsys: Capture) -> None:
    """It is the version of the package, with the compiler of the core."""
    with pytest.raises(SystemExit, match="0"):
        main(["--version"])
    text = f"maplines {maplines_can.__version__}, core built with {core.compiler}\n"
    assert capsys.readouterr().out == text


@pytest.mark.parametrize("module", ["maplines_can", "maplines_can.cli"])
def test_the_command_runs_as_a_module(module: str) -> None:
    """python -m maplines_can is maplines."""
    command = [sys.executable, "-m", module, "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"maplines {maplines_can.__version__}, ")


def test_interrupt_ends_cleanly(channel: str) -> None:
    """SIGINT to a sender: the counters, status 0, no traceback."""
    script = (
        "import signal\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored in the background
        "from maplines_can.cli import main\n"
        f"bus = ['--interface', 'virtual', '--channel', '{channel}']\n"
        "raise SystemExit(main(['send', *bus, '--rate', '100']))"
    )
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", script], **pipes) as sender:  # type: ignore[call-overload]
        assert "until Ctrl-C" in sender.stderr.readline()
        sender.send_signal(signal.SIGINT)
        out, err = sender.communicate(timeout=120)
    assert sender.returncode == 0, err
    assert "sent" in out
    assert "Traceback" not in err


def test_interrupt_while_a_module_is_imported(monkeypatch: Patch) -> None:
    """The status of Ctrl-C, no traceback."""

    def import_module(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("maplines_can.cli.import_module", import_module)
    assert main(["demo"]) == 130


@pytest.mark.parametrize("extra", ["fmi", "secoc", "mf4", "study", "plot", "ros", "osi"])
def test_item_11_an_extra_is_one_that_a_checkout_has(extra: str) -> None:
    """The command in the message names an extra of pyproject.toml; nothing is published."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert extra in extras["optional-dependencies"]
    assert str(missing_extra("this needs that", extra)).endswith(f'pip install -e ".[{extra}]"')


def test_item_11_no_text_names_a_package_that_is_not_published() -> None:
    """No message and no page says pip install maplines_can."""
    texts = [*(ROOT / "maplines_can").rglob("*.py"), *ROOT.glob("*.md"), *ROOT.glob("d*/*.md")]
    wrong = [
        path for path in texts if re.search(r"install\s.?maplines_can", path.read_text("utf-8"))
    ]
    assert len(texts) > 50
    assert wrong == []
