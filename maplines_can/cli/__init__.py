"""The command ``maplines``.

Each command has a module of its own, which is imported only if the command is given: a receiver
loads nothing of the study, and ``maplines --help`` nothing at all.

It may import the product, ``study`` and ``testing``.
"""

from __future__ import annotations

import argparse
import errno
import logging
import os
import signal
import sys
import threading
import warnings
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from typing import Any

from .. import __version__
from ..values.errors import CoreError, MaplinesError
from .command_line import Parser, note
from .file_arguments import missing_file_hint

__all__ = ["main"]

#: Commands: module in this package, and one line of help. The module adds
#: command X with its function ``add_X``.
COMMANDS = {
    "demo": ("demo", "send a scenario over a bus, receive its lines, compare"),
    "send": ("send", "send the lines of a scenario until Ctrl-C"),
    "receive": ("receive", "print the lines that arrive on a bus until Ctrl-C"),
    "decode": ("decode", "print the lines in a log file, or write tables of many"),
    "info": ("info", "print what is in log files: messages, gaps, lines, what was dropped"),
    "diff": ("diff", "compare the lines of two logs: which differ, and by how many sigmas"),
    "plot": ("plot", "draw the lines in log files, with their uncertainty"),
    "view": ("view", "show a bus or a log, live, in a page of the browser"),
    "monitor": ("monitor", "show the lines of a bus in this terminal, until q"),
    "map": ("map", "print what is in a map file, and draw it"),
    "drive": ("drive", "drive on a map, and send or record the lines around the car"),
    "replay": ("replay", "send the frames of a log on a bus at the recorded times"),
    "restbus": ("restbus", "simulate the nodes around a device: lines and other messages"),
    "consume": ("consume", "use received lines as a car does: fuse, steer, check"),
    "scenarios": ("paper", "list the scenarios that can be sent"),
    "generate": ("generate", "generate C for an ECU from a DBC, and vectors for its test"),
    "design": ("design", "design a DBC for a number of frames or a limit on the error"),
    "accuracy": ("accuracy", "compare the received lines of a drive with the truth"),
    "claims": ("paper", "compare each representation of a line with Monte Carlo samples"),
    "figures": ("paper", "draw the figures of the paper"),
    "selftest": ("selftest", "compare the core with its model on this machine, bit by bit"),
}
STUDY_COMMANDS = {
    "run": ("study", "compare codes, bit widths and sets of lines; can be resumed"),
    "report": ("study", "write an HTML report with plots of a run"),
    "maps": ("study", "compare the records of scenes on your maps"),
    "production": ("study", "compare with the lane messages of production cars"),
}
FMU_COMMANDS = {
    "run": ("fmu_run", "run FMUs that are nodes of a CAN bus: FMI 3.0, FMI-LS-BUS 1.0.0"),
    "check": ("fmu_check", "check FMUs against FMI-LS-BUS 1.0.0"),
}
#: Commands that have commands of their own, and one line of help.
GROUPS = {
    "study": (STUDY_COMMANDS, "study the error caused by quantization on the bus"),
    "fmu": (FMU_COMMANDS, "run FMUs on a simulated CAN bus, and check them"),
}
#: Errors of a device that is full; those of files name them.
NO_ROOM = (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC))
#: Parts of error messages that name a Python argument, and the option of the command for it.
OPTIONS = {
    "a lower rate, fd=True, a higher bitrate or a higher max_load": "a lower --rate, --fd, a "
    "higher --bitrate or a higher --max-load",
    "use fewer lines or components": "use fewer --lines or --components",
    "use fewer lines": "use fewer --lines",
    "interface=...": "--interface",
    "channel=...": "--channel",
    "channel='can0'": "--channel can0",
    "with fd=False": "without --fd",
    "fd=False": "without --fd",
    "fd=True": "--fd",
    "frames or max_kl": "--frames or --max-kl",
    "frames: ": "--frames ",
    "max_kl": "--max-kl",
    "of ranges above": "of --range above",
    "of sigmas above": "of --sigma above",
    "ranges: ": "--range: ",
    "sigmas: ": "--sigma: ",
    "max_saturated": "--max-saturated",
    "keep_mean": "--keep-mean",
    "ranges must": "--range must",
    "sigmas must": "--sigma must",
    "finer_bits": "--finer",
    "window must": "--window must",
    "; use map_scene and encode_scene": "; use maplines demo, send, receive, decode or drive",
    "leave out the projection": "leave out --projection",
    "ignore_findings=True": "--ignore-findings",
    "leave out the bit rate": "leave out --bitrate",
    "encoding=, --encoding": "--encoding",
    "encoding=": "--encoding ",
    "step must": "--step must",
    "projection must": "--projection must",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, by default with the arguments of the process.

    Returns:
        Exit status: 0, 1 for an error, 130 for Ctrl-C. Wrong usage raises
        ``SystemExit`` with status 2.
    """
    argv = sys.argv[1:] if argv is None else argv
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # it was closed before the start
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - open until the end
    logging.basicConfig(format="maplines: %(message)s", stream=sys.stderr)
    warnings.showwarning = _show_warning
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # kill ends it as Ctrl-C does
    try:
        return _run(argv)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of our output, such as head, has closed it
        return 0
    except (MaplinesError, OSError, ValueError) as error:
        message = _with_options(" ".join(_text(error).split()))
        is_loaded = not isinstance(error, CoreError)  # the hint needs most of the package
        note(f"error: {message}{missing_file_hint(message, argv) if is_loaded else ''}")
        return 1
    finally:
        _drop_output()


def _run(argv: Sequence[str]) -> int:
    try:
        arguments = _parser(argv).parse_args(argv)
        if getattr(arguments, "keys", None):
            arguments.fd = True  # a frame of classic CAN is too short for a MAC
        return int(arguments.run(arguments))
    finally:
        sys.stdout.flush()  # of help, too; at exit, there would be a traceback


def _drop_output() -> None:
    """Drop what standard output cannot take, which Python would try to write again at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    """Print a warning as a note, without the place in the code."""
    note(str(message) if category is UserWarning else f"{category.__name__}: {message}")


class _Version(argparse.Action):
    """Option that prints the version and the compiler of the core, and ends it."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        text = "print the version, and what compiler built the core"
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help=text)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from ..core import compiler  # loads the core

        print(f"maplines {__version__}, core built with {compiler}")
        parser.exit()


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser with the options of the command in ``argv``; only names of the others."""
    parser = Parser(
        prog="maplines",
        description="Lines of a digital map on a CAN bus, with their uncertainty.",
        epilog="Start with 'maplines demo'. Help for a command: maplines COMMAND --help",
    )
    parser.add_argument("--version", action=_Version)
    words = [word for word in argv if not word.startswith("-")]
    commands = _add_commands(parser, COMMANDS, words[:1])
    for name, (table, text) in GROUPS.items():
        group = commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        _add_commands(group, table, words[1:2] if words[:1] == [name] else [])
    return parser


def _add_commands(
    parser: argparse.ArgumentParser, table: dict[str, tuple[str, str]], given: list[str]
) -> argparse._SubParsersAction[argparse.ArgumentParser]:
    """Add the commands of a table, importing the module of the given one only."""
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, (module, text) in table.items():
        if [name] == given:
            getattr(import_module(f".{module}", __package__), f"add_{name}")(commands)
        else:
            commands.add_parser(name, help=text)
    return commands


def _text(error: Exception) -> str:
    """Return the text of an error, without an error number if a file is missing."""
    if isinstance(error, FileNotFoundError) and error.filename is not None:
        return f"{error.filename}: there is no such file or folder"
    if isinstance(error, OSError) and error.errno in NO_ROOM:
        name = "standard output" if error.filename is None else error.filename
        return f"{name}: cannot be written: {error.strerror}"
    return str(error)


def _with_options(message: str) -> str:
    """Return an error message with the options of the command instead of Python arguments."""
    for argument, option in OPTIONS.items():
        message = message.replace(argument, option)
    return message
