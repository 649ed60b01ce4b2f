"""Signals that the records of lines share with those of the pose error."""

from __future__ import annotations

from ...values.line import Kind
from .record_pages import SignalSpec

# fmt: off
CRC = SignalSpec(
    name="Crc", bits=16,
    about="CRC-16/CCITT-FALSE over all other bytes of the record, then the slot's E2EDataId, "
          "low byte first (AUTOSAR E2E profile 5).",
    why="profile 5 asks for 16 bits, and for this place at the head of the record")
KIND = SignalSpec(
    name="Kind", bits=3, choices={kind.value: kind.name for kind in Kind},
    about="Kind of line on the road.", why="eight values")
AGE = SignalSpec(
    name="Age", bits=5, factor=8, unit="ms", choices={31: "TOO_OLD"},
    about="Time from the pose to the transmission, rounded up. The greatest raw value means "
          "too old, or unknown: the sender no longer vouches for the line; do not use it.",
    why="a step is 24 cm of travel at 30 m/s, along the line where it matters least")
# fmt: on
