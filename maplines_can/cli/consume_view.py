"""The page of a consumer: ``--view`` of ``maplines consume``."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from ..consumers import FusedLane
from ..desk.facts import Facts, line_facts, scene_facts
from ..values.line import MapLine
from ..wire import LineCodec
from .command_line import note, option_group
from .options import add_port

#: Takes the facts of a cycle, the lane, and the lines of the camera.
Show = Callable[[Callable[[], Facts], FusedLane, Sequence[MapLine]], None]


def add_page(parser: argparse.ArgumentParser) -> None:
    """Add ``--view`` and ``--port``."""
    option_group(parser, "output").add_argument(
        "--view",
        action="store_true",
        help="show the lines, those of the camera and the fused lane in a page of your browser, as "
        "'maplines view'",
    )
    add_port(parser)


@contextmanager
def page_of(arguments: argparse.Namespace, codec: LineCodec, name: str) -> Iterator[Show]:
    """Yield the function that shows a cycle; without ``--view``, it does nothing.

    The page of a log stays until Ctrl-C.

    Args:
        arguments: of the command.
        codec: of the lines.
        name: of the bus or the log.
    """
    if not arguments.view:
        yield lambda *_: None
        return
    from ..desk.history import FactHistory
    from ..desk.server import about
    from .view import FIVE_MINUTES, served, wait_for_ctrl_c

    is_live = arguments.log is None and not arguments.simulate
    history = FactHistory(FIVE_MINUTES if is_live else None)

    def show(facts: Callable[[], Facts], lane: FusedLane, camera: Sequence[MapLine]) -> None:
        consumer = {
            "fused": None if lane.scene is None else scene_facts(lane.scene),
            "camera": {
                line.slot.name: {
                    "line": line_facts(line),
                    "is_rejected": line.slot in lane.rejected,
                }
                for line in camera
            },
        }
        history.add(facts() | {"consumer": consumer})

    with served(history, about(codec, name, is_live=is_live), "127.0.0.1", arguments.port):
        yield show
        history.end()
        if not is_live:
            note("all is read; the page stays until Ctrl-C")
            with suppress(KeyboardInterrupt):
                wait_for_ctrl_c()
