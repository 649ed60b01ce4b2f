"""Checksum, status of a counter and state machine of AUTOSAR E2E (PRS_E2EProtocol, profile 5)."""

from __future__ import annotations

from typing import NamedTuple

#: Statuses that count as OK in a window.
OKS = ("OK", "OKSOMELOST")
#: Names of the statuses of a check.
STATUSES = ("OK", "NONEWDATA", "ERROR", "REPEATED", "OKSOMELOST", "WRONGSEQUENCE")


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

    def of(self, name: str, state: str) -> int:
        """Return the bound of a state: INIT, VALID or INVALID."""
        return int(getattr(self, f"{name}_{state.lower()}"))


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
        self._checks = list[str]()  # in the window, the last one at the end
        self.state = "NODATA"

    def step(self, status: str) -> None:
        """Add a check, and pass to the next state if it is time."""
        if self.state == "NODATA":
            if status not in ("ERROR", "NONEWDATA"):
                self.state = "INIT"  # this check does not count
            return
        of, state = self._windows.of, self.state
        self._checks = [*self._checks, status][-of("window_size", state) :]
        oks, errors = sum(one in OKS for one in self._checks), self._checks.count("ERROR")
        has_errors = errors > of("max_error_state", state)
        if not has_errors and oks >= of("min_ok_state", state):
            self.state = "VALID"
        elif state == "VALID" or (state == "INIT" and has_errors):
            self.state = "INVALID"
            if self._windows.clear_to_invalid:
                self.clear()
        self._checks = self._checks[-of("window_size", self.state) :]

    def clear(self) -> None:
        """Clear the window: what it holds is of another sequence."""
        self._checks.clear()
