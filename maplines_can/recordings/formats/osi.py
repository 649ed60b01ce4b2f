"""ASAM OSI traces in MCAP: the lane boundaries of a cycle in an ``osi3.SensorData``.

The form is that of "OSI trace file formats" in the documentation of ASAM OSI 3.8, and the meaning
of the fields that of ``osi_sensordata.proto``, ``osi_detectedlane.proto`` and ``osi_lane.proto``.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from ...values.errors import missing_extra
from ...values.line import Kind, Slot
from ..line_tables import LineTable
from .line_points import covering_points_of, is_shown
from .table_writer import About, FilesWriter, PathOf

TOPIC = "MapLines.SensorData"
#: Points of a line: one each 5 m of 80 m.
POINTS = 17
#: What a reader must know that OSI has no place for: the metadata record ``maplines_can``.
LOST = """\
Of the covariance of a line only the standard deviation of y at each point is kept, as \
boundary_line_rmse: correlations along a line and between lines are lost. It is so large that its \
linear interpolation is nowhere less than that of the line, with the distance between line and \
polyline. Cubics are points; mixtures are their mean. Lines that must not be used, E2E states, \
counters and rejected frames are left out. The lines of a message are those of a cycle; each is \
seen from the pose at its own time, of which the newest is last_measurement_time."""
FRAME = """\
Positions [m] are in the frame of the car of the sender, x forward, y to the left (ISO 8855), in \
the plane z = 0, heights are not known; mounting_position is not set. Times are since 1970. The \
tracking_id is the slot: """ + ", ".join(f"{slot.value} {slot.name}" for slot in Slot)

#: Types of OSI, which has no double lines.
_TYPES = {
    Kind.UNKNOWN: "TYPE_UNKNOWN",
    Kind.SOLID: "TYPE_SOLID_LINE",
    Kind.DASHED: "TYPE_DASHED_LINE",
    Kind.DOUBLE: "TYPE_OTHER",
    Kind.ROAD_EDGE: "TYPE_ROAD_EDGE",
    Kind.KERB: "TYPE_CURB",
    Kind.BARRIER: "TYPE_BARRIER",
    Kind.VIRTUAL: "TYPE_NO_LINE",
}


class OsiWriter(FilesWriter):
    """Writer of MCAP with the topic ``MapLines.SensorData``, a message a cycle.

    With several channels in a log the topics are ``can0.MapLines.SensorData`` and so on. A cycle
    ends before a slot that it has already, and before a line that is a cycle later than its first.

    Args:
        path_of: paths of the files.
        about: source of the tables.

    Raises:
        MissingExtraError: osi-python is not installed.
    """

    def __init__(self, path_of: PathOf, about: About) -> None:
        try:
            from mcap.writer import Writer
            from mcap_protobuf.schema import register_schema
            from osi3.osi_lane_pb2 import LaneBoundary
            from osi3.osi_sensordata_pb2 import SensorData
            from osi3.osi_version_pb2 import DESCRIPTOR, current_interface_version
        except ImportError as error:
            raise missing_extra("an OSI trace needs osi-python and mcap", "osi") from error
        super().__init__(path_of)
        self._new_message: Any = SensorData
        kinds = LaneBoundary.Classification.Type
        self._types = [kinds.Value(_TYPES[kind]) for kind in Kind]
        self._version = now = DESCRIPTOR.GetOptions().Extensions[current_interface_version]
        self._osi = f"{now.version_major}.{now.version_minor}.{now.version_patch}"
        self._file = self._files.temporary("lines").open("wb")
        self._writer: Any = Writer(self._file)
        self._writer.start(profile="", library=f"maplines_can {about.maplines_can}")
        self._schema = register_schema(self._writer, SensorData)
        for name, texts in self._metadata(about).items():
            self._writer.add_metadata(name, texts)
        self._cycle_ns = about.cycle_ms * 10**6
        self._channels: dict[str, int] = {}
        self._cycles: dict[str, Any] = {}  # those that are not complete, by topic

    def write(self, table: LineTable) -> None:
        """Write the cycles that the lines of a block complete."""
        many = len(table.categories["channel"]) > 1
        lines = table.where(is_shown(table))
        names = ("t_ns", "age", "slot", "kind")
        columns = [lines.columns[name].tolist() for name in names]
        points = (one.tolist() for one in covering_points_of(lines, POINTS))
        rows = zip(lines["channel"].tolist(), *columns, *points, strict=True)
        for channel, t_ns, age, slot, kind, *shape in rows:
            topic = f"{channel}.{TOPIC}" if many else TOPIC
            cycle = self._cycles.get(topic)
            if cycle and (slot in cycle.slots or abs(t_ns - cycle.times[0]) >= self._cycle_ns):
                self._write_cycle(topic)
                cycle = None
            if cycle is None:
                cycle = self._cycles[topic] = _Cycle(self._new_message(), [], [], [])
            cycle.slots.append(slot)
            cycle.times.append(t_ns)
            cycle.poses.append(t_ns - round(age * 1e9))
            _add_boundary(cycle.message, slot, self._types[kind], shape)

    def _write_cycle(self, topic: str) -> None:
        """Write the lines of a topic that wait for others of their cycle."""
        message, _, times, poses = self._cycles.pop(topic)
        time = max(0, *times)
        message.version.CopyFrom(self._version)
        _set_time(message.timestamp, time)
        header = message.lane_boundary_header
        header.data_qualifier = header.DATA_QUALIFIER_AVAILABLE
        for one in (message.last_measurement_time, header.measurement_time):
            _set_time(one, max(0, *poses))
        self._writer.add_message(
            self._channel(topic),
            log_time=time,
            data=message.SerializeToString(),
            publish_time=time,
        )

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            prefix = "net.asam.osi.trace.channel."
            texts = {"osi_version": self._osi, "protobuf_version": version("protobuf")}
            texts["description"] = f"Lines of a digital map, received on a CAN bus. {LOST}"
            metadata = {f"{prefix}{name}": text for name, text in texts.items()}
            self._channels[topic] = self._writer.register_channel(
                topic, "protobuf", self._schema, metadata
            )
        return self._channels[topic]

    def _metadata(self, about: About) -> dict[str, dict[str, str]]:
        """Return the metadata records of the file."""
        trace = {"version": "3.8.0", "zero_time": "1970-01-01T00:00:00Z"}
        trace |= dict.fromkeys(("min_osi_version", "max_osi_version"), self._osi)
        trace |= dict.fromkeys(
            ("min_protobuf_version", "max_protobuf_version"), version("protobuf")
        )
        trace |= {"description": FRAME, "data_sources": about.log}
        return {
            "net.asam.osi.trace": trace,
            "maplines_can": about.texts | {"frame": FRAME, "lost": LOST},
        }

    def close(self) -> list[Path]:
        """Complete the file and return its path."""
        for topic in [*self._cycles]:
            self._write_cycle(topic)
        if not self._channels:
            self._channel(TOPIC)  # a trace has one or more
        self._writer.finish()
        self._release()
        return self._files.close()

    def _release(self) -> None:
        self._file.close()


class _Cycle(NamedTuple):
    """A message with the lines so far; their slots, times of reception and of pose [ns]."""

    message: Any
    slots: list[int]
    times: list[int]
    poses: list[int]


def _add_boundary(message: Any, slot: int, kind: int, shape: Sequence[Sequence[float]]) -> None:
    """Add a line to a message.

    Args:
        message: the ``SensorData``.
        slot: its number.
        kind: type of OSI.
        shape: x, y and sigma of its points [m].
    """
    boundary = message.lane_boundary.add()
    boundary.header.tracking_id.value = slot
    boundary.candidate.add(probability=1).classification.type = kind
    for x, y, sigma in zip(*shape, strict=True):
        position = boundary.boundary_line.add().position
        position.x, position.y, position.z = x, y, 0
        error = boundary.boundary_line_rmse.add().position
        error.x, error.y, error.z = 0, sigma, 0


def _set_time(timestamp: Any, t_ns: int) -> None:
    timestamp.seconds, timestamp.nanos = divmod(t_ns, 10**9)
