"""Options of lines that are sent as scenes, with the error of their pose."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Mapping
from itertools import chain

import numpy as np

from ..bus import bus_load
from ..values.line import LeftOut, MapLineList, Slot
from ..values.scene import PoseError, Scene
from ..wire import POSE, Codec
from .parsing import option_group


def add_pose_error(parser: argparse.ArgumentParser) -> None:
    """Add ``--pose-error``."""
    option_group(parser, "message").add_argument(
        "--pose-error",
        action="store_true",
        help="send the error of the pose, too, from which the lines of a cycle are seen: receivers "
        "then know their joint covariance (always so with --dbc maplines-pose.dbc, whose lines "
        "take fewer frames, but are received with the pose error only)",
    )


def sends_scenes(codec: Codec, arguments: argparse.Namespace) -> bool:
    """Return whether lines are sent as scenes: together with the error of their pose.

    Raises:
        ValueError: options contradict each other or the DBC.
    """
    layout = codec.layout
    if arguments.pose_error and layout.pose is None:
        raise ValueError(
            f"--pose-error: {layout.source} has no message of the pose error (MapLinePose); leave "
            f"it out, or take one of this package, such as --dbc maplines.dbc"
        )
    if not (arguments.pose_error or layout.is_conditional):
        return False
    if arguments.components != 1:
        why = "--pose-error" if arguments.pose_error else f"{layout.source}"
        raise ValueError(
            f"--components {arguments.components} does not go with {why}: lines are sent with the "
            "error of their pose, and a receiver splits that itself; leave out --components"
        )
    return True


def check_scene_load(
    codec: Codec,
    slots: Collection[Slot],
    rate: float,
    bitrate: int,
    data_bitrate: int | None,
    *,
    max_load: float | None,
) -> None:
    """Check the bus load of the pose error and of lines with the longest records.

    Raises:
        ValueError: it exceeds the limit; None is no limit.
    """
    if max_load is None:
        return
    fd = data_bitrate is not None
    blank = np.zeros(codec.layout.record_bytes, dtype=np.uint8)
    empty = Scene((), np.zeros((0, 0)), PoseError(np.eye(3) * 0.01), np.zeros((0, 2)))
    pose = codec.encode_scene(empty, fd=fd, counters={})[POSE]
    lines = (codec.frames(blank, slot, fd=fd) for slot in slots)
    load = bus_load([*pose, *chain(*lines)], 1 / rate, bitrate, data_bitrate)
    if load > max_load:
        raise ValueError(
            f"{len(slots)} lines and the pose error take up to {100 * load:.3g} % of the bus at "
            f"{rate:g} Hz and {bitrate / 1000:g} kbit/s, and {100 * max_load:g} % "
            "are allowed; use fewer --lines, a lower --rate, --fd, a higher --bitrate or a higher "
            "--max-load"
        )


def left_out_of(codec: Codec, lines: MapLineList | Scene, *, fd: bool) -> Mapping[Slot, LeftOut]:
    """Return why lines are not sent, by slot: those of a scene that do not fit the message, too."""
    return (
        codec.prepare_scene(lines, fd=fd).left_out if isinstance(lines, Scene) else lines.left_out
    )
