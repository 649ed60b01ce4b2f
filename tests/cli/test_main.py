"""The command line as a whole: help, usage, errors and how it ends."""

import re
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

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


def help_of(capsys: pytest.CaptureFixture[str], *words: Any) -> Any:
    with pytest.raises(SystemExit, match="0"):
        main([*words, "--help"])
    return capsys.readouterr().out


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
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
def test_help_of_a_command(capsys: pytest.CaptureFixture[str], name: Any) -> None:
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


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
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


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        pytest.param(["decode", "nowhere.log"], "no such file", id="no-log"),
        pytest.param(["decode", "pyproject.toml"], "format '.toml' is unknown", id="format"),
        pytest.param(["demo", "--dbc", "nowhere.dbc"], "nowhere.dbc", id="no-dbc"),
        pytest.param(["demo", "--seconds", "0.1", "--plot", "/nowhere/a.png"], "/nowhere/a.png",
                     id="no-folder"),
        pytest.param(["demo", "--seconds", "0.1", "--plot", "a.xyz"], "xyz", id="no-such-format"),
        pytest.param(["send", "--interface", "socketcan", "--channel", "nocan9"], "nocan9",
                     id="no-interface"),
        pytest.param(["receive", "--interface", "warp"], "warp", id="no-such-driver"),
        pytest.param(["demo", "--components", "auto", "--max-load", "0.08"],
                     "4 lines with 4 components take 8.64 % of the bus", id="too-little-bus"),
    ],
)  # fmt: skip
def test_errors_are_one_clear_line(
    capsys: pytest.CaptureFixture[str], arguments: Any, words: str
) -> None:
    """Nonzero status, one line on standard error that names the thing, no traceback."""
    assert main(arguments) == 1
    err = capsys.readouterr().err
    assert words in err
    assert "Traceback" not in err
    assert len([row for row in err.splitlines() if "error" in row]) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        pytest.param(["receive"], "--interface and --channel", id="no-interface"),
        pytest.param(["receive", "--interface", "socketcan"], "--channel can0", id="no-channel"),
        pytest.param(["design"], "--frames or --max-kl must be given", id="no-target"),
        pytest.param(["design", "--frames", "1", "--n", "100", "--set", "road"], "--frames 1 leave",
                     id="too-few-frames"),
        pytest.param(["design", "--frames", "4", "--keep-mean", "--range", "y_off=9"],
                     "must not be given with --keep-mean", id="contradiction"),
        pytest.param(["design", "--frames", "4", "--sigma", "y_off=0"], "--sigma must", id="sigma"),
        pytest.param(["study", "run", "--out", "never", "--finer", "-8", "--n", "100", "--code",
                      "Cholesky"], "so --finer cannot be -8", id="finer"),
    ],
)  # fmt: skip
def test_errors_name_options_and_not_python_arguments(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, arguments: Any, words: str
) -> None:
    """The user of the command cannot pass interface=..., nor max_kl."""
    for variable in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_CONFIG"):
        monkeypatch.delenv(variable, raising=False)
    assert main(arguments) == 1
    err = capsys.readouterr().err
    assert words in err
    assert not re.search(r"(interface|channel|fd)=|\b(max|keep|finer)_[a-z]+", err)


@pytest.mark.parametrize(
    "arguments",
    [
        ["demo", "--scenario", "moon"],
        ["demo", "--rate", "0"],
        ["demo", "--lines", "9"],
        ["demo", "--components", "9"],
        ["demo", "--max-load", "0"],
        ["send", "--components", "all"],
        ["send", "--count", "-1"],
        ["receive", "--cycle-ms", "0.5"],
        ["decode", "--cycle-ms", "nan", "drive.log"],
        ["study"],
        ["study", "fly"],
        ["fly"],
        [],
    ],
)
def test_wrong_usage_is_status_2(capsys: pytest.CaptureFixture[str], arguments: Any) -> None:
    """One line says what is allowed, or where to read it; it does not repeat the usage."""
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(r"maplines( \w+)*: error: ", line)
    assert re.search(r"did you mean|from|see 'maplines .*--help'", line)


@pytest.mark.parametrize(
    ("arguments", "command", "hint"),
    [
        (["demo", "--rat", "5"], "maplines demo", "did you mean --rate?"),
        (["receive", "--channell=vcan0"], "maplines receive", "did you mean --channel?"),
        (["send", "--key", "car.key"], "maplines send", "did you mean --key"),
        (
            ["study", "run", "--out", "d", "--sed", "1"],
            "maplines study run",
            "did you mean --seed?",
        ),
        (["study", "production", "--mark"], "maplines study production", "mean --markdown?"),
        (["design", "--frmes", "4"], "maplines design", "did you mean --frames?"),
        (["demoo"], "maplines", "did you mean demo?"),
        (["study", "rum"], "maplines study", "did you mean run?"),
        (["demo", "--scenario", "highwai"], "maplines demo", "did you mean highway?"),
        (["receive", "--xyz"], "maplines receive", "'maplines receive --help' lists all options"),
        (["scenarios", "extra"], "maplines scenarios", "'maplines scenarios --help' lists"),
        (["--verion"], "maplines", "COMMAND"),
    ],
)
def test_item_11_an_unknown_option_is_an_error_of_its_command(
    capsys: pytest.CaptureFixture[str], arguments: Any, command: str, hint: str
) -> None:
    """The one line names the command, and the closest option."""
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{command}: error: ")
    assert hint in line


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        pytest.param("decode nofile.blf", "did you mean drive.blf?", id="log"),
        pytest.param("consume steer drvie.blf --dbc maplines-pose.dbc", "drive.blf?", id="typo"),
        pytest.param("accuracy drive.bfl.csv drive.blf", "did you mean drive.blf.csv?", id="truth"),
        pytest.param("decode x/a.log", "'maplines drive --as-fast-as-possible --record x/a.log'",
                     id="record one"),
        pytest.param("decode --dbc=maplines-poes.dbc drive.blf", "mean maplines-pose.dbc?",
                     id="DBC"),
        pytest.param("decode --dbc x/a.dbc drive.blf", "this package has maplines.dbc", id="DBCs"),
        pytest.param("drive twon.xodr --record a.log", "did you mean town.xodr?", id="map"),
        pytest.param("map x/a.osm", "this package has town.xodr", id="maps"),
        pytest.param("drive --drive car.csv --record a.log", "looked for in", id="drive"),
        pytest.param("receive --interface sockcan --channel can0", "did you mean socketcan?",
                     id="interface"),
        pytest.param("receive --interface xyz", "python-can has canalystii", id="interfaces"),
        pytest.param("drive --as-fast-as-possible", "add --record FILE", id="nothing kept"),
    ],
)  # fmt: skip
def test_an_error_says_what_to_do(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    words: str,
    hint: str,
) -> None:
    """A file or an interface that does not exist: the one that may be meant, or those there are."""
    monkeypatch.chdir(tmp_path)
    for name in ("drive.blf", "drive.blf.csv"):
        (tmp_path / name).touch()
    assert main(words.split()) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("maplines: error: ")
    assert hint in line


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


def test_interrupt_while_a_module_is_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    """The status of Ctrl-C, no traceback."""

    def import_module(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("maplines_can.cli.import_module", import_module)
    assert main(["demo"]) == 130


@pytest.mark.parametrize("extra", ["fmi", "secoc", "mf4", "study", "plot"])
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
