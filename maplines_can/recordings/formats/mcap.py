"""MCAP: a message a line in JSON, on a topic a slot, so that ``EgoLeft.y40`` is a plot; and the
lines with their bands as a scene.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from ...values.errors import missing_extra
from ...values.line import Slot
from ...wire.layout.record_signals import slot_title
from ..line_tables import LineTable, Table
from .scene_update import NAME, scene_updates
from .scene_update import schema as scene_schema
from .table_writer import About, FilesWriter, PathOf

_TYPES = {"b": "boolean", "i": "integer", "u": "integer", "f": "number"}
_TITLES = {slot.name: slot_title(slot) for slot in Slot}


class McapWriter(FilesWriter):
    """Writer of MCAP with the topics ``EgoLeft`` and so on, ``rejects`` and ``scenes``.

    With several channels in a log the topics are ``can0/EgoLeft`` and so on. The JSON schema of a
    topic has the units. A value that is not finite is left out of its message. On the topic
    ``bands`` is a ``foxglove.SceneUpdate`` for each line.

    Args:
        path_of: paths of the files.
        about: source of the tables: the metadata record ``maplines_can``.
        bands: whether there is that topic.

    Raises:
        MissingExtraError: mcap is not installed.
    """

    def __init__(self, path_of: PathOf, about: About, *, bands: bool = True) -> None:
        try:
            from mcap.writer import Writer
        except ImportError as error:
            raise missing_extra("an MCAP file needs mcap", "tables") from error
        super().__init__(path_of)
        self._file = self._files.temporary("lines").open("wb")
        self._writer: Any = Writer(self._file)
        self._writer.start(profile="", library=f"maplines_can {about.maplines_can}")
        self._writer.add_metadata("maplines_can", about.texts)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._bands, self._lifetime_ns = bands, 2 * about.cycle_ms * 10**6

    def write(self, table: LineTable) -> None:
        """Write the rows of a block, in the order of their times as far as a block has them."""
        for name, part in table.parts.items():
            many = len(part.categories.get("channel", ())) > 1
            names = [column for column in part.columns if column != "t_ns"]
            columns = [part[column].tolist() for column in names]
            for t_ns, *row in zip(part.columns["t_ns"].tolist(), *columns, strict=True):
                values = {
                    key: value
                    for key, value in zip(names, row, strict=True)
                    if not (isinstance(value, float) and not math.isfinite(value))
                }
                topic = _TITLES[values["slot"]] if name == "lines" else name
                topic = f"{values['channel']}/{topic}" if many else topic
                if topic not in self._channels:
                    self._add_channel(topic, f"maplines.{name}", _schema(name, part))
                self._add(topic, t_ns, json.dumps(values).encode())
        if self._bands:
            self._write_bands(table)

    def _write_bands(self, table: LineTable) -> None:
        many = len(table.categories["channel"]) > 1
        updates = scene_updates(table, self._lifetime_ns)
        times = table.columns["t_ns"].tolist()
        for channel, t_ns, update in zip(table["channel"].tolist(), times, updates, strict=True):
            topic = f"{channel}/bands" if many else "bands"
            if topic not in self._channels:
                self._add_channel(topic, NAME, scene_schema())
            self._add(topic, t_ns, update)

    def _add_channel(self, topic: str, name: str, schema: dict[str, Any]) -> None:
        if name not in self._schemas:
            text = json.dumps(schema).encode()
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", text)
        self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[name])

    def _add(self, topic: str, t_ns: int, data: bytes) -> None:
        time = max(t_ns, 0)  # MCAP has no times before 1970
        self._writer.add_message(self._channels[topic], log_time=time, data=data, publish_time=time)

    def close(self) -> list[Path]:
        """Complete the file and return its path."""
        self._writer.finish()
        self._release()
        return self._files.close()

    def _release(self) -> None:
        self._file.close()


def _schema(name: str, part: Table) -> dict[str, Any]:
    """Return the JSON schema of the messages of a table."""
    properties: dict[str, Any] = {}
    for column in part.columns:
        kind = part.columns[column].dtype.kind
        of_text = column in part.categories
        properties[column] = {"type": "string" if of_text else _TYPES[kind]}
        if column in part.units:
            properties[column]["description"] = f"[{part.units[column]}]"
    return {"title": f"maplines.{name}", "type": "object", "properties": properties}
