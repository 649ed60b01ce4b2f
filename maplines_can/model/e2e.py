"""Checksum, status of a counter and state machine of AUTOSAR E2E (PRS_E2EProtocol, profile 5)."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

#: Statuses that count as OK in a window.
OKS = ("OK", "OKSOMELOST")
#: Names of the statuses of a check, and of the states of an owner.
STATUSES = ("OK", "NONEWDATA", "ERROR", "REPEATED", "OKSOMELOST", "WRONGSEQUENCE")
STATES = ("VALID", "NODATA", "INIT", "INVALID")


class Windows(NamedTuple):
    """Bounds of the state machine, with AUTOSAR's names and the defaults of this project."""

    max_delta_counter: int = 16
    window_size_init: int = 10
    window_size_valid: int = 10
    window_size_invalid: int = 10
    min_ok_state_init: int = 6
    min_ok_state_valid: int = 6
    min_ok_state_invalid: int = 8
    max_error_state_init: int = 1
    max_error_state_valid: int = 2
    max_error_state_invalid: int = 0
    clear_to_invalid: bool = True

    def of(self, state: str) -> tuple[int, int, int]:
        """Return the size of the window, the least OKs and the most errors in a state."""
        return {
            "VALID": (self.window_size_valid, self.min_ok_state_valid, self.max_error_state_valid),
            "INVALID": (
                self.window_size_invalid,
                self.min_ok_state_invalid,
                self.max_error_state_invalid,
            ),
        }.get(state, (self.window_size_init, self.min_ok_state_init, self.max_error_state_init))


def crc16(data: bytes) -> int:
    """Return CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF.

    >>> hex(crc16(b"123456789"))  # the published check value
    '0x29b1'
    """
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021) & 0xFFFF if crc & 0x8000 else crc << 1
    return crc


def checksum(record: bytes, offset: int, data_id: int) -> int:
    """Return the checksum over all bytes but its own two, then the data ID, low byte first."""
    return crc16(record[:offset] + record[offset + 2 :] + data_id.to_bytes(2, "little"))


def status_of(counter: int, last: int | None, most: int, modulus: int) -> str:
    """Return the status of a counter by the last one (E2E_P05Check); the first record is OK.

    >>> [status_of(counter, 254, 2, 256) for counter in (255, 0, 1, 254)]
    ['OK', 'OKSOMELOST', 'WRONGSEQUENCE', 'REPEATED']
    """
    ahead = 1 if last is None else (counter - last) % modulus
    if ahead <= 1:
        return "OK" if ahead == 1 else "REPEATED"
    return "OKSOMELOST" if ahead <= most else "WRONGSEQUENCE"


class StateMachine:
    """State by the last checks (E2E_SMCheck)."""

    def __init__(self, windows: Windows) -> None:
        self._windows = windows
        self._checks: deque[str] = deque()  # in the window, the last one at the end
        self.state = "NODATA"

    def step(self, status: str) -> None:
        """Add a check, and pass to the next state if it is time."""
        windows = self._windows
        if self.state == "NODATA":
            if status not in ("ERROR", "NONEWDATA"):
                self.state = "INIT"  # this check does not count
            return
        self._checks.append(status)
        size, least_oks, most_errors = windows.of(self.state)
        self._shorten(size)
        oks = sum(status in OKS for status in self._checks)
        errors = self._checks.count("ERROR")
        if errors <= most_errors and oks >= least_oks:
            self.state = "VALID"
        elif self.state == "VALID" or (self.state == "INIT" and errors > most_errors):
            if windows.clear_to_invalid:
                self.clear()
            self.state = "INVALID"
        self._shorten(windows.of(self.state)[0])

    def clear(self) -> None:
        """Clear the window: what it holds is of another sequence."""
        self._checks.clear()

    def _shorten(self, size: int) -> None:
        while len(self._checks) > size:
            self._checks.popleft()
