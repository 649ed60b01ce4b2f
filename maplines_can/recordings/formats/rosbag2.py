"""ROS 2 bags: a message a line, with points and their covariances, on a topic a slot."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from ...values.errors import missing_extra
from ...values.line import Kind, Slot, Status
from ...wire import E2EState
from ...wire.layout.record_signals import slot_title
from ..line_tables import LineTable, Table
from .line_points import mean_of, points_of, upper_triangle_of
from .table_writer import About, PathOf

#: Frame of the points: that of the car, x forward, y to the left (REP 103).
FRAME = "base_link"
#: File of a bag that says what it has.
METADATA = "metadata.yaml"
#: Points of a line: one each 5 m of 80 m.
POINTS = 17
LINE, POINT = "maplines_msgs/msg/Line", "maplines_msgs/msg/PointWithCovariance"
#: As ros2/common_interfaces 328 proposes it.
POINT_DEFINITION = """\
geometry_msgs/Point point   # [m]
float64[9] covariance       # of x, y and z, row by row [m^2]
"""
_LINE_FIELDS = """\
std_msgs/Header header      # time of the pose from which the line is seen; frame of the car
uint8 slot
uint8 kind
uint8 status
uint8 state                 # E2E state after the line
bool usable                 # whether a controller might have used the line as it arrived
bool two_senders
uint32 counter
float64 age                 # from the pose to the sending [s]
float64 x_min               # y(x) = y_off + tan(beta) x + c0/2 x^2 + c1/6 x^3
float64 x_max               # for x_min <= x <= x_max [m], x forward, y to the left
float64[4] mean             # y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]
float64[10] covariance      # of these: the upper triangle, row by row
maplines_msgs/PointWithCovariance[] points  # z is not known and 0; x is chosen, so that only
                                            # y has a variance; empty if the line has no values
"""


def line_definition() -> str:
    """Return the definition of the message of a line, with the names of its numbers."""
    kinds: tuple[tuple[str, type[IntEnum]], ...] = (
        ("SLOT", Slot), ("KIND", Kind), ("STATUS", Status), ("STATE", E2EState),
    )  # fmt: skip
    names = [f"uint8 {prefix}_{one.name}={one.value}" for prefix, kind in kinds for one in kind]
    return "\n".join([*names, _LINE_FIELDS])


class Rosbag2Writer:
    """Writer of a ROS 2 bag with the topics ``/EgoLeft`` and so on, of ``maplines_msgs/msg/Line``.

    With several channels in a log the topics are ``/can0/EgoLeft`` and so on. A bag is a folder
    with ``metadata.yaml``, which has the source as custom data, and an MCAP file, which has the
    definitions of the messages. The time of a message in the bag is that of its reception.

    Args:
        path_of: paths of the files; that of the lines is the folder.
        about: source of the tables.

    Raises:
        MissingExtraError: rosbags is not installed.
        OSError: there is a folder of this name that is no bag.
    """

    def __init__(self, path_of: PathOf, about: About) -> None:
        try:
            from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError as error:
            raise missing_extra("a ROS 2 bag needs rosbags", "ros") from error
        self.path = path_of("lines")
        if self.path.is_dir() and not (self.path / METADATA).is_file():
            raise OSError(f"{self.path}: is a folder that is no bag; use another name")
        self._part = self.path.with_name(f".{self.path.name}.{os.getpid()}.part")
        shutil.rmtree(self._part, ignore_errors=True)  # of a process that was killed
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._store.register(get_types_from_msg(POINT_DEFINITION, POINT))
        self._store.register(get_types_from_msg(line_definition(), LINE))
        plugin = StoragePlugin.MCAP
        self._writer = Writer(self._part / self.path.stem, version=9, storage_plugin=plugin)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        for key, text in about.texts.items():
            self._writer.set_custom_data(key, text)
        self._writer.open()
        self._connections: dict[str, Any] = {}

    def write(self, table: LineTable) -> None:
        """Write the lines of a block."""
        many = len(table.categories["channel"]) > 1
        times = table.columns["t_ns"].clip(0).tolist()
        slots = [slot_title(Slot[name]) for name in table["slot"]]
        rows = zip(times, table["channel"].tolist(), slots, self._messages(table), strict=True)
        for t_ns, channel, slot, message in rows:
            topic = f"/{channel}/{slot}" if many else f"/{slot}"
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(
                    topic, LINE, typestore=self._store
                )
            data = self._store.serialize_cdr(message, LINE)
            self._writer.write(self._connections[topic], t_ns, data)

    def _messages(self, table: Table) -> Iterator[Any]:
        """Yield the message of each line."""
        types = self._store.types
        header, time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
        age = np.nan_to_num(table.columns["age"], nan=0.0)
        stamps = (table.columns["t_ns"] - np.round(age * 1e9).astype(np.int64)).clip(0).tolist()
        states = [E2EState[name].value for name in table["state"].tolist()]
        names = ("slot", "kind", "status", "usable", "two_senders", "counter")
        columns = [table.columns[name].tolist() for name in (*names, "age", "x_min", "x_max")]
        rows = zip(
            stamps, states, mean_of(table), upper_triangle_of(table), self._points(table), *columns,
            strict=True,
        )  # fmt: skip
        for stamp, state, mean, covariance, points, *rest in rows:
            slot, kind, status, *others = rest
            stamped = header(time(*divmod(stamp, 10**9)), FRAME)
            yield types[LINE](stamped, slot, kind, status, state, *others, mean, covariance, points)

    def _points(self, table: Table) -> Iterator[list[Any]]:
        """Yield the points of each line."""
        place, point = self._store.types["geometry_msgs/msg/Point"], self._store.types[POINT]
        x, y, sigma = points_of(table, POINTS)
        covariance = np.zeros((*x.shape, 9))
        covariance[..., 4] = sigma**2
        is_known = np.isfinite(y[:, 0]).tolist()
        for along, across, cov, known in zip(
            x.tolist(), y.tolist(), covariance, is_known, strict=True
        ):
            yield [
                point(place(*xy, 0.0), one)
                for *xy, one in zip(along, across, cov, strict=True)
                if known
            ]

    def close(self) -> list[Path]:
        """Complete the bag and return its path."""
        self._writer.close()
        if self.path.is_dir():
            shutil.rmtree(self.path)
        else:
            self.path.unlink(missing_ok=True)
        (self._part / self.path.stem).rename(self.path)
        self._part.rmdir()
        return [self.path]

    def abort(self) -> None:
        """Leave no bag."""
        with suppress(Exception):  # what is left cannot be written, either
            self._writer.abort()
        shutil.rmtree(self._part, ignore_errors=True)
