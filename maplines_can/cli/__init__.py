"""The ``maplines`` command: its jobs, each in a file of its name, and how it ends."""

from __future__ import annotations

import argparse
import logging
import signal
import sys
import threading
from importlib.metadata import version

from ..errors import MaplinesError
from .accuracy import add_truth
from .decode import add_decode
from .demo import add_demo
from .design import add_design
from .figures import add_figures
from .options import Parser
from .production import add_production
from .progress import note, progress_bar
from .receive import add_receive
from .report import add_report
from .scenarios import add_scenarios
from .send import add_send
from .study import add_study

__all__ = ["main"]


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit status: 0, 1 for an error, 2 for wrong usage."""
    arguments = _parser().parse_args(argv)
    if getattr(arguments, "keys", None):
        arguments.fd = True  # classic CAN has no room for a MAC
    logging.basicConfig(format="maplines: %(message)s", stream=sys.stderr)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # a kill ends as Ctrl-C does
    try:
        return int(arguments.run(arguments))
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of our output, such as head, has enough
        sys.stderr.close()
        return 0
    except (MaplinesError, OSError, ValueError) as error:
        note(f"error: {' '.join(str(error).split())}")
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="maplines",
        description="The lines of a digital map on a CAN bus, with their uncertainty.",
        epilog="Begin with 'maplines demo'. Each job explains itself: maplines JOB --help.",
    )
    parser.add_argument(
        "--version", action="version", version=f"maplines {version('maplines_can')}"
    )
    jobs = parser.add_subparsers(title="jobs", required=True, metavar="JOB")
    add_demo(jobs)
    add_send(jobs)
    add_receive(jobs)
    add_decode(jobs)
    add_figures(jobs)
    add_truth(jobs)
    studies = add_study(jobs, progress_bar)
    add_report(studies)
    add_production(studies)
    add_design(jobs, progress_bar)
    add_scenarios(jobs)
    return parser
